"""What `make faults` relies on: how an interrupted command and a full disk end, and that it sees what is wrong."""

from __future__ import annotations

import errno
import json
import os
import signal
import sys
import tempfile
import time
from pathlib import Path

import pytest

from sipe_bayes.cli.app import main
from sipe_bayes.core.files import replacing, scratch, write_text
from tests.fuzz.faults import COMMANDS, Case, Report, check_line, digest
from tests.problems.swings import write_case


@pytest.mark.parametrize("begun", [False, True])
def test_an_interruption_that_a_native_module_words_otherwise(
    begun: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """pybind11 makes an ImportError of what interrupts the import of its modules."""

    def stop(*_: object, **__: object) -> None:
        try:
            raise KeyboardInterrupt
        except KeyboardInterrupt as error:
            raise ImportError("initialization failed") from error

    if begun:
        from sipe_bayes.calibration import run

        monkeypatch.setattr(run, "run", stop)
    else:
        slow = type("Slow", (), {"__getattr__": stop})()
        monkeypatch.setitem(sys.modules, "sipe_bayes.calibration.discover", slow)
    monkeypatch.setattr(sys, "argv", ["sipe", "calibrate", str(write_case(tmp_path))])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 130
    assert capsys.readouterr().err.count("sipe: interrupted; the same command ") == 1


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("begun", [False, True])
def test_an_interrupted_command_says_so_once(
    number: signal.Signals,
    begun: bool,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """In its work, and while it still loads."""
    from sipe_bayes.calibration import run

    def stop(*_: object, **__: object) -> None:
        os.kill(os.getpid(), number)
        for _ in range(3000):  # any thread may be given the signal, so that a pause of this one might never end
            time.sleep(0.01)

    if begun:
        monkeypatch.setattr(run, "run", stop)
    else:
        slow = type("Slow", (), {"__getattr__": stop})()
        monkeypatch.setitem(sys.modules, "sipe_bayes.calibration.discover", slow)
    monkeypatch.setattr(sys, "argv", ["sipe", "calibrate", str(write_case(tmp_path))])
    before = signal.getsignal(signal.SIGTERM)
    ignored = signal.signal(signal.SIGINT, signal.default_int_handler)  # as a shell's job in the background has it
    with pytest.raises(SystemExit) as ended:
        main()
    signal.signal(signal.SIGINT, ignored)
    assert ended.value.code == 130
    errors = capsys.readouterr().err
    assert errors.count("sipe: interrupted; the same command ") == 1
    assert ("goes on" if begun else "begins again") in errors
    assert signal.getsignal(signal.SIGTERM) == before


def test_a_full_disk_names_the_file(tmp_path: Path) -> None:
    (tmp_path / "x.json").write_text("old")
    with pytest.raises(OSError, match=r"x\.json") as caught, replacing(tmp_path / "x.json"):
        raise OSError(errno.ENOSPC, "No space left on device")
    assert (caught.value.errno, caught.value.filename) == (errno.ENOSPC, str(tmp_path / "x.json"))
    assert [(file.name, file.read_text()) for file in tmp_path.iterdir()] == [("x.json", "old")]


def test_no_room_for_a_temporary_folder_is_a_full_disk(monkeypatch: pytest.MonkeyPatch) -> None:
    def none() -> None:
        raise FileNotFoundError(errno.ENOENT, "No usable temporary directory found")

    monkeypatch.setattr(tempfile, "TemporaryDirectory", none)
    with pytest.raises(OSError, match="TMPDIR") as caught, scratch():
        pass
    assert caught.value.errno == errno.ENOSPC


def test_times_are_no_bits(tmp_path: Path) -> None:
    write_text(tmp_path / "a.json", json.dumps({"mean": [0.5], "seconds": 1.0}))
    first = digest(tmp_path / "a.json")
    write_text(tmp_path / "a.json", json.dumps({"mean": [0.5], "seconds": 2.0}))
    assert digest(tmp_path / "a.json") == first
    write_text(tmp_path / "a.json", json.dumps({"mean": [0.50001], "seconds": 2.0}))
    assert digest(tmp_path / "a.json") != first


@pytest.mark.parametrize(
    ("errors", "wrong"),
    [("sipe: interrupted; again\n", 0), ("", 1), ("Traceback\nsipe: interrupted\n", 1), ("sipe: done\n", 1)],
)
def test_the_line_is_looked_for(errors: str, wrong: int) -> None:
    report = Report("SIGINT")
    check_line(report, errors, "interrupted")
    assert len(report.wrong) == wrong


def test_a_process_that_lives_on_is_found() -> None:
    case = Case.__new__(Case)
    case.command, case.mark = COMMANDS["calibrate"], "none of them"
    assert case.orphans() == []
