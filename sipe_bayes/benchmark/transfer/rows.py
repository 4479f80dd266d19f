"""What the transfer's records come to: a randomisation over its seeds, in percent of the oracle, and differences.

Every return R in the target stands as a percentage of the oracle's O, the agent trained in the target itself, both as
means over the seeds that both have. The paper (B. Mehta, A. Handa, D. Fox, F. Ramos 2020,
https://arxiv.org/abs/2011.08985, Section 3.4) takes 100 R / O, which means something only where returns are positive.
Intervals: 95 %, percentile bootstrap over seeds (B. Efron 1979, "Bootstrap Methods: Another Look at the Jackknife",
https://doi.org/10.1214/aos/1176344552), a seed's agent and oracle drawn together. With three seeds it has ten different
resamples and ends at the least and the greatest ratio of a seed's agent to its own oracle.

What a randomisation is worth against another one is told by differences in that percentage, seed by seed, in each
target and over all that have both (``contrasts``). Whether a better posterior trains a better policy is told by rank
correlations of the percentage with the CRPS of what was drawn from (``by_quality``).

Deviations:

- Zero is a policy Z that acts at random in the target, 100 (R - Z) / (O - Z); the paper's percentage stands beside it.
- Neither is given where an oracle earns hardly more than zero (``relative``).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

from sipe_bayes.benchmark.tables import order_estimators, order_tasks
from sipe_bayes.benchmark.transfer.study import DISTURBING, PRIOR, REFERENCES, SETTING, TRUTH, TransferRecord
from sipe_bayes.core.arrays import FloatArray

WORDS = {"truth": "truth (oracle)", "prior": "prior (uniform)", "default": "default model"}


@dataclass(frozen=True)
class Rules:
    """How percentages are judged.

    Args:
        resamples: of the bootstrap.
        level: of its interval.
        lead: share of the oracles' mean above zero that each has to earn.
        ranked: randomisations of a target whose ranks are correlated, at least.
        permutations: of the test of that.
    """

    resamples: int = 10_000
    level: float = 0.95
    lead: float = 0.1
    ranked: int = 4
    permutations: int = 10_000


RULES = Rules()

Target = tuple[str, str]
"""Task and variant."""

Percent = tuple[float, tuple[float, float] | None] | None
"""Of the oracle, with its interval over seeds (None for one seed); None where an oracle is missing or fails."""


@dataclass(frozen=True)
class Row:
    """A randomisation of one task and variant, over its seeds.

    Args:
        task: of the target.
        variant: of the target.
        name: of the randomisation with its variations.
        returns: by seed.
        spread: mean sd in theta of what was drawn from.
        crps: its mean CRPS in theta; None where some seed's is not known.
        percent: of the oracle, random being zero.
        paper: the paper's percentage.
        by_seed: percent of each seed, of the mean oracle.
        success: (K,), or None where only the return counts.
        solved: how many seeds solve the target.
        redrawn: theta, in all trainings together.
        diverged: episodes, in all trainings together.
        seconds: of a training, mean.
    """

    task: str
    variant: str
    name: str
    returns: dict[int, float]
    spread: float
    crps: float | None
    percent: Percent
    paper: Percent
    by_seed: dict[int, float]
    success: FloatArray | None
    solved: int
    redrawn: int
    diverged: int
    seconds: float

    @property
    def group(self) -> Target:
        """The target."""
        return self.task, self.variant


def label(record: TransferRecord) -> str:
    """A randomisation with its variations."""
    return record.estimator + record.setting.removeprefix(SETTING).replace(",", ", ")


def relative(mine: FloatArray, oracle: FloatArray, zero: float) -> Percent:
    """100 (R - Z) / (O - Z) of returns of the same K seeds, and its interval over seeds.

    Args:
        mine: R (K,).
        oracle: O (K,).
        zero: Z.

    Returns:
        None unless every oracle earns a tenth at least of what they earn on average above zero.
    """
    lead = oracle - zero
    if not len(mine) or lead.mean() <= 0 or lead.min() < RULES.lead * lead.mean():
        return None
    rows = np.random.default_rng(0).integers(0, len(mine), (RULES.resamples, len(mine)))
    value = 100 * (mine.mean() - zero) / lead.mean()
    if len(mine) < 2:
        return float(value), None
    again = 100 * (mine[rows].mean(1) - zero) / lead[rows].mean(1)
    low, high = np.quantile(again, [(1 - RULES.level) / 2, (1 + RULES.level) / 2])
    return float(value), (float(low), float(high))


def rows(records: Sequence[TransferRecord], crps: Mapping[str, float] | None = None) -> list[Row]:
    """Of all finished records, by task, variant and randomisation, the references first."""
    done = [r for r in records if r.done]
    made = []
    for task in order_tasks({r.task for r in done}):
        for variant in sorted({r.variant for r in done if r.task == task}):
            of = [r for r in done if (r.task, r.variant) == (task, variant)]
            oracle = {r.seed: r.earned.mean for r in of if r.estimator == TRUTH}
            zero = float(np.mean([r.earned_at_random.mean for r in of]))
            for name in ordered(of):
                made.append(_row([r for r in of if label(r) == name], name, oracle, zero, crps or {}))
    return made


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


def _row(
    mine: Sequence[TransferRecord], name: str, oracle: dict[int, float], zero: float, crps: Mapping[str, float]
) -> Row:
    mine = sorted(mine, key=lambda r: r.seed)
    returns = {r.seed: r.earned.mean for r in mine}
    both = [seed for seed in returns if seed in oracle]
    ours, theirs = np.array([returns[s] for s in both]), np.array([oracle[s] for s in both])
    percent = relative(ours, theirs, zero)
    lead = theirs.mean() - zero if percent is not None else np.nan
    rates = [r.earned.success_rate for r in mine]
    return Row(
        task=mine[0].task,
        variant=mine[0].variant,
        name=name,
        returns=returns,
        spread=float(np.mean([r.sd for r in mine])),
        crps=float(np.mean([crps[r.id] for r in mine])) if all(r.id in crps for r in mine) else None,
        percent=percent,
        paper=relative(ours, theirs, 0.0),
        by_seed={} if percent is None else {s: 100 * (returns[s] - zero) / lead for s in both},
        success=None if None in rates else np.array(rates, float),
        solved=sum(bool(r.solved_reference) for r in mine),
        redrawn=sum(r.redrawn for r in mine),
        diverged=sum(r.diverged for r in mine),
        seconds=float(np.mean([r.seconds or 0.0 for r in mine])),
    )


@dataclass(frozen=True)
class Contrast:
    """A randomisation held against another: differences in percent of the oracle, one for each seed.

    Args:
        name: of the one.
        other: of the other.
        gains: mean over the targets that have both with the same seeds.
        by_target: in each of these.
    """

    name: str
    other: str
    gains: list[float]
    by_target: dict[Target, list[float]]


def contrasts(given: Sequence[Row]) -> list[Contrast]:
    """What every randomisation is worth against others.

    Each is held against the prior with the same noise and delay; what makes it wider or less against the whole
    posterior; noise and delay against none.
    """
    by_name: dict[str, dict[Target, dict[int, float]]] = {}
    for row in given:
        by_name.setdefault(row.name, {})[row.group] = row.by_seed
    pairs = [
        (name, other)
        for name in in_order(set(by_name) - {TRUTH})
        for parts in _partners(_parts(name))
        for other in by_name
        if _parts(other) == parts
    ]
    compared = (_contrast(name, by_name[name], other, by_name[other]) for name, other in pairs)
    return [contrast for contrast in compared if contrast is not None]


def _parts(name: str) -> frozenset[str]:
    return frozenset(name.split(", "))


def _partners(parts: frozenset[str]) -> list[frozenset[str]]:
    """What a randomisation of these parts is held against."""
    noise = frozenset(part for part in parts if part.split("=")[0] in DISTURBING)
    shape = frozenset(part for part in parts if "=" in part) - noise
    prior = [] if PRIOR in parts else [noise | {PRIOR}]
    return prior + [parts - shape] * bool(shape) + [parts - noise] * bool(noise)


def _contrast(
    name: str, mine: dict[Target, dict[int, float]], other: str, theirs: dict[Target, dict[int, float]]
) -> Contrast | None:
    by_target = {
        target: {seed: value - theirs[target][seed] for seed, value in values.items()}
        for target, values in mine.items()
        if values and values.keys() == theirs.get(target, {}).keys()
    }
    seeds = set.intersection(*(set(gains) for gains in by_target.values())) if by_target else set()
    if not seeds:
        return None
    gains = [float(np.mean([gained[seed] for gained in by_target.values()])) for seed in sorted(seeds)]
    return Contrast(name, other, gains, {target: list(gained.values()) for target, gained in by_target.items()})


def by_quality(given: Sequence[Row]) -> tuple[dict[Target, float], float] | None:
    """Spearman's rank correlation of percent of the oracle with -CRPS over a target's randomisations.

    The oracle, of the best CRPS by definition, and variations, which share a posterior, do not count.

    Returns:
        Correlations by target with four randomisations at least, and the p-value of their mean by permutations within
        the targets; None without such a target.
    """
    ranked = {}
    for target in dict.fromkeys(row.group for row in given):
        plain = [row for row in given if row.group == target and row.name != TRUTH and "," not in row.name]
        of = [(-r.crps, r.percent[0]) for r in plain if r.crps is not None and r.percent is not None]
        if len(of) >= RULES.ranked:
            ranked[target] = np.array([_standard_ranks(column) for column in np.array(of).T])
    if not ranked:
        return None
    rng = np.random.default_rng(0)
    correlations = {target: float(np.mean(one * other)) for target, (one, other) in ranked.items()}
    size = (RULES.permutations, 1)
    chance = np.mean(
        [rng.permuted(np.tile(other, size), axis=1) @ one / len(one) for one, other in ranked.values()], axis=0
    )
    observed = float(np.mean(list(correlations.values())))
    return correlations, float((1 + (np.abs(chance) >= abs(observed) - 1e-12).sum()) / (1 + RULES.permutations))


def _standard_ranks(values: FloatArray) -> FloatArray:
    """Ranks with mean zero and variance one; of equal values zero."""
    ranks = stats.rankdata(values)
    spread = ranks.std()
    return (ranks - ranks.mean()) / spread if spread > 0 else np.zeros(len(values))
