r"""One linear model of the logs at an estimate: parameters, what they may lack, and what differs between logs.

The columns beside those of the N parameters and of the initial states are probes: what each extension of the table
would do to every sample (``structure.probes``), and what numbers with a tolerance would. In

.. math:: r = J_\theta \delta + E b + J_x x + \varepsilon

initial states are eliminated and theta is projected out, so that everything that is asked of the probes (which fit, how
large they are, how far they move theta) is small linear algebra: S, the information of b, and q, its score.

What a model lacks is a smooth force, and what it leaves of the samples, whitened by the noise of the fit, remembers
itself: many such samples tell as much as one of its own would. With their integrated autocorrelation time as a factor
on the variance of the noise scores at low frequencies have the variance that they show, as in the adjustment of a
composite likelihood (R. Chandler, S. Bate, "Inference for clustered data using the independence loglikelihood",
Biometrika 94 (2007), 167-183, https://doi.org/10.1093/biomet/asm015); a factor for each channel instead of a matrix.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass

import emcee
import numpy as np
import scipy.optimize

from sipe_bayes.core.arrays import BoolArray, FloatArray, IntArray
from sipe_bayes.core.checkpoint import NOTHING_KEPT, Kept
from sipe_bayes.core.options import Options, option
from sipe_bayes.core.telling import Tell, silent
from sipe_bayes.likelihood import (
    FLAT_PRECISION,
    BoundLikelihood,
    Eliminated,
    Linearisation,
    Noise,
    QuadraticPrior,
)
from sipe_bayes.simulation.callable_simulator import CallableSimulator
from sipe_bayes.structure.extension import Placed
from sipe_bayes.structure.probes import place_extensions, probes, probes_cost
from sipe_bayes.structure.whitened_rows import WhitenedRows

_SHORT = 50  # samples, of which no memory is asked
_FAINT = 1e-6  # of a probe's information, of its prior: what theta and the starts imitate to within that has no size
_PRESSED = 1e-6  # of the range: a parameter that the search left on its bound


@dataclass(frozen=True)
class AugmentedOptions(Options):
    """How much is simulated."""

    simulated_steps: float = option(5e5, "physics steps of all probes together, about", above=0)
    hides: float = option(1.4, "of the samples' scatter: from here on noise hides as much again", above=1)
    rounding: float = option(2.0, "of the simulation's rounding, below which noise is that", least=1)
    steps: int = option(4000, "of windows spread evenly over long logs: each probe is a simulation", "control steps")


AUGMENTED = AugmentedOptions()


def steps_of(windows: BoundLikelihood, placed: Sequence[Placed]) -> int:
    """Control steps of the windows that are probed: so many that all probes together stay within their cost."""
    if isinstance(windows.simulator, CallableSimulator):
        return AUGMENTED.steps
    each = max(probes_cost(windows, placed) / len(windows.trajectories), 1.0)
    skip = windows.simulator.physics_steps(float(windows.dt.min()))[0]
    return int(min(AUGMENTED.steps, AUGMENTED.simulated_steps / (each * skip)))


@dataclass(frozen=True)
class Projected:
    """K probes with initial states and theta (N,) projected out.

    Args:
        information: S (K, K).
        score: q (K,).
        whole: (K,) information of each with theta known: of one that theta can imitate far more than that in S.
        answer: (N, K): by how much theta moves back for one of each.
        covariance: (N, N) of theta; zero of parameters that the search left on their bounds.
        base: (N,) step of theta without probes.
        pressed: (N,) how far beyond its bound each parameter would go by itself that a bound holds; else zero.
    """

    information: FloatArray
    score: FloatArray
    whole: FloatArray
    answer: FloatArray
    covariance: FloatArray
    base: FloatArray
    pressed: FloatArray


@dataclass(frozen=True)
class Fitted:
    """Some probes at their best: log-likelihood in nats, and sizes (J,)."""

    level: float
    sizes: FloatArray


class DivergesError(ValueError):
    """A simulation that diverges at the estimate."""


class AugmentedModel:
    """The logs linearised at the estimate, with K probes beside the N parameters.

    Costs a linearisation and a rollout for each probe. Of long or many logs some windows are looked at, spread evenly.

    ``share`` is how many times as many windows there are as are looked at.

    Args:
        windows: the logs, W windows of C channels.
        theta: (N,) the estimate.
        noise: (C,) there.
        starts: (W, D) of the windows; default the best.
        prior: of the fit; default flat.
        lin: at theta and starts, where it is known.
        tell: called with what is being done.
        kept: keeps what extensions do.
        placed: extensions that are probed; default all that the registry has.

    Raises:
        DivergesError: where the simulation diverges at theta.
    """

    def __init__(
        self,
        windows: BoundLikelihood,
        theta: FloatArray,
        noise: Noise,
        starts: FloatArray | None = None,
        prior: QuadraticPrior | None = None,
        lin: Linearisation | None = None,
        tell: Tell = silent,
        kept: Kept = NOTHING_KEPT,
        placed: Sequence[Placed] | None = None,
    ) -> None:
        if placed is None:
            placed = place_extensions(windows, theta, windows.no_starts() if starts is None else starts)
        whole, some = windows, windows.spread_over(steps_of(windows, placed))
        self.share = windows.num_windows / len(some)
        if len(some) < windows.num_windows:
            windows, starts = windows.part(some), None if starts is None else starts[some]
            lin = None if lin is None else lin.part(some)
        starts = windows.fit_starts(theta, noise)[0] if starts is None else starts
        prior = QuadraticPrior(theta, np.zeros((len(theta), len(theta)))) if prior is None else prior
        self.windows, self.theta, self.noise, self.starts = windows, theta, noise, starts
        linearisation = lin or windows.linearise(theta, starts)
        if not linearisation.valid:
            raise DivergesError("theta: the simulation diverges at the estimate; nothing can be said of its residuals")
        try:
            made = probes(windows, theta, starts, placed, tell, kept)
        finally:
            whole.rollouts = windows.rollouts
        self.probes, self.one_sided, self.effects = made.named, made.one_sided, made.effects
        n = windows.num_theta
        parts = (linearisation.jacobian[..., :n], made.change, linearisation.jacobian[..., n:])
        self.residual, self.jacobian = linearisation.residual, np.concatenate(parts, axis=-1)
        self.count, self.coloured = n + len(self.probes), bool((noise.tau > 0).any())
        self.inner, self.pull = prior.precision + FLAT_PRECISION * np.eye(n), prior.pull(theta)
        self.rows = WhitenedRows(self.jacobian, windows)
        self.seen = AtNoise(self, noise)

    def left(self, residual: FloatArray, step: FloatArray, starts: FloatArray) -> FloatArray:
        """What a step of theta and probes (N + K,) and one of the starts (W, D) leave of a residual (W, L, C)."""
        moved = self.jacobian[..., : self.count] @ step
        turned = np.einsum("wlcd,wd->wlc", self.jacobian[..., self.count :], starts)
        return np.where(self.windows.observed, residual - moved - turned, 0.0)

    def estimate_noise(self, before: Noise, sizes: FloatArray) -> Noise:
        """The noise where the probes have sizes (K,), theta and the starts being free to follow; ``before`` another."""
        n, windows = self.windows.num_theta, self.windows
        own = np.concatenate([self.jacobian[..., :n], self.jacobian[..., self.count :]], axis=-1)
        lin = Linearisation(self.residual - self.jacobian[..., n : self.count] @ sizes, own, True)
        pulls = windows.pulls(self.inner, self.pull, self.starts, AtNoise(self, before, sizes).free)
        noise = windows.estimate_noise(windows.moments(lin), before, pulls, self.coloured)
        return Noise(np.maximum(noise.sd, windows.rounding), noise.tau)

    @property
    def scatter(self) -> Noise | None:
        """White noise of the samples' scatter in channels whose fit takes far more for noise; None without such."""
        noise, scatter = self.noise, self.windows.level.sd
        rests = scatter < AUGMENTED.rounding * self.windows.rounding
        holds = (scatter * AUGMENTED.hides < noise.sd) & ~rests
        return Noise(np.where(holds, scatter, noise.sd), np.where(holds, 0.0, noise.tau)) if holds.any() else None

    def fitted(self, columns: IntArray, before: Noise | None = None) -> Fitted:
        """The log-likelihood with some probes (J,) of any size, at the noise that is best with them.

        before: from which that noise is searched; default the fit's.
        """
        before = self.noise if before is None else before
        n, windows = self.windows.num_theta, self.windows
        every = np.concatenate([np.arange(n), n + columns, np.arange(self.count, self.jacobian.shape[-1])])
        moments = windows.moments(Linearisation(self.residual, self.jacobian[..., every], True))
        normal, count = moments.normal(before), n + len(columns)
        precision, pull = np.zeros((count, count)), np.zeros(count)
        precision[:n, :n], pull[:n] = self.inner, self.pull
        # probes of no size of their own, so that the information exists
        precision[n:, n:] = _FAINT * np.diag(np.diag(normal.sum(0))[n:count])
        noise = windows.estimate_noise(moments, before, windows.pulls(precision, pull, self.starts), True)
        normal = moments.normal(noise)
        arrow = windows.eliminate(normal, count, self.starts)
        total = arrow.gradient + pull
        step = np.linalg.solve(arrow.precision + precision, total)
        square = float(normal[:, -1, -1].sum()) - arrow.explained - float(total @ step)
        return Fitted(-0.5 * (moments.log_determinant(noise) + square), np.asarray(step[n:], float))

    def fitted_at_noise(self, columns: IntArray) -> Fitted:
        """The same at the noise of the fit, beside the level without probes: a score test, without a simulation."""
        made = self.seen.projected
        information, score = made.information[np.ix_(columns, columns)], made.score[columns]
        sizes = np.linalg.solve(information + _FAINT * np.diag(made.whole[columns]), score)
        return Fitted(0.5 * float(score @ sizes), np.asarray(sizes, float))

    def traded(self, sizes: FloatArray) -> FloatArray:
        """By how much sizes (..., K) of the probes change theta itself (..., N), which they trade."""
        return np.sqrt(np.maximum(sizes, 0.0)) @ self._trades

    @functools.cached_property
    def _trades(self) -> FloatArray:
        """(K, N) of each probe at size 1."""
        nothing = (0.0,) * self.windows.num_theta
        return np.array([probe.trade or nothing for probe in self.probes]).reshape(-1, len(nothing))


class AtNoise:
    """The normal equations of an ``AugmentedModel`` beside a noise, at sizes of its probes that are taken for likely.

    Args:
        logs: the model.
        noise: (C,) of the channels.
        sizes: (K,), by which parameters that the search left on a bound may come away from it; default none.
    """

    def __init__(self, logs: AugmentedModel, noise: Noise, sizes: FloatArray | None = None) -> None:
        self.logs, self.noise = logs, noise
        self.sizes = np.zeros(len(logs.probes)) if sizes is None else sizes
        self.normal = logs.rows.normal(logs.residual, noise)
        self.arrow: Eliminated = logs.windows.eliminate(self.normal, logs.count, logs.starts)

    def of_part(self, windows: IntArray) -> tuple[FloatArray, FloatArray]:
        """Precision (N + K, N + K) and gradient (N + K,) of some windows (V,) alone."""
        logs = self.logs
        part = logs.windows.part(windows)
        part.start_precision = logs.windows.start_precision
        arrow = part.eliminate(self.normal[windows], logs.count, logs.starts[windows])
        return arrow.precision, arrow.gradient

    @functools.cached_property
    def free(self) -> BoolArray:
        """(N,): which parameters are not held by a bound that the search left them on."""
        logs, n = self.logs, self.logs.windows.num_theta
        at_low, at_high = logs.theta <= _PRESSED, logs.theta >= 1 - _PRESSED
        precision = self.arrow.precision[:n, :n] + logs.inner
        pull = self.arrow.gradient[:n] + logs.pull - self.arrow.precision[:n, n:] @ self.sizes
        if not (at_low | at_high).any():
            return np.ones(n, bool)
        root = np.linalg.cholesky(precision)
        bounds = np.where(at_low, 0.0, -np.inf), np.where(at_high, 0.0, np.inf)
        step = scipy.optimize.lsq_linear(root.T, np.linalg.solve(root, pull), bounds, tol=1e-12)
        return np.asarray(step.active_mask == 0)

    @functools.cached_property
    def projected(self) -> Projected:
        """Theta projected out of the probes."""
        logs, arrow, n = self.logs, self.arrow, self.logs.windows.num_theta
        covariance, among = np.zeros((n, n)), np.ix_(self.free, self.free)
        covariance[among] = np.linalg.inv((arrow.precision[:n, :n] + logs.inner)[among])
        base = covariance @ (arrow.gradient[:n] + logs.pull)
        cross = arrow.precision[:n, n:]
        answer = covariance @ cross
        information = arrow.precision[n:, n:] - cross.T @ answer
        score = arrow.gradient[n:] - cross.T @ base
        pull = arrow.gradient[:n] + logs.pull - cross @ self.sizes
        own = np.maximum(np.diag(arrow.precision[:n, :n] + logs.inner), 1e-300)
        pressed = np.where(self.free, 0.0, pull / own)
        return Projected(information, score, np.diag(arrow.precision)[n:], answer, covariance, base, pressed)

    def left(self, sizes: FloatArray) -> FloatArray:
        """What is left of the residual (W, L, C) where the probes have sizes (K,) and all else follows."""
        step = np.concatenate([self.projected.base - self.projected.answer @ sizes, sizes])
        return self.logs.left(self.logs.residual, step, self.arrow.blocks(step))

    @functools.cached_property
    def discounted(self) -> AtNoise:
        """The same beside a noise whose samples tell no more than they do beside those around them."""
        left = self.logs.windows.whitened(self.left(self.sizes)[None], self.noise)
        memory = np.array([_memory(z[0]) for z in left])
        return AtNoise(self.logs, Noise(self.noise.sd * np.sqrt(memory), self.noise.tau), self.sizes)


def _memory(z: FloatArray) -> float:
    """Integrated autocorrelation time of z (n,), by emcee; at least one."""
    if len(z) < _SHORT or not z.std():
        return 1.0
    return max(1.0, float(emcee.autocorr.integrated_time(z, tol=0)[0]))
