"""``sipe discover`` and ``sipe calibrate --discover``: twenty lines that end with an answer, JSON is JSON."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from sipe_bayes.cli.app import main
from sipe_bayes.cli.discover import counted
from tests.problems.lacking import write_lacking
from tests.problems.swings import strict_json


@pytest.fixture
def config(tmp_path: Path) -> Path:
    return write_lacking(tmp_path)


def told(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], *words: object) -> str:
    monkeypatch.setattr("sys.argv", ["sipe", *map(str, words)])
    with pytest.raises(SystemExit) as left:
        main()
    out, err = capsys.readouterr()
    assert left.value.code == 0, err
    return out


def test_ends_with_an_answer(config: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    out = config.parent / "out"
    lines = told(monkeypatch, capsys, "discover", config, "--threads", 1, "--out", out).splitlines()
    assert len(lines) <= 20
    answer = lines[-6:]
    words = ("The logs support dry friction at hinge, 0.1", "error falls to 0.", "passes for noise", "may be trusted")
    for line, word in zip(answer, words, strict=False):
        assert word in line
    assert answer[-2:] == [
        f"report: {out / 'report.html'}",
        f"next: sipe calibrate {out / 'discovered.toml'} (the model with these values: {out / 'discovered.xml'})",
    ]


def test_calibrates_and_then_discovers(
    config: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ("calibrate", config, "--discover", "--json", "--threads", 1, "--out", config.parent / "out")
    found = strict_json(told(monkeypatch, capsys, *words))
    assert found["misfit"]["p"] < 0.05
    assert [piece["label"] for piece in found["discovery"]["pieces"] if piece["kept"]] == ["dry_friction:hinge"]
    assert (Path(found["out"]) / "report.html").exists()
    assert Path(found["discovery"]["out"]) == Path(found["out"]) / "discover"
    assert (Path(found["out"]) / "discover" / "discovered.toml").exists()


def test_a_search_says_how_many_rollouts_it_took() -> None:
    shown = list[str]()
    says = counted(lambda what, _, __: shown.append(what))
    for done in (1200, 2000):
        says("fitting", done, 2000)
    assert shown == ["fitting; 1200 rollouts, at most 2000", "fitting"]


def words_of(config: Path) -> list[str]:
    return ["sipe", "discover", str(config), "--threads", "1", "--out", str(config.parent / "o")]


def interrupted(config: Path, during: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The command, which ends as what was interrupted does."""
    monkeypatch.setattr("sys.argv", words_of(config))
    monkeypatch.setattr(during, _interrupted)
    with pytest.raises(SystemExit) as left:
        main()
    assert left.value.code == 130


def test_an_interrupted_search_answers_with_what_it_has(
    config: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Dry friction is fitted and kept before the others are asked once more; report, table and model are written."""
    interrupted(config, "sipe_bayes.structure.search.StructureSearch._prune", monkeypatch)
    shown = capsys.readouterr().out
    assert "dry friction at hinge" in shown
    assert "the search ended when it was interrupted" in " ".join(shown.split())
    folder = config.parent / "o"
    assert {"report.html", "structures.json", "discovered.xml"} <= {file.name for file in folder.iterdir()}
    monkeypatch.undo()
    monkeypatch.setattr("sys.argv", words_of(config))
    with pytest.raises(SystemExit, match="0"):
        main()
    assert "when it was interrupted" not in capsys.readouterr().out


def test_who_interrupts_again_is_told_what_there_is(
    config: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    interrupted(config, "sipe_bayes.calibration.discover.summarise", monkeypatch)
    errors = capsys.readouterr().err
    size = r"\(joint:hinge.frictionloss 0.1\d* N m\)"
    assert re.search(
        rf"interrupted: \d+ structures fitted, the best so far dry_friction:hinge {size}, \d\d+ nats", errors
    )
    assert errors.rstrip().endswith("over the model as it was; the same command goes on")


def test_a_time_limit_ends_a_search_with_what_it_has(
    config: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """No time at all: the model as it is is fitted, nothing more."""
    monkeypatch.setattr("sys.argv", [*words_of(config), "--time-limit", "0"])
    with pytest.raises(SystemExit, match="0"):
        main()
    shown = " ".join(capsys.readouterr().out.split())
    assert "the search ended at its time limit before what the model may lack was ranked" in shown
    assert "give a longer --time-limit, and the same folder goes on" in shown


def _interrupted(*_: object) -> None:
    raise KeyboardInterrupt
