"""Whether the logs are explained as well from elsewhere: cheap searches from draws of the prior, after the optima.

Some machines have several parameters' values that fit alike, to the last bit. A pendulum swings as fast about an axis
at either of two distances from its centre of mass (H. Kater 1818, "An account of experiments for determining the length
of the pendulum vibrating seconds", Phil. Trans. R. Soc. 108); two starting points may both find the one. Scouts go
downhill in theta alone, on few windows, the starts as the log tells them. One that comes to rest about as low as the
optimum lies on those windows, and not in its valley, is a further starting point.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.inference.laplace.levenberg_marquardt import descend
from sipe_bayes.inference.laplace.strategy import Optimum, SearchProblem
from sipe_bayes.inference.laplace.windows.energy import LinearisedWindows, WindowEnergy, WindowPoint, present_noise
from sipe_bayes.inference.laplace.windows.growing_windows import grows
from sipe_bayes.likelihood.settings import BudgetExhausted
from sipe_bayes.likelihood.windows import Windows


@dataclass(frozen=True)
class _Rest:
    """Where a scout came to rest: theta (N,), its energy, and the curvature (N, N) there."""

    theta: FloatArray
    energy: float
    curvature: FloatArray

    def leads_to(self, theta: FloatArray, energy: float, slack: float) -> bool:
        """Whether the way to theta (N,) climbs no more than the energies differ: both lie in one valley."""
        way = theta - self.theta
        return bool(0.5 * way @ self.curvature @ way < 2 * abs(energy - self.energy) + slack)


def may_scout(problem: SearchProblem, windows: Windows) -> bool:
    """Whether scouts are of use: not with a starting point given, starts unmeasured, or bodies that tumble."""
    return (
        bool(windows.num_start) and windows.starts_measured and problem.options.initial is None and not grows(windows)
    )


def scouted(problem: SearchProblem, windows: Windows, optima: Sequence[Optimum]) -> FloatArray:
    """Further starting points (K, N).

    Raises:
        BudgetExhausted: where the budget may not last.
    """
    tuning = problem.options.tuning.scouting
    few = min(windows.num_windows, tuning.most_windows, max(tuning.least_windows, windows.num_windows // 10))
    view = windows.part(np.linspace(0, windows.num_windows - 1, few).round().astype(int))
    share = view.steps.sum() / windows.steps.sum()
    most = tuning.scouts * tuning.steps * (windows.num_theta + 2) * len(windows.trajectories)
    if windows.rollouts + share * most > windows.budget:
        raise BudgetExhausted
    view.budget, before, begin = math.inf, windows.rollouts, view.no_starts()
    best = max(optima, key=lambda optimum: optimum.evidence).theta
    residual, valid = view.residuals(best[None], begin[None])
    energy = WindowEnergy(view, present_noise(view, residual[0]), problem.quadratic_prior)
    level, rests = energy(best, begin, residual[0]), list[_Rest]()
    for theta in _apart(problem, best) if valid[0] else []:
        rest = _rest(problem, energy, theta)
        if rest is None or rest.energy > tuning.as_good * level or rest.leads_to(best, level, tuning.slack):
            continue
        if not any(rest.leads_to(other.theta, other.energy, tuning.slack) for other in rests):
            rests.append(rest)
    windows.rollouts = before + math.ceil((view.rollouts - before) * share)
    lowest = sorted(rests, key=lambda rest: rest.energy)[: tuning.most_points]
    return np.array([rest.theta for rest in lowest]).reshape(-1, windows.num_theta)


def _apart(problem: SearchProblem, best: FloatArray) -> FloatArray:
    """Draws (S, N) of the prior that lie far from the optimum (N,) and from one another."""
    generator = torch.Generator().manual_seed(problem.seed)
    draws = problem.prior.sample((problem.options.tuning.scouting.draws,), generator=generator).numpy()
    chosen, nearest = list[int](), np.linalg.norm(draws - best, axis=1)
    for _ in range(problem.options.tuning.scouting.scouts):
        chosen.append(int(nearest.argmax()))
        nearest = np.minimum(nearest, np.linalg.norm(draws - draws[chosen[-1]], axis=1))
    return np.asarray(draws[chosen])


def _rest(problem: SearchProblem, energy: WindowEnergy, theta: FloatArray) -> _Rest | None:
    """Where a search in theta alone comes to rest; None where it diverges."""
    view, tuning, damping = energy.windows, problem.options.tuning, problem.options.tuning.damping.first
    begin, residual, rest = view.no_starts(), None, None
    for _ in range(tuning.scouting.steps):
        lin = view.linearise(theta, begin, with_starts=False, residual=residual)
        if not lin.valid:
            return None
        fixed = np.zeros((*lin.residual.shape, view.num_start))
        moments = view.moments(
            type(lin)(lin.residual, np.concatenate([lin.jacobian, fixed], axis=-1), True), white=True
        )
        linearised = LinearisedWindows(energy, WindowPoint(theta, begin, lin.residual), moments)
        rest = _Rest(theta, linearised.energy, linearised.model(0.0).hessian)
        fit = descend(linearised, damping, tuning.scouting.tolerance * linearised.energy, tuning.damping)
        if fit.point is None:
            return rest
        theta, residual, damping = fit.point.theta, fit.point.residual, fit.damping
    return rest
