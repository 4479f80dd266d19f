"""A linear mass on a spring with process noise, and its Kalman filter."""

from __future__ import annotations

import numpy as np

import sipe_bayes as sipe
from sipe_bayes.core.parameters import Parameter
from sipe_bayes.core.trajectory import Trajectories, Trajectory
from sipe_bayes.envs.base import START_SD
from sipe_bayes.likelihood import StateSpace, bind
from sipe_bayes.likelihood.state_space.chain import Chain
from sipe_bayes.likelihood.state_space.linearisation import ChainNoise
from sipe_bayes.simulation.simulator import Simulator

MASS, DAMPING, STEP, SKIP = 2.0, 0.7, 0.01, 2
LOW, HIGH = 5.0, 25.0
SD, PROCESS = 0.02, np.array([0.003, 0.05])
MADE_WITH = ChainNoise(np.array([SD]), PROCESS)


def spring(num_threads: int = 1) -> Simulator:
    """A point mass on a slide joint with known damping and unknown stiffness, position measured, pushed by a motor."""
    xml = (
        f'<mujoco><option timestep="{STEP}" gravity="0 0 0" integrator="Euler"/><worldbody><body>'
        f'<joint name="x" type="slide" axis="1 0 0" damping="{DAMPING}" stiffness="10"/>'
        f'<geom size="0.1" mass="{MASS}" contype="0" conaffinity="0"/></body></worldbody>'
        '<actuator><motor name="m" joint="x"/></actuator></mujoco>'
    )
    parameters = [Parameter("stiffness", LOW, HIGH, targets=("joint:x.stiffness",))]
    return Simulator(sipe.MjcfEnvironment.build(xml, parameters, ["m"], ["joint:x.position"]), num_threads=num_threads)


def spring_step(stiffness: float) -> tuple[np.ndarray, np.ndarray]:
    """Transition (2, 2) and control (2,) of a control step: Euler with implicit damping, SKIP times."""
    share = STEP / (MASS + STEP * DAMPING)
    velocity = np.array([-share * stiffness, 1 - share * DAMPING])
    one = np.stack([np.array([1.0, 0.0]) + STEP * velocity, velocity])
    push = share * np.array([STEP, 1.0])
    return np.linalg.matrix_power(one, SKIP), sum(
        (np.linalg.matrix_power(one, k) @ push for k in range(SKIP)), np.zeros(2)
    )


def spring_logs(
    seed: int = 0, count: int = 2, steps: int = 60, process: np.ndarray = PROCESS, kick: float = 0.0
) -> list[Trajectory]:
    """Logs of a stiffness of 12 N/m with process noise, of different lengths, one sample missing; kick.

    M/s, at the 21st control step.
    """
    rng = np.random.default_rng(seed)
    transition, push = spring_step(12.0)
    logs = []
    for k in range(count):
        length = steps - 7 * k
        actions = 4 * np.sin(np.arange(length)[:, None] * 0.11 * (k + 1))
        x, seen = np.array([0.3, 0.0]), []
        for action in [*actions[:, 0], 0.0]:
            seen.append(x[0] + SD * rng.standard_normal())
            x = transition @ x + push * action + process * rng.standard_normal(2)
            x = x + np.array([0.0, kick]) * (len(seen) == 21)
        seen[5] = np.nan
        logs.append(Trajectory(np.array(seen)[:, None], actions, STEP * SKIP, name=f"log{k}"))
    return logs


def kalman(
    logs: list[Trajectory],
    firsts: np.ndarray,
    stiffness: float,
    noise: ChainNoise = MADE_WITH,
    start_sd: tuple[float, ...] = START_SD,
) -> float:
    """``log p(logs | stiffness)`` by a plain Kalman filter; firsts (R, 2), start_sd: of the first states."""
    transition, push = spring_step(stiffness)
    total = 0.0
    for log, first in zip(logs, firsts, strict=True):
        mean, covariance = first, np.diag(np.square(start_sd[:2]))
        for k, seen in enumerate(log.observations[:, 0]):
            if np.isfinite(seen):
                variance = covariance[0, 0] + noise.sd[0] ** 2
                total -= 0.5 * (np.log(2 * np.pi * variance) + (seen - mean[0]) ** 2 / variance)
                gain = covariance[:, 0] / variance
                mean, covariance = mean + gain * (seen - mean[0]), covariance - np.outer(gain, covariance[0])
            if k < len(log):
                mean = transition @ mean + push * log.actions[k, 0]
                covariance = transition @ covariance @ transition.T + np.diag(noise.process**2)
    return total


def kicked_logs(kick: float = 1.0) -> list[Trajectory]:
    """Little process noise, but for a kick in each of two logs."""
    return spring_logs(steps=120, process=PROCESS / 20, kick=kick)


def spring_chain() -> tuple[Chain, list[Trajectory], np.ndarray]:
    """The chain of the logs, these, and the means of their first states."""
    logs = spring_logs()
    chain = bind(StateSpace(noise_sd=(SD,)), spring(), Trajectories.stack(logs))
    return chain, logs, chain.reference[chain.first][:, 1:3]
