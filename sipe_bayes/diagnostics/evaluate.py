"""How well simulations follow logs: errors over open-loop windows, signals with their band, residuals.

Windows start from the measured state (``likelihood.starts.estimates``), so a held-out log needs no fit of its own; a
parameter that differs between logs takes the mean of the calibrated ones there.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import scipy.stats

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.thresholds import THRESHOLDS
from sipe_bayes.diagnostics.records import ChannelNoise, ChannelScore, Comparison, Residual, Signal
from sipe_bayes.envs.poses import inertial_joints
from sipe_bayes.likelihood import BoundLikelihood, Noise
from sipe_bayes.simulation.simulator import Simulator

LOOKED_AT = 2000  # control steps that say whether measured starts make most of an error


def errors(windows: BoundLikelihood, theta: FloatArray) -> FloatArray:
    """RMSE (B, logs, C) of theta (B, N) over the windows of each log from measured starts.

    Infinite where one of the log's windows diverges, NaN where a channel has no sample.
    """
    return _roots(windows, _squares(windows, windows.predict(theta, measured_starts(windows, theta))[0]))


def errors_from_best_starts(windows: BoundLikelihood, theta: FloatArray) -> FloatArray:
    """As ``errors`` of one theta (N,), from the starts that it fits best: (logs, C)."""
    return np.asarray(_roots(windows, _best_residuals(windows, theta)[None] ** 2)[0])


def _roots(windows: BoundLikelihood, square: FloatArray) -> FloatArray:
    """RMSE (B, logs, C) of squared errors (B, W, L, C)."""
    logs = [windows.log == k for k in range(len(windows.trajectories))]
    count = np.stack([windows.observed[mine].sum(axis=(0, 1)) for mine in logs])
    total = np.stack([square[:, mine].sum(axis=(1, 2)) for mine in logs], axis=1)
    roots = np.where(np.isfinite(total), np.sqrt(total / np.maximum(count, 1)), np.inf)
    return np.where(count == 0, np.nan, roots)


def _squares(windows: BoundLikelihood, predicted: FloatArray) -> FloatArray:
    """Squared errors (B, W, L, C) of predictions, zero where nothing was measured."""
    return np.where(windows.observed, (windows.measured - predicted) ** 2, 0.0)


def both_predicted(windows: BoundLikelihood, theta: FloatArray) -> FloatArray:
    """Predictions (2, W, L, C) from measured starts: of theta (N,) and of the model as given."""
    thetas = np.stack([theta, np.clip(windows.simulator.space.default_theta, 0, 1)])
    return windows.predict(thetas, measured_starts(windows, thetas))[0]


def compare_errors(
    windows: BoundLikelihood,
    theta: FloatArray,
    reference: tuple[BoundLikelihood, FloatArray] | None = None,
    fit_starts: bool = False,
) -> Comparison | None:
    """Errors of theta (N,) against the nominal model, or a ``reference``: the same windows of another, and its theta.

    The mean over logs and channels of log(RMSE of the reference / RMSE of theta), with the jackknife's standard error
    over tenths of each log: a paired t-test, too sure of a log of few windows. Where measured starts make nearly all of
    theta's error (velocities from noisy positions), or with ``fit_starts``, both models are compared from the starts
    that each fits best. None where there is nothing finite to compare.
    """
    models = (windows, theta), reference or (windows, np.clip(windows.simulator.space.default_theta, 0, 1))
    measured = [_squares(w, w.predict(x[None], measured_starts(w, x[None]))[0]) for w, x in models]
    square, some = np.concatenate(measured), windows.spread_over(LOOKED_AT, every_log=True)
    share = _share_of_starts(windows, square[0][some], _best_residuals(windows.part(some), theta) ** 2)
    by_starts = share > THRESHOLDS.starts_rule
    if by_starts or fit_starts:
        fits = np.stack([_best_residuals(w, x) for w, x in models]) ** 2
        by_starts &= bool(np.isfinite(fits).all())
        square = fits if np.isfinite(fits).all() else square
    parts = []  # of each log: sums (2, pieces, C)
    for k in range(len(windows.trajectories)):
        mine = windows.log == k
        rows, owned = square[:, mine].reshape(2, -1, square.shape[-1]), windows.compared[mine].any(-1).ravel()
        sums = np.stack([piece.sum(1) for piece in np.array_split(rows[:, owned], 10, axis=1)], axis=1)
        usable = np.isfinite(sums).all((0, 1)) & (np.count_nonzero(sums, axis=1) > 1).all(0)
        if usable.any():
            parts.append(sums[:, :, usable])
    return replace(_jackknifed(parts), starts=share if by_starts else None) if parts else None


def _best_residuals(windows: BoundLikelihood, theta: FloatArray) -> FloatArray:
    """Residuals (W, L, C) of theta (N,) from the starts that fit best; infinite where the simulation is not valid."""
    noise = Noise(np.maximum(0.05 * np.nan_to_num(windows.spread), windows.rounding), np.zeros(len(windows.fitted)))
    residual, valid = windows.fit_starts(theta, noise)[1:]
    return np.where(windows.observed, residual if valid else np.inf, 0.0)


def _share_of_starts(windows: BoundLikelihood, square: FloatArray, fitted: FloatArray) -> float:
    """How much smaller squared errors (W, L, C) are from fitted starts, in the spreads; 0 where either is infinite."""
    weight = np.where(windows.spread > 0, 1 / np.maximum(windows.spread, 1e-300) ** 2, 0.0)
    with np.errstate(invalid="ignore"):
        before, after = float((square * weight).sum()), float((fitted * weight).sum())
    return 1 - after / before if np.isfinite(before + after) and before > 0 else 0.0


def _jackknifed(parts: list[FloatArray]) -> Comparison:
    """parts: of each log the sums (2, pieces, channels) of squared errors, of theta and of the model as given."""
    pieces, pairs = (sum(part.shape[axis] for part in parts) for axis in (1, 2))
    mean, variance = 0.0, 0.0
    for part in parts:
        whole, count = part.sum(1, keepdims=True), part.shape[1]
        # shares of the mean log ratio: of all pieces, and without each
        gain, without = (0.5 * np.log(own[1] / own[0]).sum(-1) / pairs for own in (whole, whole - part))
        mean += float(gain[0])
        variance += (count - 1) / count * float(((without - without.mean()) ** 2).sum())
    freedom, error = pieces - len(parts), max(float(np.sqrt(variance)), 1e-12)
    margin = float(scipy.stats.t.ppf(0.975, freedom)) * error
    p = float(2 * scipy.stats.t.sf(abs(mean) / error, freedom))
    ratio, low, high = np.exp([mean, mean - margin, mean + margin]).tolist()
    return Comparison(ratio, low, high, p, pieces)


def fitted_units(windows: BoundLikelihood) -> list[str]:
    """The units of the fitted channels, empty where the environment tells none."""
    units = getattr(windows.simulator.environment, "channel_units", None)
    return ["" if units is None else units[c] for c in windows.channels]


def channel_noise(windows: BoundLikelihood, noise: Noise) -> dict[str, ChannelNoise]:
    """The noise of each fitted channel."""
    at_limit = noise.tau >= (1 - 1e-3) * windows.trajectories.longest
    rows = zip(noise.sd.tolist(), noise.tau.tolist(), fitted_units(windows), at_limit.tolist(), strict=True)
    return {channel: ChannelNoise(*row) for channel, row in zip(windows.fitted, rows, strict=True)}


def channel_scores(
    windows: BoundLikelihood, theta: FloatArray, predicted: FloatArray | None = None
) -> list[ChannelScore]:
    """One row for each log and channel, theta (N,) beside the model as given; predicted: by ``both_predicted``."""
    predicted = both_predicted(windows, theta) if predicted is None else predicted
    rmse = _roots(windows, _squares(windows, predicted))
    return [
        ChannelScore(log, *channel, float(rmse[0, k, c]), float(rmse[1, k, c]))
        for k, log in enumerate(windows.trajectories.names)
        for c, channel in enumerate(zip(windows.fitted, fitted_units(windows), strict=True))
        if not np.isnan(rmse[0, k, c])
    ]


def _stitched(windows: BoundLikelihood, predicted: FloatArray, log: int) -> FloatArray:
    """Predictions (B, T+1, C) of one log, of predicted (B, W, L, C); NaN where no window stands."""
    out = np.full((len(predicted), len(windows.trajectories[log].time), predicted.shape[-1]), np.nan)
    for w in np.flatnonzero(windows.log == log):
        place, channel = np.nonzero(windows.compared[w])
        out[:, windows.start[w] + place, channel] = predicted[:, w, place, channel]
    return out


def signals(
    windows: BoundLikelihood, use: str, predicted: FloatArray, band: tuple[FloatArray, FloatArray]
) -> list[Signal]:
    """What the report draws of each log and channel: predicted (2, W, L, C) at the mode and by another, and bands."""
    every, out = np.concatenate([predicted, np.stack(band)]), []
    for k, log in enumerate(windows.trajectories):
        lines, begins = _stitched(windows, every, k), windows.start[windows.log == k] * log.dt
        for c, channel in enumerate(zip(windows.fitted, fitted_units(windows), strict=True)):
            measured, (mode, other, low, high) = log.observations[:, windows.channels[c]], lines[..., c]
            out.append(Signal(log.name, use, *channel, log.time, measured, mode, low, high, other, begins))
    return out


def white_noise(windows: BoundLikelihood, theta: FloatArray) -> Noise:
    """White noise of the size of the residuals at theta (N,), with the windows' starts at their best."""
    squares = (_best_residuals(windows, theta) ** 2).sum(axis=(0, 1))
    size = np.sqrt(squares / np.maximum(windows.observed.sum(axis=(0, 1)), 1))
    return Noise(np.maximum(size, windows.rounding), np.zeros(len(size)))


def fitted_residuals(windows: BoundLikelihood, theta: FloatArray, noise: Noise, starts: FloatArray) -> list[Residual]:
    """Residuals of each log and channel at theta (N,) and starts (W, D), whitened by noise (C,)."""
    residual = windows.residuals(theta[None], starts[None])[0][0]
    both = np.stack([np.where(windows.observed, residual, np.nan), np.full(residual.shape, np.nan)])
    for c, own in enumerate(windows.whitened(residual[None], noise)):
        both[1].reshape(-1, residual.shape[2])[windows.sequences[c].index, c] = own[0]
    out = []
    for k, trajectory in enumerate(windows.trajectories):
        raw, whitened = _stitched(windows, both, k)
        for c, channel in enumerate(zip(windows.fitted, fitted_units(windows), strict=True)):
            out.append(Residual(trajectory.name, *channel, trajectory.time, raw[:, c], whitened[:, c]))
    return out


def measured_starts(windows: BoundLikelihood, theta: FloatArray, near: FloatArray | None = None) -> FloatArray:
    """Initial states (B, W, D) of theta (B, N) for free simulations: zero is what was measured.

    Of free bodies that strike something the first tenth of a second tells far more than its smoothed first sample:
    there they are those that fit it best, of ``near`` (N,) for all or of each theta.
    """
    poses = isinstance(windows.simulator, Simulator) and windows.simulator.environment.poses
    inertial = bool(poses) and bool(inertial_joints(windows.simulator.model, poses))
    if not poses or inertial or not windows.num_start or not windows.impacts:
        return windows.no_starts(len(theta))
    view = windows.beginnings(windows.telling_steps(max(8, math.ceil(0.1 / float(windows.dt.min())))))
    with windows.counting(view):
        own = [view.fit_starts(at, windows.level)[0] for at in (theta if near is None else near[None])]
    return np.broadcast_to(np.stack(own), (len(theta), *own[0].shape))
