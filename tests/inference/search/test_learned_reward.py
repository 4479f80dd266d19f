"""The learned reward: it prefers the truth where control steps tell, and does not where they say nothing."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
import torch

from sipe_bayes.core.checkpoint import load_state, save_state
from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.envs.mjcf import MjcfEnvironment
from sipe_bayes.inference.search.learned_reward import LearnedReward, RewardOptions
from sipe_bayes.likelihood import Segments, bind
from sipe_bayes.likelihood.windows import Windows
from sipe_bayes.models.discriminator import Discriminator, Training, TrainingState
from sipe_bayes.simulation.simulator import Simulator
from tests.problems.pendulums import XML, log, pendulum

TRUTH = np.array([[0.3, 0.6]])


def whole_state(seeds: Iterable[int] = (3,)) -> Windows:
    """Angle and velocity both recorded, from ``TRUTH``: single control steps tell mass and damping.

    seeds: of each log's actions.
    """
    plain = pendulum()
    channels = ["joint:hinge.position", "joint:hinge.velocity"]
    environment = MjcfEnvironment.build(XML, list(plain.space), ["motor"], channels)
    simulator = Simulator(environment, num_threads=1)
    values = simulator.space.values(TRUTH)[0].tolist()
    logs = [log(simulator, values, seed, str(seed), steps=400, sd=0.0) for seed in seeds]
    return bind(Segments(noise_sd=(0.0, 0.0)), simulator, Trajectories.stack(logs))


def windows(sd: float = 0.0, likelihood: Segments | None = None) -> Windows:
    simulator = pendulum()
    trajectory = log(simulator, simulator.space.values(TRUTH)[0].tolist(), 3, steps=400, sd=sd)
    return bind(likelihood or Segments(noise_sd=(sd,)), simulator, Trajectories.stack(trajectory))


def trained(reward: LearnedReward, features: np.ndarray, rounds: int) -> TrainingState:
    state = reward.start()
    for _ in range(rounds):
        state = reward.train(state, features)
    return state


def same(one: TrainingState, other: TrainingState) -> bool:
    return all(np.array_equal(getattr(one, f.name), getattr(other, f.name)) for f in fields(one))


def test_the_truth_is_rewarded_above_wrong_thetas() -> None:
    bound = whole_state()
    reward = LearnedReward(bound)
    rng = np.random.default_rng(0)
    pool = reward.features(bound.simulate(rng.uniform(size=(20, 2))))
    state = trained(reward, pool, 20)
    wrong = np.array([[0.9, 0.6], [0.3, 0.05], [0.8, 0.1], [0.05, 0.95]])
    rewards = reward(state, reward.features(bound.simulate(np.concatenate([TRUTH, wrong]))))
    print(rewards)
    assert (rewards[0] > rewards[1:]).all(), rewards


def test_a_feature_that_stays_still_in_the_recording_tells_nothing_and_stops_nothing() -> None:
    """As the object's velocities in a log in which the hand never touches it."""
    bound = whole_state()
    reward = LearnedReward(bound, RewardOptions(discriminator_updates=2))
    reward.recorded[:, 0] = 0.7
    made = reward.features(bound.simulate(np.random.default_rng(0).uniform(size=(3, 2))))
    state = reward.train(trained(reward, made, 1), made)
    rewards = reward(state, made)
    assert np.isfinite(rewards).all(), rewards
    made[..., 0] += 5.0
    np.testing.assert_array_equal(reward(state, made), rewards)


def test_starting_states_and_actions_need_not_match() -> None:
    """Six recordings.

    It is trained on, and rewards, simulations under other actions from other states, which reach about the same.
    """
    recorded, other = whole_state(range(3, 9)), whole_state(range(50, 56))
    assert not np.isclose(recorded.actions, other.actions).any((1, 2)).all()
    assert not np.isclose(recorded.measured[:, 0], other.measured[:, 0])[recorded.start > 0].any()
    reward = LearnedReward(recorded)
    pool = reward.features(other.simulate(np.random.default_rng(0).uniform(size=(20, 2))), other)
    wrong = np.array([[0.9, 0.6], [0.3, 0.05], [0.8, 0.1]])
    made = reward.features(other.simulate(np.concatenate([TRUTH, wrong])), other)
    rewards = reward(trained(reward, pool, 20), made)
    print(rewards)
    assert (rewards[0] > rewards[1:] + 0.2).all(), rewards


def test_noise_alone_rewards_nothing() -> None:
    """Recorded and simulated steps from one distribution.

    Rewards of different sets stay near log 1/2 and near each other.
    """
    bound = windows()
    reward = LearnedReward(bound, RewardOptions(discriminator_updates=20))
    rng = np.random.default_rng(1)
    shape = (6, 200, reward.recorded.shape[1])
    reward.recorded = torch.from_numpy(rng.standard_normal((20_000, shape[2])).astype(np.float32))
    state = trained(reward, rng.standard_normal(shape).astype(np.float32).repeat(5, 0), 2)
    fresh = reward(state, rng.standard_normal(shape).astype(np.float32))
    print(fresh)
    assert np.abs(fresh - np.log(0.5)).max() < 0.15, fresh
    assert np.ptp(fresh) < 0.1, fresh


def test_noise_of_the_recording_does_not_give_simulations_away() -> None:
    """With noise of a stated sd on the log, simulations at the truth get it too.

    The discriminator's loss stays near log 2; without, it falls.
    """
    sd = 0.05
    losses = []
    for stated in (sd, 1e-9):
        bound = windows(sd, Segments(noise_sd=(sd,)))
        reward = LearnedReward(bound)
        reward.noise = np.array([stated])
        features = reward.features(bound.simulate(TRUTH))
        losses.append(float(reward(trained(reward, features, 10), features)[0]))
    print(losses)
    assert losses[0] > losses[1] + 0.2, losses


def test_diverged_simulations_are_rewarded_least() -> None:
    bound = windows()
    reward = LearnedReward(bound)
    predicted = bound.simulate(np.concatenate([TRUTH, TRUTH]))
    predicted[1, -1, 3:] = np.nan
    features = reward.features(predicted)
    assert np.isnan(features[1]).all()
    rewards = reward(trained(reward, features, 1), features)
    assert np.isfinite(rewards[0])
    assert rewards[1] == -np.inf
    assert reward.features(None).shape == (0, *features.shape[1:])
    before = reward.start()
    after = reward.train(before, features[1:])
    assert same(before, after)


def test_training_goes_on_exactly_from_disk(tmp_path: Path) -> None:
    bound = windows()
    reward = LearnedReward(bound, RewardOptions(discriminator_updates=5))
    features = reward.features(bound.simulate(np.random.default_rng(0).uniform(size=(4, 2))))
    once = reward.train(reward.start(), features)
    save_state(tmp_path / "s", once, "x")
    two = reward.train(once, features)
    again = LearnedReward(bound, RewardOptions(discriminator_updates=5)).train(
        load_state(tmp_path / "s", TrainingState, "x"), features
    )
    assert same(two, again)
    assert not np.array_equal(once.weights, two.weights)


def test_the_discriminator_learns_a_density_ratio() -> None:
    """Recorded N(1, 1), simulated N(-1, 1): the logit is 2 x, to 0.5 within an sd and a half of either."""
    rng = np.random.default_rng(0)
    network = Discriminator(1)
    network.standardise.fit(torch.from_numpy(rng.normal(1, 1, (10_000, 1)).astype(np.float32)))
    training = Training(network, 0.003)
    for _ in range(1500):
        real, fake = (torch.from_numpy(rng.normal(m, 1, (160, 1)).astype(np.float32)) for m in (1, -1))
        training.step(real, fake)
    x = torch.linspace(-1.5, 1.5, 7)[:, None]
    with torch.no_grad():
        found = network(x).numpy()
    np.testing.assert_allclose(found, 2 * x[:, 0].numpy(), atol=0.5)


def test_a_log_without_whole_steps_says_so() -> None:
    simulator = pendulum()
    trajectory = log(simulator, [0.6, 0.1], 3, steps=100)
    trajectory.observations[1::2] = np.nan
    bound = bind(Segments(), simulator, Trajectories.stack(trajectory))
    with pytest.raises(ValueError, match="state_difference"):
        LearnedReward(bound)
