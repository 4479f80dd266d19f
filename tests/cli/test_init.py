"""Wrong input of `sipe init`, and what it asks: one line each, with the argument, the value and the remedy."""

import re
from collections.abc import Callable, Sequence
from pathlib import Path
from types import SimpleNamespace

import pandas as pd
import pytest
import typer
from typer.testing import CliRunner, Result

from sipe_bayes.cli import init as command
from sipe_bayes.cli.app import app
from tests.problems.swings import MODEL, contents, swing

EMPTY = ("csv", "txt", "npz", "json", "h5", "mat", "parquet", "mcap", "db3", "ulg")


def nothing(log: pd.DataFrame) -> pd.DataFrame:
    return log


def restarted(log: pd.DataFrame) -> pd.DataFrame:
    return log.assign(time=log["time"].where(log.index < 100, log["time"] - 0.5))


def bare(folder: Path) -> None:
    (folder / "bare.csv").write_text((folder / "log.csv").read_text().partition("\n")[2])


def called(folder: Path, words: str, log: pd.DataFrame) -> Result:
    (folder / "model.xml").write_text(MODEL)
    log.to_csv(folder / "log.csv", index=False)
    bare(folder)
    for suffix in EMPTY:
        (folder / f"empty.{suffix}").touch()
    return CliRunner().invoke(app, ["init", *words.split()])


# (arguments, change of the log, words of the one line)
WRONG: list[tuple[str, Callable[[pd.DataFrame], pd.DataFrame], str]] = [
    ("modl.xml log.csv", nothing, r"model: no file 'modl.xml'; give the path .*; did you mean 'model.xml'\?"),
    (
        "other.xml log.csv",
        nothing,
        r"model: no file 'other.xml'; give the path of an MJCF file, or the MJCF text itself",
    ),
    ("model.xml lag.csv", nothing, r"lag.csv: no such file; did you mean 'log.csv'\?"),
    *(
        (f"model.xml empty.{kind}", nothing, rf"empty.{kind}: holds no samples, the file is empty; .*")
        for kind in EMPTY
    ),
    (
        "model.xml log.csv",
        restarted,
        r"log.csv: the clock 'time' goes back 1 times, first in row 102 from 0.99 to 0.5; .*",
    ),
    (
        "model.xml log.csv",
        lambda log: log[::-1],
        r"log.csv: the clock 'time' goes back 300 times, .*; sort the rows, .*",
    ),
    ("model.xml bare.csv", nothing, r"bare.csv: the first line must name the columns, .*, or --columns t,q,\.\.\."),
    ("model.xml bare.csv --columns t,q", nothing, r"bare.csv: 2 names are given .*; it has 3: correct --columns .*"),
    (
        "model.xml log.csv --columns t,q",
        nothing,
        r"log.csv: 2 names are given .*; the file names .*: drop --columns .*",
    ),
    (
        "log.csv model.xml",
        nothing,
        r"log.csv: is a log, and the model comes first; exchange them: sipe init MODEL.xml .*",
    ),
    (". model.xml", nothing, r".: is a log, and the model comes first; .*"),
    (
        "model.xml log.csv --out no/such/a.toml",
        nothing,
        r"--out .*a.toml: the folder 'no/such' does not exist; make it.*",
    ),
    ("model.xml log.csv --out .", nothing, r"--out .: is a folder; give the name of a file: --out calibrate.toml"),
    ("model.xml log.csv --out log.csv", nothing, r"--out log.csv: exists already; give --force to overwrite it.*"),
    ("model.xml", nothing, r"expected a model and at least one log: sipe init MODEL.xml LOG\.\.\."),
]


@pytest.mark.parametrize(("words", "change", "line"), WRONG, ids=[words for words, _, _ in WRONG])
def test_wrong_input_is_one_line(
    words: str,
    change: Callable[[pd.DataFrame], pd.DataFrame],
    line: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    called(tmp_path, "", log := change(swing()))
    before = contents(tmp_path)
    result = called(tmp_path, words, log)
    assert (result.exit_code, result.stdout) == (2, "")
    assert re.fullmatch(f"sipe: {line}\n", result.stderr), result.stderr
    assert contents(tmp_path) == before


def asked(answers: Sequence[int | BaseException], folder: Path, monkeypatch: pytest.MonkeyPatch) -> Result:
    """A call on a terminal, where typer prompts for answers."""
    rest = iter(answers)

    def prompt(*_: object, **__: object) -> int:
        answer = next(rest)
        if isinstance(answer, int):
            return answer
        raise typer.Abort from answer  # as typer words the end of the input, and an interruption

    monkeypatch.chdir(folder)
    terminal = SimpleNamespace(isatty=lambda: True)
    monkeypatch.setattr(command, "sys", SimpleNamespace(stdin=terminal, stdout=terminal))
    monkeypatch.setattr(typer, "prompt", prompt)
    return called(folder, "model.xml log.csv", swing())


def test_an_answer_beyond_those_there_are(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    result = asked([7, 2], tmp_path, monkeypatch)
    assert "sign ambiguity: flipped together they fit equally well" in result.stdout
    assert "expected a number from 1 to 2, got 7" in result.stdout
    assert result.exit_code == 0
    assert (tmp_path / "calibrate.toml").read_text().count("\nsign = -1") == 2


@pytest.mark.parametrize(
    ("end", "code", "line"),
    [
        (EOFError(), 2, "no answer: the input ended, nothing is written; --yes keeps what is proposed"),
        (KeyboardInterrupt(), 130, "interrupted"),
    ],
)
def test_input_that_ends_at_a_question(
    end: BaseException, code: int, line: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    result = asked([end], tmp_path, monkeypatch)
    assert (result.exit_code, result.stderr) == (code, f"sipe: {line}\n")
    assert not (tmp_path / "calibrate.toml").exists()
