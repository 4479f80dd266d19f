"""Levenberg-Marquardt steps within the unit cube, for the search over a chain of states.

An energy, -log of likelihood x prior, is known at a point and linearised there. The states are eliminated. A quadratic
programme over theta is left,

    minimise over s:  1/2 s' (H + damping diag H) s - g' s,   0 <= theta + s <= 1,

which MuJoCo's mju_boxQP solves. K. Levenberg 1944, "A method for the solution of certain non-linear problems in least
squares", Q. Appl. Math. 2; D. Marquardt 1963, "An algorithm for least-squares estimation of nonlinear parameters",
J. SIAM 11. A step into a simulation that diverges is refused and shortened. ``DampingRule`` says how steps are damped.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import ClassVar, Generic, Protocol, TypeVar

import numpy as np

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.likelihood.block_tridiagonal import damped_box_step


class DampingRule:
    """How the damping of a step follows from the one before."""

    first: ClassVar[float] = 1e-4  # nearly Gauss and Newton's
    most: ClassVar[float] = 1e6  # above it a step is none

    def after(self, damping: float, lowered: bool) -> float:
        """The damping of the next step, after one that ``lowered`` the energy or did not."""
        if lowered:
            return max(1e-9, damping * 0.2)  # below it rounding rules
        return max(damping, self.first) * 8.0


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
        """The quadratic model, damped also in what is eliminated; raises LinAlgError where rounding leaves none."""

    def simulated(self, theta: FloatArray, change: FloatArray) -> tuple[P_co, float]:
        """The point at theta (N,) with what is eliminated changed, and its energy: infinite where it diverges."""


@dataclass(frozen=True)
class Descent(Generic[P]):
    """Where a step led (None: no step lowered the energy), the energy there, and the damping of the next step."""

    point: P | None
    energy: float
    damping: float


def descend(linearised: LinearisedEnergy[P], damping: float, tolerance: float, rule: DampingRule) -> Descent[P]:
    """The first of ever shorter damped steps that lowers the energy.

    Where it gains less than ``tolerance`` nats, and damping of earlier steps may be why, one nearly undamped step is
    tried as well: at a kink, as of dry friction, damping grows until a step promises nothing.
    """
    fit = _shorten(linearised, damping, tolerance, rule)
    if linearised.energy - fit.energy >= tolerance or damping <= rule.first:
        return fit
    undamped = _try(linearised, rule.first, tolerance)
    if undamped is None or undamped.energy >= fit.energy:
        return fit
    return replace(undamped, damping=rule.after(rule.first, lowered=True))


def _shorten(linearised: LinearisedEnergy[P], damping: float, tolerance: float, rule: DampingRule) -> Descent[P]:
    """The first of ever shorter steps that lowers the energy, from one damping on."""
    standing: Descent[P] = Descent(None, linearised.energy, damping)
    while damping <= rule.most:
        step = _try(linearised, damping, tolerance)
        if step is None:
            return standing
        if step.point is not None:
            return replace(step, damping=rule.after(damping, lowered=True))
        damping = rule.after(damping, lowered=False)
    return standing


def _try(linearised: LinearisedEnergy[P], damping: float, tolerance: float) -> Descent[P] | None:
    """A damped step, without a point where it gained nothing; None where it is to gain less than ``tolerance``."""
    refused: Descent[P] = Descent(None, linearised.energy, damping)
    try:
        model = linearised.model(damping)
    except np.linalg.LinAlgError:
        return refused
    move = damped_box_step(model.hessian, model.gradient, linearised.theta, damping)
    if model.gain(move) < tolerance:
        return None
    point, energy = linearised.simulated(np.clip(linearised.theta + move, 0.0, 1.0), model.rest(move))
    return Descent(point, energy, damping) if energy < linearised.energy else refused
