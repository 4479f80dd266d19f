"""Logs linearised at an estimate, with what the library of extensions would do to them beside the parameters.

The columns of the linear model are the N parameters, K probes (a small step of each extension of ``structure``, see
``structure.probes``) and the windows' starts. What the checks of the residuals ask (``misfit.misspecification``) and
the intervals for a model that lacks something (``misfit.missing_physics``) are both answered in it.

What a model lacks is a smooth force, and what it leaves of the samples, whitened by the noise of the fit, remembers
itself: many such samples tell as much as one of its own would. With their integrated autocorrelation time as a factor
on the variance of the noise (``ProbedLogs.discounted``) scores at low frequencies have the variance that they show, as
in the adjustment of a composite likelihood (R. Chandler, S. Bate, "Inference for clustered data using the independence
loglikelihood", Biometrika 94 (2007), 167-183, https://doi.org/10.1093/biomet/asm015); a factor for each channel instead
of a matrix.
"""

from __future__ import annotations

import copy
import functools
from collections.abc import Sequence
from dataclasses import dataclass, field

import emcee
import numpy as np

from sipe_bayes.core.arrays import FloatArray, IntArray
from sipe_bayes.core.checkpoint import NOTHING_KEPT, Kept
from sipe_bayes.core.options import Options, option
from sipe_bayes.diagnostics.evaluate import best_starts
from sipe_bayes.diagnostics.misfit.whitened_rows import Products, WhitenedRows
from sipe_bayes.inference.recorded import Tell, silent
from sipe_bayes.likelihood import BoundLikelihood, Eliminated, Linearisation, Noise, QuadraticPrior
from sipe_bayes.simulation.callable_simulator import CallableSimulator
from sipe_bayes.structure.extension import Extension, Placed
from sipe_bayes.structure.probes import place_extensions, probes, probes_cost

FLAT_PRECISION = 1e-6  # keeps information invertible where a direction is open
_SHORT = 50  # samples, of which no memory is asked
_PRESSED = 1e-6  # of the range: a parameter that the search left on its bound


@dataclass(frozen=True)
class MisfitOptions(Options):
    """What residuals are asked, and how the null is simulated."""

    simulated: int = option(99, "draws of the null at most: p resolves a percent", least=1)
    exceeded: int = option(10, "draws odder than the logs, after which no more are made: they are not odd", least=1)
    pieces: int = option(10, "of a log, among which the largest mean square is looked for", least=1)
    lags: tuple[int, ...] = option((1, 2, 3, 5, 8, 13, 21, 34), "of a channel's memory, at every scale", "samples")
    alike: float = option(0.8, "of the best probe's statistic, from which another cause is named beside it", least=0)
    causes: int = option(3, "that are named at most", least=1)
    simulated_steps: float = option(1e6, "physics steps of all probes together, about", above=0)
    steps: int = option(4000, "of windows spread evenly over long logs: each probe is a simulation", "control steps")
    hides: float = option(1.4, "of the samples' scatter: from here on noise hides as much again", above=1)
    rounding: float = option(2.0, "of the simulation's rounding, below which noise is that", least=1)
    batch: int = option(20, "draws of the null whose products are formed together", least=1)


MISFIT = MisfitOptions()


@dataclass(frozen=True)
class Solved:
    """A residual solved for theta and starts, without the K probes.

    Args:
        statistics: (K + 2 C,) cube roots: probes, sums of squared autocorrelations, largest mean squares of a piece.
        left: (W, L, C) of the residual.
        step: (N + K,) of theta; zero of the probes.
        score: (K,) of each probe.
        information: (K,) of each probe, all else projected out; infinite of one whose size would be negative, or that
            theta can imitate.
        two_sided: (K,) the same of all, whatever their sign.
        answer: (N, K) of theta to the probes.
        variance: (N,) of theta.
    """

    statistics: FloatArray
    left: FloatArray
    step: FloatArray
    score: FloatArray
    information: FloatArray
    two_sided: FloatArray
    answer: FloatArray
    variance: FloatArray


@dataclass(frozen=True)
class _Statistics:
    """Rows (S, K + 2 C) of ``Solved.statistics``."""

    rows: FloatArray


@dataclass
class _Null:
    """Draws of the null as far as they were asked for, and where the next come from."""

    rng: np.random.Generator
    rows: list[FloatArray] = field(default_factory=list)


def steps_of(windows: BoundLikelihood, placed: Sequence[Placed]) -> int:
    """Control steps of the windows that are probed: so many that all probes together stay within their cost."""
    if isinstance(windows.simulator, CallableSimulator):
        return MISFIT.steps
    each = max(probes_cost(windows, placed) / len(windows.trajectories), 1.0)
    skip = windows.simulator.physics_steps(float(windows.dt.min()))[0]
    return int(min(MISFIT.steps, MISFIT.simulated_steps / (each * skip)))


class ProbedLogs:
    """The logs linearised at the estimate, with K probes beside the N parameters.

    Costs a linearisation and a rollout for each probe. Of long or many logs some windows are looked at, spread evenly.

    Args:
        windows: the logs, W windows of C channels.
        theta: (N,) the estimate.
        noise: (C,) there.
        starts: (W, D) of the windows; default the best.
        prior: of the fit; default flat.
        lin: at theta and starts, where it is known.
        tell: called with what is being done.
        kept: keeps what extensions do, and draws of the null.
        extensions: that are probed; default all that the registry has.

    Raises:
        ValueError: where the simulation diverges at theta.
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
        extensions: Sequence[Extension] | None = None,
    ) -> None:
        placed = place_extensions(windows, theta, windows.no_starts() if starts is None else starts, extensions)
        some = windows.spread_over(steps_of(windows, placed))
        if len(some) < windows.num_windows:
            windows, starts = windows.part(some), None if starts is None else starts[some]
            lin = None if lin is None else lin.part(some)
        starts = best_starts(windows, theta, noise) if starts is None else starts
        prior = QuadraticPrior(theta, np.zeros((len(theta), len(theta)))) if prior is None else prior
        self.windows, self.theta, self.noise = windows, theta, noise
        self.starts, self.tells = starts, noise.sd >= MISFIT.rounding * windows.rounding
        linearisation = lin or windows.linearise(theta, starts)
        if not linearisation.valid:
            raise ValueError("theta: the simulation diverges at the estimate; nothing can be said of its residuals")
        self.tell, self.kept = tell, kept
        self.probes, effects, self.one_sided = probes(windows, theta, starts, placed, extensions is None, tell, kept)
        n = windows.num_theta
        parts = (linearisation.jacobian[..., :n], effects, linearisation.jacobian[..., n:])
        self.residual, self.jacobian = linearisation.residual, np.concatenate(parts, axis=-1)
        self.count = n + len(self.probes)
        self.coloured = bool((noise.tau > 0).any())
        self.inner = prior.precision + FLAT_PRECISION * np.eye(n)
        self.free, self.pull = np.ones(n, bool), prior.pull(theta)
        self.rows = WhitenedRows(self.jacobian, windows)
        total = self.arrow.gradient[:n] + self.pull
        self._nulls: dict[int, _Null] = {}
        self.free = ~(((theta <= _PRESSED) & (total < 0)) | ((theta >= 1 - _PRESSED) & (total > 0)))

    @functools.cached_property
    def arrow(self) -> Eliminated:
        """Normal equations of theta and probes (N + K) at the fit's noise, the windows' starts eliminated."""
        return self.windows.eliminate(self.rows.normal(self.residual, self.noise), self.count)

    @functools.cached_property
    def seen(self) -> Solved:
        """Of the logs themselves."""
        return self.solved(self.residual, self.noise, self.pull)

    @functools.cached_property
    def memory(self) -> FloatArray:
        """(C,): how many samples of a channel tell as much as one of its own."""
        return self.memory_of(self.seen.left, self.noise)

    def memory_of(self, left: FloatArray, noise: Noise) -> FloatArray:
        """Integrated autocorrelation times (C,), at least one, of what is left (W, L, C), whitened by a noise."""
        return np.array([_memory(z) for z in self.white(left, noise)])

    @functools.cached_property
    def discounted(self) -> ProbedLogs:
        """The same logs, with samples that tell no more than they do beside those around them."""
        return self._with(remembering(self.noise, self.memory))

    @functools.cached_property
    def at_scatter(self) -> ProbedLogs:
        """The same logs with white noise of the samples' scatter in channels whose fit takes far more for noise.

        That holds what a wrong model leaves, and hides what it is: slow noise passes for slow forces.
        """
        noise, scatter = self.noise, self.windows.level.sd
        rests = scatter < MISFIT.rounding * self.windows.rounding
        holds = (scatter * MISFIT.hides < noise.sd) & ~rests
        if not holds.any():
            return self
        return self._with(Noise(np.where(holds, scatter, noise.sd), np.where(holds, 0.0, noise.tau)))

    def _with(self, noise: Noise) -> ProbedLogs:
        """The same logs beside another noise."""
        out = copy.copy(self)
        for name in ("arrow", "seen", "memory", "discounted", "at_scatter"):
            out.__dict__.pop(name, None)
        out.noise, out._nulls = noise, {}
        return out

    def null(self, seed: int, simulated: int) -> FloatArray:
        """Statistics (simulated, K + 2 C) of noise alone, each with the noise that is then estimated; made once."""
        made = self._nulls.setdefault(seed, _Null(np.random.default_rng(seed)))
        while len(made.rows) < simulated:
            self.tell(f"comparing with noise alone, draw {len(made.rows)} of at most {MISFIT.simulated}")
            draws = self.drawn(made.rng, MISFIT.batch)  # also of what is kept: the next begin where these end
            name = f"noise-{seed}-{len(made.rows)}"
            made.rows.extend(self.kept.of(name, _Statistics, functools.partial(self._statistics, draws)).rows)
        return np.stack(made.rows[:simulated])

    def _statistics(self, draws: FloatArray, kept: Kept) -> _Statistics:
        """Of residuals (W, L, C, S), each with the noise that is estimated in it."""
        windows, n, rows = self.windows, self.windows.num_theta, []
        pulls = windows.pulls(self.inner, np.zeros(n), windows.no_starts(), self.free)
        jacobian = np.concatenate([self.jacobian[..., :n], self.jacobian[..., self.count :]], axis=-1)
        for s, moments in enumerate(windows.moments_of_each(draws, jacobian)):
            noise = windows.estimate_noise(moments, self.noise, pulls, self.coloured)
            rows.append(self.solved(draws[..., s], noise).statistics)
        return _Statistics(np.stack(rows))

    def drawn(self, rng: np.random.Generator, simulated: int) -> FloatArray:
        """Residuals (W, L, C, S) of the noise alone."""
        out = np.zeros((*self.residual.shape, simulated))
        for c, s in enumerate(self.windows.sequences):
            a = s.coefficients(float(self.noise.tau[c]))
            flat = rng.standard_normal((len(s.index), simulated)) * np.sqrt(1 - a**2)[:, None]
            for i in np.flatnonzero(a):
                flat[i] += a[i] * flat[i - 1]
            column = np.zeros((self.residual[:, :, c].size, simulated))
            column[s.index] = self.noise.sd[c] * flat
            out[:, :, c] = column.reshape(*self.residual.shape[:2], simulated)
        return out

    def traded(self, sizes: FloatArray, some: IntArray | slice = slice(None)) -> FloatArray:
        """By how much sizes (..., K) of the probes, or of ``some``, change theta itself (..., N) that they trade."""
        return np.sqrt(np.maximum(sizes, 0.0)) @ self._trades[some]

    @functools.cached_property
    def _trades(self) -> FloatArray:
        """(K, N) of each probe at size 1."""
        nothing = (0.0,) * self.windows.num_theta
        return np.array([probe.trade or nothing for probe in self.probes]).reshape(-1, len(nothing))

    def lin(self, columns: IntArray) -> Linearisation:
        """The logs' own residual with some columns of theta and probes, and the starts."""
        starts = np.arange(self.count, self.jacobian.shape[-1])
        jacobian = self.jacobian[..., np.concatenate([columns, starts])]
        return Linearisation(self.residual, jacobian, True)

    def solved(self, residual: FloatArray, noise: Noise, pull: FloatArray | None = None) -> Solved:
        """Statistics of a residual, with what they are made of.

        Args:
            residual: (W, L, C).
            noise: (C,) of the channels.
            pull: (N,) of the prior; default none.
        """
        windows, n = self.windows, self.windows.num_theta
        made = self.rows.products(residual, noise, n)
        # information of theta and probes with the starts eliminated; inverted among the parameters that are free
        arrow = windows.eliminate(made.normal, n)
        probed = _eliminated(arrow, made, n)
        inverse, among = np.zeros((n, n)), np.ix_(self.free, self.free)
        inverse[among] = np.linalg.inv((arrow.precision + self.inner)[among])
        base, cross = inverse @ (arrow.gradient + (0.0 if pull is None else pull)), inverse @ probed.cross
        # score and information of each probe with theta projected out; one that theta can imitate is not usable
        gradient, whole = probed.gradient - probed.cross.T @ base, probed.information + FLAT_PRECISION
        two_sided = whole - np.einsum("ik,ik->k", probed.cross, cross)
        usable = two_sided > 1e-6 * whole + 2 * FLAT_PRECISION
        information = np.where(usable & ~(self.one_sided & (gradient < 0)), two_sided, np.inf)
        # what theta and starts leave, whitened by channel
        step = np.concatenate([base, np.zeros(self.count - n)])
        left = self.left(residual, step, arrow.blocks(base))
        statistics = np.concatenate([np.cbrt(gradient**2 / information), self.whiteness(left, noise)])
        return Solved(statistics, left, step, gradient, information, two_sided, cross, np.diag(inverse))

    def whiteness(self, residual: FloatArray, noise: Noise) -> FloatArray:
        """Cube roots (2 C,) of what a residual (W, L, C) has of autocorrelation, and of its largest mean squares.

        Both are none of a channel whose noise is but the simulation's rounding, as of a joint that rests: that follows
        itself.
        """
        white = [z * told for z, told in zip(self.white(residual, noise), self.tells, strict=True)]
        split = [np.array_split(z, MISFIT.pieces) for z in white]
        pieces = [max((float((p**2).mean()) for p in own if len(p)), default=0.0) for own in split]
        return np.cbrt(np.array([autocorrelation(z) for z in white] + pieces))

    def left(self, residual: FloatArray, step: FloatArray, starts: FloatArray) -> FloatArray:
        """What a step of theta and probes (N + K,) and one of the starts (W, D) leave of a residual (W, L, C)."""
        moved = self.jacobian[..., : self.count] @ step
        turned = np.einsum("wlcd,wd->wlc", self.jacobian[..., self.count :], starts)
        return np.where(self.windows.observed, residual - moved - turned, 0.0)

    def white(self, residual: FloatArray, noise: Noise) -> list[FloatArray]:
        """Each channel of a residual (W, L, C), whitened."""
        return [rows[0] for rows in self.windows.whitened(residual[None], noise)]


@dataclass(frozen=True)
class _Eliminated:
    """K probes with the windows' starts eliminated: gradient (K,), information of each (K,), and with theta (N, K)."""

    gradient: FloatArray
    information: FloatArray
    cross: FloatArray


def _eliminated(arrow: Eliminated, made: Products, n: int) -> _Eliminated:
    """Of the probes' products, what eliminating the starts of theta's normal equations leaves."""
    d, k = arrow.shift.shape[1], len(made.squares)
    plain = made.cross.sum(0)
    coupling = made.cross[:, n : n + d].copy()
    coupling[:-1] += made.cross[1:, n + d : n + 2 * d]
    flat = coupling.reshape(len(coupling) * d, k)
    explained = (flat * arrow.solve(flat)).sum(0) if d else np.zeros(k)
    cross = plain[:n] - arrow.slope.reshape(len(flat), n).T @ flat
    return _Eliminated(plain[-1] - arrow.shift.ravel() @ flat, made.squares - explained, cross)


def remembering(noise: Noise, memory: FloatArray) -> Noise:
    """A noise whose samples (of each channel) tell less, by what they remember (C,)."""
    return Noise(noise.sd * np.sqrt(memory), noise.tau)


def _memory(z: FloatArray) -> float:
    """Integrated autocorrelation time of z (n,), by emcee; at least one."""
    if len(z) < _SHORT or not z.std():
        return 1.0
    return max(1.0, float(emcee.autocorr.integrated_time(z, tol=0)[0]))


def autocorrelation(z: FloatArray) -> float:
    """Box and Pierce's sum of squared autocorrelations of z (n,) at ``MISFIT.lags``, times n."""
    z = z - z.mean()
    square = max(float(z @ z), 1e-300)
    return float(len(z) * sum((z[lag:] @ z[:-lag] / square) ** 2 for lag in lags(z)))


def oddness(seen: FloatArray, null: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Statistics of a log (K,) in sds from their mean, and the largest of each draw (n,) of the null (n, K).

    Mean and sd are of the log's and the draws' together, so that under the null each is as likely to be the oddest. By
    the draws' own, each of which takes part in them, the log's would look odder than it is: with sixty statistics 9 %
    of right models would raise an alarm at 5 %.
    """
    rows = np.vstack([seen, null])
    rows = (rows - rows.mean(0)) / np.maximum(rows.std(0), 1e-12)
    return rows[0], rows[1:].max(1)


def lags(z: FloatArray) -> list[int]:
    """Of ``MISFIT.lags`` those that z (n,) is long enough for."""
    return [lag for lag in MISFIT.lags if lag < len(z) // 4]
