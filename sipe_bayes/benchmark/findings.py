"""What records and tables say, in words: the facts of a run, and sentences that hold outside noise or say that they do not."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from sipe_bayes.benchmark.cells import BASELINES, SUITES, suite
from sipe_bayes.benchmark.records import Record, mixed
from sipe_bayes.benchmark.spent import by_suite, cpu_time, duration, percent, suite_of, together
from sipe_bayes.benchmark.tables import (
    ALL,
    MEASURES,
    VARIANT_NAMES,
    Entry,
    Table,
    against,
    competes,
    differ,
    order_estimators,
    order_tasks,
)

# What was run


def facts(records: Sequence[Record], runs: Sequence[dict[str, Any]]) -> list[tuple[str, str]]:
    """(label, text): what was run, on what, in how much time."""
    estimators = order_estimators({r.estimator for r in records})
    found = [
        ("environments", ", ".join(order_tasks({r.task for r in records}))),
        ("estimators", ", ".join(e for e in estimators if e not in BASELINES)),
        ("baselines", ", ".join(e for e in estimators if e in BASELINES) or "none was run: no figure shows the prior"),
        ("suites", _suites(records)),
        ("settings", ", ".join(sorted({r.setting for r in records}))),
        (
            "variants",
            ", ".join(text for name, text in VARIANT_NAMES.items() if any(r.variant == name for r in records)),
        ),
        ("seeds", _numbers(r.seed for r in records)),
        ("budget", f"{_numbers(r.budget for r in records)} rollouts"),
        ("trajectories", f"{_horizons(records)} control steps; by {_listed(r.log for r in records)}"),
        ("CPU time", cpu_time(records)),
        ("wall time", _wall_time(runs)),
        ("versions", "; ".join(f"{p} {_listed(r.versions.get(p, '') for r in records)}" for p in _packages(records))),
        ("states of the code", _sources(records)),
        ("not comparable", ", ".join(f"{group}: its cells were given different logs" for group in mixed(records))),
        ("commands", _commands(records)),
    ]
    return [(label, text) for label, text in found if text]


def _suites(records: Sequence[Record]) -> str:
    """How much there is, as run by default, of each suite that was asked for."""
    done = {(r.id, r.budget, r.steps) for r in records if r.done}
    asked = {suite_of(r.command) for r in records}
    counts = {
        name: {(cell.id, cell.budget, cell.horizon) for cell in suite(name)}
        for name in SUITES
        if name in asked - {"all"}
    }
    found = ", ".join(f"{name} {len(done & cells):,} of {len(cells):,}" for name, cells in counts.items())
    return f"{found}, each in its own sizes" if found else ""


def _wall_time(runs: Sequence[dict[str, Any]]) -> str:
    """Of all runs, as far as ``runs.json`` has them."""
    if not runs:
        return ""
    every = together(runs)
    parts = ", ".join(f"{name} {duration(row['seconds'])}" for name, row in by_suite(runs).items())
    text = (
        f"{duration(every['seconds'])} on {every['workers']} cores, cells that were measured again included ({parts})"
    )
    share = every["cpu_use_simulating"]
    return text if share is None else f"{text}; CPU use {percent(share)} while simulating"


def _sources(records: Sequence[Record]) -> str:
    """Where several states of the package's code made the records; older records do not say by which they were made."""
    found = Counter(r.checksums.get("source", "not kept") for r in records if r.done)
    return ", ".join(f"{name} ({count:,} cells)" for name, count in found.most_common()) if len(found) > 1 else ""


def _commands(records: Sequence[Record]) -> str:
    """The commands behind the records; of those that differ in what they selected only one."""
    plain = {_ordered(re.sub(r" --select (?:'[^']*'|\S+)", "", r.command)) for r in records}
    chosen = any(" --select " in r.command for r in records)
    return _listed(plain) + (", in parts by --select" if chosen else "")


def _ordered(command: str) -> str:
    """A command with its options in one order."""
    what, *options = re.split(r" (?=--[a-z])", command)
    return " ".join([what, *sorted(options, reverse=True)])


def _packages(records: Sequence[Record]) -> list[str]:
    return list(dict.fromkeys(package for r in records for package in r.versions if r.versions[package]))


def _horizons(records: Sequence[Record]) -> str:
    """How long the trajectories are, by task where that differs."""
    tasks: dict[int, set[str]] = {}
    for record in records:
        tasks.setdefault(record.steps, set()).add(record.task)
    if len(tasks) == 1:
        return f"{next(iter(tasks)):,}"
    return "; ".join(f"{steps:,} ({', '.join(order_tasks(tasks[steps]))})" for steps in sorted(tasks))


def _numbers(values: Iterable[int]) -> str:
    return ", ".join(f"{v:,}" for v in sorted(set(values)))


def _listed(values: Iterable[str]) -> str:
    return ", ".join(sorted({v for v in values if v}))


# What it says


def unequal(records: Sequence[Record]) -> str:
    """A sentence where the records of one table had different budgets or logs of different length; else empty."""
    mine = [r for r in records if r.estimator not in BASELINES]
    budgets = sorted({r.budget for r in mine})
    lengths = [t for t in order_tasks({r.task for r in mine}) if len({r.steps for r in mine if r.task == t}) > 1]
    found = []
    if len(budgets) > 1:
        found.append(f"budgets differ ({_numbers(budgets)} rollouts)")
    if lengths:
        found.append(f"trajectories differ in length on {', '.join(lengths)}")
    return f"The rows do not compare: {' and '.join(found)}." if found else ""


def table_findings(tables: Sequence[Table]) -> list[str]:
    """What the tables say, over all environments where they are complete."""
    found = []
    for table in tables:
        if table.measure.name not in ("accuracy", "CRPS skill", "CRPS"):
            continue
        column = ALL if ALL in table.columns else table.columns[0]
        rows = {name: entry for name, _ in table.rows if (entry := table.entry(name, column)) is not None}
        mine = {name: entry for name, entry in rows.items() if competes(name)}
        if not mine:
            continue
        sign = MEASURES[table.measure.name].better
        first = max(mine, key=lambda name: sign * mine[name].mean)
        where = "over all environments" if column == ALL else f"on {column}"
        if all(len(entry.values) < 2 for entry in mine.values()):
            found.append(f"Best {table.measure.name} {where}: {first}, {text(mine[first])}; one seed tells no more.")
            continue
        noise = (
            "ahead of every other outside noise"
            if mine[first].best
            else "not ahead of every other and of the baselines outside noise"
        )
        found.append(f"Best {table.measure.name} {where}: {first}, {text(mine[first])}; {noise}.")
        reference = "prior_mean" if table.measure.name == "accuracy" else "prior"
        if reference in rows:
            found.append(_against(table.measure.name, sign, reference, rows[reference].mean, mine))
    return found


def _against(measure: str, sign: int, reference: str, level: float, mine: dict[str, Entry]) -> str:
    """Which estimators are better than a baseline, which worse, and of which that cannot be told."""
    verdicts: dict[int, list[str]] = {1: [], -1: [], 0: []}
    for name, entry in mine.items():
        verdicts[sign * against(entry.values, level)].append(name)
    kinds = {1: f"Better in {measure} than the {reference.replace('_', ' ')}", -1: "worse", 0: "not told apart"}
    parts = [f"{kind}: {', '.join(verdicts[v]) or 'none'}" for v, kind in kinds.items() if verdicts[v] or v == 1]
    return "; ".join(parts) + "."


def pair_findings(left: Sequence[Record], right: Sequence[Record], labels: tuple[str, str]) -> list[str]:
    """For each estimator what a setting gains in mean accuracy over another, paired by environment and seed; its error and the test
    are over the seeds that have every shared environment in both."""
    found = []
    for estimator in order_estimators({r.estimator for r in right}):
        one, two = (
            {(r.task, r.seed): float(r.scores["mean_accuracy"]) for r in rows if r.estimator == estimator}
            for rows in (left, right)
        )
        tasks = order_tasks({task for task, _ in one.keys() & two.keys()})
        seeds = sorted({seed for _, seed in two if all((t, seed) in one and (t, seed) in two for t in tasks)})
        if not seeds:
            found.append(
                f"{estimator}: no seed has every environment with {labels[0]} and with {labels[1]}; nothing is compared."
            )
            continue
        gains = {t: [two[t, s] - one[t, s] for s in seeds] for t in tasks}
        over = tuple(float(np.mean([gains[t][k] for t in tasks])) for k in range(len(seeds)))
        verdict = {1: "a gain outside noise", -1: "a loss outside noise", 0: "not told from none"}[against(over, 0.0)]
        ahead = sum(float(np.mean(g)) > 0 for g in gains.values())
        found.append(
            f"{estimator}: mean accuracy with {labels[1]} less that with {labels[0]} is {text(Entry(over, 3))}, {verdict}; "
            f"it is positive on {ahead} of {len(tasks)} environments."
        )
    return found


def sweep_findings(rows: Sequence[tuple[str, str, Entry, bool]]) -> list[str]:
    """Whether the search over hyper-parameters chooses the defaults."""
    found = []
    for estimator in dict.fromkeys(row[0] for row in rows):
        mine = [row for row in rows if row[0] == estimator]
        defaults, first = next((row for row in mine if row[3]), None), mine[0]
        if first[3]:
            found.append(f"{estimator}: the search chooses the defaults, {first[1]}.")
        elif defaults is not None:
            told = "outside noise" if differ(first[2].values, defaults[2].values) else "within noise"
            found.append(
                f"{estimator}: the search would choose {first[1]} ({text(first[2])}), the best of {len(mine)}, and not the defaults, "
                f"{defaults[1]} ({text(defaults[2])}); they differ {told}, of which being the best of so many takes a part."
            )
    return found


def text(entry: Entry) -> str:
    """Mean and standard error."""
    mean, error = entry.texts()
    return f"{mean} ± {error}" if error else mean
