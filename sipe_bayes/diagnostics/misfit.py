"""Can the model explain the log? Residuals that are not noise.

In the linear model of ``structure.augmented``, with autoregressive noise, two kinds of statistics are looked at.

- *Probes*: the score statistic of the size of each extension (C. R. Rao 1948,
  https://doi.org/10.1017/S0305004100023987), all else projected out; none where a size may not be negative and is.
- *Whiteness* of each channel's whitened residuals: the sum of squared autocorrelations over lags 1, 2, 3, 5, 8, ...
  (G. Box, D. Pierce 1970, https://doi.org/10.1080/01621459.1970.10481180), and the largest mean square of ten pieces of
  time, beside that of all.

The null is simulated: noise as estimated, drawn anew, projected alike. Each statistic's cube root is standardised by
its mean and sd over these and the log's; the largest is compared with the largest of each. So the p-value holds for
any number of probes, up to the linearisation. Named are the extensions that the strongest effect of
``structure.single_effects`` may be.

Deviations: the null knows of the noise's estimation but the first autocorrelation. Without a user's MJCF only whiteness
is asked, which slow misfit passes as slow noise.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.diagnostics.records import Misfit
from sipe_bayes.likelihood import FLAT_PRECISION
from sipe_bayes.structure.augmented import AtNoise
from sipe_bayes.structure.discrepancy import Discrepancy
from sipe_bayes.structure.probes import Probe

_PIECES = 10  # of a log, among which the largest mean square is looked for


def misfit(found: Discrepancy, sd: FloatArray | None = None, seed: int = 0, simulated: int = 199) -> Misfit:
    """How odd the residuals of fitted logs are, against ``simulated`` draws of the null, and what they look like most.

    ``sd`` (N,) is that of the posterior in theta, by default of the linearisation.
    """
    seen = found.at.logs.seen
    null = statistics(seen, drawn(seen, np.random.default_rng(seed), simulated))
    odd, largest = oddness(statistics(seen, seen.logs.residual[..., None], own=True)[0], null)
    worst, floor = int(odd.argmax()), 1 / (1 + len(largest))
    p = float((1 + (largest >= odd.max()).sum()) * floor)
    sd = np.sqrt(np.diag(seen.projected.covariance)) if sd is None else sd
    effect, probes = None if found.effects is None else found.effects.single[0], seen.logs.probes
    sizes = np.zeros(len(probes))
    if effect is not None and effect.present > 0.5:
        first = {probes[k].name: probes[k] for k in reversed(found.usable)}
        sizes[found.usable] = effect.sizes / effect.present
        named = _of_sizes(found.at, sizes, [first[name] for name in effect.alike()], sd, p)
        if worst < len(probes) or not named.is_small:
            return replace(named, floor=floor)
    if worst >= len(probes):
        return replace(_of_colour(seen, worst - len(probes), p), floor=floor)
    sizes = np.zeros(len(probes))
    sizes[worst] = seen.projected.score[worst] / seen.projected.information[worst, worst]
    return replace(_of_sizes(seen, sizes, [probes[worst]], sd, p), floor=floor)


def drawn(at: AtNoise, random: np.random.Generator, simulated: int) -> FloatArray:
    """Residuals (W, L, C, S) of the noise alone."""
    logs, noise = at.logs, at.noise
    out = np.zeros((*logs.residual.shape, simulated))
    for c, s in enumerate(logs.windows.sequences):
        a = s.coefficients(float(noise.tau[c]))
        flat = random.standard_normal((len(s.index), simulated)) * np.sqrt(1 - a**2)[:, None]
        for i in np.flatnonzero(a):
            flat[i] += a[i] * flat[i - 1]
        column = np.zeros((logs.residual[:, :, c].size, simulated))
        column[s.index] = noise.sd[c] * flat
        out[:, :, c] = column.reshape(*logs.residual.shape[:2], simulated)
    return out


def statistics(at: AtNoise, residuals: FloatArray, own: bool = False) -> FloatArray:
    """Cube roots (S, K + 2 C) of residuals (W, L, C, S): of probes' scores, autocorrelations and largest mean squares.

    At the logs' ``own`` the prior of theta pulls.
    """
    logs, made, arrow, n = at.logs, at.projected, at.arrow, at.logs.windows.num_theta
    gradient, force = logs.rows.scores(residuals, at.noise)
    if own:
        gradient[:n] += logs.pull[:, None]
    flat = force.reshape(-1, force.shape[-1])
    slope = arrow.slope.reshape(len(flat), logs.count)
    gradient -= slope.T @ flat
    base = made.covariance @ gradient[:n]
    starts = (arrow.solve(flat) if len(flat) else flat) - slope[:, :n] @ base
    score = gradient[n:] - arrow.precision[n:, :n] @ base
    information = np.diag(made.information)[:, None]
    usable = information > 1e-6 * made.whole[:, None] + 2 * FLAT_PRECISION
    usable = usable & ~(logs.one_sided[:, None] & (score < 0))
    left = residuals - np.einsum("wlcn,ns->wlcs", logs.jacobian[..., :n], base)
    left -= np.einsum("wlcd,wds->wlcs", logs.jacobian[..., logs.count :], starts.reshape(force.shape))
    left = np.where(logs.windows.observed[..., None], left, 0.0)
    squares = np.where(usable, score**2 / np.where(usable, information, 1.0), 0.0)
    return np.cbrt(np.concatenate([squares, _whiteness(at, np.moveaxis(left, -1, 0))])).T


def _whiteness(at: AtNoise, left: FloatArray) -> FloatArray:
    """(2 C, S) of what is left (S, W, L, C): autocorrelations, then largest mean squares; none of rounding."""
    logs, memory, bursts = at.logs, [], []
    for z, rests in zip(logs.windows.whitened(left, at.noise), logs.rests(at.noise.sd), strict=True):
        z = z * ~rests
        if logs.coloured:  # the first autocorrelation is taken out, as an estimate of the noise would
            first = (z[:, 1:] * z[:, :-1]).sum(1) / np.maximum((z**2).sum(1), 1e-300)
            z = np.concatenate([z[:, :1], z[:, 1:] - first[:, None] * z[:, :-1]], axis=1)
        centred = z - z.mean(1, keepdims=True)
        square = np.maximum((centred**2).sum(1), 1e-300)
        at_lags = [((centred[:, k:] * centred[:, :-k]).sum(1) / square) ** 2 for k in lags(z[0])]
        memory.append(z.shape[1] * np.sum(at_lags, axis=0))
        mean = np.maximum((z**2).mean(1), 1e-300)
        pieces = [(piece**2).mean(1) for piece in np.array_split(z, _PIECES, axis=1) if piece.size]
        bursts.append(np.max(pieces, axis=0) / mean if pieces else mean)
    none = np.zeros(len(left))
    return np.stack([none + one for one in (*memory, *bursts)])


def oddness(seen: FloatArray, null: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Statistics of a log (K,) in sds from their mean, and the largest of each draw (n,) of the null (n, K).

    Mean and sd are of the log's and the draws' together, so that under the null each is as likely to be the oddest.
    """
    rows = np.vstack([seen, null])
    rows = (rows - rows.mean(0)) / np.maximum(rows.std(0), 1e-12)
    return rows[0], rows[1:].max(1)


def lags(z: FloatArray) -> list[int]:
    """Lags at every scale, in samples, that z (n,) is long enough for."""
    return [lag for lag in (1, 2, 3, 5, 8, 13, 21, 34) if lag < len(z) // 4]


def _of_sizes(at: AtNoise, sizes: FloatArray, causes: list[Probe], sd: FloatArray, p: float) -> Misfit:
    """That probes are at work, at sizes (K,), beside the noise that they leave; theta has sds (N,)."""
    logs = at.logs
    before, after = at.left(np.zeros_like(sizes)), at.left(sizes)
    gains = [z[0] ** 2 - z[1] ** 2 for z in logs.windows.whitened(np.stack([before, after]), at.noise)]
    share = np.clip(1 - (after**2).sum((0, 1)) / np.maximum((before**2).sum((0, 1)), 1e-300), 0, 1)
    moved = logs.traded(sizes) - at.projected.answer @ sizes
    shift = (np.clip(logs.theta + moved, 0, 1) - logs.theta) / np.maximum(sd, 1e-12)
    cause, remedy = " or ".join(c.name for c in causes), " or ".join(c.placed.remedy for c in causes)
    moves = dict(zip(logs.windows.simulator.space.names, shift.tolist(), strict=True))
    placed = _placed(logs.seen, p, cause, remedy + "; or run sipe discover", gains, share)
    return replace(placed, shift=moves, alike=len(causes))


def _of_colour(seen: AtNoise, statistic: int, p: float) -> Misfit:
    """That samples follow one another, or are larger for a while; statistic: of 2 C, autocorrelations first."""
    logs, channels = seen.logs, len(seen.noise.sd)
    white = [z[0] for z in logs.windows.whitened(seen.left(seen.sizes)[None], seen.noise)]
    share, gains, c = np.zeros(channels), [np.zeros(len(z)) for z in white], statistic % channels
    if statistic < channels:
        before = [np.concatenate([np.zeros(lag), white[c][:-lag]]) for lag in lags(white[c])]
        rows = np.stack(before or [np.zeros_like(white[c])], axis=1)
        gains[c] = white[c] ** 2 - (white[c] - rows @ np.linalg.lstsq(rows, white[c], rcond=None)[0]) ** 2
        share[c] = gains[c].sum() / max((white[c] ** 2).sum(), 1e-300)
        cause = "samples that follow one another, as an effect does that no probe stands for"
        remedy = (
            'use noise = "ar1"; then ' * (not logs.coloured) + "look at the residuals' plot for what moves with them"
        )
    else:
        gains[c] = white[c] ** 2
        most = max(float(piece.sum()) for piece in np.array_split(gains[c], _PIECES))
        share[c] = most / max(gains[c].sum(), 1e-300) - 1 / _PIECES
        cause = "noise that is larger for a while"
        remedy = "look at what happened there; leave that span out if it was a disturbance"
    return _placed(seen, p, cause, remedy, gains, np.maximum(share, 0.0))


def _placed(seen: AtNoise, p: float, cause: str, remedy: str, gains: list[FloatArray], share: FloatArray) -> Misfit:
    """Where it shows most, by what each sample of each channel contributes; share: (C,) that is explained."""
    logs, windows = seen.logs, seen.logs.windows
    channel = int(np.argmax([g.sum() for g in gains]))
    index = windows.sequences[channel].index
    window, place = index // logs.residual.shape[1], index % logs.residual.shape[1]
    seconds, log = (windows.start[window] + place) * windows.dt[window], windows.log[window]
    parts = [part for k in np.unique(log) for part in np.array_split(np.flatnonzero(log == k), _PIECES) if len(part)]
    where = max(parts, key=lambda part: float(gains[channel][part].sum()))
    shares = dict(zip(windows.fitted, share.tolist(), strict=True))
    if held := [name for name, free in zip(windows.simulator.space.names, seen.free, strict=True) if not free]:
        remedy = f"widen the bounds of {', '.join(held)} first, which the log presses against, or {remedy}"
    name, start, stop = windows.trajectories.names[int(log[where[0]])], seconds[where[0]], seconds[where[-1]]
    return Misfit(p, cause, remedy, name, windows.fitted[channel], float(start), float(stop), shares)
