"""Our DDPG update and Stable-Baselines3's from the same weights on the same batches: the same numbers."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from stable_baselines3 import DDPG
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from torch.nn.utils import parameters_to_vector

import sipe_bayes as sipe
from sipe_bayes.rl.ddpg import Agent
from sipe_bayes.rl.replay import Batch
from sipe_bayes.rl.settings import Settings

HIDDEN, BATCH = (32, 24), 64


def rival(settings: Settings) -> Any:
    """Stable-Baselines3's agent with ``settings``, on the half-cheetah."""
    model = DDPG(
        "MlpPolicy",
        sipe.make("HalfCheetahLinks"),
        policy_kwargs={"net_arch": list(settings.hidden)},
        learning_rate=settings.learning_rate,
        batch_size=settings.batch,
        tau=settings.tau,
        gamma=settings.discount,
        buffer_size=1000,
        device="cpu",
        seed=0,
    )
    model.set_logger(Logger(folder=None, output_formats=[]))
    return model


def test_updates_are_stable_baselines_3s() -> None:
    settings = Settings(hidden=HIDDEN, batch=BATCH)
    model, rng = rival(settings), np.random.default_rng(0)
    task = model.get_env().envs[0].unwrapped.task
    seen, done = len(task.channels), task.num_actions
    agent = Agent(seen, done, task.action_low, task.action_high, settings, rng)
    pairs = (
        (agent.actor, model.actor),
        (agent.critic, model.critic),
        (agent.target_actor, model.actor_target),
        (agent.target_critic, model.critic_target),
    )
    for network, module in pairs:
        network.parameters.copy_(parameters_to_vector(module.parameters()).detach())
    given: list[ReplayBufferSamples] = []
    model.replay_buffer.sample = lambda *_, **__: given.pop()
    before = agent.actor.parameters.clone()
    for _ in range(30):
        observations, following = (rng.standard_normal((BATCH, seen)).astype(np.float32) for _ in range(2))
        actions = rng.uniform(-1, 1, (BATCH, done)).astype(np.float32)
        rewards, over = rng.standard_normal(BATCH).astype(np.float32), rng.random(BATCH) < 0.2
        discounts = np.float32(settings.discount) * ~over
        agent.update(Batch(*map(torch.from_numpy, (observations, actions, rewards, discounts, following))))
        arrays = (observations, actions, following, np.float32(over)[:, None], rewards[:, None])
        given.append(ReplayBufferSamples(*(torch.from_numpy(a) for a in arrays)))
        model.train(1, BATCH)
    assert not given
    for network, module in pairs:
        expected = parameters_to_vector(module.parameters()).detach()
        torch.testing.assert_close(network.parameters, expected, rtol=1e-4, atol=2e-6)
    assert (agent.actor.parameters - before).abs().max() > 1e-3


def test_actions_are_stable_baselines_3s() -> None:
    settings = Settings(hidden=HIDDEN)
    model, rng = rival(settings), np.random.default_rng(0)
    agent = Agent(17, 6, -1.0, 1.0, settings, rng)
    agent.actor.parameters.copy_(parameters_to_vector(model.actor.parameters()).detach())
    observations = 3 * rng.standard_normal((50, 17))
    np.testing.assert_allclose(agent.act(observations), model.predict(observations, deterministic=True)[0], atol=1e-6)
