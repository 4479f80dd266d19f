"""Optima of segments: a normal in theta, its evidence, and what is known of it; and the search that records them."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from sipe_bayes.core.arrays import BoolArray, FloatArray, IntArray
from sipe_bayes.core.findings import Finding
from sipe_bayes.core.thresholds import THRESHOLDS
from sipe_bayes.inference.laplace.energy import beyond_rounding, free_noise, pulls, updated_noise
from sipe_bayes.inference.laplace.strategy import Optimum, SearchProblem, StrategyState
from sipe_bayes.likelihood import Eliminated, Linearisation, Noise
from sipe_bayes.likelihood.moments import Moments
from sipe_bayes.likelihood.noise_spread import noise_cloud, sandwich
from sipe_bayes.likelihood.restricted import restricted
from sipe_bayes.likelihood.windows import Windows


@dataclass(frozen=True)
class WindowOptimum(Optimum):
    """An optimum of segments.

    Args:
        starts: (W, D), initial states.
        slope: (W, D, N): initial states follow theta by minus this.
        finding: why its intervals are not to be trusted; None where they may be.
        early: whether it is of a stage on the way, perhaps of fewer samples than the end.
    """

    starts: FloatArray
    slope: FloatArray
    finding: Finding | None = None
    early: bool = False


@dataclass(frozen=True)
class WindowState(StrategyState[Any]):
    """A search over segments.

    Args:
        wild: (k, 3), samples that are left out; see ``likelihood.wild_samples``.
        longer: whether the search has gone on from where longer segments led.
    """

    optima: tuple[WindowOptimum, ...] = ()
    wild: IntArray = field(default_factory=lambda: np.zeros((0, 3), np.int64))
    longer: bool = False


def summarised(
    problem: SearchProblem,
    windows: Windows,
    theta: FloatArray,
    starts: FloatArray,
    noise: Noise,
    moments: Moments,
    lin: Linearisation,
) -> WindowOptimum:
    """The normal at theta (N,) and starts (W, D) over the noise's uncertainty, and the evidence.

    moments: of the linearisation ``lin`` there.
    """
    prior = problem.quadratic_prior
    sandwiched = windows.settings.noise == "sandwich"
    solved = windows.eliminate(moments.normal(noise), moments.num_theta, starts)
    here = pulls(windows, prior, theta, starts, solved.gradient)
    prior_energy = prior.energy(theta) + 0.5 * float((starts**2 @ windows.start_precision).sum())
    evidence = restricted(moments, noise, replace(here, free=np.full(len(theta), True)))[0] - prior_energy
    white = noise.sd
    if sandwiched:
        noise = updated_noise(windows, moments, noise, theta, starts, prior, coloured=True)
    mean, covariance = np.zeros(len(theta)), np.zeros((len(theta), len(theta)))
    centres = []
    # moments of the normals of a few weighted noise values
    for weight, point in noise_cloud(moments, noise, here, free_noise(windows), windows.trajectories.longest):
        if sandwiched:
            middle = sandwich(lin.jacobian, solved.slope, white, windows.sequences, point)
            centre, spread = problem.normal(theta, *_sandwiched(solved, middle, here.free))
        else:
            point = beyond_rounding(windows, point)
            inner = windows.eliminate(moments.normal(point), moments.num_theta, starts)
            centre, spread = problem.normal(theta, inner.precision, inner.gradient)
        mean += weight * centre
        covariance += weight * spread
        centres.append((weight, centre))
    for weight, centre in centres:
        covariance += weight * np.outer(centre - mean, centre - mean)
    return WindowOptimum(theta, mean, covariance, evidence, noise.sd, noise.tau, starts, solved.slope)


def _sandwiched(solved: Eliminated, middle: FloatArray, free: BoolArray) -> tuple[FloatArray, FloatArray]:
    """Precision and gradient of plain least squares when the residuals' covariance gives ``middle`` (N, N).

    Parameters that a bound holds, not ``free`` (N,), stay there: the sandwich does not say where others would follow.
    """
    shift, inner = np.zeros(len(free)), solved.precision[np.ix_(free, free)]
    shift[free] = np.linalg.pinv(inner, rcond=1e-12, hermitian=True) @ solved.gradient[free]
    precision = solved.precision @ np.linalg.pinv(middle, rcond=1e-12, hermitian=True) @ solved.precision
    # rounding leaves some of an open direction negative
    eigenvalues, axes = np.linalg.eigh(0.5 * (precision + precision.T))
    precision = (axes * np.maximum(eigenvalues, 0.0)) @ axes.T
    return precision, precision @ shift


def not_followed(windows: Windows, sd: FloatArray) -> tuple[str, float] | None:
    """The channel that a fit with noise sds (C,) does not follow, and its noise over the scatter of its samples.

    Noise that is a good part of what a channel does is none where the samples do not scatter by it, whatever its time.
    """
    excess = np.where(sd > THRESHOLDS.gross * windows.spread, sd / windows.level.sd, 0.0)
    worst = int(excess.argmax())
    return (windows.fitted[worst], float(excess[worst])) if excess[worst] > THRESHOLDS.noise_excess else None
