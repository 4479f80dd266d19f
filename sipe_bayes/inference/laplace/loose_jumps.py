"""Jumps of a ``StateSpace`` that are let go, since one process noise for all steps cannot hold them.

A smoother that settles on the wrong side of a contact leaves a few jumps that stand out, and a process noise inferred from all
jumps alike grows with them until the whole log says little. A loose jump's sd is the coordinate's movement in a control step
instead. That costs its width, and, as few steps should need it, the logarithm of how rare it is. What is left of the log is then
followed closely, and from there the filter mostly finds the way through (``state_space_search``).

Jumps are proposed generously, as large ones hide each other and smear over their neighbours, and kept only where the evidence
asks for it. This is a mixture of two normals for the process noise, each jump assigned to one of them; a contaminated normal
(J. W. Tukey, "A survey of sampling from contaminated distributions", 1960).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from sipe_bayes.inference.laplace.smoother import border, sound
from sipe_bayes.likelihood.quadratic_prior import QuadraticPrior
from sipe_bayes.likelihood.state_space.linearisation import (
    ChainLinearisation,
    ChainNoise,
    eliminate_states,
    jump_normal,
)

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

_STANDS_OUT = 2.5  # times the usual jump
_MOST = 0.05  # of all jumps may be loose, also the probability of one


def outstanding(found: ChainLinearisation, noise: ChainNoise) -> BoolArray:
    """Jumps (K-1,) whose size is far above the usual one; at most a small share of all."""
    size = np.where(found.linked, np.sqrt(((found.jump / noise.process) ** 2).mean(1)), 0.0)
    most = int(_MOST * found.linked.sum())
    bar = max(float(np.sort(size)[-most - 1]), _STANDS_OUT * float(np.median(size[found.linked])))
    return np.asarray(size > bar)


def rarity(noise: ChainNoise) -> float:
    """Nats that loose jumps cost because they are rare."""
    return 0.0 if noise.outliers is None else -float(noise.outliers.sum()) * np.log(_MOST)


def needed(found: ChainLinearisation, noise: ChainNoise, prior: QuadraticPrior, theta: FloatArray) -> BoolArray:
    """Of the loose jumps (K-1,) those that have to be: the others are made tight one by one, first the one that gains most."""
    loose = np.zeros(len(found.linked), bool) if noise.outliers is None else noise.outliers.copy()
    while loose.any():
        gains = tightening(found, sound(found, replace(noise, outliers=loose)), prior, theta)
        best = int(gains.argmax())
        if gains[best] <= 0:
            break
        loose[np.flatnonzero(loose)[best]] = False
    return loose


def tightening(found: ChainLinearisation, noise: ChainNoise, prior: QuadraticPrior, theta: FloatArray) -> FloatArray:
    """Nats of evidence (J,) that each of the J loose jumps gains when made tight, exact for one linearisation: the
    Savage-Dickey ratio of what all else says of it (J. M. Dickey, "The weighted likelihood ratio, linear hypotheses on normal
    location parameters", 1971, https://doi.org/10.1214/aoms/1177693507)."""
    assert noise.outliers is not None
    tight, loose = noise.process, noise.outlier_sd
    wider = loose > tight  # elsewhere a loose jump is none
    solved = eliminate_states(found, noise)
    step, covariance, _ = border(prior, theta, solved.gradient).solve(solved)
    mean, spread = jump_normal(found, solved, step, covariance, np.flatnonzero(noise.outliers))
    mean, spread = mean[:, wider], spread[:, wider][:, :, wider]
    ratio = (
        tight[wider] * loose[wider] / np.sqrt(loose[wider] ** 2 - tight[wider] ** 2)
    )  # sd of the ratio of the two normals
    spread = spread + np.diag(ratio**2)
    squares = np.einsum("kd,kd->k", mean, np.linalg.solve(spread, mean[..., None])[..., 0])
    scales = float(np.log(ratio * loose[wider] / tight[wider]).sum())
    return np.asarray(scales - np.log(_MOST) - 0.5 * (squares + np.linalg.slogdet(spread)[1]))
