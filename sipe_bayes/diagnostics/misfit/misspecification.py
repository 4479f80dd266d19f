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
standardised by its mean and sd over these and the log's; the largest is compared with the largest of each. Draws end
where ten were odder (J. Besag, P. Clifford 1991, "Sequential Monte Carlo p-values",
https://doi.org/10.1093/biomet/78.2.301), looked at after 40, 60 and 80 and not after each, so that p is
(1 + odder) / (1 + drawn). So the p-value holds for white and first-order autoregressive sensor noise, whatever the
number of probes, up to the linearisation.

A small p says that something is there, not that it is large: with it come the share of each channel's residual that the
named cause explains and, of a probe, how far the estimate would move if the model had it.

Deviations:

- The log's own noise is the one that the fit found, which for other methods than ``laplace`` need not be what the null
  estimates.
- Probes are of a user's MJCF; of other environments only whiteness is asked, which slow misfit passes as slow noise.
- Where dry friction holds the simulated joint still, a small step of what acts on it changes nothing, and says nothing.
- Where the fit takes far more for noise than samples scatter by, that noise holds what the model lacks. It is asked
  whether the residuals are noise beside it, but what they look like beside noise of that scatter: the probe that
  explains most there is named, if it explains a tenth.
- Where a probe's own statistic is beyond the null and the probe explains a tenth of the residual, it is named even if
  whiteness is odder, since it says more. Causes whose statistics are about as large are named together; one that is
  named fits best, it is not proven (``sipe discover`` fits them and compares).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.thresholds import THRESHOLDS
from sipe_bayes.diagnostics.misfit.probed_logs import MISFIT, ProbedLogs, Solved, lags, oddness
from sipe_bayes.diagnostics.records import Misfit
from sipe_bayes.structure.probes import Probe


def misfit(
    logs: ProbedLogs,
    sd: FloatArray | None = None,
    seed: int = 0,
    simulated: int = MISFIT.simulated,
    estimate: FloatArray | None = None,
) -> Misfit:
    """How odd the residuals of fitted logs are.

    Args:
        logs: linearised at the estimate.
        sd: (N,) of the posterior in theta; default that of the linearisation.
        seed: of the null.
        simulated: draws of the null.
        estimate: (N,) from which theta would move; default where the logs are linearised.

    Returns:
        What they look like most, and how odd that is.
    """
    return _Named(logs, sd, logs.theta if estimate is None else estimate).misfit(seed, simulated)


class _Named:
    """Says what residuals look like."""

    def __init__(self, logs: ProbedLogs, sd: FloatArray | None, estimate: FloatArray) -> None:
        self.logs, self.sd, self.estimate = logs, sd, estimate

    def misfit(self, seed: int, simulated: int) -> Misfit:
        """The oddest statistic against draws of the null, ``simulated`` at most."""
        logs = self.logs
        seen = logs.seen
        for count in (*range(2 * MISFIT.batch, simulated, MISFIT.batch), simulated):
            odd, largest = oddness(seen.statistics, logs.null(seed, count))
            if (largest >= odd.max()).sum() >= MISFIT.exceeded:
                break

        def p(statistic: int) -> float:
            return float((1 + (largest >= odd[statistic]).sum()) / (1 + count))

        worst, k, floor = int(odd.argmax()), len(logs.probes), 1 / (1 + count)
        bursts = worst >= k + len(logs.noise.sd)
        if k and not bursts and p(worst) <= THRESHOLDS.misfit and (scatter := logs.at_scatter) is not logs:
            best = int((scatter.seen.score**2 / scatter.seen.information).argmax())
            named = _Named(scatter, self.sd, self.estimate)._probe_named(p(worst), best, scatter.seen)
            if max(named.share.values()) >= THRESHOLDS.small_misfit:
                return replace(named, floor=floor)
        if k:
            best = int(odd[:k].argmax())
            named = replace(self._probe_named(p(worst), best, seen), floor=floor)
            if best == worst or (p(best) <= THRESHOLDS.misfit and max(named.share.values()) >= THRESHOLDS.small_misfit):
                return named
        return replace(self._colour_named(p(worst), worst - k, seen), floor=floor)

    def _probe_named(self, p: float, probe: int, seen: Solved) -> Misfit:
        logs = self.logs
        n, names = logs.windows.num_theta, logs.windows.simulator.space.names
        amplitude = seen.score[probe] / seen.information[probe]
        step = seen.step + amplitude * np.concatenate([-seen.answer[:, probe], np.eye(len(self.logs.probes))[probe]])
        explained = logs.left(logs.residual, step, logs.arrow.blocks(step))
        whitened = zip(self.logs.white(seen.left, self.logs.noise), logs.white(explained, logs.noise), strict=True)
        gains = [plain**2 - probed**2 for plain, probed in whitened]
        before, after = ((x**2).sum((0, 1)) for x in (seen.left, explained))
        share = np.clip(1 - after / np.maximum(before, 1e-300), 0, 1)
        sd = np.sqrt(seen.variance) if self.sd is None else self.sd
        moved = step[:n] - seen.step[:n] + logs.traded(step[n:])
        shift = (np.clip(logs.theta + moved, 0, 1) - self.estimate) / np.maximum(sd, 1e-12)
        causes = _alike(logs, probe)
        cause, remedy = " or ".join(c.name for c in causes), " or ".join(c.remedy for c in causes)
        moves = dict(zip(names, shift.tolist(), strict=True))
        named = self._placed(p, cause, remedy + "; or run sipe discover", gains, share, moves)
        return replace(named, alike=len(causes))

    def _colour_named(self, p: float, statistic: int, seen: Solved) -> Misfit:
        """statistic: of 2 C, autocorrelations first."""
        channels, white = len(self.logs.noise.sd), self.logs.white(seen.left, self.logs.noise)
        share, gains = np.zeros(channels), [np.zeros(len(z)) for z in white]
        c = statistic % channels
        if statistic < channels:
            gains[c] = white[c] ** 2 - (white[c] - _foretold(white[c])) ** 2
            share[c] = gains[c].sum() / (white[c] ** 2).sum()
            cause = "samples that follow one another, as an effect does that no probe stands for"
            coloured = "look at the residuals' plot for what moves with them"
            remedy = coloured if self.logs.coloured else f'use noise = "ar1"; then {coloured}'
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
        windows, channel = self.logs.windows, int(np.argmax([g.sum() for g in gains]))
        index = windows.sequences[channel].index
        window, place = index // self.logs.residual.shape[1], index % self.logs.residual.shape[1]
        seconds = (windows.start[window] + place) * windows.dt[window]
        log, best, where = windows.log[window], -np.inf, np.zeros(1, int)
        for k in np.unique(log):
            for piece in np.array_split(np.flatnonzero(log == k), MISFIT.pieces):
                if len(piece) and gains[channel][piece].sum() > best:
                    best, where = float(gains[channel][piece].sum()), piece
        name = windows.trajectories.names[int(log[where[0]])]
        span = float(seconds[where[0]]), float(seconds[where[-1]])
        shares = dict(zip(windows.fitted, share.tolist(), strict=True))
        held = [name for name, free in zip(windows.simulator.space.names, self.logs.free, strict=True) if not free]
        if held:
            remedy = f"widen the bounds of {', '.join(held)} first, which the log presses against, or {remedy}"
        return Misfit(p, cause, remedy, name, windows.fitted[channel], *span, shares, shift)


def _alike(logs: ProbedLogs, probe: int) -> list[Probe]:
    """A probe and those of other causes that explain about as much, best first."""
    square = logs.seen.score**2 / logs.seen.information
    close = [k for k in np.argsort(-square) if square[k] >= MISFIT.alike * square[probe]]
    named = {logs.probes[k].name: logs.probes[k] for k in [probe, *close]}
    return list(named.values())[: MISFIT.causes]


def _foretold(z: FloatArray) -> FloatArray:
    """What least squares on the samples before, at ``MISFIT.lags``, says of z (n,)."""
    behind = lags(z)
    if not behind:
        return np.zeros_like(z)
    before = np.stack([np.concatenate([np.zeros(lag), z[:-lag]]) for lag in behind], axis=1)
    return np.asarray(before @ np.linalg.lstsq(before, z, rcond=None)[0])
