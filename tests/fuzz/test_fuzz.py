"""A short run of `make fuzz`, what once broke, and that the harness sees what is wrong."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

import pytest

from sipe_bayes.core.files import MODEL_GIB, MODEL_SECONDS, TRUST_MODELS, FileError
from tests.fuzz import run
from tests.fuzz.commands import FIRST, commands
from tests.fuzz.corpus import CORPUS, read
from tests.fuzz.run import Outcome, Player, targets

SEEDS = 6  # of each target; `make fuzz` has 100,000


@pytest.fixture(autouse=True)
def _limits(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(TRUST_MODELS)
    monkeypatch.setenv(MODEL_SECONDS, "1")
    monkeypatch.setenv(MODEL_GIB, "2")


@pytest.fixture(scope="module")
def player(tmp_path_factory: pytest.TempPathFactory) -> Player:
    return Player(tmp_path_factory.mktemp("fuzz"))


@pytest.mark.parametrize("target", targets())
def test_changed_input_gives_a_result_or_one_line(target: str, player: Player) -> None:
    wrong = [
        outcome for seed in range(2 if target == "model" else SEEDS) if (outcome := player.play(target, seed)).wrong
    ]
    assert not wrong


@pytest.mark.parametrize("file", CORPUS, ids=lambda file: f"{file.parent.name}/{file.name}")
def test_what_once_broke_is_one_line(file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ValueError) as caught:  # noqa: PT011 (each reader has its own words)
        read(file, tmp_path)
    text = str(caught.value)
    assert type(caught.value).__module__.startswith("sipe_bayes"), "a line of a library's"
    assert "\n" not in text
    assert file.stem in text
    assert "; " in text, "no remedy"


def test_every_command_is_fuzzed() -> None:
    assert set(FIRST) == set(commands())


def planted(what: Callable[[], object], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Outcome:
    tmp_path.mkdir(exist_ok=True)
    known = {"planted": (lambda folder: lambda chance: what, 1)}
    monkeypatch.setattr(run, "targets", lambda: known)
    return Player(tmp_path).play("planted", 0)


def failing(error: BaseException) -> Callable[[], object]:
    def read() -> object:
        raise error

    return read


@pytest.mark.parametrize(
    ("error", "wrong"),
    [
        (FileError("planted.json: cannot be read; write it anew"), "names nothing"),
        (FileError("log 'planted': cannot be read; write it anew"), ""),
        (ValueError("log 'planted': two\nlines"), "not one line"),
        (KeyError("cells"), "KeyError"),
        (MemoryError(), "MemoryError"),
        (AssertionError("exit code 3"), "AssertionError"),
    ],
)
def test_the_harness_sees_what_is_wrong(
    error: BaseException, wrong: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    outcome = planted(failing(error), tmp_path, monkeypatch)
    assert wrong in outcome.wrong
    assert bool(wrong) == bool(outcome.wrong)


def test_the_harness_sees_what_takes_long_or_much(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(run, "PATIENCE", 0.2)
    assert "longer than" in planted(lambda: time.sleep(2), tmp_path, monkeypatch).wrong
    assert "MemoryError" in planted(lambda: bytearray(3 * 2**30), tmp_path / "b", monkeypatch).wrong
