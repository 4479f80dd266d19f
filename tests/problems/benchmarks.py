"""What counts of a benchmark's folder, shared by the tests of runs and of executors."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from typer.testing import CliRunner, Result

from sipe_bayes.benchmark.bank import Bank
from sipe_bayes.benchmark.records import Record, posterior_path
from sipe_bayes.cli.app import app

TIMES = ("seconds", "cpu_seconds", "simulation_cpu_seconds", "command")
SMALL = ["--suite", "all", "--budget", "60", "--steps", "20"]
PENDULUM = [  # six cells, two of which share simulations
    *("--select", "pendulum/prior*/direct/in_distribution/seed0"),
    *("--select", "pendulum/simopt/direct/in_distribution"),
    *("--select", "pendulum/regression/direct/in_distribution/seed0"),
]
PENDULUM_BANK = Bank("Pendulum", "in_distribution", 0, 20)


def what_counts(folder: Path) -> dict[str, Any]:
    """Records without what they took, and the bytes of their posteriors."""
    found = {r.id: {k: v for k, v in json.loads(r.to_json()).items() if k not in TIMES} for r in Record.all_in(folder)}
    return {name: (record, posterior_path(folder, name).read_bytes()) for name, record in found.items()}


def sipe(*arguments: str) -> Result:
    """What the command does."""
    return CliRunner().invoke(app, list(arguments))


def measured(folder: Path, *arguments: str) -> Result:
    """A small run into a folder."""
    return sipe("benchmark", "run", *SMALL, *arguments, "--executor", "inline", "--out", str(folder))


def refused(found: Result, *words: str) -> None:
    """It ended with one line that holds these words."""
    assert found.exit_code == 2, found.output
    assert found.stderr.count("\n") == 1, found.stderr
    assert found.stderr.startswith("sipe: ")
    for word in words:
        assert word in found.stderr
