"""Runs that are killed, interrupted, left without disk or log, or started twice in one folder: `make faults`.

    python -m tests.fuzz.faults --command calibrate --times 10

Each fault happens at a moment drawn between the start of a command and the end of one that was left alone. After it the
same command runs again and must end with the same bits in what it leaves: posteriors, agents, models, records, JSON and
curves without their times. Two seconds after a fault no process of the command is left. A command that ends by itself
says why in one line of standard error.
"""

from __future__ import annotations

import argparse
import csv
import hashlib
import json
import os
import random
import re
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import uuid
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]
RESULT = ROOT / "examples" / "studies" / "results" / "faults.json"
MARK = "SIPE_FAULT"  # in the environment of a command and of all that it starts
ORPHANS = 2.0  # s after which none may be left
PATIENCE = 600.0
_TIMES = re.compile(r"seconds|started|command|versions|^out$|per_second|^checksums$|cpu_use")
_OUT = ("--out", "out")
_DIRECT = ["--select", "Pendulum/laplace/direct/in_distribution/seed[01]"]
_TRANSFER = ["--select", "Pendulum/laplace/transfer/in_distribution/seed0"]


@dataclass(frozen=True)
class Command:
    """A command with a tiny case.

    Args:
        words: of ``sipe``.
        again: words more of the run that goes on.
        results: patterns of the files whose bits must be the same.
        log: a file that may be taken away.
    """

    words: Sequence[str]
    results: Sequence[str]
    again: Sequence[str] = ()
    log: str = ""


COMMANDS = {
    "calibrate": Command(
        ["calibrate", "config.toml", "--out", "out", "--threads", "1"],
        ["out/posterior.safetensors", "out/posterior.json", "out/identified.xml", "out/result.json"],
        log="log.csv",
    ),
    "discover": Command(
        ["discover", "config.toml", "--out", "out", "--budget", "1500", "--threads", "1", "--only", "dry_friction"],
        ["out/**/posterior.safetensors", "out/**/*.xml", "out/*.json", "out/*.toml"],
        log="log.csv",
    ),
    "train": Command(
        [
            *("train", "Pendulum", "--steps", "600", "--start-steps", "100", "--hidden", "8,8", "--out", "out"),
            *("--evaluate-every", "200", "--evaluation-episodes", "2", "--checkpoint-every", "100", "--episodes", "2"),
        ],
        ["out/expert.*", "out/suboptimal.*", "out/curve.csv", "out/counts.json"],
        again=["--resume"],
    ),
    "benchmark": Command(
        [
            "benchmark",
            "run",
            "--suite",
            "all",
            *_DIRECT,
            "--budget",
            "60",
            "--steps",
            "30",
            "--jobs",
            "2",
            "--out",
            "out",
        ],
        ["out/records/*.json", "out/plan.json"],
    ),
    "transfer": Command(
        [
            *(
                "transfer",
                "run",
                "--suite",
                "quick",
                *_TRANSFER,
                "--training",
                "400",
                "--budget",
                "60",
                "--steps",
                "30",
            ),
            *("--jobs", "2", "--out", "out"),
        ],
        ["out/records/*.json", "out/transfer/records/*.json"],
    ),
}


@dataclass
class Report:
    """What a fault came to; nothing wrong where all is well."""

    fault: str
    line: str = ""
    wrong: list[str] = field(default_factory=list)


class Case:
    """A command's folders and how it runs."""

    def __init__(self, command: Command, folder: Path) -> None:
        from tests.problems.swings import write_case

        self.command, self.folder, self.count = command, folder, 0
        write_case(folder / "sound")
        began = time.monotonic()
        process = self.start(self.fresh())
        _, errors = process.communicate(timeout=PATIENCE)
        self.seconds = time.monotonic() - began
        self.expected = self.digests(self.place)
        if process.returncode or not self.expected:
            raise RuntimeError(f"undisturbed it ends with exit code {process.returncode}: {errors[-500:]}")

    def fresh(self) -> Path:
        """A new folder with the sound files, of the same name as the others: runs are called after it."""
        self.count += 1
        self.place = self.folder / f"run{self.count}" / "case"
        shutil.copytree(self.folder / "sound", self.place)
        return self.place

    def start(self, place: Path, again: bool = False, most: int | None = None) -> subprocess.Popen[str]:
        """The command, in a session of its own; most bytes of any file that it writes."""
        self.mark = uuid.uuid4().hex
        environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1", MARK: self.mark}
        words = [
            sys.executable,
            "-m",
            "sipe_bayes.cli.app",
            *self.command.words,
            *(self.command.again if again else ()),
        ]
        return subprocess.Popen(
            words,
            cwd=place,
            env=environment,
            text=True,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            start_new_session=True,
            preexec_fn=None if most is None else lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (most, most)),
        )

    def orphans(self) -> list[int]:
        """Processes of the last command that are still there."""
        processes = []
        for entry in Path("/proc").glob("[0-9]*"):
            try:
                if f"{MARK}={self.mark}".encode() in (entry / "environ").read_bytes():
                    processes.append(int(entry.name))
            except OSError:
                continue
        return processes

    def digests(self, place: Path) -> dict[str, str]:
        """Of each result, without its times."""
        files = {path for pattern in self.command.results for path in place.glob(pattern)}
        return {str(path.relative_to(place)): digest(path) for path in sorted(files)}

    def settle(self, report: Report, again: bool) -> Report:
        """See that nothing is left running, and that the same command ends as if nothing had happened."""
        deadline = time.monotonic() + ORPHANS
        while (left := self.orphans()) and time.monotonic() < deadline:
            time.sleep(0.05)
        if left:
            report.wrong.append(f"{len(left)} processes live on after {ORPHANS:g} s")
            for process in left:
                os.kill(process, signal.SIGKILL)
        process = self.start(self.place, again)
        _, errors = process.communicate(timeout=PATIENCE)
        if process.returncode:
            report.wrong.append(f"the run after it ends with exit code {process.returncode}: {errors.strip()[-300:]}")
        elif self.digests(self.place) != self.expected:
            now = self.digests(self.place)
            differing = [k for k in {*now, *self.expected} if now.get(k) != self.expected.get(k)]
            report.wrong.append(f"other bits in {', '.join(sorted(differing))}")
        return report

    def by_signal(self, chance: random.Random, number: signal.Signals) -> Report:
        """A signal to the command's own process, not to its workers."""
        report = Report(number.name)
        process = self.start(self.fresh())
        time.sleep(chance.uniform(0.05, 0.95) * self.seconds)
        process.send_signal(number)
        _, errors = process.communicate(timeout=PATIENCE)
        begun, whole = (self.place / "out").is_dir(), self.digests(self.place) == self.expected
        if process.returncode == -number and not errors.strip() and (whole or not begun):
            report.line = "after its end" if whole else "before its start"
        elif number != signal.SIGKILL and process.returncode:
            check_line(report, errors, "interrupted")
        return self.settle(report, again=(self.place / "out").is_dir())

    def full_disk(self, chance: random.Random) -> Report:
        """No file may have more than some bytes."""
        most = chance.choice([0, 500, 4_000, 20_000])
        report = Report(f"files of at most {most} bytes")
        process = self.start(self.fresh(), most=most)
        _, errors = process.communicate(timeout=PATIENCE)
        if process.returncode:
            check_line(report, errors, ";")
        return self.settle(report, again=(self.place / "out").is_dir())

    def no_log(self, chance: random.Random) -> Report:
        """The log is gone when the command comes back, and is there again after that."""
        report = Report("log taken away")
        process = self.start(self.fresh())
        time.sleep(chance.uniform(0.2, 0.9) * self.seconds)
        process.kill()
        process.wait()
        log = self.place / self.command.log
        kept = log.read_bytes()
        log.unlink()
        process = self.start(self.place, again=True)
        _, errors = process.communicate(timeout=PATIENCE)
        if process.returncode != 2:
            report.wrong.append(f"without its log it ends with exit code {process.returncode}")
        check_line(report, errors, "no such file")
        log.write_bytes(kept)
        return self.settle(report, again=True)

    def two_at_once(self, chance: random.Random) -> Report:
        """The same command twice in one folder."""
        report = Report("two at once")
        place = self.fresh()
        one = self.start(place)
        time.sleep(chance.uniform(0.0, 0.5) * self.seconds)
        other = self.start(place, again=bool(self.command.again))
        for process in (one, other):
            _, errors = process.communicate(timeout=PATIENCE)
            if process.returncode:
                check_line(report, errors, ";")
        return self.settle(report, again=True)


def check_line(report: Report, errors: str, word: str) -> None:
    """One line that begins with the command's name; progress on standard error is drawn over itself."""
    lines = [line for line in re.split(r"[\r\n]", errors) if line.startswith("sipe: ")]
    report.line = lines[-1] if lines else ""
    if "Traceback" in errors or not lines or word not in lines[-1]:
        report.wrong.append(f"no line with {word!r}: {errors.strip()[-400:]!r}")


def digest(path: Path) -> str:
    if path.suffix == ".json":
        content = json.dumps(_timeless(json.loads(path.read_text(encoding="utf-8"))), sort_keys=True).encode()
    elif path.suffix == ".csv":
        with path.open(encoding="utf-8", newline="") as file:
            content = json.dumps([_timeless(row) for row in csv.DictReader(file)]).encode()
    else:
        content = path.read_bytes()
    return hashlib.sha256(content).hexdigest()


def _timeless(plain: Any) -> Any:
    if isinstance(plain, dict):
        return {key: _timeless(value) for key, value in plain.items() if not _TIMES.search(key)}
    return [_timeless(value) for value in plain] if isinstance(plain, list) else plain


def faults(case: Case, times: int, seed: int = 0) -> list[Report]:
    """As many of each kind of fault."""
    chance, reports = random.Random(seed), []
    kinds: list[Callable[[], Report]] = []
    for k in range(times):
        kinds += [lambda: case.by_signal(chance, signal.SIGKILL)]
        kinds += [lambda: case.by_signal(chance, signal.SIGTERM)] if k % 3 == 1 or times == 1 else []
        kinds += [lambda: case.by_signal(chance, signal.SIGINT)] if k % 3 == 2 or times == 1 else []
        kinds += [lambda: case.full_disk(chance)] if k % 3 == 0 else []
        kinds += [lambda: case.two_at_once(chance)] if k == 0 else []
        kinds += [lambda: case.no_log(chance)] if k == 0 and case.command.log else []
    for fault in kinds:
        report = fault()
        reports.append(report)
        print(f"  {report.fault}: {'; '.join(report.wrong) or 'same bits'} [{report.line}]", flush=True)
    return reports


def counted(reports: Sequence[Report]) -> dict[str, dict[str, int]]:
    """How many of each kind of fault there were, and how many of them left something wrong."""
    kinds = ["full disk" if report.fault.startswith("files of") else report.fault for report in reports]
    failures = [kind for kind, report in zip(kinds, reports, strict=True) if report.wrong]
    return {kind: {"faults": kinds.count(kind), "wrong": failures.count(kind)} for kind in dict.fromkeys(kinds)}


def main() -> int:
    """Print a line for each fault; exit code 1 where something is wrong."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--command", action="append", choices=list(COMMANDS), help="again for several; default all")
    parser.add_argument("--times", type=int, default=10, help="kills of each command, with the other faults among them")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=RESULT, help="counts of each command, beside those of others")
    given = parser.parse_args()
    wrong, counts = 0, json.loads(given.out.read_text(encoding="utf-8")) if given.out.is_file() else {}
    for name in given.command or COMMANDS:
        with tempfile.TemporaryDirectory(prefix="sipe-faults-") as folder:
            case = Case(COMMANDS[name], Path(folder))
            print(f"{name}: {case.seconds:.0f} s undisturbed, {len(case.expected)} results", flush=True)
            reports = faults(case, given.times, given.seed)
        counts[name] = counted(reports)
        given.out.write_text(json.dumps(counts, indent=1) + "\n", encoding="utf-8")
        wrong += sum(bool(report.wrong) for report in reports)
    print(f"{wrong} wrong")
    return bool(wrong)


if __name__ == "__main__":
    sys.exit(main())
