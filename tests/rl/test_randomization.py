"""What an episode draws: from any posterior, by name and value; noise and delay; files; posteriors made wider."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from typer.testing import CliRunner

import sipe_bayes as sipe
from sipe_bayes.cli.app import app
from sipe_bayes.core.files import to_json
from sipe_bayes.core.parameters import ParameterSpace
from sipe_bayes.models.policy import load_policy
from sipe_bayes.posterior import Dirac, GaussianMixture, Particles, Posterior, prior, uniform
from sipe_bayes.rl.randomization import Draws, Randomization, load_randomization
from sipe_bayes.rl.settings import Settings
from sipe_bayes.rl.train import train
from sipe_bayes.rl.trainer import Trainer
from sipe_bayes.simulation.simulator import Simulator

TASK = sipe.make_task("Pendulum")
SPACE = TASK.space
SMALL = Settings(hidden=(8,), batch=8, start_steps=20, lanes=2, capacity=2_000)


def simulator() -> Simulator:
    return Simulator(TASK, 1)


def normal(space: ParameterSpace = SPACE) -> GaussianMixture:
    covariance = 0.01 * (np.eye(3) + 0.5 * (1 - np.eye(3)))
    return GaussianMixture(torch.zeros(1), [[0.4, 0.5, 0.9]], covariance[None], space)


# Draws


def test_particles_are_drawn_equally_often() -> None:
    """600 draws of three: each count within 4.4 sd of 200, a false alarm in 30,000."""
    points = np.array([[0.1, 0.2, 0.3], [0.4, 0.5, 0.6], [0.9, 0.8, 0.7]])
    drawn = Draws(simulator(), Particles(points, SPACE))(np.random.default_rng(0), 600)
    counts = [(drawn == point).all(1).sum() for point in points]
    assert sum(counts) == 600
    assert np.abs(np.array(counts) - 200).max() < 4.4 * np.sqrt(600 * 2 / 9), counts


def test_draws_follow_names_and_values_not_columns() -> None:
    """The same parameters in another order and between other bounds: their values count."""
    other = ParameterSpace([replace(SPACE[k], low=SPACE[k].low / 2, high=2 * SPACE[k].high) for k in (2, 0, 1)])
    value = {"mass": 1.2, "length": 0.9, "damping": 0.06}
    theta = other.normalise([value[name] for name in other.names])
    (drawn,) = Draws(simulator(), Dirac(theta, other))(np.random.default_rng(0), 1)
    np.testing.assert_allclose(SPACE.values(drawn), [value[name] for name in SPACE.names], rtol=1e-12)


def test_theta_outside_the_cube_is_drawn_anew_and_counted() -> None:
    """Bounds twice as wide for each of three parameters.

    One draw in eight fits, so 7 are drawn anew for each that does; 100 of them within 4.4 sd
    (negative binomial, sd 75).
    """
    wide = ParameterSpace(
        [replace(p, low=p.low - (p.high - p.low) / 2, high=p.high + (p.high - p.low) / 2) for p in SPACE]
    )
    draws = Draws(simulator(), uniform(wide))
    theta = draws(np.random.default_rng(0), 100)
    assert ((theta >= 0) & (theta <= 1)).all()
    assert abs(draws.redrawn - 700) < 4.4 * 75


@pytest.mark.parametrize(
    ("posterior", "words"),
    [
        (
            prior(sipe.make_task("CartPole").space),
            "lacks mass, length, damping and it has pole_mass, pole_length, cart_friction",
        ),
        (prior(SPACE.subset(["mass", "length"])), "it lacks damping; fit one"),
        (prior(ParameterSpace([*SPACE, sipe.Parameter("glue")])), "it has glue; fit one"),
        (prior(ParameterSpace([replace(SPACE[0], unit="g"), *SPACE[1:]])), "mass is in 'g', and in 'kg' in Pendulum"),
    ],
)
def test_other_parameters_are_refused_by_name(posterior: Posterior, words: str) -> None:
    with pytest.raises(ValueError, match="posterior: ") as refused:
        Trainer(TASK, SMALL, randomization=Randomization(posterior))
    assert words in str(refused.value)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"observation_noise": -1.0}, "observation_noise: expected an sd"),
        ({"observation_noise": [0.1, 0.2]}, "expected one number or 3"),
        ({"action_delay": -1}, "action_delay: expected at least 0"),
        ({"action_delay": 1.5}, "action_delay: expected a whole number"),
        ({"posterior": np.full(3, 0.5)}, "posterior: expected a Posterior"),
    ],
)
def test_wrong_randomizations(changes: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        Trainer(TASK, SMALL, randomization=Randomization(**{"posterior": prior(SPACE), **changes}))


# Noise and delay


class Seen:
    """What an agent sees, sends and the simulator gets, step by step."""

    def __init__(self, trainer: Trainer, steps: int) -> None:
        lanes, self.sent, self.got, self.seen, self.true = trainer.episodes, [], [], [], []
        actions, step = trainer._actions, lanes.step
        trainer._actions = lambda: self._kept(self.sent, actions())  # type: ignore[method-assign]
        lanes.step = lambda given: step(self._kept(self.got, given))  # type: ignore[method-assign]
        for _ in range(steps):
            trainer.advance()
            self.seen.append(trainer._disturbances.observations.copy())  # type: ignore[union-attr]
            self.true.append(lanes.observations.copy())

    @staticmethod
    def _kept(into: list[np.ndarray], given: np.ndarray) -> np.ndarray:
        into.append(given.copy())
        return given


def test_actions_arrive_late() -> None:
    """Against a plain reference.

    In each episode and lane an action arrives 0 to 3 steps after it was sent, before that the middle.
    """
    trainer = Trainer(TASK, replace(SMALL, lanes=6, start_steps=10**9), 1, Randomization(prior(SPACE), action_delay=3))
    found = Seen(trainer, 402)
    sent, got = np.array(found.sent), np.array(found.got)
    delays = []
    for lane in range(6):
        for begin in (0, 201):  # of 200 steps; the one between them only begins the second
            here, there = sent[begin : begin + 200, lane, 0], got[begin : begin + 200, lane, 0]
            late = [d for d in range(4) if (there[d:] == here[: 200 - d]).all() and (there[:d] == 0).all()]
            assert len(late) == 1, (lane, begin, late)
            delays += late
    assert len(set(delays)) > 2, delays


def test_observations_are_noisy_by_an_episode_of_its_own() -> None:
    """Each episode's noise has one sd between 0 and the greatest one.

    Of 200 samples a sd is known to 5 %, so that 25 % are 5 sd.
    """
    greatest = np.array([0.1, 0.0, 2.0])
    trainer = Trainer(TASK, replace(SMALL, lanes=6, start_steps=10**9), 1, Randomization(prior(SPACE), greatest))
    found = Seen(trainer, 200)
    noise = np.array(found.seen) - np.array(found.true)
    assert (noise[..., 1] == 0).all()
    share = noise.std(0)[:, [0, 2]] / greatest[[0, 2]]
    np.testing.assert_allclose(share[:, 0], share[:, 1], rtol=0.5)
    assert ((share > 0) & (share < 1.25)).all()
    assert np.ptp(share[:, 0]) > 0.2
    kept = trainer.replay.observations[: trainer.replay.head + 1].numpy()
    np.testing.assert_array_equal(kept[1:], np.array(found.seen, np.float32))


def test_one_number_leaves_the_desired_goal_alone() -> None:
    task = sipe.make_task("FetchPush")
    trainer = Trainer(task, replace(SMALL, start_steps=10**9), 0, Randomization(prior(task.space), 0.1))
    trainer.advance()
    noise = trainer.replay.observations[1].numpy() - trainer.episodes.observations.astype(np.float32)
    assert (noise[:, -3:] == 0).all()
    assert (noise[:, :-3] != 0).all()


# Files


def exported(folder: Path, posterior: Posterior, named: bool, space: ParameterSpace = SPACE) -> Path:
    """What `sipe calibrate` leaves, of ``output.domain_randomization``'s form."""
    values = space.values(posterior.mean.numpy())
    width = np.array([p.high - p.low for p in space])
    rows = [
        {
            "name": p.name,
            "unit": p.unit,
            "targets": {t: 1.0 for t in p.targets},
            "low": p.low,
            "high": p.high,
            "mean": m,
        }
        for p, m in zip(space, values.tolist(), strict=True)
    ]
    covariance = (posterior.covariance.numpy() * width * width[:, None]).tolist()
    found: dict[str, Any] = {"parameters": rows, "names": list(space.names), "covariance": covariance}
    if named:
        posterior.save(folder / "posterior")
        found["posterior"] = "posterior"
    path = folder / "domain_randomization.json"
    path.write_text(to_json(found))
    return path


def policy_under(randomization: Randomization) -> list[Any]:
    trainer = Trainer(TASK, SMALL, 5, randomization)
    while trainer.steps < 500:
        trainer.advance()
    assert trainer.agent.updates > 400
    return [part for layer in trainer.policy().layers for part in layer]


def test_exported_file_gives_the_same_training(tmp_path: Path) -> None:
    posterior = normal()
    read = load_randomization(exported(tmp_path, posterior, named=True))
    for a, b in zip(policy_under(read), policy_under(Randomization(posterior)), strict=True):
        np.testing.assert_array_equal(a, b)
    assert read.fingerprint == Randomization(posterior).fingerprint != Randomization(posterior, 0.1).fingerprint


def test_train_command_reads_the_file(tmp_path: Path) -> None:
    given = [
        "--steps",
        "60",
        "--hidden",
        "8",
        "--batch",
        "8",
        "--start-steps",
        "20",
        "--episodes",
        "2",
        "--evaluation-episodes",
        "2",
    ]
    file = exported(tmp_path, normal(), named=True)
    made = CliRunner().invoke(
        app, ["train", "Pendulum", *given, "--randomization", str(file), "--out", str(tmp_path / "a")]
    )
    assert made.exit_code == 0, made.output
    chosen = Settings(hidden=(8,), batch=8, start_steps=20)
    policy = train(
        "Pendulum", 60, 0, tmp_path / "b", chosen, randomization=Randomization(normal()), evaluation_episodes=2
    )
    for a, b in zip(load_policy(tmp_path / "a" / "expert.safetensors").layers, policy.layers, strict=True):
        np.testing.assert_array_equal(a[0], b[0])
    other = exported(
        tmp_path, prior(sipe.make_task("CartPole").space), named=True, space=sipe.make_task("CartPole").space
    )
    refused = CliRunner().invoke(
        app, ["train", "Pendulum", *given, "--randomization", str(other), "--out", str(tmp_path / "c")]
    )
    assert refused.exit_code == 2
    assert "over other parameters than Pendulum: it lacks mass, length, damping" in refused.stderr


def test_file_without_a_posterior_stands_for_its_normal(tmp_path: Path) -> None:
    """Mean and covariance become those before the cube cuts them off; a point stays one; additions are read."""
    posterior = normal()
    path = exported(tmp_path, posterior, named=False)
    path.write_text(to_json({**json.loads(path.read_text()), "observation_noise": [0.1, 0.1, 0.2], "action_delay": 2}))
    read = load_randomization(path)
    assert isinstance(read.posterior, GaussianMixture)
    np.testing.assert_allclose(read.posterior.means[0], posterior.mean, atol=1e-9)
    np.testing.assert_allclose(read.posterior.covariances[0], posterior.covariance, atol=1e-9)
    assert (list(read.observation_noise), read.action_delay) == ([0.1, 0.1, 0.2], 2)  # type: ignore[arg-type]
    point = load_randomization(exported(tmp_path, Dirac([0.2, 0.3, 0.4], SPACE), named=False))
    drawn = Draws(simulator(), point.posterior)(np.random.default_rng(0), 50)
    np.testing.assert_allclose(drawn, np.tile([0.2, 0.3, 0.4], (50, 1)), atol=1e-5)


def test_files_that_say_something_else(tmp_path: Path) -> None:
    path = exported(tmp_path, normal(), named=True)
    (tmp_path / "posterior.safetensors").unlink()
    with pytest.raises(FileNotFoundError, match="no such file"):
        load_randomization(path)
    for text in ("[]", "{", "{}", '{"parameters": [{"name": "mass"}], "covariance": [[1]]}'):
        path.write_text(text)
        with pytest.raises(ValueError, match=r"cannot be read as a domain randomisation \(.*\); export it"):
            load_randomization(path)


# Wider


def test_wider_has_the_spread_it_says() -> None:
    """The sd of 8,000 draws is known to 0.8 %: 4 % are five sd."""
    narrow = GaussianMixture(torch.zeros(1), [[0.4, 0.5, 0.6]], 0.0009 * np.eye(3)[None], SPACE)
    wide = narrow.wider(2.5)
    np.testing.assert_allclose(wide.stddev, 2.5 * narrow.stddev, rtol=0.04)
    np.testing.assert_allclose(wide.mean, narrow.mean, atol=5 * 0.075 / np.sqrt(8000))
    np.testing.assert_allclose(narrow.wider(1).stddev, narrow.stddev, rtol=0.04)


@pytest.mark.parametrize("sd", [2e-9, 1e-6])
def test_wider_takes_very_narrow_posteriors(sd: float) -> None:
    """As narrow as a transfer's ``--wider`` still widens."""
    points = 0.5 + sd * np.random.default_rng(0).standard_normal((2000, len(SPACE)))
    np.testing.assert_allclose(Particles(points, SPACE).wider(2).stddev.numpy(), 2 * points.std(0), rtol=0.1)


def test_wider_stays_in_the_cube_without_piling_up_on_its_faces() -> None:
    wide = normal().wider(20)
    assert isinstance(wide, Particles)
    assert ((wide.theta > 0) & (wide.theta < 1)).all()
    assert ((wide.theta < 0.05).double().mean(0) < 0.1).all()
    np.testing.assert_array_equal(wide.theta, normal().wider(20).theta)


@pytest.mark.parametrize(
    ("factor", "words"), [(0.5, "factor: expected at least 1"), (float("nan"), "factor"), ("2", "factor")]
)
def test_wider_refuses(factor: Any, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        normal().wider(factor)
    with pytest.raises(ValueError, match=r"got a point; take \.smoothed"):
        Dirac([0.5, 0.5, 0.5], SPACE).wider(2)
