"""What records and tables say, in words: the facts of a run, and sentences that hold outside noise or say so."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from sipe_bayes.benchmark.cells import BASELINES, REFERENCE, SUITES, suite
from sipe_bayes.benchmark.records import Record, mixed
from sipe_bayes.benchmark.run_log import Run, Usage, by_suite, cpu_time, duration, percent, suite_of
from sipe_bayes.benchmark.tables import (
    ALL,
    MEASURES,
    VARIANT_NAMES,
    Entry,
    Table,
    against,
    best_of,
    competes,
    differ,
    order_estimators,
    order_tasks,
    over_tasks,
)
from sipe_bayes.inference.registry import arguments

# What was run


def facts(records: Sequence[Record], runs: Sequence[Run]) -> list[tuple[str, str]]:
    """What was run, on what, in how much time.

    Returns:
        Labels and texts.
    """
    estimators = order_estimators({r.estimator for r in records})
    labelled = [
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
    return [(label, text) for label, text in labelled if text]


def _suites(records: Sequence[Record]) -> str:
    """How much there is, as run by default, of each suite that was asked for."""
    done = {(r.id, r.budget, r.steps) for r in records if r.done}
    asked = {suite_of(r.command) for r in records}
    counts = {
        name: {(cell.id, cell.budget, cell.horizon) for cell in suite(name)}
        for name in SUITES
        if name in asked - {"all"}
    }
    shares = ", ".join(f"{name} {len(done & cells):,} of {len(cells):,}" for name, cells in counts.items())
    return f"{shares}, each in its own sizes" if shares else ""


def _wall_time(runs: Sequence[Run]) -> str:
    """Of all runs, as far as ``runs.json`` has them."""
    if not runs:
        return ""
    every = Usage.of(runs)
    parts = ", ".join(f"{name} {duration(usage.seconds)}" for name, usage in by_suite(runs).items())
    text = f"{duration(every.seconds)} on {every.workers} cores, cells that were measured again included ({parts})"
    share = every.cpu_use_simulating
    return text if share is None else f"{text}; CPU use {percent(share)} while simulating"


def _sources(records: Sequence[Record]) -> str:
    """Where several states of the package's code made the records; older records do not say by which they were made."""
    states = Counter(r.checksums.get("source", "not kept") for r in records if r.done)
    return ", ".join(f"{name} ({count:,} cells)" for name, count in states.most_common()) if len(states) > 1 else ""


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
    sentences = []
    if len(budgets) > 1:
        sentences.append(f"budgets differ ({_numbers(budgets)} rollouts)")
    if lengths:
        sentences.append(f"trajectories differ in length on {', '.join(lengths)}")
    return f"The rows do not compare: {' and '.join(sentences)}." if sentences else ""


def table_findings(tables: Sequence[Table]) -> list[str]:
    """What the tables say, over all environments where they are complete."""
    sentences = []
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
            sentences.append(
                f"Best {table.measure.name} {where}: {first}, {text(mine[first])}; one seed tells no more."
            )
            continue
        noise = (
            "ahead of every other outside noise"
            if mine[first].best
            else "not ahead of every other and of the baselines outside noise"
        )
        sentences.append(f"Best {table.measure.name} {where}: {first}, {text(mine[first])}; {noise}.")
        reference = "prior_mean" if table.measure.name == "accuracy" else "prior"
        if reference in rows:
            sentences.append(_against(table.measure.name, sign, reference, rows[reference].mean, mine))
    return sentences


def _against(measure: str, sign: int, reference: str, level: float, mine: dict[str, Entry]) -> str:
    """Which estimators are better than a baseline, which worse, and of which that cannot be told."""
    verdicts: dict[int, list[str]] = {1: [], -1: [], 0: []}
    for name, entry in mine.items():
        verdicts[sign * against(entry.values, level)].append(name)
    kinds = {1: f"Better in {measure} than the {reference.replace('_', ' ')}", -1: "worse", 0: "not told apart"}
    parts = [f"{kind}: {', '.join(verdicts[v]) or 'none'}" for v, kind in kinds.items() if verdicts[v] or v == 1]
    return "; ".join(parts) + "."


def pair_findings(left: Sequence[Record], right: Sequence[Record], labels: tuple[str, str]) -> list[str]:
    """For each estimator what a setting gains in mean accuracy over another, paired by environment and seed.

    The gain's error and its test are over the seeds that have every shared environment in both.

    Args:
        left: of one setting.
        right: of the other.
        labels: their names.
    """
    sentences = []
    for estimator in order_estimators({r.estimator for r in right}):
        one, two = (
            {(r.task, r.seed): r.scored.mean_accuracy for r in rows if r.estimator == estimator}
            for rows in (left, right)
        )
        tasks = order_tasks({task for task, _ in one.keys() & two.keys()})
        seeds = sorted({seed for _, seed in two if all((t, seed) in one and (t, seed) in two for t in tasks)})
        if not seeds:
            sentences.append(
                f"{estimator}: no seed has every environment with {labels[0]} and with {labels[1]}; nothing is "
                "compared."
            )
            continue
        gains = {t: [two[t, s] - one[t, s] for s in seeds] for t in tasks}
        over = tuple(float(np.mean([gains[t][k] for t in tasks])) for k in range(len(seeds)))
        verdict = {1: "a gain outside noise", -1: "a loss outside noise", 0: "not told from none"}[against(over, 0.0)]
        ahead = sum(float(np.mean(g)) > 0 for g in gains.values())
        sentences.append(
            f"{estimator}: mean accuracy with {labels[1]} less that with {labels[0]} is {text(Entry(over, 3))}, "
            f"{verdict}; it is positive on {ahead} of {len(tasks)} environments."
        )
    return sentences


# The search over hyper-parameters


@dataclass(frozen=True)
class Tried:
    """Values that the search over hyper-parameters tried.

    Args:
        estimator: whose.
        values: in words; empty for what is held against them.
        entry: mean accuracy over the tasks that it was tuned on.
        default: whether these are the library's defaults.
    """

    estimator: str
    values: str
    entry: Entry
    default: bool


def sweep_rows(records: Sequence[Record]) -> list[Tried]:
    """The search over hyper-parameters by estimator, the best values first.

    Only combinations that were run on every task and seed of the search are comparable. Last, without values, come the
    baselines and ``laplace`` in the direct setting.
    """
    tried: dict[tuple[str, str], dict[str, dict[int, float]]] = {}
    ours: dict[tuple[str, str], bool] = {}
    tuned = {record.task for record in records if record.setting == "sweep"}
    for record in records:
        searched = record.setting == "sweep"
        where = (record.setting, record.variant) == ("direct", "in_distribution")
        beside = where and record.estimator in (*BASELINES, REFERENCE) and record.task in tuned
        if not record.done or not (searched or beside):
            continue
        values = ", ".join(f"{k} = {v}" for k, v in record.values.items())
        key = (record.estimator if searched else f"{record.estimator}, direct", values)
        tried.setdefault(key, {}).setdefault(record.task, {})[record.seed] = record.scored.mean_accuracy
        ours[key] = searched and _are_defaults(record)
    rows = []
    for estimator in order_estimators({e for e, _ in tried}):
        mine = {key: row for key, row in tried.items() if key[0] == estimator}
        values_of = {key[1]: over for key, row in mine.items() if (over := over_tasks(row, sorted(tuned)))}
        best = best_of(values_of, 1)
        ranked = sorted(values_of, key=lambda v: -float(np.mean(values_of[v])))
        rows += [Tried(estimator, v, Entry(values_of[v], 3, v == best), ours[estimator, v]) for v in ranked]
    return rows


def _are_defaults(record: Record) -> bool:
    """Whether a cell sets its estimator's arguments to what they are by default."""
    taken = arguments(record.estimator)
    return all(name in taken and taken[name].default == value for name, value in record.values.items())


def sweep_findings(rows: Sequence[Tried]) -> list[str]:
    """Whether the search over hyper-parameters chooses the defaults."""
    sentences = []
    for estimator in dict.fromkeys(row.estimator for row in rows):
        mine = [row for row in rows if row.estimator == estimator]
        defaults, first = next((row for row in mine if row.default), None), mine[0]
        if first.default:
            sentences.append(f"{estimator}: the search chooses the defaults, {first.values}.")
        elif defaults is not None:
            outside = "outside noise" if differ(first.entry.values, defaults.entry.values) else "within noise"
            sentences.append(
                f"{estimator}: the search would choose {first.values} ({text(first.entry)}), the best of {len(mine)}, "
                f"and not the defaults, {defaults.values} ({text(defaults.entry)}); they differ {outside}, of which "
                "being the best of so many takes a part."
            )
    return sentences


def text(entry: Entry) -> str:
    """Mean and standard error."""
    mean, error = entry.texts()
    return f"{mean} ± {error}" if error else mean
