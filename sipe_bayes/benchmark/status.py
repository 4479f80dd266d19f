"""How far a folder of results is: counts, failures, and the time that went into it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from sipe_bayes.benchmark.records import Progress, Record, mixed
from sipe_bayes.benchmark.run_log import Run, Usage, by_suite, cpu_time, duration, percent, read_runs


@dataclass(frozen=True)
class Summary(Progress):
    """How far a folder is, and what it took.

    Args:
        mixed: groups of cells that do not compare.
        converged: by task and estimator, how many of the seeds with a policy solve their environment.
        cpu_time: in words.
        runs: each that was started.
        suites: what the runs of each suite took.
        all: what all took.
    """

    mixed: list[str]
    converged: dict[str, str]
    cpu_time: str
    runs: list[Run]
    suites: dict[str, Usage]
    all: Usage

    def to_dict(self) -> dict[str, object]:
        """As JSON has it."""
        return {**asdict(self), "runs": [{**asdict(run), **asdict(Usage.of([run]))} for run in self.runs]}

    def lines(self, named: int = 20, latest: int = 3) -> list[str]:
        """To be read."""
        text = [self.headline, *(f"failed: {cell}: {why}" for cell, why in self.failed.items())]
        text += [f"missing: {cell}" for cell in self.missing[:named]]
        if len(self.missing) > named:
            text.append(f"missing: {len(self.missing) - named} more")
        text += [
            f"mixed: {group}: its cells were given different logs; delete their records, and run again"
            for group in self.mixed
        ]
        text += [f"converged: {name}: {count} seeds" for name, count in self.converged.items()]
        if self.failed:
            text.append("the same command with --retry-failed measures those that failed again")
        if self.done:
            text.append(f"CPU time of these cells: {self.cpu_time}")
        text += [_one_run(run) for run in self.runs[-latest:]]
        if len(self.runs) > latest:
            text.append(f"and {len(self.runs) - latest} runs before; --json has them all")
        if len(self.runs) > 1:
            text += [f"{name}: {_time(usage)}" for name, usage in (*self.suites.items(), ("all runs", self.all))]
        return text


def summary(folder: Path) -> Summary:
    """Of a folder of results.

    Raises:
        RecordError: for one in which no run was started.
    """
    records, runs = Record.every(folder), read_runs(folder)
    return Summary(
        **vars(Progress.of(Record, records, folder)),
        mixed=mixed(records),
        converged=_converged(records),
        cpu_time=cpu_time(records),
        runs=runs,
        suites=by_suite(runs),
        all=Usage.of(runs),
    )


def _converged(records: Sequence[Record]) -> dict[str, str]:
    """By task and estimator: how many of the seeds with a policy solve their environment."""
    asked, solved = Counter[str](), Counter[str]()
    for record in records:
        if record.converged is not None:
            name = f"{record.task}/{record.estimator}/{record.setting}"
            asked[name] += 1
            solved[name] += record.converged
    return {name: f"{solved[name]} of {count}" for name, count in asked.items()}


def _one_run(run: Run) -> str:
    usage = Usage.of([run])
    share = f"CPU use {percent(usage.cpu_use)} of {run.workers} workers"
    return f"{run.started}: {run.units} units in {run.seconds:.0f} s, {share}{_simulating(usage)}: {run.command}"


def _time(usage: Usage) -> str:
    return f"{duration(usage.seconds)}, {duration(usage.cpu_seconds)} of CPU{_simulating(usage)}"


def _simulating(usage: Usage) -> str:
    share = usage.cpu_use_simulating
    if share is None:
        return ""
    return f", CPU use {percent(share)} while simulating ({duration(usage.simulating_seconds)})"
