"""What a run of the benchmark refuses, and what it leaves alone."""

import errno
import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from sipe_bayes.benchmark import measure, measurement
from sipe_bayes.benchmark.cells import Cell
from sipe_bayes.benchmark.measure import ESTIMATES
from sipe_bayes.benchmark.records import Record
from sipe_bayes.core import files
from tests.problems.benchmarks import PENDULUM, TIMES, measured, refused, sipe, what_counts


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--suite", "paper", "--select", "fetch_pushh/npe"], ["fetch_pushh/npe", "did you mean 'FetchPush/npe"]),
        (["--suite", "paper", "--select", "Hopper/npe"], ["of the suite paper", "--suite all"]),
        (["--suite", "papers"], ["--suite papers", "quick"]),
        (["--jobs", "0", "--executor", "pool"], ["--jobs 0"]),
        (["--budget", "0"], ["--budget 0"]),
        (["--executor", "slurm"], ["slurm", "pool, ray or inline"]),
        (["--address", "10.0.0.1:6379"], ["goes with --executor ray"]),
        (["--executor", "ray", "--address", "127.0.0.1:1"], ["127.0.0.1:1: does not answer"]),
        (["--executor", "ray", "--address", "somewhere"], ["expected HOST:PORT"]),
        (["--out", "/dev/null"], ["is a file"]),
        (["--out", "/proc/sipe"], ["/proc/sipe"]),
    ],
)
def test_bad_input_is_one_line(arguments: list[str], words: list[str], tmp_path: Path) -> None:
    out = [] if "--out" in arguments else ["--out", str(tmp_path / "out")]
    chosen = [] if {"--suite", "--select"} & set(arguments) else ["--suite", "all", "--select", "pendulum/prior/direct"]
    refused(sipe("benchmark", "run", *chosen, *arguments, *out), *words)


@pytest.mark.parametrize("kind", ["benchmark", "transfer"])
def test_no_suite_is_no_suite(kind: str, tmp_path: Path) -> None:
    """None is run, or shown, by accident."""
    refused(sipe(kind, "run", "--out", str(tmp_path / "out")), "--suite", "quick")
    refused(sipe(kind, "cells", "--select", "Door"), "--select Door")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"budget": 61}, ["with budget 61 and not 60"]),
        ({"steps": 7}, ["with steps 7 and not 20"]),
        ({"versions": {**measurement.versions(), "mujoco": "3.9"}}, ["with versions mujoco 3.9 and not mujoco "]),
    ],
)
def test_results_of_another_kind_are_left_alone(
    changes: dict[str, Any], words: list[str], undisturbed: Path, tmp_path: Path
) -> None:
    other = replace(Record.all_in(undisturbed)[0], **changes)
    other.write(tmp_path)
    refused(measured(tmp_path, *PENDULUM), *words, "choose another folder")
    assert Record.all_in(tmp_path) == [other]


def test_read_only_folder(tmp_path: Path) -> None:
    """To root every folder can be written but those that are none."""
    tmp_path.chmod(0o500)
    folder = Path("/proc/self/task") if os.access(tmp_path, os.W_OK) else tmp_path
    before = sorted(p.name for p in tmp_path.iterdir())
    found = measured(folder, *PENDULUM)
    refused(found, f"sipe: {folder}", "choose another folder")
    assert any(why in found.stderr for why in ("denied", "not permitted", "no such file"))
    assert "Errno" not in found.stderr
    assert sorted(p.name for p in tmp_path.iterdir()) == before


def test_versions_of_cells_not_asked_for_count_too(undisturbed: Path, tmp_path: Path) -> None:
    """Tables would mix them."""
    other = replace(Record.all_in(undisturbed)[0], versions={**measurement.versions(), "mujoco": "3.9"})
    other.write(tmp_path)
    elsewhere = ["--select", "cartpole/prior/direct/default/seed0"]
    refused(measured(tmp_path, *elsewhere), "with versions mujoco 3.9", other.id, "choose another folder")


def test_a_folder_that_is_elsewhere(undisturbed: Path) -> None:
    """On a machine that does not see the folder of results a cell makes its simulations itself.

    The same result, their cost apart, and nothing left behind.
    """
    nowhere, cell = Path("/proc/nowhere"), replace(Cell("Pendulum", "regression"), budget=60, steps=20)
    done = ESTIMATES.run(cell, nowhere, "")
    assert not done.failed, done.line
    record = json.loads(done.files[1][1])
    assert record["simulation_cpu_seconds"] > 0
    same = {k: v for k, v in record.items() if k not in TIMES}
    assert (same, done.files[0][1]) == what_counts(undisturbed)[cell.id]


@pytest.mark.parametrize(("room_for", "kept"), [(0, 0), (3, 0), (12, 2), (13, 3)])
def test_full_disk_loses_nothing(
    room_for: int, kept: int, monkeypatch: pytest.MonkeyPatch, undisturbed: Path, tmp_path: Path
) -> None:
    """After some files, plan and times among them, there is no room.

    What is there is whole, and the same command goes on.
    """
    room, replacing = [room_for], files.replacing

    @contextmanager
    def full(path: Path) -> Iterator[Path]:
        with replacing(path) as temporary:
            yield temporary
            room[0] -= 1
            if room[0] < 0:
                raise OSError(errno.ENOSPC, "No space left on device", str(path))

    monkeypatch.setattr(files, "replacing", full)
    refused(measured(tmp_path, *PENDULUM), "no space left", "free some space")
    assert len(list(tmp_path.glob("records/P*.json"))) == kept
    assert not list(tmp_path.rglob(".*.[a-z]*"))  # no half-written file
    monkeypatch.setattr(files, "replacing", replacing)
    assert measured(tmp_path, *PENDULUM).exit_code == 0
    assert what_counts(tmp_path) == what_counts(undisturbed)


def test_a_cell_that_finds_the_disk_full_is_not_at_fault(
    monkeypatch: pytest.MonkeyPatch, undisturbed: Path, tmp_path: Path
) -> None:
    """However a library says it, no cell is recorded as failed, and the same command goes on."""
    for error in (
        OSError(errno.EFBIG, "File too large", "posterior.nc"),
        RuntimeError("I/O error: No space left on device (os error 28)"),
        RuntimeError("Unable to flush file (errno = 28, error message = 'No space left on device')"),
    ):

        def full(*_: object, error: Exception = error) -> bytes:
            raise error

        with monkeypatch.context() as patch:
            patch.setattr(measure, "netcdf", full)
            refused(measured(tmp_path, *PENDULUM), "free some space", "the same command goes on")
        assert not list(tmp_path.glob("records/P*.json"))
    assert measured(tmp_path, *PENDULUM).exit_code == 0
    assert what_counts(tmp_path) == what_counts(undisturbed)


def test_two_runs_at_once_are_refused(tmp_path: Path) -> None:
    with files.exclusive(tmp_path):
        refused(measured(tmp_path, *PENDULUM), "another run is at work")
