"""Bands that hold what a sensor reads: the posterior's, widened by what the training logs show to be missing.

The posterior's band knows neither the noise nor what the model lacks, and errors grow with the time since a window
began. Each channel's root-mean-square error by that time, made monotone by isotonic regression, scales a conformal
widening (Y. Romano, E. Patterson, E. Candes, "Conformalized quantile regression", NeurIPS 2019,
https://arxiv.org/abs/1905.03222): with scores s = max(low - y, y - high) / scale of the training samples, the band is
low - q scale to high + q scale, where q is a quantile of s. Samples of one piece of time are not exchangeable, pieces
nearly so: tenths of each log have the same weight, and the quantile is that of K pieces, 0.9 (K + 1) / K (R. Dunn, L.
Wasserman, A. Ramdas, "Distribution-free prediction sets for two-layer hierarchical models", JASA 118 (2023),
https://doi.org/10.1080/01621459.2022.2060112, on pooling).

Deviations:

- The training logs also gave the estimate, so that their errors are somewhat small where parameters are many: what a
  band holds is measured on held-out logs.
- A band is never narrower than the posterior's.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import scipy.optimize

from sipe_bayes.core.arrays import BoolArray, FloatArray
from sipe_bayes.core.thresholds import THRESHOLDS
from sipe_bayes.diagnostics.evaluate import fitted_units, posterior_band
from sipe_bayes.diagnostics.records import BandCoverage
from sipe_bayes.likelihood import BoundLikelihood
from sipe_bayes.posterior import Posterior

PIECES = 10  # of a log: errors of neighbouring samples are not independent, of tenths nearly so


@dataclass(frozen=True)
class Bands:
    """By how much the posterior's bands are widened.

    Args:
        margin: (L, C) in the channels' units, by samples since a window began; of later ones it is the last.
    """

    margin: FloatArray

    @classmethod
    def of(cls, windows: BoundLikelihood, predicted: FloatArray, low: FloatArray, high: FloatArray) -> Bands:
        """From training logs.

        Args:
            windows: W of L samples and C channels.
            predicted: (W, L, C) at the mode.
            low: (W, L, C) of the posterior's band.
            high: (W, L, C).
        """
        scale = np.maximum(_growth(windows, predicted), np.maximum(windows.rounding, 1e-12))
        with np.errstate(invalid="ignore"):
            score = np.maximum(low - windows.measured, windows.measured - high) / scale
        margin = np.zeros_like(scale)
        for c in range(scale.shape[1]):
            pieces = [score[..., c][piece] for piece in _pieces(windows, c)]
            margin[:, c] = scale[:, c] * max(_pooled(pieces), 0.0)
        return cls(margin)

    def widen(self, low: FloatArray, high: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Bands (W, L, C), widened."""
        steps = np.minimum(np.arange(low.shape[1]), len(self.margin) - 1)
        return low - self.margin[steps], high + self.margin[steps]


def predictive_bands(
    windows: Mapping[str, BoundLikelihood],
    predicted: Mapping[str, FloatArray],
    theta: FloatArray,
    posterior: Posterior,
    seed: int,
    lacking: bool = False,
) -> dict[str, tuple[FloatArray, FloatArray]]:
    """The ends (W, L, C) of 90 % bands of logs by their use, widened by what those of ``train`` show.

    Args:
        windows: the logs.
        predicted: (2, W, L, C) at the mode and by what it is compared with.
        theta: (N,) the mode.
        posterior: of theta.
        seed: of its draws.
        lacking: whether the posterior is that of what a further log would ask for, of a model that lacks something: in
            which direction its predictions are then wrong elsewhere is not known, so that bands are as wide on both
            sides of the mode.
    """
    narrow = {use: posterior_band(own, theta, posterior, seed, predicted[use][0]) for use, own in windows.items()}
    if lacking:
        for use, (low, high) in narrow.items():
            half = np.maximum(predicted[use][0] - low, high - predicted[use][0])
            narrow[use] = predicted[use][0] - half, predicted[use][0] + half
    bands = Bands.of(windows["train"], predicted["train"][0], *narrow["train"])
    return {use: bands.widen(*band) for use, band in narrow.items()}


def band_coverage(windows: BoundLikelihood, low: FloatArray, high: FloatArray) -> BandCoverage | None:
    """How much of logs their bands (W, L, C) hold; None where nothing was measured."""
    shares, halves = [], {}
    for c, (channel, unit) in enumerate(zip(windows.fitted, fitted_units(windows), strict=True)):
        inside = (low[..., c] <= windows.measured[..., c]) & (windows.measured[..., c] <= high[..., c])
        pieces = _pieces(windows, c)
        if pieces:
            shares.append([float(inside[piece].mean()) for piece in pieces])
            width = np.concatenate([(high - low)[..., c][piece] for piece in pieces])
            halves[channel] = float(np.median(width)) / 2, unit
    if not shares:
        return None
    every = np.concatenate(shares)
    return BandCoverage(float(every.mean()), float(every.std() / np.sqrt(len(every))), len(every), halves)


def _growth(windows: BoundLikelihood, predicted: FloatArray) -> FloatArray:
    """Root-mean-square errors (L, C) by samples since a window began, which do not fall."""
    square = np.where(windows.observed, (windows.measured - predicted) ** 2, 0.0)
    square = np.where(np.isfinite(square), square, 0.0).sum(0)
    count = windows.observed.sum(0).astype(float)
    out = np.zeros_like(square)
    for c in range(square.shape[1]):
        seen = count[:, c] > 0
        if seen.any():
            mean = square[seen, c] / count[seen, c]
            rising = scipy.optimize.isotonic_regression(mean, weights=count[seen, c]).x
            out[:, c] = np.sqrt(np.interp(np.arange(len(out)), np.flatnonzero(seen), rising))
    return out


def _pieces(windows: BoundLikelihood, channel: int) -> list[BoolArray]:
    """Masks (W, L) of a channel's samples: tenths of each log."""
    masks = []
    for k in range(len(windows.trajectories)):
        own = windows.observed[..., channel] & (windows.log == k)[:, None]
        places = np.flatnonzero(own)
        for part in np.array_split(places, PIECES):
            if len(part):
                mask = np.zeros(own.size, bool)
                mask[part] = True
                masks.append(mask.reshape(own.shape))
    return masks


def _pooled(pieces: list[FloatArray]) -> float:
    """The quantile of scores by piece, each piece of the same weight; the largest where the pieces are too few."""
    if not pieces:
        return 0.0
    score = np.concatenate(pieces)
    weight = np.concatenate([np.full(len(piece), 1 / len(piece)) for piece in pieces])
    finite = np.where(np.isfinite(score), score, np.inf)
    order = np.argsort(finite)
    level = THRESHOLDS.shown_interval * (len(pieces) + 1) / len(pieces)
    place = np.searchsorted(np.cumsum(weight[order]) / len(pieces), min(level, 1.0) - 1e-12)
    value = float(finite[order][min(int(place), len(order) - 1)])
    return value if np.isfinite(value) else float(np.max(score[np.isfinite(score)], initial=0.0))
