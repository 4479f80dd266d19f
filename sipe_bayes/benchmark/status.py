"""How far a folder of results is: counts, failures, and the time that went into it."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

from sipe_bayes.benchmark.records import Record
from sipe_bayes.benchmark.run import runs

_SHOWN = 20  # missing cells that are named


def summary(folder: Path) -> dict[str, Any]:
    """Of a folder of results, as plain data; raises RecordError for another one."""
    records, found = Record.progress(folder)
    return {
        **found,
        "mixed": _mixed(records),
        "converged": _converged(records),
        "runs": [_used(row) for row in runs(folder)],
    }


def _mixed(records: list[Record]) -> list[str]:
    """Tasks, variants and seeds whose cells were given different logs, as an agent was installed or trained anew meanwhile: they do
    not compare."""
    logs: dict[str, set[str]] = {}
    for record in records:
        if record.done and record.log != "policy":
            group = f"{record.task}/{record.variant}/seed{record.seed}" + (
                "/sweep" if record.setting == "sweep" else ""
            )
            logs.setdefault(group, set()).add(record.checksums["log"])
    return [group for group, found in logs.items() if len(found) > 1]


def _converged(records: list[Record]) -> dict[str, str]:
    """By task and estimator: how many of the seeds with a policy solve their environment."""
    asked, solved = Counter[str](), Counter[str]()
    for record in records:
        if record.converged is not None:
            name = f"{record.task}/{record.estimator}/{record.setting}"
            asked[name] += 1
            solved[name] += record.converged
    return {name: f"{solved[name]} of {count}" for name, count in asked.items()}


def _used(row: dict[str, Any]) -> dict[str, Any]:
    """A run with the share of its workers' time in which they computed; None where nothing was simulated."""
    spent = row["simulating"]
    return {
        **row,
        "cpu_use": _share(row["cpu_seconds"], row["seconds"] * row["workers"]),
        "cpu_use_simulating": _share(spent["cpu_seconds"], spent["seconds"] * row["workers"]),
    }


def _share(part: float, whole: float) -> float | None:
    return part / whole if whole else None


def lines(found: dict[str, Any]) -> list[str]:
    """``summary`` to be read."""
    missing = found["missing"]
    said = [headline(found), *(f"failed: {cell}: {why}" for cell, why in found["failed"].items())]
    said += [f"missing: {cell}" for cell in missing[:_SHOWN]]
    if len(missing) > _SHOWN:
        said.append(f"missing: {len(missing) - _SHOWN} more")
    said += [
        f"mixed: {group}: its cells were given different logs; delete their records, and run again"
        for group in found["mixed"]
    ]
    said += [f"converged: {name}: {count} seeds" for name, count in found["converged"].items()]
    for row in found["runs"]:
        use = f"{row['units']} units in {row['seconds']:.0f} s, CPU use {_percent(row['cpu_use'])} of {row['workers']} workers"
        if row["cpu_use_simulating"] is not None:
            use += f", {_percent(row['cpu_use_simulating'])} while simulating ({row['simulating']['seconds']:.0f} s)"
        said.append(f"{row['started']}: {use}: {row['command']}")
    if len(found["runs"]) > 1:
        seconds, cpu = (sum(row[name] for row in found["runs"]) for name in ("seconds", "cpu_seconds"))
        said.append(f"all runs: {seconds / 3600:.2f} h, {cpu / 3600:.2f} h of CPU")
    return said


def headline(found: dict[str, Any]) -> str:
    """The counts of a summary."""
    counts = f"{found['done']} done, {len(found['failed'])} failed, {len(found['missing'])} missing"
    return f"{found['folder']}: {found['cells']} cells, {counts}"


def _percent(share: float | None) -> str:
    return "?" if share is None else f"{share:.0%}"
