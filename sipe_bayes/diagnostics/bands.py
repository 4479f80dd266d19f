"""Bands that hold what a sensor reads: the posterior's, widened by what the training logs show to be missing.

Each channel's root-mean-square error by the time since a window began, the largest so far, scales a conformal widening
(Y. Romano, E. Patterson, E. Candes, "Conformalized quantile regression", NeurIPS 2019,
https://arxiv.org/abs/1905.03222): with scores s = max(low - y, y - high) / scale of the training samples, the band is
low - q scale to high + q scale, where q >= 0 is the quantile of s at 0.9 (K + 1) / K; K tenths of logs are nearly
exchangeable, samples are not. Deviation: the training logs also gave the estimate, which makes their errors smaller.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping

import numpy as np
import torch

from sipe_bayes.core.arrays import BoolArray, FloatArray
from sipe_bayes.core.thresholds import THRESHOLDS
from sipe_bayes.diagnostics.evaluate import fitted_units, measured_starts
from sipe_bayes.diagnostics.records import BandCoverage
from sipe_bayes.likelihood import BoundLikelihood
from sipe_bayes.posterior import Posterior

DRAWS = 16  # of the posterior, between whose 5 and 95 % the band lies


def widening(windows: BoundLikelihood, predicted: FloatArray, low: FloatArray, high: FloatArray) -> FloatArray:
    """By how much training logs, ``predicted`` (W, L, C) at the mode, widen the posterior's bands (W, L, C): (L, C)."""
    scale = np.maximum(_growth(windows, predicted), np.maximum(windows.rounding, 1e-12))
    with np.errstate(invalid="ignore"):
        score = np.maximum(low - windows.measured, windows.measured - high) / scale
    margin = np.zeros_like(scale)
    for c in range(scale.shape[1]):
        if pieces := _by_piece(windows, score[..., c], c):
            scores, level = np.concatenate(pieces), THRESHOLDS.shown_interval * (len(pieces) + 1) / len(pieces)
            scores[~np.isfinite(scores)] = np.max(scores, where=np.isfinite(scores), initial=0.0)
            margin[:, c] = scale[:, c] * max(float(np.quantile(scores, min(level, 1.0), method="higher")), 0.0)
    return margin


def widen(margin: FloatArray, low: FloatArray, high: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Bands (W, L, C), widened; of samples later than the margin's its last."""
    own = margin[np.minimum(np.arange(low.shape[1]), len(margin) - 1)]
    return low - own, high + own


def predictive_bands(
    windows: Mapping[str, BoundLikelihood],
    predicted: Mapping[str, FloatArray],
    theta: FloatArray,
    posterior: Posterior,
    seed: int,
    lacking: bool = False,
) -> dict[str, tuple[FloatArray, FloatArray]]:
    """The ends (W, L, C) of 90 % bands of logs by their use, widened by what those of ``train`` show.

    ``predicted`` are (2, W, L, C) at the mode ``theta`` (N,) and by what it is compared with; ``seed`` is of the
    posterior's draws. Bands of a discrepancy-aware one (``lacking``) are as wide on both sides of the mode.
    """
    narrow = {use: _posterior_band(own, theta, posterior, seed) for use, own in windows.items()}
    for use, (low, high) in narrow.items() if lacking else ():
        mode = predicted[use][0]
        half = np.maximum(mode - low, high - mode)
        narrow[use] = mode - half, mode + half
    margin = widening(windows["train"], predicted["train"][0], *narrow["train"])
    return {use: widen(margin, *band) for use, band in narrow.items()}


def _posterior_band(
    windows: BoundLikelihood, theta: FloatArray, posterior: Posterior, seed: int
) -> tuple[FloatArray, FloatArray]:
    """5 and 95 % quantiles (W, L, C) of predictions by draws of a posterior, whose mode is theta (N,)."""
    draws = posterior.sample((DRAWS,), generator=torch.Generator().manual_seed(seed)).numpy()
    lines = windows.predict(draws, measured_starts(windows, draws, theta))[0]
    quantile = np.quantile if np.isfinite(lines).all() else np.nanquantile  # many times faster than with NaN
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # samples that no draw reached
        low, high = quantile(lines, [0.05, 0.95], axis=0)
    return low, high


def band_coverage(windows: BoundLikelihood, low: FloatArray, high: FloatArray) -> BandCoverage | None:
    """How much of logs their bands (W, L, C) hold; None where nothing was measured."""
    shares, halves = [], {}
    for c, (channel, unit) in enumerate(zip(windows.fitted, fitted_units(windows), strict=True)):
        inside = (low[..., c] <= windows.measured[..., c]) & (windows.measured[..., c] <= high[..., c])
        if pieces := _by_piece(windows, inside, c):
            shares += [float(piece.mean()) for piece in pieces]
            width = np.concatenate(_by_piece(windows, (high - low)[..., c], c))
            halves[channel] = float(np.median(width)) / 2, unit
    if not shares:
        return None
    error = float(np.std(shares) / np.sqrt(len(shares)))
    return BandCoverage(float(np.mean(shares)), error, len(shares), halves)


def _growth(windows: BoundLikelihood, predicted: FloatArray) -> FloatArray:
    """RMSE (L, C) by samples since a window began, the largest until then."""
    square = np.where(windows.observed, (windows.measured - predicted) ** 2, 0.0)
    total = np.where(np.isfinite(square), square, 0.0).sum(0)
    return np.maximum.accumulate(np.sqrt(total / np.maximum(windows.observed.sum(0), 1)))


def _by_piece(windows: BoundLikelihood, values: FloatArray | BoolArray, channel: int) -> list[FloatArray]:
    """Values (W, L) at the samples of a channel: of tenths of each log, which are nearly independent."""
    own = windows.observed[..., channel]
    logs = [values[own & (windows.log == k)[:, None]] for k in range(len(windows.trajectories))]
    return [piece for one in logs for piece in np.array_split(one, 10) if len(piece)]
