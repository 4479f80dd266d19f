"""Searches on beginnings of windows from known states, and where they come to rest.

Differences are wide at first: a short one across a jump is a slope of jump by length. They shrink where nothing is left
to gain over them, and begin on longer beginnings as long as theta is still open. Each channel counts by the size of
what is left of it: what is minimised is the sum of these sizes' logarithms, by the number of samples.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.inference.laplace.levenberg_marquardt import descend
from sipe_bayes.inference.laplace.strategy import SearchProblem
from sipe_bayes.inference.laplace.windows.energy import (
    LinearisedWindows,
    WindowEnergy,
    WindowPoint,
    beyond_start_noise,
    judging_channels,
    present_noise,
    unevenly_left,
)
from sipe_bayes.likelihood.noise import NORMAL_MAD, Noise
from sipe_bayes.likelihood.quadratic_prior import QuadraticPrior
from sipe_bayes.likelihood.windows import Linearisation, Windows


@dataclass(frozen=True)
class Rest:
    """Where a search came to rest.

    Args:
        theta: (N,).
        misfit: what it minimises there.
        covariance: (N, N), of theta.
        fits: whether no more is left than the noise of the known starts; not where that is unknown.
    """

    theta: FloatArray
    misfit: float
    covariance: FloatArray
    fits: bool

    @property
    def sd(self) -> FloatArray:
        """(N,), of theta."""
        return np.sqrt(np.diag(self.covariance))

    def holds(self, other: Rest) -> bool:
        """Whether another search came to rest in the same place."""
        return bool((np.abs(other.theta - self.theta) < self.sd).all())


@dataclass(frozen=True)
class _WeighedEnergy(WindowEnergy):
    """The energy where the residuals count by the squares of ``root`` (W, L, C)."""

    root: FloatArray

    def __call__(self, theta: FloatArray, starts: FloatArray, residual: FloatArray) -> float:
        """See ``WindowEnergy``."""
        return super().__call__(theta, starts, residual * self.root)


def rest_on(
    problem: SearchProblem,
    windows: Windows,
    horizon: int,
    limit: float,
    theta: FloatArray,
    widths: FloatArray,
    robust: bool = False,
) -> Rest | None:
    """Where a search from theta (N,) on beginnings comes to rest; None where it diverges.

    widths: (N,), of the first differences. robust: by Student's t.

    Raises:
        BudgetExhausted: where the budget ends.
    """
    view, share = beginning(windows, horizon, limit)
    tuning, rule, starts = problem.options.tuning.contact, problem.options.tuning.damping, view.no_starts()
    least = max(view.theta_step, tuning.narrowest)
    size = np.maximum(widths, least)
    damping, residual = rule.first, np.zeros(0)
    try:
        for number in range(tuning.most_steps):
            lin = view.linearise(theta, starts, residual=residual if number else None, theta_step=size)
            if not lin.valid:
                return None
            linearised = _linearised(view, lin, theta, problem.quadratic_prior, tuning.freedom if robust else None)
            covariance = problem.normal(theta, linearised.model(0.0).hessian, np.zeros(len(theta)))[1]
            tolerance = tuning.enough * linearised.energy
            fit = descend(linearised, damping, tolerance, rule)
            point = fit.point or linearised.point
            theta, residual, damping = point.theta, point.residual, fit.damping
            if fit.gained < tolerance:
                if (size <= least).all():
                    break
                size, damping = np.maximum(size / tuning.finer, least), rule.first
    finally:
        windows.rollouts += math.ceil(view.rollouts * share)
    return Rest(theta, misfit_of(view, residual), covariance, _fits(view, residual))


def beginning(windows: Windows, horizon: int, limit: float) -> tuple[Windows, float]:
    """The first control steps of all windows, with a count and a budget of their own; and how much of whole ones."""
    view = windows.part(np.arange(windows.num_windows)).beginnings(horizon)
    share = float(view.steps.sum() / windows.steps.sum())
    view.rollouts, view.budget = 0, (limit - windows.rollouts) / share
    return view, share


def _linearised(
    windows: Windows, lin: Linearisation, theta: FloatArray, prior: QuadraticPrior, freedom: float | None
) -> LinearisedWindows:
    """The energy for noise of the present residuals' size, or with weights of Student's t of so many degrees."""
    point, noise = WindowPoint(theta, windows.no_starts(), lin.residual), present_noise(windows, lin.residual)
    if freedom is None:
        return LinearisedWindows(WindowEnergy(windows, noise, prior), point, windows.moments(lin, white=True))
    sizes = np.where(windows.observed, np.abs(lin.residual), np.nan)
    sd = np.maximum(NORMAL_MAD * np.nanmedian(sizes, axis=(0, 1)), windows.rounding)
    root = np.sqrt((freedom + 1) / (freedom + (lin.residual / sd) ** 2))
    lin = replace(lin, residual=root * lin.residual, jacobian=root[..., None] * lin.jacobian)
    energy = _WeighedEnergy(windows, Noise(sd, noise.tau), prior, root)
    return LinearisedWindows(energy, point, windows.moments(lin, white=True))


def _fits(windows: Windows, residual: FloatArray) -> bool:
    """Whether residuals (W, L, C) are no more than the noise of the known starts, and no larger in some windows."""
    if not judging_channels(windows).any() or unevenly_left(windows, residual) is not None:
        return False
    return beyond_start_noise(windows, present_noise(windows, residual).sd) is None


def misfit_of(windows: Windows, residual: FloatArray) -> float:
    """-log likelihood of residuals (W, L, C) under white noise of their own size, up to a constant."""
    noise, counts = present_noise(windows, residual), windows.observed.sum(axis=(0, 1))
    return float(0.5 * windows.chi_square(residual[None], noise)[0] + counts @ np.log(noise.sd))
