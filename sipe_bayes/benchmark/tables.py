"""Tables of the benchmark: one number per estimator and environment, as mean and standard error over seeds.

An entry is set apart as the best of its column only when that is outside noise: it must be the best mean and differ
from every other estimator's by Welch's t-test at 5 % (B. Welch 1947, "The generalization of 'Student's' problem when
several different population variances are involved", Biometrika 34, https://doi.org/10.1093/biomet/34.1-2.28). It
follows that a column of equally good estimators has a best one in less than 5 % of cases, and that one seed never has
one. Baselines do not compete, but the best must beat the prior mean and the prior too, by a one-sample t-test, as they
are the same with every seed. On the default variant nothing is the best: its truth is the prior mean, so that no
measure tells learning from knowing nothing.

A run with a policy counts only if the policy solved simulators drawn from the estimate, as in the paper (Mehta, Handa,
Fox, Ramos 2020, https://arxiv.org/abs/2011.08985, Section 3.2); where no run of a setting did, all count, and the
report says so.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import stats

from sipe_bayes.benchmark.cells import BASELINES, REFERENCE
from sipe_bayes.benchmark.records import Record
from sipe_bayes.core.thresholds import THRESHOLDS
from sipe_bayes.diagnostics.scores import Scores

_EQUAL = 1e-9  # difference of two means that is rounding
OUTSIDE = "out_of_distribution"
ALL = "mean of all"
BESIDE = f"{REFERENCE}, direct"
VARIANT_NAMES = {"in_distribution": "in distribution", "default": "default", OUTSIDE: "out of distribution"}

Value = Callable[[Record, "Context"], float | None]
Key = tuple[str, str, int]


@dataclass(frozen=True)
class Context:
    """What a value may need beside its record: the prior's CRPS (N,) by task, variant and seed."""

    prior_crps: dict[Key, tuple[float, ...]]

    @classmethod
    def of(cls, records: Sequence[Record]) -> Context:
        """Of all records of a folder."""
        return cls({(r.task, r.variant, r.seed): r.scored.crps for r in records if r.done and r.estimator == "prior"})

    def crps(self, record: Record) -> tuple[float, ...] | None:
        """The prior's, on the same truth; of another seed where this one was not scored: the truth is the same."""
        same = (
            crps
            for (task, variant, _), crps in self.prior_crps.items()
            if (task, variant) == (record.task, record.variant)
        )
        return self.prior_crps.get((record.task, record.variant, record.seed)) or next(same, None)


@dataclass(frozen=True)
class Measure:
    """A column's number.

    Args:
        name: of the measure.
        meaning: in a few words.
        better: 1 where larger is better, -1 where smaller is, 0 where nothing is the best.
        digits: behind the point.
        value: of a finished record; None where it has none.
    """

    name: str
    meaning: str
    better: int
    digits: int
    value: Value


def _of_scores(value: Callable[[Scores], float | None]) -> Value:
    return lambda record, _: value(record.scored)


def _determined_skill(record: Record, context: Context) -> float | None:
    """1 - CRPS / CRPS of the prior over the parameters that the log determines."""
    reference = context.crps(record)
    if reference is None or not record.determined or not any(record.determined):
        return None
    known = np.array(record.determined)
    worst = float(np.array(reference)[known].mean())
    return 1 - float(np.array(record.scored.crps)[known].mean()) / worst if worst > 0 else None


def _noticed(scores: Scores) -> float | None:
    """Share of the parameters whose truth lies outside that put their median on that bound."""
    outside = [float(n) for n in scores.noticed if n is not None]
    return float(np.mean(outside)) if outside else None


MEASURES = {
    m.name: m
    for m in (
        Measure("accuracy", "1 - |mean - truth|, mean over parameters", 1, 3, _of_scores(lambda s: s.mean_accuracy)),
        Measure("worst accuracy", "the same of the worst parameter", 1, 3, _of_scores(lambda s: min(s.accuracy))),
        Measure(
            "spread",
            "accuracy of the best parameter less that of the worst",
            -1,
            3,
            _of_scores(lambda s: max(s.accuracy) - min(s.accuracy)),
        ),
        Measure(
            "CRPS skill",
            "1 - CRPS / CRPS of the prior; 0 is the prior, 1 the truth",
            1,
            3,
            _of_scores(lambda s: s.skill_over_prior),
        ),
        Measure(
            "CRPS skill, determined", "the same over the parameters that the log determines", 1, 3, _determined_skill
        ),
        Measure(
            "CRPS",
            "continuous ranked probability score in theta, mean over parameters",
            -1,
            4,
            _of_scores(lambda s: s.mean_crps),
        ),
        Measure("energy score", "of all parameters together, in theta", -1, 3, _of_scores(lambda s: s.energy)),
        Measure(
            "coverage",
            "share of parameters whose 90 % interval holds the truth; the prior's hold all, as the truths lie well "
            "inside",
            0,
            2,
            _of_scores(lambda s: s.coverage(0.9)),
        ),
        Measure(
            "contraction",
            "1 - sd / sd of the prior, mean over parameters",
            0,
            2,
            _of_scores(lambda s: s.mean_contraction),
        ),
        Measure(
            "noticed",
            "share of parameters outside the bounds whose median sits on that bound",
            1,
            2,
            _of_scores(_noticed),
        ),
        Measure(
            "CPU seconds",
            "of the method, simulations included unless they were shared",
            0,
            0,
            lambda r, _: r.cpu_seconds,
        ),
    )
}
_INSIDE_MEASURES = (
    "accuracy",
    "worst accuracy",
    "spread",
    "CRPS skill",
    "CRPS skill, determined",
    "coverage",
    "contraction",
    "CPU seconds",
)
_OUTSIDE_MEASURES = ("CRPS", "energy score", "noticed", "CPU seconds")


@dataclass(frozen=True)
class Entry:
    """Of a table: the seeds' values, and whether it is set apart as the best."""

    values: tuple[float, ...]
    digits: int
    best: bool = False

    @property
    def mean(self) -> float:
        """Over seeds."""
        return float(np.mean(self.values))

    @property
    def standard_error(self) -> float | None:
        """None for one seed."""
        count = len(self.values)
        return float(np.std(self.values, ddof=1)) / math.sqrt(count) if count > 1 else None

    def texts(self) -> tuple[str, str]:
        """Mean and standard error; the latter empty for one seed."""
        error = self.standard_error
        return f"{self.mean + 0.0:.{self.digits}f}", "" if error is None else f"{error:.{self.digits}f}"


@dataclass(frozen=True)
class Table:
    """A measure by estimator and environment; rows: (estimator, an entry or None for each column)."""

    measure: Measure
    columns: tuple[str, ...]
    rows: tuple[tuple[str, tuple[Entry | None, ...]], ...]

    def part(self, columns: Sequence[int]) -> Table:
        """The same table with some of its columns."""
        rows = tuple((name, tuple(entries[c] for c in columns)) for name, entries in self.rows)
        return Table(self.measure, tuple(self.columns[c] for c in columns), rows)

    def entry(self, row: str, column: str) -> Entry | None:
        """The entry of an estimator on an environment."""
        return dict(self.rows)[row][self.columns.index(column)]


def measures(variant: str) -> tuple[str, ...]:
    """The measures that mean something on a variant: outside the bounds neither accuracy nor coverage does."""
    return _OUTSIDE_MEASURES if variant == OUTSIDE else _INSIDE_MEASURES


def score_table(records: Sequence[Record], name: str, context: Context) -> Table | None:
    """A table over the tasks of records.

    Args:
        records: all of one setting and variant.
        name: of the measure.
        context: of all records.

    Returns:
        The table; None where no record has the measure.
    """
    measure, default = MEASURES[name], all(r.variant == "default" for r in records)
    rows: dict[str, dict[str, dict[int, float]]] = {e: {} for e in order_estimators({r.estimator for r in records})}
    for record in records:
        value = measure.value(record, context) if record.done else None
        if value is not None and math.isfinite(value):
            rows[record.estimator].setdefault(record.task, {})[record.seed] = float(value)
    rows = {estimator: row for estimator, row in rows.items() if row}
    columns = [c for c in order_tasks({r.task for r in records}) if any(c in row for row in rows.values())]
    if not columns:
        return None
    whole = [ALL] if len(columns) > 1 else []
    entries = {
        e: [*(_seeds(row.get(c, {})) for c in columns), *(over_tasks(row, columns) for _ in whole)]
        for e, row in rows.items()
    }
    better = 0 if default else measure.better
    best = [best_of({e: v[k] for e, v in entries.items()}, better) for k in range(len(columns) + len(whole))]
    made = {
        e: tuple(Entry(v, measure.digits, best[k] == e) if v else None for k, v in enumerate(values))
        for e, values in entries.items()
    }
    return Table(measure, (*columns, *whole), tuple(made.items()))


def _seeds(values: dict[int, float]) -> tuple[float, ...]:
    return tuple(values[seed] for seed in sorted(values))


def over_tasks(row: dict[str, dict[int, float]], columns: Sequence[str]) -> tuple[float, ...]:
    """Means over all tasks, of the seeds that have them all.

    Args:
        row: task -> seed -> value.
        columns: the tasks.
    """
    if not all(c in row for c in columns):
        return ()
    seeds = set.intersection(*(set(row[c]) for c in columns))
    return tuple(float(np.mean([row[c][seed] for c in columns])) for seed in sorted(seeds))


def best_of(column: dict[str, tuple[float, ...]], better: int) -> str | None:
    """The estimator that is the best outside noise, if there is one."""
    mine = {e: v for e, v in column.items() if competes(e) and v}
    if better == 0 or len(mine) < 2:
        return None
    first = max(mine, key=lambda e: better * float(np.mean(mine[e])))
    rest = [v for e, v in mine.items() if e != first]
    trivial = [float(np.mean(v)) for e, v in column.items() if e in BASELINES and v]
    ahead = all(better * against(mine[first], t) > 0 for t in trivial)
    return first if ahead and all(differ(mine[first], other) for other in rest) else None


def competes(name: str) -> bool:
    """Whether a row is an estimator of the table's own setting, and not what it is held against."""
    return name not in (*BASELINES, BESIDE)


def differ(a: Sequence[float], b: Sequence[float]) -> bool:
    """Whether two means differ outside noise, by Welch's test; never with one seed on either side."""
    if len(a) < 2 or len(b) < 2:
        return False
    if np.ptp(a) == 0 and np.ptp(b) == 0:  # deterministic
        return bool(abs(a[0] - b[0]) > _EQUAL)
    moments = [m for v in (a, b) for m in (np.mean(v), np.std(v, ddof=1), len(v))]
    return bool(stats.ttest_ind_from_stats(*moments, equal_var=False).pvalue < THRESHOLDS.method_comparison)


def against(values: Sequence[float], constant: float) -> int:
    """Whether a mean differs from a constant outside noise, by a one-sample t-test.

    Returns:
        1 or -1 where the mean is above or below it, else 0; 0 with one seed.
    """
    above = float(np.mean(values)) - constant
    if len(values) < 2 or abs(above) <= _EQUAL:
        return 0
    if np.ptp(values) > 0 and stats.ttest_1samp(values, constant).pvalue >= THRESHOLDS.method_comparison:
        return 0
    return 1 if above > 0 else -1


def counted(records: Sequence[Record]) -> tuple[list[Record], str]:
    """The finished records that count, and a sentence about those that do not, empty where all do."""
    done = [r for r in records if r.done]
    judged = [r for r in done if r.converged is not None]
    if not judged:
        return done, ""
    solved = [r for r in judged if r.converged]
    where = f"{len(solved)} of {len(judged)} runs ended with a policy that solves the estimated simulators"
    if not solved:
        return done, f"{where}; so all runs are shown, and none would count in the paper."
    return [r for r in done if r.converged is not False], f"{where}; the others do not count, as in the paper."


def order_tasks(tasks: set[str]) -> list[str]:
    """As in the registry."""
    from sipe_bayes.envs.registry import TASKS

    return _ordered(tasks, list(TASKS))


def order_estimators(names: set[str]) -> list[str]:
    """As in the registry, the baselines last."""
    from sipe_bayes.inference.registry import ESTIMATORS

    return _ordered(names, [*ESTIMATORS, *BASELINES])


def _ordered(names: set[str], order: list[str]) -> list[str]:
    return sorted(names, key=lambda n: (order.index(n) if n in order else len(order) - len(BASELINES) - 0.5, n))


def results(records: Sequence[Record]) -> dict[str, dict[str, list[Scores]]]:
    """What the SiPE plot wants: estimator -> task -> scores of each seed."""
    by_estimator: dict[str, dict[str, list[Scores]]] = {}
    for estimator in order_estimators({r.estimator for r in records}):
        mine = [r for r in records if r.estimator == estimator and r.done]
        by_estimator[estimator] = {
            t: [r.scored for r in mine if r.task == t] for t in order_tasks({r.task for r in mine})
        }
    return by_estimator


def renamed(records: Sequence[Record], label: str) -> list[Record]:
    """The same records with the setting in the estimator's name, so that two settings stand in one table."""
    return [replace(r, estimator=f"{r.estimator}, {label}") for r in records if r.estimator not in BASELINES]


def warning_counts(records: Sequence[Record]) -> list[tuple[str, str, int]]:
    """Estimator, warning without parameters and numbers, and how often, the most frequent first."""

    def general(record: Record, warning: str) -> str:
        for name in sorted(record.names, key=len, reverse=True):
            warning = re.sub(rf"\b{re.escape(name)}\b(, )?", "", warning)
        return " ".join(re.sub(r"\d[\d.,e-]*", "#", warning).split())

    count = Counter((r.estimator, general(r, w)) for r in records for w in r.warnings)
    return [(estimator, text, times) for (estimator, text), times in count.most_common()]
