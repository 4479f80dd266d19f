"""What it took: ``runs.json``, each run in a folder of results, and what its records and runs come to.

How each estimate went, look by look, stands in ``looks.csv`` and in a TensorBoard log.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import asdict, astuple, dataclass, fields, replace
from pathlib import Path

from pydantic import TypeAdapter

from sipe_bayes.benchmark.records import Look, Record
from sipe_bayes.core.files import OutputError, read_json, reading, to_json, write_text
from sipe_bayes.rl.train import write_table

RUNS, LOOKS = "runs.json", "looks.csv"
_OTHER_COMMANDS = {"simulate": "sipe simulate", "transfer": "sipe transfer"}


@dataclass(frozen=True)
class Took:
    """Seconds of the clock, and of all CPUs."""

    seconds: float = 0.0
    cpu_seconds: float = 0.0


@dataclass(frozen=True)
class Run:
    """What one run took.

    Args:
        command: that started it.
        started: when, UTC.
        workers: processes.
        units: of work that were done.
        seconds: of the clock.
        cpu_seconds: of all CPUs.
        simulating: what its simulations alone took.
    """

    command: str
    started: str = ""
    workers: int = 1
    units: int = 0
    seconds: float = 0.0
    cpu_seconds: float = 0.0
    simulating: Took = Took()

    def and_unit(self, seconds: float, cpu_seconds: float, simulation: bool) -> Run:
        """The run with one unit more.

        Args:
            seconds: since the run began.
            cpu_seconds: of the unit.
            simulation: whether the unit is one that other units wait for.
        """
        simulating = Took(seconds, self.simulating.cpu_seconds + cpu_seconds) if simulation else self.simulating
        cpu = self.cpu_seconds + cpu_seconds
        return replace(self, units=self.units + 1, seconds=seconds, cpu_seconds=cpu, simulating=simulating)


@dataclass(frozen=True)
class Usage:
    """Runs as one: sums, and the shares of their workers' time in which they computed; None where there was nothing.

    Args:
        seconds: of the clock.
        cpu_seconds: of all CPUs.
        workers: the most that any had.
        simulating_seconds: of the clock, in simulations.
        cpu_use: share over all the time.
        cpu_use_simulating: share over the simulations.
    """

    seconds: float
    cpu_seconds: float
    workers: int
    simulating_seconds: float
    cpu_use: float | None
    cpu_use_simulating: float | None

    @classmethod
    def of(cls, runs: Iterable[Run]) -> Usage:
        """Of several runs together."""
        runs = list(runs)
        return cls(
            seconds=sum(run.seconds for run in runs),
            cpu_seconds=sum(run.cpu_seconds for run in runs),
            workers=max((run.workers for run in runs), default=0),
            simulating_seconds=sum(run.simulating.seconds for run in runs),
            cpu_use=_share((run, run.workers) for run in runs),
            cpu_use_simulating=_share((run.simulating, run.workers) for run in runs),
        )


def _share(rows: Iterable[tuple[Run | Took, int]]) -> float | None:
    rows = list(rows)
    whole = sum(took.seconds * workers for took, workers in rows)
    return sum(took.cpu_seconds for took, _ in rows) / whole if whole else None


def read_runs(folder: Path) -> list[Run]:
    """What each run in a folder of results took; none where nothing was run.

    Raises:
        OutputError: for a file that cannot be read.
    """
    path = folder / RUNS
    if not path.is_file():
        return []
    plain = read_json(path, "what runs took", "delete it", OutputError)
    with reading(path, "what runs took", "delete it", OutputError):
        return TypeAdapter(list[Run]).validate_python(plain["runs"])


def write_runs(folder: Path, runs: Sequence[Run]) -> None:
    """Keep what each run took."""
    write_text(folder / RUNS, to_json({"runs": [asdict(run) for run in runs]}, indent=0) + "\n")


def write_looks(folder: Path) -> tuple[Path, Path]:
    """Write how each estimate of a folder of results went, over its rollouts.

    Returns:
        looks.csv, a row for each look of each cell, and the folder of the TensorBoard logs, one for each cell.
    """
    from torch.utils.tensorboard import SummaryWriter

    table, logs = folder / LOOKS, folder / "tensorboard"
    of_cell = ("id", "task", "estimator", "setting", "variant", "seed")
    of_look = [field.name for field in fields(Look)]
    records = [record for record in Record.every(folder) if record.done]
    rows = [[getattr(r, name) for name in of_cell] + list(astuple(look)) for r in records for look in r.history]
    write_table(table, [*of_cell, *of_look], rows)
    for record in records:
        own = logs / record.id.replace("/", "__")
        if not own.is_dir():
            with SummaryWriter(own) as writer:
                for look in record.history:
                    for name in of_look[1:]:
                        if (value := getattr(look, name)) is not None:
                            writer.add_scalar(f"{record.task} {record.variant}/{name}", value, look.rollouts)
    return table, logs


def by_suite(runs: Iterable[Run]) -> dict[str, Usage]:
    """Usage of each suite's runs."""
    groups: dict[str, list[Run]] = {}
    for run in runs:
        groups.setdefault(suite_of(run.command), []).append(run)
    return {name: Usage.of(group) for name, group in groups.items()}


def suite_of(command: str) -> str:
    """The suite that a command asks for."""
    words = command.split()
    if len(words) > 1 and words[1] in _OTHER_COMMANDS:
        return _OTHER_COMMANDS[words[1]]
    named = re.search(r"--suite[ =](\S+)", command)
    return named[1] if named else "paper" if words else "from Python"


def cpu_time(records: Sequence[Record]) -> str:
    """What the cells that are there took, by setting; simulations that several of them share are counted once."""
    method, shared = dict[str, float](), dict[tuple[str, str, int, int], float]()
    for r in records:
        method[r.setting] = method.get(r.setting, 0.0) + (r.cpu_seconds or 0.0)
        bank = (r.task, r.variant, r.seed, r.steps)
        shared[bank] = max(shared.get(bank, 0.0), r.simulation_cpu_seconds)
    parts = ", ".join(f"{name} {duration(seconds)}" for name, seconds in method.items())
    simulations, untimed = duration(sum(shared.values())), sum(r.done and r.cpu_seconds is None for r in records)
    text = f"{duration(sum(method.values()))} for the methods ({parts}), {simulations} for shared simulations"
    return f"{text}; {untimed} cells that went on after an interruption are not timed" if untimed else text


def percent(share: float | None) -> str:
    """A share in words."""
    return "?" if share is None else f"{share:.0%}"


def duration(seconds: float) -> str:
    """In the unit that suits it."""
    if seconds >= 3600:
        return f"{seconds / 3600:.1f} h"
    return f"{seconds / 60:.1f} min" if seconds >= 60 else f"{seconds:.1f} s"
