"""A ram that strikes a sprung block, its logs, and which of their windows a model follows."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sipe_bayes.calibration.checks.fitted import Fit
from sipe_bayes.core.parameters import Parameter
from sipe_bayes.core.trajectory import Trajectories, Trajectory
from sipe_bayes.diagnostics.evaluate import best_starts
from sipe_bayes.envs.mjcf import MjcfEnvironment
from sipe_bayes.inference.laplace.options import FollowedTuning
from sipe_bayes.inference.laplace.windows.followed import (
    FOLLOWED,
    FollowedLook,
    followed_windows,
)
from sipe_bayes.inference.laplace.windows.growing_windows import Doubt
from sipe_bayes.likelihood.noise import Noise
from sipe_bayes.likelihood.quadratic_prior import QuadraticPrior
from sipe_bayes.likelihood.settings import Segments
from sipe_bayes.likelihood.windows import Windows
from sipe_bayes.posterior import prior
from sipe_bayes.simulation.simulator import Simulator

BUFFERS = """<mujoco><option timestep=".005"/><worldbody>
<body name="ram"><joint name="ram" type="slide" axis="1 0 0" damping="2" frictionloss="{friction}"/>
<geom type="box" size=".05 .05 .05" mass=".8"/></body>
<body name="block" pos=".14 0 0"><joint name="block" type="slide" axis="1 0 0" damping="1" stiffness="30"/>
<geom type="box" size=".05 .05 .05" mass=".5"/></body></worldbody>
<actuator><motor name="push" joint="ram" gear="4"/></actuator></mujoco>"""
TRUTH, NOISE, DT = np.array([0.4, 0.6]), np.array([3e-4, 3e-4]), 0.01
CHANNELS = ("joint:ram.position", "joint:block.position")


def machine(friction: float = 0.0) -> Simulator:
    """A ram that strikes a sprung block."""
    unknown = [
        Parameter("ram_damping", 0.5, 4.0, targets=("joint:ram.damping",)),
        Parameter("block_mass", 0.2, 1.0, targets=("body:block.mass",)),
    ]
    return Simulator(
        MjcfEnvironment.build(BUFFERS.format(friction=friction), unknown, ["push"], CHANNELS), num_threads=1
    )


def recorded(friction: float = 0.0, seed: int = 0, count: int = 4) -> Trajectories:
    """Logs of 1.2 s."""
    engine, random, logs = machine(friction), np.random.default_rng(seed), []
    for k in range(count):
        tones = np.sin(2 * np.pi * random.uniform(0.5, 2.0, 3) * DT * np.arange(120)[:, None] + random.uniform(0, 6, 3))
        command = tones.mean(1, keepdims=True)
        clean = engine.rollout(TRUTH[None], command[None], engine.default_state()[None], DT).observations[0]
        noisy = clean + NOISE * random.standard_normal(clean.shape)
        logs.append(Trajectory(noisy, command, DT, name=f"log {k}", channels=CHANNELS))
    return Trajectories.stack(logs)


def everything(logs: Trajectories, theta: np.ndarray = TRUTH) -> Fit:
    """All windows of logs, from their best starts."""
    white, windows = Noise(NOISE, np.zeros(2)), Windows(Segments(0.2, "white"), machine(), logs)
    return Fit(windows, theta, white, best_starts(windows, theta, white), False)


def look_at(fit: Fit, tuning: FollowedTuning = FOLLOWED) -> FollowedLook | Doubt:
    """What is followed of it."""
    believed = QuadraticPrior.of(prior(fit.windows.simulator.space))
    return followed_windows(fit.windows, fit.theta, fit.starts, fit.noise, believed, tuning)


def changed(logs: Trajectories, samples: list[tuple[int, slice, float]]) -> Trajectories:
    """Logs of which some samples of the block are so many metres off."""
    observations = logs.observations.copy()
    for log, where, by in samples:
        observations[log, where, 1] += by
    return replace(logs, observations=observations)
