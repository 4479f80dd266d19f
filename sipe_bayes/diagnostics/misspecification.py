"""Can the model explain the log? Residuals that are not noise.

At the estimate, with parameters and windows' starts free to follow (linearised, but for parameters that the log presses
against a bound) and autoregressive noise, two kinds of statistics are looked at.

- *Probes*: a small step of each extension that ``structure`` has a place for, away from the model as it is. The score
  statistic of its size b, all else projected out, is chi-square with one degree of freedom (C. R. Rao 1948,
  https://doi.org/10.1017/S0305004100023987): the simulation answers what such physics would have done to every sample.
  A size that may not be negative counts as none where it would be.
- *Whiteness* of each channel's whitened residuals: the sum of squared autocorrelations over lags 1, 2, 3, 5, 8, ...
  (G. Box, D. Pierce 1970, https://doi.org/10.1080/01621459.1970.10481180), and the largest mean square of ten pieces of
  time.

The null is simulated: noise as estimated, drawn anew, estimated anew, projected alike. Each statistic's cube root is
standardised by its mean and sd over these; the largest is compared with the largest of each. So the p-value holds for
white and first-order autoregressive sensor noise, whatever the number of probes, up to the linearisation.

A small p says that something is there, not that it is large: with it come the share of each channel's residual that the
named cause explains and, of a probe, how far the estimate would move if the model had it.

Deviations:

- The log's own noise is the one that the fit found, which for other methods than ``laplace`` need not be what the null
  estimates.
- Probes are of a user's MJCF; of other environments only whiteness is asked, which slow misfit passes as slow noise.
- Where dry friction holds the simulated joint still, a small step of what acts on it changes nothing, and says nothing.
- Where a probe's own statistic is beyond the null and the probe explains a tenth of the residual, it is named even if
  whiteness is odder, since it says more. Causes whose statistics are about as large are named together; one that is
  named fits best, it is not proven (``sipe discover`` fits them and compares).
"""

from __future__ import annotations

import copy
from dataclasses import dataclass

import numpy as np

from sipe_bayes.core.arrays import FloatArray, IntArray
from sipe_bayes.core.options import Options, option
from sipe_bayes.core.thresholds import THRESHOLDS
from sipe_bayes.diagnostics.evaluate import best_starts
from sipe_bayes.diagnostics.records import Misfit
from sipe_bayes.diagnostics.thinning import spread_windows
from sipe_bayes.likelihood.block_tridiagonal import Eliminated
from sipe_bayes.likelihood.moments import Moments
from sipe_bayes.likelihood.noise import Noise, coefficients, whiten
from sipe_bayes.likelihood.quadratic_prior import QuadraticPrior
from sipe_bayes.likelihood.restricted import Pulls, eliminate_starts, estimate_noise
from sipe_bayes.likelihood.windows import Linearisation, Windows
from sipe_bayes.structure.probes import Probe, probes

_FLAT_PRECISION = 1e-6  # keeps information invertible where a direction is open
_PRESSED = 1e-6  # of the range: a parameter that the search left on its bound


@dataclass(frozen=True)
class MisfitOptions(Options):
    """What residuals are asked, and how the null is simulated."""

    simulated: int = option(99, "draws of the null: p resolves a percent", least=1)
    pieces: int = option(10, "of a log, among which the largest mean square is looked for", least=1)
    lags: tuple[int, ...] = option((1, 2, 3, 5, 8, 13, 21, 34), "of a channel's memory, at every scale", "samples")
    alike: float = option(0.8, "of the best probe's statistic, from which another cause is named beside it", least=0)
    causes: int = option(3, "that are named at most", least=1)
    steps: int = option(1600, "of windows spread evenly over long logs: each probe is a simulation", "control steps")
    batch: int = option(16, "draws of the null whose products are formed together", least=1)


MISFIT = MisfitOptions()


def misfit(
    windows: Windows,
    theta: FloatArray,
    noise: Noise,
    *,
    starts: FloatArray | None = None,
    sd: FloatArray | None = None,
    prior: QuadraticPrior | None = None,
    seed: int = 0,
    simulated: int = MISFIT.simulated,
    lin: Linearisation | None = None,
) -> Misfit:
    """How odd the residuals of fitted windows are; costs a linearisation and a rollout for each probe.

    Of long or many logs some windows are looked at, spread evenly.

    Args:
        windows: the logs, W windows of C channels.
        theta: (N,) the estimate.
        noise: (C,) found there.
        starts: (W, D) of the windows; default the best.
        sd: (N,) of the posterior in theta; default that of the linearisation.
        prior: of the fit; default flat.
        seed: of the null.
        simulated: draws of the null.
        lin: at theta and starts, where it is known.

    Returns:
        What they look like most, and how odd that is.

    Raises:
        ValueError: where the simulation diverges at theta.
    """
    kept = spread_windows(windows, MISFIT.steps)
    if len(kept) < windows.num_windows:
        windows, starts = windows.part(kept), None if starts is None else starts[kept]
        lin = None if lin is None else Linearisation(lin.residual[kept], lin.jacobian[kept], lin.valid)
    starts = best_starts(windows, theta, noise) if starts is None else starts
    prior = QuadraticPrior(theta, np.zeros((len(theta), len(theta)))) if prior is None else prior
    residuals = _Residuals(windows, theta, noise, starts, prior, lin)
    return residuals.misfit(np.random.default_rng(seed), simulated, sd)


@dataclass(frozen=True)
class _Solved:
    """A residual solved for theta and starts, without the K probes.

    Args:
        statistics: (K + 2 C,) cube roots: probes, sums of squared autocorrelations, largest mean squares of a piece.
        left: (W, L, C) of the residual.
        step: (N + K,) of theta; zero of the probes.
        score: (K,) of each probe.
        information: (K,) of each probe, all else projected out.
        answer: (N, K) of theta to the probes.
        variance: (N,) of theta.
        arrow: the windows' starts eliminated.
    """

    statistics: FloatArray
    left: FloatArray
    step: FloatArray
    score: FloatArray
    information: FloatArray
    answer: FloatArray
    variance: FloatArray
    arrow: Eliminated


class _Residuals:
    """The log linearised at the estimate, with K probes beside the N parameters."""

    def __init__(
        self,
        windows: Windows,
        theta: FloatArray,
        noise: Noise,
        starts: FloatArray,
        prior: QuadraticPrior,
        lin: Linearisation | None = None,
    ) -> None:
        self.windows, self.theta, self.noise = windows, theta, noise
        linearisation = lin or windows.linearise(theta, starts)
        if not linearisation.valid:
            raise ValueError("theta: the simulation diverges at the estimate; nothing can be said of its residuals")
        self.probes, effects, self.one_sided = probes(windows, theta, starts)
        n = windows.num_theta
        parts = (linearisation.jacobian[..., :n], effects, linearisation.jacobian[..., n:])
        self.residual, self.jacobian = linearisation.residual, np.concatenate(parts, axis=-1)
        self.count = n + len(self.probes)
        self.coloured = bool((noise.tau > 0).any())
        self.inner = prior.precision + _FLAT_PRECISION * np.eye(n)
        self.free, self.pull = np.ones(n, bool), prior.pull(theta)
        arrow = self._arrow(self.moments(self.residual[..., None])[0][1], noise)
        total = arrow.gradient[:n] + self.pull
        self.free = ~(((theta <= _PRESSED) & (total < 0)) | ((theta >= 1 - _PRESSED) & (total > 0)))

    def misfit(self, rng: np.random.Generator, simulated: int, sd: FloatArray | None) -> Misfit:
        """The oddest statistic against ``simulated`` draws of the null; sd (N,) of the posterior."""
        seen = self.solved(self.residual, self.moments(self.residual[..., None])[0][1], self.noise, self.pull)
        null = self.null(rng, simulated)
        middle, spread = null.mean(0), np.maximum(null.std(0), 1e-12)
        odd, largest = (seen.statistics - middle) / spread, ((null - middle) / spread).max(1)

        def p(statistic: int) -> float:
            return float((1 + (largest >= odd[statistic]).sum()) / (1 + simulated))

        worst, k = int(odd.argmax()), len(self.probes)
        if k:
            best = int(odd[:k].argmax())
            named = self._probe_named(p(worst), best, seen, sd)
            if best == worst or (p(best) <= THRESHOLDS.misfit and max(named.share.values()) >= THRESHOLDS.small_misfit):
                return named
        return self._colour_named(p(worst), worst - k, seen)

    def null(self, rng: np.random.Generator, simulated: int) -> FloatArray:
        """Statistics (simulated, K + 2 C) of noise alone, each with the noise that is then estimated."""
        draws, rows = self.drawn(rng, simulated), []
        for part in np.array_split(np.arange(simulated), max(1, simulated // MISFIT.batch)):
            for s, (plain, probed) in zip(part, self.moments(draws[..., part]), strict=True):
                noise = self._estimated(plain)
                rows.append(self.solved(draws[..., s], probed, noise).statistics)
        return np.stack(rows)

    def drawn(self, rng: np.random.Generator, simulated: int) -> FloatArray:
        """Residuals (W, L, C, S) of the noise alone."""
        out = np.zeros((*self.residual.shape, simulated))
        for c, s in enumerate(self.windows.sequences):
            a = coefficients(s.gaps, float(self.noise.tau[c]))[s.gap]
            flat = rng.standard_normal((len(s.index), simulated)) * np.sqrt(1 - a**2)[:, None]
            for i in np.flatnonzero(a):
                flat[i] += a[i] * flat[i - 1]
            column = np.zeros((self.residual[:, :, c].size, simulated))
            column[s.index] = self.noise.sd[c] * flat
            out[:, :, c] = column.reshape(*self.residual.shape[:2], simulated)
        return out

    def moments(self, residuals: FloatArray) -> list[tuple[Moments, Moments]]:
        """For each of residuals (W, L, C, S) the products without the probes and with them."""
        n, count, many = self.windows.num_theta, self.count, residuals.shape[-1]
        parts = (self.jacobian[..., :count], residuals, self.jacobian[..., count:])
        rows = np.concatenate(parts, axis=-1)
        whole = Moments(np.zeros(rows.shape[:3]), rows, count + many, self.windows.sequences)
        starts = count + many + np.arange(2 * self.windows.num_start)

        def of(s: int, first: int) -> Moments:
            return _chosen(whole, np.concatenate([np.arange(first), starts, [count + s]]), first)

        return [(of(s, n), of(s, count)) for s in range(many)]

    def _estimated(self, moments: Moments) -> Noise:
        """The noise that a fit would have found in a draw of it."""
        windows = self.windows
        pulls = Pulls(self.inner, np.zeros(moments.num_theta), windows.start_precision, windows.no_starts(), self.free)
        span = float(windows.dt.min()), windows.trajectories.longest
        return estimate_noise(moments, self.noise, pulls, windows.fixed_sd, self.coloured, *span, windows.scales)

    def _arrow(self, moments: Moments, noise: Noise) -> Eliminated:
        windows = self.windows
        return eliminate_starts(moments.normal(noise), self.count, windows.start_precision, windows.no_starts())

    def solved(self, residual: FloatArray, moments: Moments, noise: Noise, pull: FloatArray | None = None) -> _Solved:
        """Statistics of a residual, with what they are made of.

        Args:
            residual: (W, L, C).
            moments: its products with theta, probes and starts.
            noise: (C,) of the channels.
            pull: (N,) of the prior; default none.
        """
        n = self.windows.num_theta
        # information of theta and probes with the starts eliminated; inverted among the parameters that are free
        arrow = self._arrow(moments, noise)
        inner, inverse = arrow.precision + _FLAT_PRECISION * np.eye(self.count), np.zeros((n, n))
        inner[:n, :n] = arrow.precision[:n, :n] + self.inner
        among = np.ix_(self.free, self.free)
        inverse[among] = np.linalg.inv(inner[:n, :n][among])
        base, cross = inverse @ (arrow.gradient[:n] + (0.0 if pull is None else pull)), inverse @ inner[:n, n:]
        # score and information of each probe with theta projected out; one that theta can imitate is not usable
        gradient = arrow.gradient[n:] - inner[n:, :n] @ base
        information = np.diag(inner)[n:] - np.einsum("ik,ik->k", inner[:n, n:], cross)
        usable = information > 1e-6 * np.diag(inner)[n:] + 2 * _FLAT_PRECISION
        information = np.where(usable & ~(self.one_sided & (gradient < 0)), information, np.inf)
        # what theta and starts leave, whitened by channel
        base = np.concatenate([base, np.zeros(self.count - n)])
        left = self._left(residual, base, arrow.blocks(base))
        white = self._white(left, noise)
        whiteness = [_autocorrelation(z) for z in white]
        pieces = [
            max((float((p**2).mean()) for p in np.array_split(z, MISFIT.pieces) if len(p)), default=0.0) for z in white
        ]
        statistics = np.cbrt(np.concatenate([gradient**2 / information, whiteness, pieces]))
        return _Solved(statistics, left, base, gradient, information, cross, np.diag(inverse), arrow)

    def _left(self, residual: FloatArray, step: FloatArray, starts: FloatArray) -> FloatArray:
        """What a step of theta and probes (N + K,) and one of the starts (W, D) leave of a residual (W, L, C)."""
        moved = self.jacobian[..., : self.count] @ step
        turned = np.einsum("wlcd,wd->wlc", self.jacobian[..., self.count :], starts)
        return np.where(self.windows.observed, residual - moved - turned, 0.0)

    def _white(self, residual: FloatArray, noise: Noise) -> list[FloatArray]:
        """Each channel of a residual (W, L, C), whitened."""
        rows = zip(np.moveaxis(residual, -1, 0), self.windows.sequences, noise.sd, noise.tau, strict=True)
        return [whiten(channel.reshape(-1), s, float(sd), float(tau)) for channel, s, sd, tau in rows]

    def _probe_named(self, p: float, probe: int, seen: _Solved, sd: FloatArray | None) -> Misfit:
        n, names = self.windows.num_theta, self.windows.simulator.space.names
        amplitude = seen.score[probe] / seen.information[probe]
        step = seen.step + amplitude * np.concatenate([-seen.answer[:, probe], np.eye(len(self.probes))[probe]])
        explained = self._left(self.residual, step, seen.arrow.blocks(step))
        whitened = zip(self._white(seen.left, self.noise), self._white(explained, self.noise), strict=True)
        gains = [plain**2 - probed**2 for plain, probed in whitened]
        before, after = ((x**2).sum((0, 1)) for x in (seen.left, explained))
        share = np.clip(1 - after / np.maximum(before, 1e-300), 0, 1)
        sd = np.sqrt(seen.variance) if sd is None else sd
        shift = (np.clip(self.theta + step[:n] - seen.step[:n], 0, 1) - self.theta) / np.maximum(sd, 1e-12)
        causes = self._alike(probe, seen)
        cause, remedy = " or ".join(c.name for c in causes), " or ".join(c.remedy for c in causes)
        return self._placed(
            p, cause, f"{remedy}; or run sipe discover", gains, share, dict(zip(names, shift.tolist(), strict=True))
        )

    def _alike(self, probe: int, seen: _Solved) -> list[Probe]:
        """The best probe and those of other causes that explain about as much, best first."""
        square = seen.score**2 / seen.information
        close = [k for k in np.argsort(-square) if square[k] >= MISFIT.alike * square[probe]]
        named = {self.probes[k].name: self.probes[k] for k in [probe, *close]}
        return list(named.values())[: MISFIT.causes]

    def _colour_named(self, p: float, statistic: int, seen: _Solved) -> Misfit:
        """statistic: of 2 C, autocorrelations first."""
        channels, white = len(self.noise.sd), self._white(seen.left, self.noise)
        share, gains = np.zeros(channels), [np.zeros(len(z)) for z in white]
        c = statistic % channels
        if statistic < channels:
            gains[c] = white[c] ** 2 - (white[c] - _foretold(white[c])) ** 2
            share[c] = gains[c].sum() / (white[c] ** 2).sum()
            cause = "samples that follow one another, as an effect does that no probe stands for"
            coloured = "look at the residuals' plot for what moves with them"
            remedy = coloured if self.coloured else f'use noise = "ar1"; then {coloured}'
        else:
            gains[c] = white[c] ** 2
            most = max(float(piece.sum()) for piece in np.array_split(gains[c], MISFIT.pieces))
            share[c] = most / gains[c].sum() - 1 / MISFIT.pieces
            cause = "noise that is larger for a while"
            remedy = "look at what happened there; leave that span out if it was a disturbance"
        return self._placed(p, cause, remedy, gains, np.maximum(share, 0.0), {})

    def _placed(
        self, p: float, cause: str, remedy: str, gains: list[FloatArray], share: FloatArray, shift: dict[str, float]
    ) -> Misfit:
        """gains: per channel what each sample contributes."""
        windows, channel = self.windows, int(np.argmax([g.sum() for g in gains]))
        index = windows.sequences[channel].index
        window, place = index // self.residual.shape[1], index % self.residual.shape[1]
        seconds = (windows.start[window] + place) * windows.dt[window]
        log, best, where = windows.log[window], -np.inf, np.zeros(1, int)
        for k in np.unique(log):
            for piece in np.array_split(np.flatnonzero(log == k), MISFIT.pieces):
                if len(piece) and gains[channel][piece].sum() > best:
                    best, where = float(gains[channel][piece].sum()), piece
        name = windows.trajectories.names[int(log[where[0]])]
        span = float(seconds[where[0]]), float(seconds[where[-1]])
        shares = dict(zip(windows.fitted, share.tolist(), strict=True))
        held = [name for name, free in zip(windows.simulator.space.names, self.free, strict=True) if not free]
        if held:
            remedy = f"widen the bounds of {', '.join(held)} first, which the log presses against, or {remedy}"
        return Misfit(p, cause, remedy, name, windows.fitted[channel], *span, shares, shift)


def _chosen(moments: Moments, columns: IntArray, num_theta: int) -> Moments:
    """Moments of some columns [theta | x_w | x_{w-1} | r] of others; the first ``num_theta`` are theta's."""
    chosen, width = copy.copy(moments), moments.num_theta + 2 * moments.num_start + 1
    products = moments.products.reshape(-1, moments.windows, width, width)
    products = products.take(columns, axis=-1).take(columns, axis=-2)
    chosen.products, chosen.num_theta = products.reshape(len(products), -1), num_theta
    return chosen


def _foretold(z: FloatArray) -> FloatArray:
    """What least squares on the samples before, at ``MISFIT.lags``, says of z (n,)."""
    lags = _lags(z)
    if not lags:
        return np.zeros_like(z)
    before = np.stack([np.concatenate([np.zeros(lag), z[:-lag]]) for lag in lags], axis=1)
    return np.asarray(before @ np.linalg.lstsq(before, z, rcond=None)[0])


def _autocorrelation(z: FloatArray) -> float:
    z = z - z.mean()
    square = max(float(z @ z), 1e-300)
    return float(len(z) * sum((z[lag:] @ z[:-lag] / square) ** 2 for lag in _lags(z)))


def _lags(z: FloatArray) -> list[int]:
    return [lag for lag in MISFIT.lags if lag < len(z) // 4]
