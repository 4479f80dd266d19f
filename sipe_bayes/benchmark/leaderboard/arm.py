"""The arm of mujoco.sysid's tutorial: five hinges whose armatures are unknown, 2 s of sines as torques.

The model is the one that the installed mujoco.sysid tests itself with. As in the tutorial: armatures of .5, .4, .3, .2
and .1 kg m^2 sought in [.01, .6], positions at 500 Hz with noise of .6 rad, the first state known (at rest). The noise
is white, or first-order autoregressive with rho .99 and the same sd. The first log has the tutorial's truth, the others
have truths drawn from the prior, so that coverage means something.
"""

from __future__ import annotations

import re
from functools import partial
from importlib import import_module

import numpy as np

from sipe_bayes.benchmark.leaderboard.task import FROM_START, Case, Kind, Problem, Task, known_start
from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.parameters import Parameter
from sipe_bayes.core.trajectory import Trajectories, Trajectory
from sipe_bayes.envs.mjcf import MjcfEnvironment
from sipe_bayes.simulation.simulator import Simulator

JOINTS = tuple(f"joint{k}" for k in range(1, 6))
TRUTH = np.array([0.5, 0.4, 0.3, 0.2, 0.1])  # kg m^2
LOW, HIGH, START = 0.01, 0.6, 0.01
NOISE, RHO = 0.6, 0.99
_TORQUE = np.array([5.0, 4.0, 3.0, 2.0, 1.0])  # N m
_FREQUENCY = np.array([0.5, 0.7, 0.4, 0.9, 0.6])  # Hz
_PHASE = np.array([0.0, 0.5, 1.0, 1.5, 2.0])
_NOISES = {"arm_white": 0.0, "arm_ar1": RHO}
_LOGS, _SECONDS, _BUDGET = 5, 2, 1000


def tasks() -> list[Task]:
    """With white noise, and with noise that is correlated in time."""
    about = f"arm of mujoco.sysid's tutorial, {_LOGS} logs of {_SECONDS} s, noise of {NOISE} rad"
    return [
        Task(name, Kind.ARM, f"{about}, rho {rho:g}", _BUDGET, partial(_problem, rho)) for name, rho in _NOISES.items()
    ]


def xml() -> str:
    """The tutorial's model with armatures that do not give the truth away; raises ImportError without mujoco.sysid."""
    try:
        published: str = import_module("mujoco.sysid.tests.test_integration").ARM_XML
    except ImportError as error:
        raise ImportError(
            f"the arm's tasks take the model of mujoco.sysid, which cannot be imported ({error}); pip install "
            "'sipe-bayes[leaderboard]', or name other --tasks"
        ) from error
    return re.sub('armature="[^"]*"', f'armature="{START}"', published)


def arm() -> Simulator:
    """The arm, its armatures unknown."""
    parameters = [Parameter(f"{j}_armature", LOW, HIGH, targets=(f"joint:{j}.armature",)) for j in JOINTS]
    motors = [f"act{k}" for k in range(1, 6)]
    environment = MjcfEnvironment.build(xml(), parameters, motors, [f"joint:{j}.position" for j in JOINTS])
    return Simulator(environment, num_threads=1)


def torques(seconds: int, dt: float) -> FloatArray:
    """Commands (T, 5)."""
    clock = np.arange(round(seconds / dt)) * dt
    return np.asarray(_TORQUE * np.sin(2 * np.pi * _FREQUENCY * clock[:, None] + _PHASE))


def recorded(simulator: Simulator, truth: FloatArray, seconds: int, rho: float, seed: int) -> Trajectory:
    """A noisy log from rest, with its states.

    Args:
        simulator: the arm.
        truth: armatures (5,), kg m^2.
        seconds: that it takes.
        rho: correlation of the noise from sample to sample.
        seed: of the noise.
    """
    dt = float(simulator.model.opt.timestep)
    commands = torques(seconds, dt)
    motion = simulator.rollout((truth - LOW) / (HIGH - LOW), commands, simulator.default_state(), dt=dt)
    assert motion.states is not None
    rng = np.random.default_rng([seed, seconds, round(100 * rho)])
    white = rng.standard_normal(motion.observations[0].shape)
    noise = np.empty_like(white)
    noise[0] = white[0]
    for k in range(1, len(white)):
        noise[k] = rho * noise[k - 1] + np.sqrt(1 - rho**2) * white[k]
    channels = simulator.environment.channels
    seen = motion.observations[0] + NOISE * noise
    return Trajectory(seen, commands, dt, states=motion.states[0], name=f"log {seed}", channels=channels)


def _problem(rho: float) -> Problem:
    simulator, cases = arm(), []
    for seed in range(_LOGS):
        drawn = np.random.default_rng([4, seed]).uniform(LOW, HIGH, len(TRUTH))
        truth = TRUTH if seed == 0 else drawn
        log = known_start(Trajectories.stack(recorded(simulator, truth, _SECONDS, rho, seed)))
        cases.append(Case(f"log {seed}", log, simulator.space.normalise(truth)))
    return Problem(simulator, FROM_START, tuple(cases))
