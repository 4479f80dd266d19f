"""Machines of which a parameter below some value changes nothing, as a friction below that of the floor."""

from __future__ import annotations

from typing import ClassVar

import mujoco
import numpy as np

import sipe_bayes as sipe
from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.parameters import Parameter
from sipe_bayes.core.trajectory import Trajectory
from sipe_bayes.simulation.simulator import Simulator
from tests.problems.pendulums import DT, XML, log

FLOOR = 0.1  # of the damping, in the middle of its range


class FlooredEnvironment(sipe.MjcfEnvironment):
    """Whose last parameter is taken for ``FLOOR`` where it is less."""

    floor: ClassVar[float] = FLOOR

    def write(self, model: mujoco.MjModel, values: FloatArray, log: str | None = None) -> bool:
        """See the base class."""
        return super().write(model, np.append(values[:-1], max(values[-1], self.floor)), log)


def floored_pendulum() -> Simulator:
    """Rod mass, and damping of which the lower half of the range does nothing."""
    parameters = [
        Parameter("rod_mass", 0.3, 1.0, targets=("body:rod.mass",)),
        Parameter("damping", 0.0, 0.2, targets=("joint:hinge.damping",)),
    ]
    return Simulator(FlooredEnvironment.build(XML, parameters, ["motor"], ["joint:hinge.position"]), num_threads=1)


def floored_log(theta: FloatArray, seed: int, steps: int, sd: float) -> Trajectory:
    """Of the pendulum from a known start, with its states."""
    simulator = floored_pendulum()
    values = [p.value(t) for p, t in zip(simulator.space, theta, strict=True)]
    made = log(simulator, values, seed, steps=steps, sd=sd)
    motion = simulator.rollout(theta, made.actions, simulator.default_state(), dt=DT)
    assert motion.states is not None
    noise = sd * np.random.default_rng([seed, 1]).standard_normal(motion.observations[0].shape)
    return Trajectory(motion.observations[0] + noise, made.actions, DT, states=motion.states[0])


def damping_quantiles(given: Trajectory, levels: list[float]) -> FloatArray:
    """Of the posterior on a grid of 0.01, whose masses of the rod from .2 to .6 hold all that can be told from none."""
    grid = (np.arange(100) + 0.5) / 100
    mass = grid_posterior(given, (grid[20:60], grid))
    assert mass[[0, -1]].sum() < 1e-6
    mass = mass.sum(0)
    return np.interp(levels, np.cumsum(mass) - 0.5 * mass, grid)


def grid_posterior(given: Trajectory, axes: tuple[FloatArray, FloatArray]) -> FloatArray:
    """Masses (A, B) of known starts on a grid, noise of unknown sd integrated out under a flat prior on its log.

    Of all dampings below the floor one is simulated.
    """
    simulator = floored_pendulum()
    floor = FLOOR / simulator.space[-1].high
    points, place = np.unique(
        np.stack(np.meshgrid(axes[0], np.maximum(axes[1], floor), indexing="ij"), -1).reshape(-1, 2),
        axis=0,
        return_inverse=True,
    )
    count = len(points)
    assert given.states is not None
    seen = simulator.rollout(
        points, np.tile(given.actions, (count, 1, 1)), np.tile(given.states[0], (count, 1)), dt=np.full(count, DT)
    ).observations
    squares = ((given.observations - seen) ** 2).sum((1, 2))[place.ravel()]
    mass = (squares / squares.min()) ** (-0.5 * len(given))
    return np.asarray((mass / mass.sum()).reshape(len(axes[0]), -1))
