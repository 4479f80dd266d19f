"""Levenberg-Marquardt steps within the unit cube: the one way in which every search of ``laplace`` goes downhill.

An energy, -log of likelihood x prior, is known at a point and linearised there. What depends on theta alone to first
order (windows' starts, states) is eliminated; a small quadratic programme over theta is left,

    minimise over s:  1/2 s' (H + damping diag H) s - g' s,   0 <= theta + s <= 1,

solved by MuJoCo's mju_boxQP. K. Levenberg 1944, "A method for the solution of certain non-linear problems in least
squares", Q. Appl. Math. 2; D. Marquardt 1963, "An algorithm for least-squares estimation of nonlinear parameters",
J. SIAM 11. A step into a diverged or unphysical simulation is refused and shortened, so one bad rollout costs one
step, not the fit.

**How steps are damped** is said in one place: ``DampingRule.after``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Generic, Protocol, TypeVar

import numpy as np

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.options import Options, option
from sipe_bayes.likelihood.minimise import damped_box_step


@dataclass(frozen=True)
class DampingRule(Options):
    """How the damping of a step follows from the one before."""

    first: float = option(1e-4, "damping of the first step, nearly Gauss and Newton's", above=0)
    shrink: float = option(0.2, "factor after a step that lowered the energy", above=0, below=1)
    grow: float = option(8.0, "factor after one that did not", above=1)
    least: float = option(1e-9, "below it rounding rules", above=0)
    most: float = option(1e6, "above it a step is none, and the search stands still", above=0)
    least_refused: float = option(0.0, "damping before it grows, at least", least=0)

    def after(self, damping: float, lowered: bool) -> float:
        """The damping of the next step, after one that ``lowered`` the energy or did not."""
        if lowered:
            return max(self.least, damping * self.shrink)
        return max(damping, self.least_refused) * self.grow


@dataclass(frozen=True)
class QuadraticModel:
    """The energy around a point as a quadratic in theta, all else eliminated.

    Args:
        hessian: (N, N), with the prior.
        gradient: (N,), the downhill one, with the prior.
        explained: twice the nats that a step of what is eliminated gains at a fixed theta.
        rest: the best change of what is eliminated for a step (N,) of theta.
    """

    hessian: FloatArray
    gradient: FloatArray
    explained: float
    rest: Callable[[FloatArray], FloatArray]

    def gain(self, move: FloatArray) -> float:
        """Nats by which a step (N,) of theta is to lower the energy."""
        return float(self.gradient @ move - 0.5 * move @ self.hessian @ move) + 0.5 * self.explained

    def step(self, theta: FloatArray, damping: float) -> FloatArray:
        """Minimiser (N,) of the damped model within the unit cube around theta (N,); zero where there is none."""
        return damped_box_step(self.hessian, self.gradient, theta, damping)


P = TypeVar("P")
P_co = TypeVar("P_co", covariant=True)


class LinearisedEnergy(Protocol[P_co]):
    """An energy at a point P, which holds theta (N,) and what is eliminated, and its linearisation there."""

    @property
    def theta(self) -> FloatArray:
        """Where the energy is linearised (N,)."""

    @property
    def energy(self) -> float:
        """The energy there."""

    def model(self, damping: float) -> QuadraticModel:
        """The quadratic model with what is eliminated damped as well.

        Raises:
            np.linalg.LinAlgError: where rounding leaves none.
        """

    def simulated(self, theta: FloatArray, change: FloatArray) -> tuple[P_co, float]:
        """The point at theta (N,) where what is eliminated has changed by ``change``, and its energy by simulation.

        The energy is infinite where the simulation diverges.
        """


@dataclass(frozen=True)
class Descent(Generic[P]):
    """What came of trying to go downhill.

    Args:
        point: where the step led; None where none was taken.
        energy: there, or where it stands.
        damping: of the next step.
        converged: whether there is nothing left to gain, or no step gained what was expected.
        expected: nats that the step was to gain; infinite where a stale linearisation's step was refused.
        gained: nats that it gained.
        refused: most nats that a step was to gain which gained nothing.
        exhausted: whether steps were refused until there was none, not until one was to gain too little.
    """

    point: P | None
    energy: float
    damping: float
    converged: bool = False
    expected: float = 0.0
    gained: float = 0.0
    refused: float = 0.0
    exhausted: bool = False


def descend(
    linearised: LinearisedEnergy[P], damping: float, tolerance: float, rule: DampingRule, stale: bool = False
) -> Descent[P]:
    """The first of ever shorter damped steps that lowers the energy.

    Where damping left over from earlier steps is why nothing is to be gained, one nearly undamped step is tried as
    well: at a kink, as of dry friction, damping grows until it promises nothing, whatever the slope says.

    Args:
        linearised: the energy at a point and around it.
        damping: of the first step tried.
        tolerance: nats; where a step is to gain less the search has converged.
        rule: how the damping changes.
        stale: whether the linearisation is of an earlier point; a refused step is then left to a fresh one.
    """
    fit = _shortened(linearised, damping, tolerance, rule, stale)
    step = _tried(linearised, rule.first, tolerance) if fit.converged and damping > rule.first else None
    if step is None or step.converged:
        return fit
    if step.gained > fit.gained:
        return replace(step, damping=rule.after(rule.first, lowered=True), converged=step.gained < tolerance)
    return replace(fit, expected=np.inf, converged=False) if stale else replace(fit, refused=step.expected)


def _shortened(
    linearised: LinearisedEnergy[P], damping: float, tolerance: float, rule: DampingRule, stale: bool
) -> Descent[P]:
    """The first of ever shorter steps that lowers the energy, from one damping on."""
    standing: Descent[P] = Descent(None, linearised.energy, damping)
    refused = 0.0
    while damping <= rule.most:
        step = _tried(linearised, damping, tolerance)
        if step is not None and step.converged:
            return replace(standing, converged=True, refused=refused)
        if step is not None and step.point is not None:
            return replace(step, damping=rule.after(damping, lowered=True), converged=step.gained < tolerance)
        if step is not None and stale:
            return replace(standing, expected=np.inf)
        damping, refused = rule.after(damping, lowered=False), max(refused, step.expected if step else 0.0)
    return replace(standing, converged=True, refused=refused, exhausted=True)


def _tried(linearised: LinearisedEnergy[P], damping: float, tolerance: float) -> Descent[P] | None:
    """A damped step: converged where it is to gain less than ``tolerance``, without a point where it gained nothing.

    None where rounding leaves no model.
    """
    try:
        model = linearised.model(damping)
    except np.linalg.LinAlgError:
        return None
    move = model.step(linearised.theta, damping)
    expected = model.gain(move)
    if expected < tolerance:
        return Descent(None, linearised.energy, damping, converged=True, expected=expected)
    theta = np.clip(linearised.theta + move, 0.0, 1.0)
    point, energy = linearised.simulated(theta, model.rest(move))
    gained = linearised.energy - energy
    if gained > 0:
        return Descent(point, energy, damping, expected=expected, gained=gained)
    return Descent(None, linearised.energy, damping, expected=expected)
