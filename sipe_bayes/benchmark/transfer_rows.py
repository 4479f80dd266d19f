"""What the transfer's records come to: rows of a randomisation over its seeds, percentages of the oracle, and differences.

Every return R in the target stands as a percentage of the oracle's O, the agent trained in the target itself, both as means over the seeds that
both have. The paper (B. Mehta, A. Handa, D. Fox, F. Ramos 2020, https://arxiv.org/abs/2011.08985, Section 3.4) takes 100 R / O, which
means something only where returns are positive. Deviation: here zero is a policy Z that acts at random in the target,

    100 (R - Z) / (O - Z),

and the paper's percentage stands beside it where every oracle earns more than 0. Intervals: 95 %, percentile bootstrap over seeds (B. Efron
1979, "Bootstrap Methods: Another Look at the Jackknife", https://doi.org/10.1214/aos/1176344552), a seed's agent and oracle drawn together. With
three seeds it has ten different resamples and ends at the best and the worst seed. There is none where an oracle fails: a resample's
denominator would be near zero.

What a randomisation is worth against another one is told by differences in that percentage, seed by seed, over all tasks and variants
that have both (``contrasts``).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sipe_bayes.benchmark.tables import order_estimators, order_tasks
from sipe_bayes.benchmark.transfer import REFERENCES, SETTING, TRUTH, TransferRecord

FloatArray = NDArray[np.float64]

WORDS = {"truth": "truth (oracle)", "prior": "prior (uniform)", "default": "default model"}
_RESAMPLES = 10_000
_LEVEL = 0.95
_LEAST_LEAD = 0.1

Percent = tuple[float, tuple[float, float] | None] | None
"""Of the oracle, with its interval over seeds (None for one seed); None where an oracle is lacking or fails."""


@dataclass(frozen=True)
class Row:
    """A randomisation of one task and variant, over its seeds. returns: by seed; spread: mean sd in theta of what was drawn from;
    percent: of the oracle, random being zero; paper: the paper's percentage; by_seed: percent of each seed, of the mean oracle; success (K,) or
    None. solved: how many seeds solve the target. diverged, redrawn: in all trainings together. seconds: of a training, mean."""

    task: str
    variant: str
    name: str
    returns: dict[int, float]
    spread: float
    percent: Percent
    paper: Percent
    by_seed: dict[int, float]
    success: FloatArray | None
    solved: int
    redrawn: int
    diverged: int
    seconds: float

    @property
    def group(self) -> tuple[str, str]:
        return self.task, self.variant


def label(record: TransferRecord) -> str:
    """A randomisation with its variations."""
    return record.estimator + record.setting.removeprefix(SETTING).replace(",", ", ")


def relative(mine: FloatArray, oracle: FloatArray, zero: float) -> tuple[float, tuple[float, float] | None] | None:
    """100 (R - Z) / (O - Z) of returns (K,) of the same K seeds, and its interval over seeds, None for one seed. None altogether unless
    every oracle earns a tenth at least of what they earn on average above zero."""
    lead = oracle - zero
    if not len(mine) or lead.mean() <= 0 or lead.min() < _LEAST_LEAD * lead.mean():
        return None
    rows = np.random.default_rng(0).integers(0, len(mine), (_RESAMPLES, len(mine)))
    value = 100 * (mine.mean() - zero) / lead.mean()
    if len(mine) < 2:
        return float(value), None
    again = 100 * (mine[rows].mean(1) - zero) / lead[rows].mean(1)
    low, high = np.quantile(again, [(1 - _LEVEL) / 2, (1 + _LEVEL) / 2])
    return float(value), (float(low), float(high))


def rows(records: Sequence[TransferRecord]) -> list[Row]:
    """Of all finished records, by task, variant and randomisation, the references first."""
    done = [r for r in records if r.done]
    found = []
    for task in order_tasks({r.task for r in done}):
        for variant in sorted({r.variant for r in done if r.task == task}):
            of = [r for r in done if (r.task, r.variant) == (task, variant)]
            oracle = {r.seed: r.evaluation["mean"] for r in of if r.estimator == TRUTH}
            zero = float(np.mean([r.random["mean"] for r in of]))
            found += [_row([r for r in of if label(r) == name], name, oracle, zero) for name in ordered(of)]
    return found


def ordered(records: Sequence[TransferRecord]) -> list[str]:
    """The randomisations with their variations, the references first."""
    return in_order({label(r) for r in records})


def in_order(names: set[str]) -> list[str]:
    """Randomisations as every table and figure has them."""
    order = [*REFERENCES, *order_estimators({_plain(n) for n in names} - set(REFERENCES))]
    return sorted(names, key=lambda name: (order.index(_plain(name)), name))


def _plain(name: str) -> str:
    """A randomisation without its variations."""
    return name.split(",")[0]


def _row(mine: Sequence[TransferRecord], name: str, oracle: dict[int, float], zero: float) -> Row:
    mine = sorted(mine, key=lambda r: r.seed)
    returns = {r.seed: float(r.evaluation["mean"]) for r in mine}
    both = [seed for seed in returns if seed in oracle]
    ours, theirs = np.array([returns[s] for s in both]), np.array([oracle[s] for s in both])
    percent = relative(ours, theirs, zero)
    lead = theirs.mean() - zero if percent is not None else np.nan
    rates = [r.evaluation["success_rate"] for r in mine]
    return Row(
        task=mine[0].task,
        variant=mine[0].variant,
        name=name,
        returns=returns,
        spread=float(np.mean([r.sd for r in mine])),
        percent=percent,
        paper=relative(ours, theirs, 0.0),
        by_seed={} if percent is None else {s: 100 * (returns[s] - zero) / lead for s in both},
        success=None if None in rates else np.array(rates, float),
        solved=sum(bool(r.solved_reference) for r in mine),
        redrawn=sum(r.redrawn for r in mine),
        diverged=sum(r.diverged for r in mine),
        seconds=float(np.mean([r.seconds or 0.0 for r in mine])),
    )


def _prior(name: str, names: set[str]) -> str:
    """The prior that a randomisation is held against: with the same noise and delay, where there is that."""
    same = f"prior{name.removeprefix(_plain(name))}"
    return same if same in names else "prior"


def contrasts(found: Sequence[Row]) -> list[tuple[str, str, list[float], int]]:
    """(randomisation, what it is held against, differences in percent of the oracle of each seed, over how many targets): every
    randomisation against the prior, and variations against what they vary. A seed's difference is the mean over the targets that have
    both with all their seeds."""
    by_name: dict[str, dict[tuple[str, str], dict[int, float]]] = {}
    for row in found:
        by_name.setdefault(row.name, {})[row.group] = row.by_seed
    pairs = [(name, _prior(name, set(by_name))) for name in by_name if _plain(name) not in ("prior", TRUTH)]
    pairs += [(name, _plain(name)) for name in by_name if "," in name]
    said = []
    for name, other in pairs:
        if other not in by_name:
            continue
        groups = [g for g, mine in by_name[name].items() if mine and mine.keys() == by_name[other].get(g, {}).keys()]
        seeds = set.intersection(*(set(by_name[name][g]) for g in groups)) if groups else set()
        if seeds:
            gains = [
                float(np.mean([by_name[name][g][s] - by_name[other][g][s] for g in groups])) for s in sorted(seeds)
            ]
            said.append((name, other, gains, len(groups)))
    return said
