"""What a planned experiment would tell of the parameters, before it is done.

At theta the simulation of the planned commands is linearised as ``laplace`` would linearise the log, windows' starts
unknown and marginalised, noise as given; what is left is the Fisher information I(theta) = J' V^-1 J of the parameters
alone. With the present knowledge, a normal of precision P, the experiment leaves the covariance (P + I)^-1: D. Lindley
1956, "On a measure of the information provided by an experiment" (https://doi.org/10.1214/aoms/1177728069); K.
Chaloner, I. Verdinelli 1995, "Bayesian experimental design: a review" (https://doi.org/10.1214/ss/1177009939), whose
A-criterion, averaged over draws of theta, this is, in sds.

A parameter of one log (a zero error) says nothing of the planned one, which has a value of its own: that is
marginalised, with a uniform prior, and the old ones learn nothing. What is determined is judged by the sd that is left,
beside a uniform prior's.

Deviations:

- The noise's own uncertainty is left out.
- The expectation is linear in theta at each draw, so that contacts that are made or missed between draws show only in
  their average.
- What is known is a normal: along a ridge, each draw's open direction differs a little from the normal's, so that some
  contraction of a ridge's members is promised that no experiment brings.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.findings import Code, Finding, finding
from sipe_bayes.core.parameters import ParameterSpace
from sipe_bayes.core.thresholds import THRESHOLDS
from sipe_bayes.core.trajectory import Trajectories, Trajectory
from sipe_bayes.diagnostics.identifiability import ridges
from sipe_bayes.diagnostics.records import Ridge
from sipe_bayes.likelihood import FLAT_PRECISION, UNIFORM_PRECISION, Noise, Segments, bind
from sipe_bayes.posterior import GaussianMixture, Posterior
from sipe_bayes.simulation.simulator import Simulator

_IDLE = 1e-6  # contraction of a uniform prior below which the experiment does not touch a parameter
_DRAWS = 4000  # of the normal that is left, among which ridges are looked for


@dataclass(frozen=True)
class Plan:
    """An experiment.

    Args:
        actions: (T, A).
        dt: s that each is held.
        start: (S,) the state before; default the model's own.
        name: of the plan.
    """

    actions: FloatArray
    dt: float
    start: FloatArray | None = None
    name: str = "planned"


@dataclass(frozen=True)
class Expectation:
    """What a plan is expected to leave.

    Args:
        names: of the N parameters.
        contraction: (N,) of each parameter's sd, from what it is now.
        remaining: (N,) of a uniform prior's sd, with what is known now.
        covariance: (N, N) in theta.
        ridges: combinations that it determines better than their members.
        idle: parameters that it never excites.
    """

    names: tuple[str, ...]
    contraction: FloatArray
    remaining: FloatArray
    covariance: FloatArray
    ridges: list[Ridge]
    idle: tuple[str, ...]

    def findings(self) -> list[Finding]:
        """What the plan would not determine; none where it determines all."""
        noticed = [finding(Code.NEVER_EXCITED, parameters=[name]) for name in self.idle]
        noticed += [ridge.finding(Code.RIDGE_EXPECTED) for ridge in self.ridges]
        named = {name for item in noticed for name in item.parameters}
        return noticed + [
            finding(Code.NOT_DETERMINED_EXPECTED, parameters=[name], contraction=c)
            for name, c in zip(self.names, self.remaining, strict=True)
            if c < THRESHOLDS.not_determined and name not in named
        ]

    def sentences(self) -> list[str]:
        """The same in words."""
        return [item.text for item in self.findings()]


def information(
    simulator: Simulator, likelihood: Segments, plan: Plan, noise: Noise, theta: FloatArray
) -> FloatArray | None:
    """Fisher information of a plan at one theta, its own nuisances marginalised.

    Args:
        simulator: of the model.
        likelihood: that the log would be fitted with.
        plan: the experiment.
        noise: (C,) of the fitted channels.
        theta: (N,).

    Returns:
        (N, N), or None where the simulation diverges.
    """
    start = simulator.default_state() if plan.start is None else plan.start
    motion = simulator.rollout(theta[None], plan.actions[None], start[None], plan.dt, [plan.name])
    if motion.states is None or not motion.valid.all():
        return None
    log = Trajectory(
        motion.observations[0], plan.actions, plan.dt, motion.states[0], plan.name, simulator.environment.channels
    )
    windows = bind(likelihood, simulator, Trajectories.stack(log))
    windows.start_precision = windows.weak_precision  # without noise it would seem to be measured exactly
    linearisation = windows.linearise(theta, windows.no_starts())
    if not linearisation.valid:
        return None
    normal = windows.moments(linearisation).normal(noise)
    return _of_shared(windows.eliminate(normal, windows.num_theta).precision, simulator.space)


def _of_shared(plain: FloatArray, space: ParameterSpace) -> FloatArray:
    """Information (N, N) with a new value in place of each nuisance of one log.

    The simulation takes the logs' mean for it.
    """
    own: dict[tuple[str, ...], list[int]] = {}
    for j, parameter in enumerate(space):
        if parameter.log is not None:
            own.setdefault(parameter.targets, []).append(j)
    if not own:
        return plain
    shared = [j for j, p in enumerate(space) if p.log is None]
    design = np.zeros((len(space), len(shared) + len(own)))
    design[shared, np.arange(len(shared))] = 1.0
    for k, members in enumerate(own.values()):
        design[members, len(shared) + k] = 1.0
    joint, count = design.T @ plain @ design, len(shared)
    cross, inner = joint[:count, count:], joint[count:, count:] + UNIFORM_PRECISION * np.eye(len(own))
    marginal = np.zeros_like(plain)
    marginal[np.ix_(shared, shared)] = joint[:count, :count] - cross @ np.linalg.solve(inner, cross.T)
    return marginal


def informations(
    simulator: Simulator, likelihood: Segments, plan: Plan, noise: Noise, thetas: FloatArray
) -> list[FloatArray]:
    """``information`` at each of thetas (M, N) where the simulation does not diverge."""
    every = (information(simulator, likelihood, plan, noise, theta) for theta in thetas)
    return [one for one in every if one is not None]


def knowledge(known: Posterior) -> FloatArray:
    """Precision (N, N) of the normal with a posterior's covariance."""
    covariance = known.covariance.numpy()
    return np.asarray(np.linalg.inv(covariance + 1e-12 * np.eye(len(covariance))))


def contraction(precision: FloatArray, gains: Sequence[FloatArray]) -> FloatArray:
    """Expected 1 - sd afterwards / sd now of each parameter.

    Args:
        precision: (N, N) of what is known now.
        gains: M of (N, N), informations of the plan, over which the sd is averaged.

    Returns:
        (N,).
    """
    return np.asarray(1 - _afterwards(precision, gains) / np.sqrt(np.diag(np.linalg.inv(precision))))


def _afterwards(precision: FloatArray, gains: Sequence[FloatArray]) -> FloatArray:
    """Expected sds (N,)."""
    return np.asarray(np.mean([np.sqrt(np.diag(np.linalg.inv(precision + one))) for one in gains], axis=0))


def expect(
    simulator: Simulator,
    likelihood: Segments,
    plan: Plan,
    noise: Noise,
    known: Posterior,
    *,
    draws: int = 8,
    seed: int = 0,
) -> Expectation:
    """What a plan is expected to tell beyond what is known.

    Args:
        simulator: of the model.
        likelihood: that the log would be fitted with.
        plan: the experiment.
        noise: (C,) of the fitted channels.
        known: the prior, or the posterior so far.
        draws: of ``known``, over which the expectation goes.
        seed: of the draws.

    Raises:
        ValueError: where all draws diverge.
    """
    thetas = known.sample((draws,), generator=torch.Generator().manual_seed(seed)).numpy()
    gains = informations(simulator, likelihood, plan, noise, thetas)
    if not gains:
        raise ValueError(
            f"plan: {plan.name!r} diverges at all {draws} draws; make its commands smaller, or narrow the bounds"
        )
    precision, middle = knowledge(known), np.median(thetas, axis=0)
    gain, remaining = contraction(precision, gains), 1 - _afterwards(precision, gains) * np.sqrt(UNIFORM_PRECISION)
    centre = information(simulator, likelihood, plan, noise, middle)
    centre = gains[0] if centre is None else centre
    covariance = np.asarray(np.linalg.inv(precision + centre), np.float64)
    open_covariance = np.linalg.inv(centre + FLAT_PRECISION * np.eye(len(middle)))
    normal = GaussianMixture([0.0], middle[None], open_covariance[None], known.space)
    values = normal.values(_DRAWS, generator=torch.Generator().manual_seed(seed))
    names, excited = known.space.names, np.mean([np.diag(one) for one in gains], axis=0) / (2 * UNIFORM_PRECISION)
    return Expectation(
        names,
        gain,
        remaining,
        covariance,
        ridges(known.space, values, remaining.tolist()),
        tuple(name for name, c in zip(names, excited, strict=True) if c < _IDLE),
    )
