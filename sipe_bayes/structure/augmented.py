r"""One linear model of the logs at an estimate: parameters, what they may lack, and what differs between logs.

The columns beside those of the N parameters and of the initial states are probes, what each extension would do to every
sample (``structure.probes``). In

.. math:: r = J_\theta \delta + E b + J_x x + \varepsilon

initial states are eliminated and theta is projected out; S, the information of b, and q, its score, are left.

What a model lacks is a smooth force: what it leaves of the whitened samples remembers itself. Their integrated
autocorrelation time, a factor on the noise's variance, gives scores at low frequencies the variance that they show, as
in the adjustment of a composite likelihood (R. Chandler, S. Bate, "Inference for clustered data using the independence
loglikelihood", Biometrika 94 (2007), 167-183, https://doi.org/10.1093/biomet/asm015); by channel, not by a matrix.
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
from sipe_bayes.core.telling import Tell, silent
from sipe_bayes.likelihood import FLAT_PRECISION, BoundLikelihood, Eliminated, Linearisation, Noise, QuadraticPrior
from sipe_bayes.simulation.callable_simulator import CallableSimulator
from sipe_bayes.structure.extension import Placed
from sipe_bayes.structure.probes import bounds, effects, place_extensions, probes_cost

_FAINT = 1e-6  # of a probe's information, of its prior: what theta and the starts imitate to within that has no size
_PRESSED = 1e-6  # of the range: a parameter that the search left on its bound


def steps_of(windows: BoundLikelihood, placed: Sequence[Placed]) -> int:
    """Control steps of the windows that are probed: so many that probes take about half a million physics steps."""
    if isinstance(windows.simulator, CallableSimulator):
        return 4000
    each = max(probes_cost(windows, placed) / len(windows.trajectories), 1.0)
    return int(min(4000, 5e5 / (each * windows.simulator.physics_steps(float(windows.dt.min()))[0])))


@dataclass(frozen=True)
class Projected:
    """K probes with initial states and theta (N,) projected out: their information S (K, K) and score q (K,).

    Args:
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


class DivergesError(ValueError):
    """A simulation that diverges at the estimate."""


class AugmentedModel:
    """The logs linearised at the estimate, with K probes beside the N parameters.

    Costs a linearisation and a rollout for each probe. Of long or many logs some windows are looked at, spread evenly;
    ``share`` is how many times as many there are. ``probes`` and ``one_sided`` (K,), whether the size of each may not
    be negative, are in the order of ``effects``; ``jacobian`` has columns of theta, probes and starts.

    Args:
        windows: the logs, W windows of C channels.
        theta, noise: (N,) the estimate, and (C,) there.
        starts, prior: (W, D) of the windows, default the best; and of the fit, default flat.
        lin: at theta and starts, where it is known.
        tell, kept, placed: see ``effects``; by default extensions are all of the registry.

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
        n, prior = len(theta), prior or QuadraticPrior(theta, np.zeros((len(theta), len(theta))))
        self.windows, self.theta, self.noise, self.starts = windows, theta, noise, starts
        lin = lin or windows.linearise(theta, starts)
        if not lin.valid:
            raise DivergesError("theta: the simulation diverges at the estimate; nothing can be said of its residuals")
        try:
            self.effects = effects(windows, theta, starts, placed, tell, kept)
        finally:
            whole.rollouts = windows.rollouts
        self.probes = [probe for effect in self.effects for probe in effect.named()]
        one_sided = [bounds(effect.placed.plain, effect.probes)[0] >= 0 for effect in self.effects]
        self.one_sided = np.concatenate([np.zeros(0, bool), *one_sided])
        changes = [effect.change / effect.size for effect in self.effects]
        self.residual = lin.residual
        self.jacobian = np.concatenate([lin.jacobian[..., :n], *changes, lin.jacobian[..., n:]], axis=-1)
        self.count, self.coloured = n + len(self.probes), bool((noise.tau > 0).any())
        self.inner, self.pull = prior.precision + FLAT_PRECISION * np.eye(n), prior.pull(theta)
        self._trades = np.array([probe.trade for probe in self.probes]).reshape(-1, n)
        self.rows = WhitenedRows(self.jacobian, windows)
        self.seen = AtNoise(self, noise)

    def estimate_noise(self, before: Noise, sizes: FloatArray) -> Noise:
        """The noise where probes have sizes (K,), all else being free to follow; searched from ``before``."""
        n, windows = self.windows.num_theta, self.windows
        own = np.delete(self.jacobian, np.s_[n : self.count], axis=-1)
        lin = Linearisation(self.residual - self.jacobian[..., n : self.count] @ sizes, own, True)
        pulls = windows.pulls(self.inner, self.pull, self.starts, AtNoise(self, before, sizes).free)
        noise = windows.estimate_noise(windows.moments(lin), before, pulls, self.coloured)
        return Noise(np.maximum(noise.sd, windows.rounding), noise.tau)

    def rests(self, sd: FloatArray) -> BoolArray:
        """Which channels (C,) have no more noise, of sd (C,), than the simulation's rounding, as of a joint at rest."""
        return np.asarray(sd < 2.0 * self.windows.rounding)

    @property
    def scatter(self) -> Noise | None:
        """White noise of the samples' scatter in channels whose fit takes far more for noise; None without such."""
        noise, scatter = self.noise, self.windows.level.sd
        holds = (scatter * 1.4 < noise.sd) & ~self.rests(scatter)  # from there on noise hides as much again
        return Noise(np.where(holds, scatter, noise.sd), np.where(holds, 0.0, noise.tau)) if holds.any() else None

    def fitted(self, columns: IntArray, before: Noise | None = None) -> tuple[float, FloatArray]:
        """The log-likelihood in nats with some probes (J,) at their best sizes (J,), and these, at the best noise.

        That is searched from ``before``, by default from the fit's.
        """
        before, n, windows = before or self.noise, self.windows.num_theta, self.windows
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
        step = np.linalg.solve(arrow.precision + precision, arrow.gradient + pull)
        square = float(normal[:, -1, -1].sum()) - arrow.explained - float((arrow.gradient + pull) @ step)
        return -0.5 * (moments.log_determinant(noise) + square), np.asarray(step[n:], float)

    def fitted_at_noise(self, columns: IntArray) -> tuple[float, FloatArray]:
        """The same at the noise of the fit, less the level without probes: a score test."""
        made = self.seen.projected
        information, score = made.information[np.ix_(columns, columns)], made.score[columns]
        sizes = np.linalg.solve(information + _FAINT * np.diag(made.whole[columns]), score)
        return 0.5 * float(score @ sizes), np.asarray(sizes, float)

    def traded(self, sizes: FloatArray) -> FloatArray:
        """By how much sizes (..., K) of the probes change theta itself (..., N), which they trade."""
        return np.sqrt(np.maximum(sizes, 0.0)) @ self._trades


class AtNoise:
    """The normal equations of an ``AugmentedModel`` beside a noise (C,), at sizes (K,) of its probes, or at none."""

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
        """(N,): which parameters are not held by a bound that the search left them on; by ``sizes`` some come away."""
        logs, n = self.logs, self.logs.windows.num_theta
        at_low, at_high = logs.theta <= _PRESSED, logs.theta >= 1 - _PRESSED
        if not (at_low | at_high).any():
            return np.ones(n, bool)
        root = np.linalg.cholesky(self.arrow.precision[:n, :n] + logs.inner)
        pull = self.arrow.gradient[:n] + logs.pull - self.arrow.precision[:n, n:] @ self.sizes
        limits = np.where(at_low, 0.0, -np.inf), np.where(at_high, 0.0, np.inf)
        step = scipy.optimize.lsq_linear(root.T, np.linalg.solve(root, pull), limits, tol=1e-12)
        return np.asarray(step.active_mask == 0)

    @functools.cached_property
    def projected(self) -> Projected:
        """Theta projected out of the probes."""
        logs, arrow, n = self.logs, self.arrow, self.logs.windows.num_theta
        covariance, among = np.zeros((n, n)), np.ix_(self.free, self.free)
        covariance[among] = np.linalg.inv((arrow.precision[:n, :n] + logs.inner)[among])
        pull, cross = arrow.gradient[:n] + logs.pull, arrow.precision[:n, n:]
        base, answer = covariance @ pull, covariance @ cross
        information, score = arrow.precision[n:, n:] - cross.T @ answer, arrow.gradient[n:] - cross.T @ base
        own = np.maximum(np.diag(arrow.precision[:n, :n] + logs.inner), 1e-300)
        pressed = np.where(self.free, 0.0, (pull - cross @ self.sizes) / own)
        return Projected(information, score, np.diag(arrow.precision)[n:], answer, covariance, base, pressed)

    def left(self, sizes: FloatArray) -> FloatArray:
        """The residual (W, L, C) that is left where the probes have sizes (K,) and all else follows."""
        logs, step = self.logs, np.concatenate([self.projected.base - self.projected.answer @ sizes, sizes])
        moved = logs.jacobian[..., : logs.count] @ step
        turned = np.einsum("wlcd,wd->wlc", logs.jacobian[..., logs.count :], self.arrow.blocks(step))
        return np.where(logs.windows.observed, logs.residual - moved - turned, 0.0)

    @functools.cached_property
    def discounted(self) -> AtNoise:
        """The same beside a noise whose samples tell no more than they do beside those around them."""
        memory = [
            max(1.0, float(emcee.autocorr.integrated_time(z[0], tol=0)[0])) if z.shape[1] >= 50 and z.std() else 1.0
            for z in self.logs.windows.whitened(self.left(self.sizes)[None], self.noise)
        ]
        return AtNoise(self.logs, Noise(self.noise.sd * np.sqrt(memory), self.noise.tau), self.sizes)


class WhitenedRows:
    """Rows of a Jacobian (W, L, C, N + K + D), and the row before each, to be whitened by a noise.

    The sums of ``Moments``, which serve any noise, grow with the square of the columns. Where there are many of these
    and few noises, it is cheaper to whiten the rows for each, and to form only the products that are asked for.
    """

    def __init__(self, jacobian: FloatArray, windows: BoundLikelihood) -> None:
        self.num_theta, self.sequences = jacobian.shape[-1] - windows.num_start, windows.sequences
        self._shape = w, length, channels = jacobian.shape[:3]
        place = np.arange(w * channels * length).reshape(w, channels, length).swapaxes(0, 1).reshape(channels, -1)
        # rows (W, C, L) of observed samples, and of those before them, where there are such
        self._place = np.concatenate([place[c, s.index] for c, s in enumerate(self.sequences)])
        self._linked = np.concatenate([s.previous for s in self.sequences]) >= 0
        self._previous = np.concatenate([place[c, s.previous] for c, s in enumerate(self.sequences)])[self._linked]
        self._crosses = self._placed([s.crosses.astype(float) for s in self.sequences]) > 0
        self._rows, self._before = self._both(jacobian)

    def normal(self, residual: FloatArray, noise: Noise) -> FloatArray:
        """Products (W, K', K') of all columns with a residual (W, L, C), as ``Moments.normal`` gives them."""
        rows = np.concatenate(self._whitened(residual[..., None], noise), axis=-1)
        return np.swapaxes(rows, 1, 2) @ rows

    def scores(self, residuals: FloatArray, noise: Noise) -> tuple[FloatArray, FloatArray]:
        """Products of the columns with residuals (W, L, C, S): (N + K, S), and of each window's start (W, D, S)."""
        theta, starts, white = self._whitened(residuals, noise)
        d = starts.shape[-1] // 2
        each = np.swapaxes(starts, 1, 2) @ white
        force = each[:, :d].copy()
        force[:-1] += each[1:, d:]
        return np.einsum("wrk,wrs->ks", theta, white, optimize=True), force

    def _whitened(self, residuals: FloatArray, noise: Noise) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Rows (W, C L, N + K), (W, C L, 2 D) of [x_w | x_{w-1}], and those of residuals (W, L, C, S): (W, C L, S)."""
        n, memory = self.num_theta, [s.coefficients(tau) for s, tau in zip(self.sequences, noise.tau, strict=True)]
        weights = [1 / (sd * np.sqrt(1 - a**2)) for sd, a in zip(noise.sd, memory, strict=True)]
        weight, lag = self._placed(weights), self._placed([a * x for a, x in zip(memory, weights, strict=True)])
        inside = np.where(self._crosses, 0.0, lag)
        theta = weight * self._rows[..., :n] - lag * self._before[..., :n]
        own = weight * self._rows[..., n:] - inside * self._before[..., n:]
        # across an edge the row before belongs to the start of the window before
        earlier = (inside - lag) * self._before[..., n:]
        left, before = self._both(residuals)
        return theta, np.concatenate([own, earlier], axis=-1), weight * left - lag * before

    def _both(self, values: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Observed rows (W, C L, q) of values (W, L, C, q), and what is in the row before each; else zero."""
        windows, length, channels = self._shape
        flat = np.moveaxis(values, 2, 1).reshape(windows * channels * length, -1)
        rows, before = np.zeros((2, *flat.shape))
        rows[self._place] = flat[self._place]
        before[self._place[self._linked]] = flat[self._previous]
        rows, before = (one.reshape(windows, channels * length, flat.shape[1]) for one in (rows, before))
        return rows, before

    def _placed(self, values: list[FloatArray]) -> FloatArray:
        """Numbers of each channel's samples at their rows (W, C L, 1), zero where nothing was observed."""
        windows, length, channels = self._shape
        out = np.zeros(windows * channels * length)
        out[self._place] = np.concatenate(values)
        return out.reshape(windows, -1, 1)
