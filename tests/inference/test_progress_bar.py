"""The progress bar: on a terminal and in a notebook, nowhere else."""

from __future__ import annotations

import io
import sys

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


def test_silence(monkeypatch: pytest.MonkeyPatch) -> None:
    assert shown(monkeypatch, io.StringIO()) == ""
    assert shown(monkeypatch, Terminal(), quiet=True) == ""


def test_notebook(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ipykernel", sys)
    assert "start 1 of 3:  25%" in shown(monkeypatch, io.StringIO())
