"""The progress bar: on a terminal and in a notebook; lines elsewhere, one every 15 s."""

from __future__ import annotations

import io
import sys
import time

import pytest

import sipe_bayes as sipe


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def shown(monkeypatch: pytest.MonkeyPatch, stream: io.StringIO, quiet: bool = False) -> str:
    monkeypatch.setattr(sys, "stderr", stream)
    with sipe.ProgressBar(quiet=quiet) as progress:
        progress("start 1 of 3", 20, 80)
        progress("done", 90, 80)
    return stream.getvalue()


def test_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    text = shown(monkeypatch, Terminal())
    assert "start 1 of 3:  25%" in text
    assert "20/80" in text
    assert "done: 100%" in text


class Clock:
    """Time that passes as a test has it."""

    def __init__(self) -> None:
        self.now = 1000.0

    def monotonic(self) -> float:
        return self.now


def lines(monkeypatch: pytest.MonkeyPatch, quiet: bool = False, counted: bool = True) -> list[str]:
    """What is printed of a call every four seconds to 40 of 100, then of two after the fit, to no terminal."""
    clock, stream = Clock(), io.StringIO()
    monkeypatch.setattr(sys, "stderr", stream)
    monkeypatch.setattr("sipe_bayes.inference.progress_bar.time", clock)
    with sipe.ProgressBar(quiet=quiet, counted=counted) as progress:
        for done in range(0, 50, 10):
            progress(f"step {done}", done, 100)
            clock.now += 4
        for _ in range(2):
            clock.now += 14
            progress("checking", 40, 40)
    return stream.getvalue().splitlines()


def test_lines(monkeypatch: pytest.MonkeyPatch) -> None:
    fit, checks = "16 s: step 40; 40 of about 100 rollouts", "34 s: checking"
    assert lines(monkeypatch) == [f"{fit}, about 24 s left", checks]
    assert lines(monkeypatch, counted=False) == ["16 s: step 40", checks]


def test_a_count_of_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    """What an earlier run did tells nothing of this one's speed, nor what came before another count."""
    clock, stream = Clock(), io.StringIO()
    monkeypatch.setattr(sys, "stderr", stream)
    monkeypatch.setattr("sipe_bayes.inference.progress_bar.time", clock)
    with sipe.ProgressBar() as progress:
        for done, total in ((800, 1000), (850, 1000), (0, 500), (50, 500)):
            progress("fitting", done, total)
            clock.now += 15
    first, _, second = stream.getvalue().splitlines()
    assert first.endswith("850 of about 1000 rollouts, about 45 s left")
    assert second.endswith("50 of about 500 rollouts, about 2 min left")


def test_lines_come_while_nothing_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of one long piece of work, as long as it lasts and no longer."""
    stream = io.StringIO()
    monkeypatch.setattr(sys, "stderr", stream)
    monkeypatch.setattr("sipe_bayes.inference.progress_bar._SECONDS", 0.05)
    monkeypatch.setattr("sipe_bayes.inference.progress_bar._CHECKED", 0.01)
    with sipe.ProgressBar() as progress:
        progress("long work", 3, 8)
        deadline = time.monotonic() + 30
        while stream.getvalue().count("long work; 3 of about 8 rollouts") < 3 and time.monotonic() < deadline:
            time.sleep(0.01)
    printed = stream.getvalue()
    assert printed.count("long work; 3 of about 8 rollouts") >= 3
    time.sleep(0.2)
    assert stream.getvalue() == printed


def test_silence(monkeypatch: pytest.MonkeyPatch) -> None:
    assert shown(monkeypatch, io.StringIO()) == ""  # what takes no 15 s
    assert shown(monkeypatch, Terminal(), quiet=True) == ""
    assert lines(monkeypatch, quiet=True) == []


def test_notebook(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ipykernel", sys)
    assert "start 1 of 3:  25%" in shown(monkeypatch, io.StringIO())


def test_a_total_that_shrinks_is_the_same_count(monkeypatch: pytest.MonkeyPatch) -> None:
    clock, stream = Clock(), io.StringIO()
    monkeypatch.setattr(sys, "stderr", stream)
    monkeypatch.setattr("sipe_bayes.inference.progress_bar.time", clock)
    with sipe.ProgressBar() as progress:
        for done, total in ((0, 300), (100, 300), (200, 250), (250, 250)):
            progress("fitting", done, total)
            clock.now += 15
    first, second, last = stream.getvalue().splitlines()
    assert first.endswith("100 of about 300 rollouts, about 30 s left")
    assert second.endswith("200 of about 250 rollouts, about 8 s left")
    assert last == "45 s: fitting"
