"""What it took: ``runs.json``, each run in a folder of results, and what its records and runs come to."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from sipe_bayes.benchmark.records import Record
from sipe_bayes.core.files import OutputError, to_json, write_text

LOG = "runs.json"
_ELSEWHERE = {"simulate": "sipe simulate", "transfer": "sipe transfer"}


def runs(folder: Path) -> list[dict[str, Any]]:
    """What each run in a folder of results took: command, started, workers, units, seconds, cpu_seconds, and of its simulations
    alone ``simulating``."""
    path = folder / LOG
    try:
        found: list[dict[str, Any]] = json.loads(path.read_text(encoding="utf-8"))["runs"] if path.is_file() else []
    except (ValueError, KeyError) as error:
        raise OutputError(f"{path}: cannot be read ({error}); delete it") from None
    return found


def keep(folder: Path, rows: list[dict[str, Any]]) -> None:
    write_text(folder / LOG, to_json({"runs": rows}, indent=0) + "\n")


def together(rows: Iterable[dict[str, Any]]) -> dict[str, Any]:
    """Runs as one: sums, and the shares of their workers' time in which they computed, over all of it (cpu_use) and over their
    simulations (cpu_use_simulating); None where there was nothing."""
    rows = list(rows)
    simulating = [{**row["simulating"], "workers": row["workers"]} for row in rows]
    return {
        "seconds": sum(row["seconds"] for row in rows),
        "cpu_seconds": sum(row["cpu_seconds"] for row in rows),
        "workers": max((row["workers"] for row in rows), default=0),
        "simulating_seconds": sum(row["seconds"] for row in simulating),
        "cpu_use": _use(rows),
        "cpu_use_simulating": _use(simulating),
    }


def by_suite(rows: Iterable[dict[str, Any]]) -> dict[str, dict[str, Any]]:
    """``together`` of each suite's runs."""
    groups: dict[str, list[dict[str, Any]]] = {}
    for row in rows:
        groups.setdefault(suite_of(row["command"]), []).append(row)
    return {name: together(group) for name, group in groups.items()}


def suite_of(command: str) -> str:
    """The suite that a command asks for."""
    words = command.split()
    if len(words) > 1 and words[1] in _ELSEWHERE:
        return _ELSEWHERE[words[1]]
    found = re.search(r"--suite[ =](\S+)", command)
    return found[1] if found else "paper" if words else "from Python"


def _use(rows: list[dict[str, Any]]) -> float | None:
    whole = sum(row["seconds"] * row["workers"] for row in rows)
    return sum(row["cpu_seconds"] for row in rows) / whole if whole else None


def cpu_time(records: Sequence[Record]) -> str:
    """What the cells that are there took, each once, by setting; simulations that several of them share are counted once."""
    method, banks = dict[str, float](), dict[tuple[str, str, int, int], float]()
    for r in records:
        method[r.setting] = method.get(r.setting, 0.0) + (r.cpu_seconds or 0.0)
        bank = (r.task, r.variant, r.seed, r.steps)
        banks[bank] = max(banks.get(bank, 0.0), r.simulation_cpu_seconds)
    parts = ", ".join(f"{name} {duration(seconds)}" for name, seconds in method.items())
    shared, untimed = duration(sum(banks.values())), sum(r.done and r.cpu_seconds is None for r in records)
    text = f"{duration(sum(method.values()))} for the methods ({parts}), {shared} for shared simulations"
    return f"{text}; {untimed} cells that went on after an interruption are not timed" if untimed else text


def percent(share: float | None) -> str:
    return "?" if share is None else f"{share:.0%}"


def duration(seconds: float) -> str:
    """In the unit that suits it."""
    if seconds >= 3600:
        return f"{seconds / 3600:.1f} h"
    return f"{seconds / 60:.1f} min" if seconds >= 60 else f"{seconds:.1f} s"
