"""Which extensions a fit asks for: score tests against the residuals, all else free to follow.

At the estimate, with parameters and initial states free to follow (linearised), the effect of an extension along its
probes has a best size and a gain in log-likelihood (C. R. Rao 1948, https://doi.org/10.1017/S0305004100023987). What a
model lacks has made the noise larger and slower than it is, so the noise is estimated anew with each extension.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from sipe_bayes.core.arrays import FloatArray, IntArray
from sipe_bayes.structure.augmented import AugmentedModel, Fitted
from sipe_bayes.structure.extension import Placed
from sipe_bayes.structure.probes import Effect, bounds

_SHAPED = 0.1  # of a parameter's range: a probe that goes further gives a shape, not a size
_ESTIMATED = 60  # shapes; of 379 on a six-joint arm the best twelve were among the 46 best at the noise of the fit
_INSIDE = 0.02, 0.98  # of a range, where a fit may start


@dataclass(frozen=True)
class Candidate:
    """An extension with its predicted gain.

    Args:
        placed: which.
        gain: log-likelihood that it is to gain, in nats.
        theta: (P,) its parameters where a fit is to start.
        others: (N,) where the parameters beside it are to start.
    """

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
    plain = logs.fitted(np.zeros(0, int)).level
    ranked, best = dict[str, Candidate](), sorted(range(len(rough)), key=lambda k: -rough[k].gain)
    for place, k in enumerate(best):
        candidate = _candidate(logs, *shapes[k], plain, logs.fitted) if place < _ESTIMATED else rough[k]
        label = candidate.placed.label
        if label not in ranked or candidate.gain > ranked[label].gain:
            ranked[label] = candidate
    return sorted(ranked.values(), key=lambda candidate: -candidate.gain)


def _candidate(
    logs: AugmentedModel, effect: Effect, columns: IntArray, plain: float, fit: Callable[[IntArray], Fitted]
) -> Candidate:
    """An extension's predicted gain within its bounds, beside the log-likelihood ``plain`` without it."""
    at, probes = effect.placed.plain, effect.probes
    low, high = bounds(at, probes)
    size = np.array([logs.probes[k].size for k in columns])
    use = np.ones(len(probes), bool)
    amplitude, level = np.zeros(len(probes)), plain
    while use.any():
        fitted = fit(columns[use])
        amplitude[:] = 0.0
        amplitude[use] = fitted.sizes / size[use]
        wrong = use & ((amplitude < 0) & (low >= 0) | (amplitude > 0) & (high <= 0))
        if not wrong.any():
            level = fitted.level
            break
        use &= ~wrong
        amplitude[:] = 0.0
    if effect.trades.any():  # what they change goes with the square of their size
        amplitude = np.sqrt(np.maximum(amplitude, 0.0))
    amplitude = np.clip(amplitude, low, high)
    others = np.clip(logs.theta + amplitude @ effect.trades, 0.0, 1.0)
    whole = np.abs(amplitude).sum()
    value = at + amplitude @ (probes - at)
    shaped = np.abs(probes - at).max(0) > _SHAPED  # what a probe had beside its size
    shaped |= (len(probes) > 1) & (np.ptp(probes, axis=0) == 0)
    if whole > 0 and not effect.trades.any():
        value = np.where(shaped, np.abs(amplitude) / whole @ probes, value)
    gain = logs.share * (level - plain)
    return Candidate(effect.placed, gain, np.clip(value, *_INSIDE), others)
