"""DDPG, policies and training: against autograd, files that were tampered with, runs that were interrupted."""

from __future__ import annotations

import json
import shutil
from dataclasses import astuple, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import nn

import sipe_bayes as sipe
from sipe_bayes.models.policy import PolicyError, load_policy
from sipe_bayes.posterior import prior
from sipe_bayes.rl.ddpg import Agent
from sipe_bayes.rl.normaliser import Normaliser
from sipe_bayes.rl.randomization import Randomization
from sipe_bayes.rl.replay import Batch
from sipe_bayes.rl.settings import Settings
from sipe_bayes.rl.train import CHECKPOINT, read_curve, train
from sipe_bayes.rl.trainer import Trainer
from tests.problems.checkpoints import contents
from tests.problems.policies import SMALL, policy

SEEN, DONE, BATCH = 5, 2, 32


def batch(seed: int) -> Batch:
    rng = np.random.default_rng(seed)
    draws = (
        rng.standard_normal(shape).astype(np.float32)
        for shape in ((BATCH, SEEN), (BATCH, DONE), BATCH, BATCH, (BATCH, SEEN))
    )
    observations, actions, returns, discounts, following = map(torch.from_numpy, draws)
    return Batch(observations, actions, returns, discounts.abs() / 3, following)


def plain(sizes: tuple[int, ...], layer_norm: bool) -> nn.Sequential:
    layers: list[nn.Module] = []
    for before, after in pairwise(sizes):
        layers += [nn.Linear(before, after), *([nn.LayerNorm(after)] if layer_norm else []), nn.ReLU()]
    return nn.Sequential(*layers[: -3 if layer_norm else -2], nn.Linear(sizes[-2], sizes[-1]))


class PlainDdpg:
    """The algorithm by autograd, module by module."""

    def __init__(self, agent: Agent) -> None:
        self.agent, self.settings = agent, agent.settings
        self.networks = []
        for network in (agent.actor, agent.critic, agent.target_actor, agent.target_critic):
            module = plain(network.sizes, network.layer_norm)
            nn.utils.vector_to_parameters(network.parameters.clone(), module.parameters())
            self.networks.append(module)
        self.optimisers = [torch.optim.Adam(n.parameters(), self.settings.learning_rate) for n in self.networks[:2]]

    def squash(self, outputs: torch.Tensor) -> torch.Tensor:
        low, high = self.agent.action_low, self.agent.action_high
        return outputs.tanh() * (high - low) / 2 + (high + low) / 2

    def update(self, given: Batch) -> None:
        actor, critic, target_actor, target_critic = self.networks
        s, a, r, d, after = (getattr(given, name) for name in Batch.__annotations__)
        with torch.no_grad():
            y = r + d * target_critic(torch.cat([after, self.squash(target_actor(after))], 1))[:, 0]
            if self.settings.clip_targets:
                y = y.clamp(-1 / (1 - self.settings.discount), 0)
        self.step(0, critic, ((critic(torch.cat([s, a], 1))[:, 0] - y) ** 2).mean())
        squashed = actor(s).tanh()
        value = critic(torch.cat([s, self.squash(actor(s))], 1))
        loss = self.settings.action_penalty * (squashed**2).mean() - value.mean()
        if self.settings.cloning:
            shown, half = self.settings.demonstrated, (self.agent.action_high - self.agent.action_low) / 2
            away = (self.squash(actor(s)) - a)[-shown:] / half
            loss = loss + self.settings.cloning * value.abs().mean().detach() * (away**2).sum(1).mean()
        self.step(1, actor, loss)
        with torch.no_grad():
            for network, target in ((actor, target_actor), (critic, target_critic)):
                for p, q in zip(network.parameters(), target.parameters(), strict=True):
                    q += self.settings.tau * (p - q)

    def step(self, which: int, network: nn.Module, loss: torch.Tensor) -> None:
        optimiser = self.optimisers[1 - which]
        for o in self.optimisers:
            o.zero_grad()
        loss.backward()
        optimiser.step()


@pytest.mark.parametrize(
    "settings",
    [
        Settings(hidden=(16, 8)),
        Settings(hidden=(16, 8), layer_norm=True),
        Settings(hidden=(16, 8), clip_targets=True, action_penalty=0.5, tau=0.05),
        Settings(hidden=(16, 8), batch=BATCH, demonstration_share=0.4, cloning=1.5),
    ],
    ids=["published", "layer norm", "hindsight's", "cloning"],
)
def test_updates_are_those_of_autograd(settings: Settings) -> None:
    agent = Agent(SEEN, DONE, -2.0, 3.0, settings, np.random.default_rng(0))
    reference = PlainDdpg(agent)
    before = agent.actor.parameters.clone()
    for seed in range(20):
        agent.update(batch(seed))
        reference.update(batch(seed))
    networks = (agent.actor, agent.critic, agent.target_actor, agent.target_critic)
    for network, module in zip(networks, reference.networks, strict=True):
        expected = nn.utils.parameters_to_vector(module.parameters()).detach()
        torch.testing.assert_close(network.parameters, expected, rtol=1e-4, atol=2e-5)
    assert (agent.actor.parameters - before).abs().max() > 1e-3


def test_actor_finds_the_best_action_of_a_known_reward() -> None:
    rng = np.random.default_rng(0)
    agent = Agent(SEEN, DONE, -2.0, 3.0, Settings(hidden=(32, 32), learning_rate=3e-3), rng)

    def best(observations: np.ndarray) -> np.ndarray:
        return np.stack([observations[:, 0], 0.5 - observations[:, 1] * observations[:, 2]], 1).clip(-1.5, 2.5)

    def error(observations: np.ndarray) -> float:
        return float(np.sqrt(((agent.act(observations) - best(observations)) ** 2).mean()))

    held_out = rng.uniform(-1, 1, (500, SEEN))
    before = error(held_out)
    for _ in range(1500):
        observations = rng.uniform(-1, 1, (128, SEEN)).astype(np.float32)
        actions = rng.uniform(-2, 3, (128, DONE)).astype(np.float32)
        returns = -((actions - best(observations)) ** 2).sum(1).astype(np.float32)
        seen, done, earned = map(torch.from_numpy, (observations, actions, returns))
        agent.update(Batch(seen, done, earned, torch.zeros(128), seen))
    assert error(held_out) < 0.25 < 0.5 < before, (error(held_out), before)


@pytest.mark.parametrize("normalised", [False, True])
def test_policy_acts_as_its_agent_and_survives_the_file(tmp_path: Path, normalised: bool) -> None:
    rng = np.random.default_rng(0)
    agent = Agent(SEEN, DONE, -2.0, 3.0, Settings(hidden=(16, 8), normalise=normalised), rng)
    observations = 5 * rng.standard_normal((200, SEEN)) + 2
    if agent.normaliser is not None:
        agent.normaliser.update(observations)
    for seed in range(5):
        agent.update(batch(seed))
    made = agent.policy("Pendulum", goal_size=1)
    np.testing.assert_allclose(made(observations), agent.act(observations), rtol=0, atol=1e-5)
    assert made(observations).min() >= -2
    assert made(observations).max() <= 3
    np.testing.assert_allclose(made(observations[0]), made(observations)[0], atol=1e-6)
    made.save(tmp_path / "agent.safetensors")
    read = load_policy(tmp_path / "agent.safetensors", "Pendulum")
    np.testing.assert_array_equal(read(observations), made(observations))
    assert (read.goal_size, read.task, read.observation_size, read.action_size) == (1, "Pendulum", SEEN, DONE)


def with_header(content: bytes, **changes: Any) -> bytes:
    """The file with another header of the policy."""
    size = int.from_bytes(content[:8], "little")
    outer = json.loads(content[8 : 8 + size])
    outer["__metadata__"]["policy"] = json.dumps({**json.loads(outer["__metadata__"]["policy"]), **changes})
    text = json.dumps(outer).encode()
    return len(text).to_bytes(8, "little") + text + content[8 + size :]


def test_policies_that_were_tampered_with_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "agent.safetensors"
    policy().save(path)
    whole = path.read_bytes()
    flipped = bytearray(whole)
    flipped[-3] ^= 1
    size = len(sipe.make_task("Pendulum").channels)
    cases = {
        "cannot be read as a whole safetensors file": whole[:-100],
        "as a whole": b"",
        "does not match its checksum": bytes(flipped),
        rf"weight\.0: expected shape \(9, {size}\) of float32, got \(8, {size}\)": with_header(
            whole, sizes=[size, 9, 8, 1]
        ),
        "expected the arrays .*weight.3": with_header(whole, sizes=[size, 8, 8, 8, 1]),
        "at least one layer": with_header(whole, sizes=[3]),
        "cannot be read as a policy's header .could not convert string to float": with_header(whole, clip="wide"),
        "expected a policy of format": with_header(whole, format="other/1"),
    }
    for words, content in cases.items():
        path.write_bytes(content)
        with pytest.raises(PolicyError, match=words) as raised:
            load_policy(path)
        assert "\n" not in str(raised.value)
        assert str(path) in str(raised.value)
    path.write_bytes(whole)
    with pytest.raises(PolicyError, match="expected a policy for Hopper, got one for Pendulum"):
        load_policy(path, "Hopper")
    with pytest.raises(FileNotFoundError, match="no such policy"):
        load_policy(tmp_path / "none.safetensors")
    with pytest.raises(ValueError, match=rf"observations: expected \(B, {size}\), got \(2, 40\)"):
        load_policy(path)(np.zeros((2, 40)))


def test_normaliser_has_the_moments_of_all_it_saw() -> None:
    rng = np.random.default_rng(0)
    parts = [3 * rng.standard_normal((n, SEEN)) - 7 for n in (1, 5, 40)]
    found, together = Normaliser(SEEN, 2.0), np.concatenate(parts)
    for part in parts:
        found.update(part)
    np.testing.assert_allclose(found.mean, together.mean(0), rtol=1e-5)
    np.testing.assert_allclose(found.scale, together.std(0), rtol=1e-5)
    other = Normaliser(SEEN, 2.0)
    other.restore(found.state())
    values = torch.from_numpy(together.astype(np.float32))
    np.testing.assert_array_equal(other.apply(values), found.apply(values))
    assert found.apply(100 * values).abs().max() == 2


VARIED = Settings(
    hidden=(8, 8),
    batch=16,
    start_steps=60,
    lanes=3,
    normalise=True,
    n_step=2,
    layer_norm=True,
    random_share=0.2,
    updates_per_step=0.7,
)


@pytest.mark.parametrize(
    ("task", "settings"),
    [("Pendulum", SMALL), ("Hopper", VARIED), ("FetchPush", VARIED)],
    ids=["published", "every option", "goals and hindsight"],
)
def test_a_resumed_run_is_the_uninterrupted_one(tmp_path: Path, task: str, settings: Settings) -> None:
    wider = [
        replace(p, high=p.low + 1.5 * (p.high - p.low)) for p in sipe.make_task(task).space
    ]  # some theta are drawn anew
    drawn = Randomization(prior(sipe.ParameterSpace(wider)), observation_noise=0.01, action_delay=2)
    run = {"evaluate_every": 90, "evaluation_episodes": 2, "checkpoint_every": 75, "randomization": drawn}
    whole = train(task, 270, 3, tmp_path / "whole", settings, **run)  # type: ignore[arg-type]
    short = tmp_path / "short"

    def interrupt(line: str, step: int, steps: int) -> None:
        if step >= 200:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(task, 270, 3, short, settings, report=interrupt, **run)  # type: ignore[arg-type]
    assert not (short / "expert.safetensors").exists()
    with pytest.raises(ValueError, match=r"add --resume to go on"):
        train(task, 270, 3, short, settings, **run)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="belongs to another run"):
        train(task, 270, 4, short, settings, resume=True, **run)  # type: ignore[arg-type]
    resumed = train(task, 270, 3, short, settings, resume=True, **run)  # type: ignore[arg-type]
    for a, b in zip(whole.layers, resumed.layers, strict=True):
        np.testing.assert_array_equal(a[0], b[0])
    curves = [[astuple(row)[:4] for row in read_curve(tmp_path / name)] for name in ("whole", "short")]
    assert curves[0] == curves[1]
    assert len(curves[0]) == 3
    states = [contents(tmp_path / name / CHECKPOINT) for name in ("whole", "short")]
    assert states[0].keys() == states[1].keys()
    for name, value in states[0].items():
        if name not in ("seconds", "curve"):  # the time it took
            np.testing.assert_array_equal(value, states[1][name], err_msg=name)
    assert states[0]["trainer"]["agent"]["updates"] > 100
    assert states[0]["trainer"]["redrawn"] > 0
    assert len(list((short / "checkpoint").glob("replay-*.npz"))) == 1


def test_a_finished_training_is_read_and_another_one_is_not(tmp_path: Path) -> None:
    """Without its checkpoint: the same run is there at once.

    Under another randomisation, and for more steps, it is trained.
    """
    space, folder = sipe.make_task("Pendulum").space, tmp_path / "run"
    run = {"evaluate_every": 90, "evaluation_episodes": 2, "checkpoint_every": 75}

    def trained(theta: float, steps: int) -> list[float]:
        train(
            "Pendulum",
            steps,
            0,
            folder,
            SMALL,
            resume=True,
            randomization=Randomization(sipe.Dirac([theta] * 3, space)),
            **run,
        )  # type: ignore[arg-type]
        return [path.stat().st_mtime_ns for path in sorted((folder / "policies").iterdir())]

    first = trained(0.5, 270)
    shutil.rmtree(folder / "checkpoint")
    assert trained(0.5, 270) == first
    assert not (folder / "checkpoint").exists()
    assert trained(0.6, 270) != first
    shutil.rmtree(folder / "checkpoint")
    assert trained(0.6, 360)[-1] > first[-1]


def test_every_episode_gets_a_theta_of_its_own() -> None:
    task = sipe.make_task("FetchPush")
    trainer = Trainer(task, Settings(hidden=(8,), start_steps=10**6, lanes=2), 0, Randomization(prior(task.space)))
    used = []
    for _ in range(152):  # three episodes of 50 steps, the two later ones with a step that only begins them
        trainer.advance()
        used.append(trainer.episodes.theta.copy())
    assert trainer.steps == 2 * 150
    drawn = [used[0], used[50], used[101]]
    np.testing.assert_array_equal(used, np.repeat(drawn, [50, 51, 51], axis=0))
    assert len(np.unique(np.concatenate(drawn), axis=0)) == 6


def test_a_training_may_end_episodes_of_the_fallen() -> None:
    task = sipe.make_task("HumanoidLinks")
    begun = []
    for ends in (False, True):
        trainer = Trainer(task, Settings(hidden=(8,), lanes=2, start_steps=400, end_hopeless=ends), 0)
        for _ in range(100):  # random actions fell it within some twenty steps
            trainer.advance()
        begun.append(int((~trainer.replay.transition[:100]).sum()))
        upright = ~task.hopeless(trainer.episodes.states)
        assert upright.any() == ends
    with pytest.raises(ValueError, match="end_hopeless: expected a task that knows"):
        Trainer(sipe.make_task("Door"), Settings(end_hopeless=True))
    assert begun[0] == 0
    assert 4 <= begun[1] <= 20
    assert not task.hopeless(task.initial_states(np.random.default_rng(0), 3)[0]).any()


def test_demonstrations_fill_their_share_of_a_batch() -> None:
    task = sipe.make_task("FetchPush")
    shown = sipe.demonstrations("FetchPush", count=3)
    settings = Settings(hidden=(8,), batch=40, start_steps=50, demonstration_share=0.25)
    trainer = Trainer(task, settings, 0, demonstrations=shown)
    for _ in range(60):
        trainer.advance()
    assert trainer.agent.updates == 10  # 59 steps and the one that began the second episode
    known = {row.tobytes() for row in np.float32(shown.observations[:, :, :25]).reshape(-1, 25)}
    drawn = trainer._batch()
    assert sum(row[:25].tobytes() in known for row in drawn.observations.numpy()) == 10
    with pytest.raises(ValueError, match="give both or neither"):
        Trainer(task, settings)


def test_settings_out_of_range_are_refused() -> None:
    cases = {
        "discount: expected a share at least 0 and at most 1, got 1.5": {"discount": 1.5},
        "batch: expected at least 1, got 0": {"batch": 0},
        "tau: expected a share at least 0 and at most 1, got nan": {"tau": float("nan")},
        "hidden: expected the sizes": {"hidden": ()},
        "clip_targets: expected a discount below 1": {"clip_targets": True, "discount": 1.0},
    }
    for words, settings in cases.items():
        with pytest.raises(ValueError, match=words):
            Settings(**settings)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="capacity: expected room for more than an episode of 200"):
        Trainer(sipe.make_task("Pendulum"), Settings(capacity=100))
    with pytest.raises(ValueError, match="device: 'tpu' is not available here; use 'cpu'"):
        Trainer(sipe.make_task("Pendulum"), Settings(), device="tpu")
    assert Settings(lanes=4).deviations() == {"lanes": 4}
