"""Jumps of a ``StateSpace`` that are outliers, since one process noise for all steps cannot hold them.

A smoother that settles on the wrong side of a contact leaves a few jumps that stand out, and a process noise inferred
from all jumps alike grows with them until the whole log says little. An outlier's sd is the coordinate's movement in a
control step instead. That costs its width, and, as few steps should need it, the logarithm of how rare it is. What is
left of the log is then followed closely, and from there the filter mostly finds the way through (``search``).

Jumps are proposed generously, as large ones hide each other and smear over their neighbours, and kept only where the
evidence asks for it. This is a mixture of two normals for the process noise, each jump assigned to one of them; a
contaminated normal (J. W. Tukey, "A survey of sampling from contaminated distributions", 1960).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sipe_bayes.core.arrays import BoolArray, FloatArray
from sipe_bayes.inference.laplace.state_space.options import OutlierTuning
from sipe_bayes.inference.laplace.state_space.smoother import border, solvable
from sipe_bayes.likelihood.quadratic_prior import QuadraticPrior
from sipe_bayes.likelihood.state_space.linearisation import (
    ChainLinearisation,
    ChainNoise,
    eliminate_states,
    jump_normal,
)


def outstanding(linear: ChainLinearisation, noise: ChainNoise, tuning: OutlierTuning) -> BoolArray:
    """Jumps (K-1,) whose size is far above the usual one; at most a small share of all."""
    size = np.where(linear.linked, np.sqrt(((linear.jump / noise.process) ** 2).mean(1)), 0.0)
    most = int(tuning.most * linear.linked.sum())
    bar = max(float(np.sort(size)[-most - 1]), tuning.stands_out * float(np.median(size[linear.linked])))
    return np.asarray(size > bar)


def rarity(noise: ChainNoise, tuning: OutlierTuning) -> float:
    """Nats that outliers cost because they are rare."""
    return 0.0 if noise.outliers is None else -float(noise.outliers.sum()) * np.log(tuning.most)


def needed(
    linear: ChainLinearisation, noise: ChainNoise, prior: QuadraticPrior, theta: FloatArray, tuning: OutlierTuning
) -> BoolArray:
    """Of the outliers (K-1,) those that have to be: the others are made regular, first the one that gains most."""
    outliers = np.zeros(len(linear.linked), bool) if noise.outliers is None else noise.outliers.copy()
    while outliers.any():
        gains = regular_gains(linear, solvable(linear, replace(noise, outliers=outliers)), prior, theta, tuning)
        best = int(gains.argmax())
        if gains[best] <= 0:
            break
        outliers[np.flatnonzero(outliers)[best]] = False
    return outliers


def regular_gains(
    linear: ChainLinearisation, noise: ChainNoise, prior: QuadraticPrior, theta: FloatArray, tuning: OutlierTuning
) -> FloatArray:
    """Nats (J,) of evidence that each of J outliers gains when made regular, exact for one linearisation.

    This is the Savage-Dickey ratio of what all else says of it (J. M. Dickey, "The weighted likelihood ratio, linear
    hypotheses on normal location parameters", 1971, https://doi.org/10.1214/aoms/1177693507).
    """
    assert noise.outliers is not None
    narrow, wide = noise.process, noise.outlier_sd
    wider = wide > narrow  # elsewhere an outlier is none
    solved = eliminate_states(linear, noise)
    step, covariance, _ = border(prior, theta, solved.gradient).solve(solved)
    mean, spread = jump_normal(linear, solved, step, covariance, np.flatnonzero(noise.outliers))
    mean, spread = mean[:, wider], spread[:, wider][:, :, wider]
    # sd of the ratio of the two normals
    ratio = narrow[wider] * wide[wider] / np.sqrt(wide[wider] ** 2 - narrow[wider] ** 2)
    spread = spread + np.diag(ratio**2)
    squares = np.einsum("kd,kd->k", mean, np.linalg.solve(spread, mean[..., None])[..., 0])
    scales = float(np.log(ratio * wide[wider] / narrow[wider]).sum())
    return np.asarray(scales - np.log(tuning.most) - 0.5 * (squares + np.linalg.slogdet(spread)[1]))
