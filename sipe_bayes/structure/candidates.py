"""Which extensions a fit asks for: score tests against the residuals, all else free to follow.

At the estimate, with parameters and windows' starts free to follow (linearised), the effect of an extension along its
probes has a best amplitude and a gain in log-likelihood (C. R. Rao 1948,
https://doi.org/10.1017/S0305004100023987). What a model lacks has made the noise larger and slower than it is, so the
noise is estimated anew with each extension.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.inference.recorded import Tell, silent
from sipe_bayes.likelihood import FLAT_PRECISION, BoundLikelihood, Linearisation, Noise, QuadraticPrior
from sipe_bayes.structure.extension import Placed
from sipe_bayes.structure.probes import Effect, bounds, effects

_FAINT = 1e-6  # of a probe's information, of its prior: what theta and the starts imitate to within that has no size
_SHAPED = 0.1  # of a parameter's range: a probe that goes further gives a shape, not a size
_INSIDE = 0.02, 0.98  # of a range, where a fit may start


@dataclass(frozen=True)
class Candidate:
    """An extension with what it promises.

    Args:
        placed: which.
        gain: log-likelihood that it is to gain, in nats.
        theta: (P,) its parameters where a fit is to start.
        amplitude: (K,) of its probes.
        others: (N,) where the parameters beside it are to start.
    """

    placed: Placed
    gain: float
    theta: FloatArray
    amplitude: FloatArray
    others: FloatArray


def candidates(
    windows: BoundLikelihood,
    theta: FloatArray,
    starts: FloatArray,
    noise: Noise,
    prior: QuadraticPrior,
    placed: Sequence[Placed],
    tell: Tell = silent,
) -> list[Candidate]:
    """Extensions ranked by what they promise, best first; costs a linearisation and a rollout for each probe.

    Args:
        windows: the logs.
        theta: (N,), the estimate.
        starts: (W, D), there.
        noise: (C,), there.
        prior: of theta.
        placed: the extensions.
        tell: called with what is being done.
    """
    linearisation = windows.linearise(theta, starts)
    around = _Around(windows, theta, starts, noise, prior, linearisation)
    plain = around.fitted(np.zeros((*linearisation.residual.shape, 0)))
    seen = effects(windows, theta, starts, placed, tell)
    ranked: dict[str, Candidate] = {}
    for candidate in (around.candidate(effect, plain) for effect in seen):
        label = candidate.placed.label
        if label not in ranked or candidate.gain > ranked[label].gain:  # the best of its shapes
            ranked[label] = candidate
    return sorted(ranked.values(), key=lambda candidate: -candidate.gain)


def promised(
    windows: BoundLikelihood,
    theta: FloatArray,
    starts: FloatArray,
    noise: Noise,
    prior: QuadraticPrior,
    change: FloatArray,
) -> float:
    """Log-likelihood in nats that predictions which change so (W, L, C), by any amount, are to gain; at least none.

    The other arguments are those of ``candidates``.
    """
    if not change.any():
        return 0.0
    around = _Around(windows, theta, starts, noise, prior, windows.linearise(theta, starts))
    plain, with_it = (around.fitted(c) for c in (np.zeros((*change.shape, 0)), change[..., None]))
    return max(with_it.level - plain.level, 0.0) if with_it.amplitude[0] > 0 else 0.0


@dataclass(frozen=True)
class _Fitted:
    """The linear model with K probes at its best noise: log-likelihood, amplitudes (K,), whitened squares."""

    level: float
    amplitude: FloatArray
    noise: Noise


@dataclass(frozen=True)
class _Around:
    """The logs linearised at an estimate."""

    windows: BoundLikelihood
    theta: FloatArray
    starts: FloatArray
    noise: Noise
    prior: QuadraticPrior
    lin: Linearisation

    def candidate(self, effect: Effect, plain: _Fitted) -> Candidate:
        """What an extension promises, within its bounds, beside the linear model without it."""
        at, probes = effect.placed.plain, effect.probes
        low, high = bounds(at, probes)
        use = np.ones(len(probes), bool)
        amplitude, level = np.zeros(len(probes)), plain.level
        while use.any():
            fitted = self.fitted(effect.change[..., use])
            amplitude[:] = 0.0
            amplitude[use] = fitted.amplitude
            wrong = use & ((amplitude < 0) & (low >= 0) | (amplitude > 0) & (high <= 0))
            if not wrong.any():
                level = fitted.level
                break
            use &= ~wrong
            amplitude[:] = 0.0
        if effect.trades.any():  # what they change goes with the square of their size
            amplitude = np.sqrt(np.maximum(amplitude, 0.0))
        amplitude = np.clip(amplitude, low, high)
        others = np.clip(self.theta + amplitude @ effect.trades, 0.0, 1.0)
        size = np.abs(amplitude).sum()
        value = at + amplitude @ (probes - at)
        shaped = np.abs(probes - at).max(0) > _SHAPED  # what a probe had beside its size
        shaped |= (len(probes) > 1) & (np.ptp(probes, axis=0) == 0)
        if size > 0 and not effect.trades.any():
            value = np.where(shaped, np.abs(amplitude) / size @ probes, value)
        return Candidate(effect.placed, level - plain.level, np.clip(value, *_INSIDE), amplitude, others)

    def fitted(self, change: FloatArray) -> _Fitted:
        """The best noise, and what the probes' changes (W, L, C, K) amount to with all else following."""
        n, k, windows, jacobian = len(self.theta), change.shape[-1], self.windows, self.lin.jacobian
        columns = np.concatenate([jacobian[..., :n], change, jacobian[..., n:]], axis=-1)
        moments = windows.moments(Linearisation(self.lin.residual, columns, self.lin.valid))
        precision, pull = np.zeros((n + k, n + k)), np.zeros(n + k)
        precision[:n, :n], pull[:n] = self.prior.precision + FLAT_PRECISION * np.eye(n), self.prior.pull(self.theta)
        normal = moments.normal(self.noise)
        # probes of no size of their own, so that the information exists
        precision[n:, n:] = _FAINT * np.diag(np.diag(normal.sum(0))[n : n + k])
        noise = windows.estimate_noise(moments, self.noise, windows.pulls(precision, pull, self.starts), True)
        normal = moments.normal(noise)
        arrow = windows.eliminate(normal, n + k, self.starts)
        total = arrow.gradient + pull
        step = np.linalg.solve(arrow.precision + precision, total)
        square = float(normal[:, -1, -1].sum()) - arrow.explained - float(total @ step)
        return _Fitted(-0.5 * (moments.log_determinant(noise) + square), np.asarray(step[n:], float), noise)
