"""How far a folder of results is: counts, failures, and the time that went into it."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

from sipe_bayes.benchmark.records import Record, mixed
from sipe_bayes.benchmark.spent import by_suite, cpu_time, duration, percent, runs, together

_SHOWN = 20  # missing cells that are named
_RUNS = 3  # latest runs that are shown


def summary(folder: Path) -> dict[str, Any]:
    """Of a folder of results, as plain data; raises RecordError for another one."""
    records, found = Record.progress(folder)
    rows = runs(folder)
    return {
        **found,
        "mixed": mixed(records),
        "converged": _converged(records),
        "cpu_time": cpu_time(records),
        "runs": [{**row, **together([row])} for row in rows],
        "suites": by_suite(rows),
        "all": together(rows),
    }


def _converged(records: list[Record]) -> dict[str, str]:
    """By task and estimator: how many of the seeds with a policy solve their environment."""
    asked, solved = Counter[str](), Counter[str]()
    for record in records:
        if record.converged is not None:
            name = f"{record.task}/{record.estimator}/{record.setting}"
            asked[name] += 1
            solved[name] += record.converged
    return {name: f"{solved[name]} of {count}" for name, count in asked.items()}


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
    if found["failed"]:
        said.append("the same command with --retry-failed measures those that failed again")
    if found["done"]:
        said.append(f"CPU time of these cells: {found['cpu_time']}")
    for row in found["runs"][-_RUNS:]:
        use = f"{row['units']} units in {row['seconds']:.0f} s, CPU use {percent(row['cpu_use'])} of {row['workers']} workers"
        said.append(f"{row['started']}: {use}{_simulating(row)}: {row['command']}")
    if len(found["runs"]) > _RUNS:
        said.append(f"and {len(found['runs']) - _RUNS} runs before; --json has them all")
    if len(found["runs"]) > 1:
        said += [f"{name}: {_time(row)}" for name, row in (*found["suites"].items(), ("all runs", found["all"]))]
    return said


def _time(row: dict[str, Any]) -> str:
    """Of runs together."""
    return f"{duration(row['seconds'])}, {duration(row['cpu_seconds'])} of CPU{_simulating(row)}"


def _simulating(row: dict[str, Any]) -> str:
    share = row["cpu_use_simulating"]
    return (
        f", CPU use {percent(share)} while simulating ({duration(row['simulating_seconds'])})"
        if share is not None
        else ""
    )


def headline(found: dict[str, Any]) -> str:
    """The counts of a summary."""
    counts = f"{found['done']} done, {len(found['failed'])} failed, {len(found['missing'])} missing"
    return f"{found['folder']}: {found['cells']} cells, {counts}"
