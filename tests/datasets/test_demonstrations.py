"""Demonstrations, the paper's interface, and what is shown at the end."""

from __future__ import annotations

import importlib.util
import io
import warnings
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from rich.console import Console

import sipe_bayes as sipe
from sipe_bayes.core.trajectory import Trajectories, Trajectory
from sipe_bayes.datasets import demonstrations as demonstration
from sipe_bayes.datasets.acting import smooth_actions
from sipe_bayes.datasets.demonstrations import Given
from sipe_bayes.envs.registry import TASKS
from sipe_bayes.inference import get_estimator
from sipe_bayes.posterior import Dirac
from sipe_bayes.simulation.simulator import Simulator
from tests.problems.pendulums import log, pendulum
from tests.problems.policies import agent

SNIPPET = Path(__file__).parents[2] / "examples" / "paper_snippet.py"


def quietly(*args: Any, **settings: Any) -> Trajectories:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        return sipe.demonstrations(*args, **settings)


def test_what_was_used_is_said_where_it_was_asked_for() -> None:
    with pytest.warns(UserWarning, match="no expert agent of Pendulum is installed; an excitation policy") as caught:
        sipe.demonstrations("Pendulum", steps=5)
    assert caught[0].filename == __file__


def test_trajectories_have_states_rewards_and_names() -> None:
    found = quietly("Pendulum", count=3)
    assert found.observations.shape == (3, 201, 3)
    assert found.states is not None
    assert found.rewards is not None
    assert found.rewards.shape == (3, 200)
    assert found.names == ("reference_0", "reference_1", "reference_2")
    assert found.valid.all()
    simulator = Simulator(sipe.make_task("Pendulum"), num_threads=1)
    again = simulator.replay(np.full((1, 3), 0.5), found)
    np.testing.assert_array_equal(again.observations, found.observations)
    np.testing.assert_array_equal(again.rewards, found.rewards)


def test_splits_and_seeds_differ_and_the_same_call_agrees() -> None:
    first = quietly("Pendulum", steps=20)
    np.testing.assert_array_equal(first.actions, quietly("Pendulum", steps=20).actions)
    np.testing.assert_array_equal(first.actions, quietly("Pendulum", steps=20, count=7).actions[:5])
    others = [quietly("Pendulum", split="validation", steps=20), quietly("Pendulum", split="test", steps=20)]
    others.append(quietly("Pendulum", seed=1, steps=20))
    for other in others:
        assert np.abs(other.actions - first.actions).max() > 0.1
        assert np.abs(other.observations[:, 0] - first.observations[:, 0]).max() > 0.1


@pytest.mark.parametrize("kind", ["name", "task", "simulator", "gymnasium", "wrapped", "vector"])
def test_every_way_to_name_an_environment(kind: str) -> None:
    task = sipe.make_task("Pendulum")
    env = {
        "name": lambda: "Pendulum",
        "task": lambda: task,
        "simulator": lambda: Simulator(task, num_threads=1),
        "gymnasium": lambda: sipe.make("Pendulum"),
        "wrapped": lambda: gymnasium.make("sipe/Pendulum-v0"),
        "vector": lambda: sipe.make_vec("Pendulum", 2, num_threads=1),
    }[kind]()
    found = quietly(env, steps=10)
    np.testing.assert_array_equal(found.observations, quietly("Pendulum", steps=10).observations)
    assert get_estimator(env, "laplace").space.names == task.space.names


def test_the_environments_parameters_decide() -> None:
    for variant in ("in_distribution", "out_of_distribution"):
        env = sipe.make("Pendulum", variant)
        found = quietly(env, steps=30)
        rolled = env.simulator.rollout(env.theta, found.actions, found.states[:, 0], allow_outside=True)  # type: ignore[index]
        np.testing.assert_array_equal(found.observations, rolled.observations)
        assert np.abs(found.observations - quietly("Pendulum", steps=30).observations).max() > 0.01


@pytest.mark.usefixtures("agents")
@pytest.mark.parametrize("name", list(TASKS))
def test_every_task_can_be_excited(name: str) -> None:
    """From the task's own starting states, within the bounds of its actions; meshes are compiled once a task."""
    try:
        env = sipe.make(name)
    except FileNotFoundError as error:
        pytest.skip(str(error))
    found = quietly(env, count=2, steps=20)
    assert env.task.action_low <= found.actions.min() < found.actions.max() <= env.task.action_high
    assert found.rewards is not None
    assert np.isfinite(found.observations).all()


def test_the_excitation_is_smooth() -> None:
    """Below 2 Hz at an amplitude of 0.8: a step of dt changes at most 2 pi 2 0.8 dt of the half range."""
    task = sipe.make_task("Pendulum")
    actions = smooth_actions(task, 0.05, 2000, np.random.default_rng(0))
    assert np.abs(np.diff(actions, axis=0)).max() <= 2 * np.pi * 2 * 0.8 * 0.05 * task.action_high
    assert 0.3 < np.abs(actions).max() <= 0.8 * task.action_high


# Agents, random actions, noise


@pytest.fixture
def agents(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder in place of that of the agents, and no stored sets."""
    monkeypatch.setattr(demonstration, "AGENT_FILES", tmp_path)
    monkeypatch.setenv("SIPE_BAYES_DATA", str(tmp_path / "none"))
    return tmp_path


def test_an_installed_agent_acts(agents: Path) -> None:
    """In closed loop, on what it observes, rounded to float32; whatever the number of trajectories."""
    env = sipe.make("HalfCheetahJoints", "in_distribution")
    policy = agent(env.task)
    assert demonstration.agent_file("HalfCheetahJoints", "expert") is None
    policy.save(agents / "HalfCheetahLinks-expert.safetensors")
    found = sipe.demonstrations(env, steps=12)
    for one in found:
        wanted = np.stack([policy(o[None])[0] for o in one.observations[:-1]])
        np.testing.assert_array_equal(one.actions, wanted.astype(np.float32))
    assert np.abs(found.actions - found.actions[:1]).max() > 0.01
    np.testing.assert_array_equal(found.actions[:2], sipe.demonstrations(env, steps=12, count=2).actions)
    with pytest.warns(UserWarning, match="no suboptimal agent"):
        sipe.demonstrations(env, "suboptimal", steps=2)


def test_an_agent_acts_on_what_the_environment_shows(agents: Path) -> None:
    """The humanoid's observations are late: those of its closed loop, not of a start from each state."""
    env = sipe.make("HumanoidLinks")
    policy = agent(env.task)
    policy.save(agents / "HumanoidLinks-expert.safetensors")
    found = sipe.demonstrations(env, steps=6, count=1)
    rng = np.random.default_rng([0, 0, 0, 1])
    env.reset()
    assert env._episodes is not None
    env._episodes.generators = [rng]
    env._episodes.begin(np.ones(1, bool))
    seen = env._episodes.observations[0]
    for t in range(6):
        np.testing.assert_array_equal(seen, found.observations[0, t])
        seen = env.step(policy(seen[None])[0].astype(np.float32))[0]


def test_an_agent_is_varied_where_every_episode_starts_alike(agents: Path) -> None:
    task = sipe.make_task("Door")
    policy = agent(task)
    policy.save(agents / "Door-expert.safetensors")
    found = sipe.demonstrations("Door", steps=40)
    np.testing.assert_array_equal(found.states[:, 0], found.states[:1, 0].repeat(5, 0))  # type: ignore[index]
    meant = np.stack([policy(o) for o in found.observations[:, :-1]])
    error = found.actions - meant
    inside = (np.abs(found.actions) < 1) & (np.abs(meant) < 0.7)
    assert error[inside].std() == pytest.approx(0.05, rel=0.05)  # of thousands: three standard errors and clipping


def test_an_agent_of_another_robot_is_refused(agents: Path) -> None:
    agent(sipe.make_task("Hopper")).save(agents / "Pendulum-expert.safetensors")
    with pytest.raises(ValueError, match=r"Pendulum-expert.safetensors: expected 3 observations and 1 actions"):
        sipe.demonstrations("Pendulum")


def test_random_actions_are_uniform_and_need_no_agent() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = sipe.demonstrations("Pendulum", "random")
    low, high = found.actions.min(), found.actions.max()
    assert -2 <= low < -1.95
    assert 1.95 < high <= 2
    assert abs(np.corrcoef(found.actions[:, :-1].ravel(), found.actions[:, 1:].ravel())[0, 1]) < 0.1  # 3 in 1/sqrt(995)


def test_variants_by_name() -> None:
    env = sipe.make("Pendulum", "in_distribution")
    expected = quietly(env, steps=9).observations
    for given in ("Pendulum", sipe.make_task("Pendulum"), Simulator(sipe.make_task("Pendulum"), 1), env):
        found = quietly(given, variant="in_distribution", steps=9)
        np.testing.assert_array_equal(found.observations, expected)
    with pytest.raises(ValueError, match="variant: env has parameters other than those of 'default'"):
        quietly(env, variant="default", steps=9)


def test_noise_is_of_the_level_asked_for_and_hides_the_truth() -> None:
    clean = quietly("Pendulum")
    noisy = quietly("Pendulum", noise=0.01)
    error = (noisy.observations - clean.observations) / clean.observations.std((0, 1))
    np.testing.assert_allclose(error.std((0, 1)), 0.01, rtol=0.08)  # 1005 samples: 3.5 standard errors
    assert noisy.states is None
    assert noisy.rewards is None
    np.testing.assert_array_equal(noisy.observations, quietly("Pendulum", noise=0.01).observations)
    assert np.abs(noisy.observations - quietly("Pendulum", noise=0.01, noise_seed=1).observations).max() > 0.01
    one = quietly("Pendulum", noise=np.array([0.0, 0.0, 2.0]))
    np.testing.assert_array_equal(one.observations[..., :2], clean.observations[..., :2])
    assert (one.observations - clean.observations)[..., 2].std() == pytest.approx(2.0, rel=0.08)


def test_wrong_input() -> None:
    lanes = sipe.make_vec("Pendulum", 2, num_threads=1)
    lanes.theta[1] = 0.3
    table: list[tuple[Any, type[Exception], str]] = [
        (
            lambda: sipe.demonstrations("Pendulum", type="novice"),
            ValueError,
            "type: expected one of expert, suboptimal",
        ),
        (lambda: sipe.demonstrations("Pendulum", split="train"), ValueError, "split: expected one of reference"),
        (lambda: sipe.demonstrations("Pendulums"), ValueError, "did you mean 'Pendulum'"),
        (lambda: sipe.demonstrations("Pendulum", variant="other"), ValueError, "variant: no 'other'"),
        (lambda: sipe.demonstrations("Pendulum", count=0), ValueError, "count: expected at least 1, got 0"),
        (lambda: quietly("Pendulum", noise=[0.1, 0.1]), ValueError, r"noise: expected one number or \(3,\)"),
        (lambda: quietly("Pendulum", noise=-0.1), ValueError, "none below zero"),
        (lambda: sipe.demonstrations(pendulum()), ValueError, "no starting states"),
        (lambda: sipe.demonstrations(3), TypeError, "expected a task's name"),
        (lambda: sipe.demonstrations(lanes), ValueError, "parameters differ"),
    ]
    for call, exception, words in table:
        with pytest.raises(exception, match=words):
            call()


# The paper's interface


def test_an_estimator_keeps_what_it_is_given() -> None:
    given, env = Given(), sipe.make("Pendulum")
    with pytest.warns(UserWarning, match="an excitation policy"):
        first = given.stack(env)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert given.stack(env) is first
        assert given.stack(gymnasium.Wrapper(env)) is first
    env.set_parameters(np.full(3, 0.4))
    with pytest.warns(UserWarning, match="an excitation policy"):
        assert given.stack(env) is not first
    trajectories = [log(pendulum(), [0.6, 0.05], seed, steps=10) for seed in (1, 2)]
    both = given.stack(trajectories)
    assert given.stack(list(trajectories)) is both
    assert given.stack(trajectories, anew=True) is not both
    assert len(given.stack(trajectories[0])) == 1
    assert given.stack(trajectories[0]) is given.stack(trajectories[0])
    assert given.stack(both) is both
    with pytest.raises(ValueError, match="at least one"):
        given.stack([])


def test_the_papers_snippet_runs(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    """Without noise the three parameters are found to 1e-6 of their range."""
    spec = importlib.util.spec_from_file_location("paper_snippet", SNIPPET)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    with pytest.warns(UserWarning, match="an excitation policy"):
        posterior = module.main(str(tmp_path / "figure.png"))
    truth = sipe.make_task("Pendulum").theta("in_distribution")
    np.testing.assert_allclose(posterior.mean.numpy(), truth, atol=1e-6)
    assert (tmp_path / "figure.png").stat().st_size > 5000
    assert "damping" in capsys.readouterr().out


def test_an_environment_stands_for_its_demonstrations() -> None:
    env = sipe.make("Pendulum", "in_distribution")
    by_env, by_hand = (get_estimator("Pendulum", "laplace", budget=300, seed=1) for _ in range(2))
    with pytest.warns(UserWarning, match="an excitation policy"):
        found = by_env.fit(env)
    np.testing.assert_array_equal(found.mean.numpy(), by_hand.fit(quietly(env)).mean.numpy())


def test_results_are_shown_in_units(tmp_path: Path) -> None:
    space = sipe.make_task("Pendulum").space
    console = Console(file=io.StringIO(), width=80)
    figure = sipe.show_results(Dirac([0.5, 0.0, 1.0], space), [0.5, 0.5, 0.5], tmp_path / "new" / "a.png", console)
    text = console.file.getvalue()  # type: ignore[attr-defined]
    assert "0.5 to 0.5" in text
    assert "N m s/rad" in text
    assert "100 %" in text
    assert "truth" in text
    assert max(map(len, text.splitlines())) <= 80
    assert len(figure.axes) == 3
    assert [p.name for p in (tmp_path / "new").iterdir()] == ["a.png"]
    with pytest.raises(ValueError, match="expected 3 parameters"):
        sipe.show_results(Dirac([0.5, 0.0, 1.0], space), [0.5])


# Rewards of recorded trajectories


def test_rewards_survive_stacking_cutting_and_the_disk(tmp_path: Path) -> None:
    found = quietly("Pendulum", count=2, steps=12)
    assert found.rewards is not None
    short = found[1].slice(2, 9)
    np.testing.assert_array_equal(short.rewards, found.rewards[1, 2:9])
    stacked = Trajectories.stack([found[0], short])
    assert stacked.rewards is not None
    np.testing.assert_array_equal(stacked.rewards[0], found.rewards[0])
    np.testing.assert_array_equal(stacked.rewards[1], [*found.rewards[1, 2:9], *[0.0] * 5])
    stacked.save(tmp_path / "a.npz")
    np.testing.assert_array_equal(Trajectories.load(tmp_path / "a.npz").rewards, stacked.rewards)
    without = Trajectory(short.observations, short.actions, short.dt)
    assert Trajectories.stack([found[0], without]).rewards is None
    with pytest.raises(ValueError, match="one for each step"):
        Trajectory(short.observations, short.actions, short.dt, rewards=np.zeros(3))
