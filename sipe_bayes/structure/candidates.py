"""Which extensions a fit asks for: score tests against the residuals, all else free to follow.

At the estimate the effect of an extension along its probes has a best size and a gain in log-likelihood (C. R. Rao
1948, https://doi.org/10.1017/S0305004100023987). The noise, which what a model lacks has made larger and slower, is
estimated anew with each.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from sipe_bayes.core.arrays import FloatArray, IntArray
from sipe_bayes.structure.augmented import AugmentedModel
from sipe_bayes.structure.extension import Placed
from sipe_bayes.structure.probes import Effect, bounds

_ESTIMATED = 60  # shapes; of 379 on a six-joint arm the best twelve were among the 46 best at the noise of the fit


@dataclass(frozen=True)
class Candidate:
    """An extension that is to gain ``gain`` nats; where a fit starts: its own theta (P,), the others' (N,)."""

    placed: Placed
    gain: float
    theta: FloatArray
    others: FloatArray


def rank_candidates(logs: AugmentedModel) -> list[Candidate]:
    """The extensions of a linear model ranked by their predicted gains, best first, each in the best of its shapes.

    The noise is estimated anew for the ``_ESTIMATED`` shapes of the largest gains at the noise of the fit.
    """
    ends = np.cumsum([len(effect.probes) for effect in logs.effects])
    shapes = [(one, np.arange(end - len(one.probes), end)) for one, end in zip(logs.effects, ends, strict=True)]
    rough = [_candidate(logs, *shape, 0.0, logs.fitted_at_noise) for shape in shapes]
    plain = logs.fitted(np.zeros(0, int))[0]
    ranked, best = dict[str, Candidate](), sorted(range(len(rough)), key=lambda k: -rough[k].gain)
    for place, k in enumerate(best):
        candidate = _candidate(logs, *shapes[k], plain, logs.fitted) if place < _ESTIMATED else rough[k]
        label = candidate.placed.label
        if label not in ranked or candidate.gain > ranked[label].gain:
            ranked[label] = candidate
    return sorted(ranked.values(), key=lambda candidate: -candidate.gain)


def _candidate(
    logs: AugmentedModel,
    effect: Effect,
    columns: IntArray,
    plain: float,
    fit: Callable[[IntArray], tuple[float, FloatArray]],
) -> Candidate:
    """An extension's predicted gain within its bounds, beside the log-likelihood ``plain`` without it."""
    at, probes = effect.placed.plain, effect.probes
    low, high = bounds(at, probes)
    use = np.ones(len(probes), bool)
    while use.any():
        amplitude = np.zeros(len(probes))
        level, amplitude[use] = fit(columns[use])
        amplitude /= effect.size
        wrong = use & ((amplitude < 0) & (low >= 0) | (amplitude > 0) & (high <= 0))
        if not wrong.any():
            break
        use &= ~wrong
    else:
        amplitude, level = np.zeros(len(probes)), plain
    if effect.trades.any():  # what they change goes with the square of their size
        amplitude = np.sqrt(np.maximum(amplitude, 0.0))
    amplitude = np.clip(amplitude, low, high)
    others = np.clip(logs.theta + amplitude @ effect.trades, 0.0, 1.0)
    whole = np.abs(amplitude).sum()
    value = at + amplitude @ (probes - at)
    shaped = np.abs(probes - at).max(0) > 0.1  # of a parameter's range: a probe that goes further gives a shape
    shaped |= (len(probes) > 1) & (np.ptp(probes, axis=0) == 0)
    if whole > 0 and not effect.trades.any():
        value = np.where(shaped, np.abs(amplitude) / whole @ probes, value)
    inside = np.clip(value, 0.02, 0.98)  # where a fit may start
    return Candidate(effect.placed, logs.share * (level - plain), inside, others)
