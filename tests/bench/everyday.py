"""Real robots: `sipe calibrate` beside a plain least-squares fit of the same parameters, each as a command of its own.

    python tests/bench/everyday.py [so101 rc_car rc_car_friction] [--out FOLDER]
    python tests/bench/everyday.py --thirds so101 --out FOLDER      # a folder that holds a run of it

A row is a held-out log: the error of one free simulation by the plain fit's code, with the plain estimate and with the
posterior mode of sipe. CPU and wall seconds are those of the whole commands.

``--thirds`` fits each third of the training logs by itself, and counts how many of the three modes of each gain and
damping lie in the 90 % intervals of the run of all data: in the plain ones, and in the discrepancy-aware ones.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
import re
import resource
import subprocess
import sys
import tempfile
import time
import tomllib
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType
from typing import NamedTuple

import numpy as np

from sipe_bayes.core.toml import to_toml

ROOT = Path(__file__).parents[2]


class Case(NamedTuple):
    """A configuration, the plain fit of its parameters, and the unit of the errors."""

    config: str
    options: tuple[str, ...]
    unit: str

    @property
    def plain(self) -> Path:
        return ROOT / "examples" / Path(self.config).parent / "plain_fit.py"


CASES = {
    "so101": Case("so101/calibrate.toml", (), "rad, five arm joints, first 30 s"),
    "rc_car": Case("rc_car/calibrate.toml", (), "m/s, whole log"),
    "rc_car_friction": Case("rc_car/calibrate_friction.toml", ("--friction",), "m/s, whole log"),
}


class Used(NamedTuple):
    """Seconds of a command: of the processor, on the clock, and until it printed a value of one of ``names``."""

    cpu: float
    wall: float
    first_estimate: float | None


def run(command: Sequence[str], names: Sequence[str] = ()) -> Used:
    """Run a Python command from the repository; raises RuntimeError with its output where it fails."""
    before, began, first, lines = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter(), None, []
    value = re.compile(rf"\b({'|'.join(map(re.escape, names))})\b\D*\d") if names else None
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "PYTHONUNBUFFERED": "1"}
    with subprocess.Popen(
        [sys.executable, *command],
        cwd=ROOT,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    ) as process:
        for line in process.stdout or ():
            lines.append(line)
            if first is None and value is not None and value.search(line):
                first = time.perf_counter() - began
    wall, after = time.perf_counter() - began, resource.getrusage(resource.RUSAGE_CHILDREN)
    if process.returncode:
        raise RuntimeError(f"{' '.join(command)}: exit code {process.returncode}\n{''.join(lines[-20:])}")
    return Used(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime, wall, first)


def load_plain(case: Case) -> ModuleType:
    spec = importlib.util.spec_from_file_location(f"plain_fit_{case.plain.parent.name}", case.plain)
    if spec is None or spec.loader is None:
        raise RuntimeError(f"{case.plain}: no such module")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def compare(name: str, out: Path) -> None:
    """Run both fits of a case into ``out`` and print its rows."""
    case, plain_file = CASES[name], out / f"{name}-plain.json"
    plain_used = run([str(case.plain), *case.options, "--out", str(plain_file)])
    plain = json.loads(plain_file.read_text(encoding="utf-8"))
    config = ROOT / "examples" / case.config
    command = ["-m", "sipe_bayes.cli.app", "calibrate", str(config), "--out", str(out / name)]
    used = run(command, list(plain["values"]))
    result = json.loads((out / name / "result.json").read_text(encoding="utf-8"))
    errors = load_plain(case).held_out_errors({row["name"]: row["mode"] for row in result["parameters"]})
    print(f"\n{name}: held-out RMSE ({case.unit})")
    print(f"{'log':<22}{'plain':>10}{'sipe':>10}{'ratio':>8}")
    for log, error in errors.items():
        print(f"{log:<22}{plain['errors'][log]:>10.4f}{error:>10.4f}{error / plain['errors'][log]:>8.2f}")
    for label, a, b in (("CPU s", plain_used.cpu, used.cpu), ("wall s", plain_used.wall, used.wall)):
        print(f"{label:<22}{a:>10.1f}{b:>10.1f}{b / a:>8.2f}")
    first = "none" if used.first_estimate is None else f"{used.first_estimate:.1f}"
    print(f"{'first estimate, s':<22}{'':>10}{first:>10}", flush=True)


def compare_thirds(name: str, out: Path) -> None:
    """Fit thirds of a case's training logs, and hold the modes against the intervals of the run in ``out``."""
    path = ROOT / "examples" / CASES[name].config
    config = tomllib.loads(path.read_text(encoding="utf-8"))
    whole = json.loads((out / name / "result.json").read_text(encoding="utf-8"))
    asked = [row for row in whole["parameters"] if re.search(r"_kp$|_damping$|_kv$", row["name"])]
    inside = {"plain": 0, "discrepancy-aware": 0}
    for part in range(3):
        cut = {**config, "model": str(path.parent / config["model"]), "logs": []}
        for log in config["logs"]:
            file = path.parent / log["file"]
            if log.get("use", "train") == "train":
                seconds = np.loadtxt(file, delimiter=",", skiprows=1, usecols=0)
                length = float(seconds[-1] - seconds[0]) / 3
                span = [round(part * length, 2), round((part + 1) * length, 2)]
                cut["logs"].append({**log, "file": str(file), "span": span})
        given = out / f"{name}-third-{part}.toml"
        given.write_text(to_toml(cut), encoding="utf-8")
        run(["-m", "sipe_bayes.cli.app", "calibrate", str(given), "--out", str(out / given.stem)])
        found = json.loads((out / given.stem / "result.json").read_text(encoding="utf-8"))
        modes = {row["name"]: row["mode"] for row in found["parameters"]}
        for row in asked:
            wide = row["further"] or (row["q05"], row["q95"])
            inside["plain"] += row["q05"] <= modes[row["name"]] <= row["q95"]
            inside["discrepancy-aware"] += wide[0] <= modes[row["name"]] <= wide[1]
    for kind, count in inside.items():
        print(f"{name}: {count} of {3 * len(asked)} modes of thirds lie in the {kind} 90 % intervals of all data")


def table(names: Sequence[str] = tuple(CASES), out: Path | None = None) -> None:
    """Compare each case; without ``out`` the runs are thrown away."""
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch) if out is None else out
        folder.mkdir(parents=True, exist_ok=True)
        for name in names:
            compare(name, folder)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", help=f"any of {', '.join(CASES)}; default all")
    parser.add_argument("--out", type=Path, help="a new folder that keeps the runs")
    parser.add_argument("--thirds", metavar="NAME", choices=CASES, help="hold fits of thirds against a kept run")
    given = parser.parse_args()
    if given.thirds:
        compare_thirds(given.thirds, given.out)
        return
    if wrong := set(given.names) - set(CASES):
        parser.error(f"expected names of {', '.join(CASES)}, got {', '.join(sorted(wrong))}")
    table(given.names or tuple(CASES), given.out)


if __name__ == "__main__":
    main()
