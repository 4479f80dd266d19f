"""How noisy samples are: by the states that they measure, which may be few; not at all where they repeat them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import sipe_bayes as sipe
from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.datasets.trajectory_sets import TASKS
from sipe_bayes.likelihood import Segments, noise_level
from tests.problems.pendulums import DT, coloured, pendulum

STEPS = 400
SIMULATOR = pendulum()


def clean() -> Trajectories:
    """A swing with its states."""
    actions = 0.8 * np.sin(2 * np.pi * 0.8 * DT * np.arange(STEPS))[None, :, None]
    return SIMULATOR.rollout(np.full((1, 2), 0.5), actions, SIMULATOR.default_state()[None], dt=DT)


def noisy(share: float, rho: float = 0.0) -> tuple[Trajectories, float]:
    """The same with noise of a share of its spread, and the noise's sd."""
    logs = clean()
    sd = share * float(logs.observations.std())
    noise = coloured(np.random.default_rng(2), STEPS + 1, sd, rho)[None, :, None]
    return replace(logs, observations=logs.observations + noise), sd


def first_alone(logs: Trajectories) -> Trajectories:
    states = np.full_like(np.asarray(logs.states), np.nan)
    states[:, 0] = np.asarray(logs.states)[:, 0]
    return replace(logs, states=states)


def level(logs: Trajectories) -> FloatArray:
    return noise_level(logs, Segments(), SIMULATOR)


def recorded(task: str) -> tuple[sipe.Simulator, Trajectories]:
    """A clean log of a benchmark's task."""
    simulator = sipe.Simulator(sipe.make_task(task), num_threads=1)
    theta, start = np.full((1, len(simulator.space)), 0.4), simulator.default_state()[None]
    actions = np.random.default_rng(0).uniform(-0.3, 0.3, (1, 60, simulator.environment.num_actions))
    goals = np.full((1, simulator.environment.goal_size), 0.5) if simulator.environment.goal_size else None
    return simulator, simulator.rollout(theta, actions, start, goals=goals)


@pytest.mark.parametrize("task", TASKS)
def test_a_clean_log_with_its_states_has_none(task: str) -> None:
    simulator, logs = recorded(task)
    assert not noise_level(logs, Segments(), simulator).any()


@pytest.mark.parametrize("every", [1, 5])
@pytest.mark.parametrize("task", ["FetchPush", "HalfCheetahLinks"])
def test_a_task_s_noise_shows_beside_its_states(task: str, every: int) -> None:
    """Every channel's, to a factor of three; the goal of the log is read off its first sample, with its noise."""
    simulator, logs = recorded(task)
    sd = 0.01 * logs.observations.std((0, 1)) + 1e-4
    states = np.asarray(logs.states).copy()
    states[:, np.arange(states.shape[1]) % every != 0] = np.nan
    noisy = logs.observations + sd * np.random.default_rng(5).standard_normal(logs.observations.shape)
    level = noise_level(replace(logs, observations=noisy, states=states), Segments(), simulator)
    assert (level / sd > 1 / 3).all()
    assert (level / sd < 3).all()


def test_one_sample_like_its_state_is_a_coincidence() -> None:
    logs, sd = noisy(0.1)
    logs.observations[0, 0, 0] = np.asarray(logs.states)[0, 0, 1]
    np.testing.assert_allclose(level(first_alone(logs)), [sd], rtol=0.2)


def test_an_unknown_sensor_s_bias_is_no_noise() -> None:
    simulator = pendulum(sipe.Parameter("bias", -0.5, 0.5, targets=("sensor:joint:hinge.position.bias",)))
    logs, sd = noisy(0.1)
    biased = replace(logs, observations=logs.observations + 0.3)
    for states in (logs.states, first_alone(logs).states, None):
        np.testing.assert_allclose(noise_level(replace(biased, states=states), Segments(), simulator), [sd], rtol=0.2)


def test_states_of_another_model_are_left_aside() -> None:
    logs, sd = noisy(0.1)
    other = replace(logs, states=np.asarray(logs.states)[..., :1])
    np.testing.assert_allclose(level(other), [sd], rtol=0.2)


def test_two_samples_show_what_their_states_tell() -> None:
    logs, _ = noisy(0.1)
    two = Trajectories.stack(next(iter(logs)).slice(0, 1))
    off = two.observations[0, :, 0] - np.asarray(two.states)[0, :, 1]
    np.testing.assert_allclose(level(two), [np.sqrt((off**2).mean())])
    assert level(replace(two, states=None)) == 0


def test_slow_noise_shows_where_the_first_state_alone_is_recorded() -> None:
    """Five logs of a correlation of .99 are smooth: their first samples tell, five of them to a third."""
    simulator, logs = SIMULATOR, [clean().observations[0] for _ in range(5)]
    rng, (states,) = np.random.default_rng(6), np.asarray(first_alone(clean()).states)
    many = Trajectories.stack(
        [
            sipe.Trajectory(x + coloured(rng, STEPS + 1, 0.3, 0.99)[:, None], np.zeros((STEPS, 1)), DT, states)
            for x in logs
        ]
    )
    rough = noise_level(replace(many, states=None), Segments(), simulator)[0]
    assert rough < 0.1
    assert 0.1 < noise_level(many, Segments(), simulator)[0] < 0.6


@pytest.mark.parametrize("share", [0.001, 0.01, 0.1])
@pytest.mark.parametrize(("rho", "sds"), [(0.0, 0.06), (0.9, 0.18)])  # of the sd of 401 samples
def test_noise_beside_recorded_states_has_its_size(share: float, rho: float, sds: float) -> None:
    logs, sd = noisy(share, rho)
    np.testing.assert_allclose(level(logs), [sd], rtol=3 * sds)


@pytest.mark.parametrize("dt", [0.001, 0.002, 0.01, 0.02])
def test_roughness_is_the_noise_at_any_rate(dt: float) -> None:
    clock = dt * np.arange(2001)
    swing = np.sin(2.0 * clock) + 0.3 * np.random.default_rng(4).standard_normal(len(clock))
    logs = Trajectories.stack(sipe.Trajectory(swing[:, None], np.zeros((2000, 1)), dt))
    np.testing.assert_allclose(level(logs), [0.3], rtol=0.09)  # three sds


@pytest.mark.parametrize("share", [0.01, 0.1])
def test_noise_shows_where_the_first_state_alone_is_recorded(share: float) -> None:
    logs, sd = noisy(share)
    np.testing.assert_allclose(level(first_alone(logs)), [sd], rtol=0.2)
    np.testing.assert_array_equal(level(first_alone(logs)), level(replace(logs, states=None)))


def test_a_stated_sd_is_believed() -> None:
    assert noise_level(noisy(0.1)[0], Segments(noise_sd=(0.25,)), SIMULATOR).tolist() == [0.25]
