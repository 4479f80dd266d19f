"""Scripted controllers and demonstrations: they solve the tasks, a seed gives the same, failures are left out."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import sipe_bayes as sipe
from sipe_bayes.cli.app import app
from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.posterior import Dirac, prior
from sipe_bayes.rl import scripted
from sipe_bayes.rl.demonstrate import demonstrate, facts_of, record
from sipe_bayes.rl.randomization import Draws
from sipe_bayes.simulation.simulator import Simulator


@pytest.mark.parametrize(("task", "least"), [("FetchPush", 0.7), ("FetchPickAndPlace", 0.9), ("FetchSlide", 0.2)])
def test_controllers_reach_goals(task: str, least: float) -> None:
    """Measured over 100 attempts and more: .84, 1.0 and .28; a gripper that rests has at most .1."""
    simulator = Simulator(sipe.make_task(task), 1)
    act = scripted.demonstrator(sipe.make_task(task))
    found, succeeded = record(simulator, act, range(24))
    assert succeeded.mean() >= least
    assert found.rewards is not None
    np.testing.assert_array_equal(found.rewards[:, -1] == 0, succeeded)
    _, rested = record(simulator, lambda seen, step, rngs: np.zeros((len(seen), 4)), range(24))
    assert rested.mean() <= 0.1


def test_demonstrations_are_the_first_attempts_that_succeed() -> None:
    task = sipe.make_task("FetchPush")
    simulator, act = Simulator(task, 1), scripted.demonstrator(task)
    some, more = (demonstrate(simulator, act, count, seed=3) for count in (3, 7))
    tried, succeeded = record(simulator, act, range(10), seed=3)
    assert not succeeded.all()  # so that something is left out
    kept = np.flatnonzero(succeeded)
    assert (some.attempts, more.attempts) == (kept[2] + 1, kept[6] + 1)
    for found, count in ((some, 3), (more, 7)):
        np.testing.assert_array_equal(found.trajectories.actions, tried.actions[kept[:count]])
        assert found.trajectories.names == tuple(f"demonstration_{i}" for i in kept[:count])
    shown = more.trajectories
    assert shown.states is not None
    goals = shown.observations[:, 0, -3:]
    again = simulator.rollout(task.theta("default"), shown.actions, shown.states[:, 0], goals=goals)
    for name in ("observations", "states", "rewards", "valid"):
        np.testing.assert_array_equal(getattr(again, name), getattr(shown, name))


def test_demonstrations_in_simulators_drawn_from_what_is_believed() -> None:
    """A point where the published model is gives what it gives.

    The prior gives each attempt a theta of its own, the same again.
    """
    task = sipe.make_task("FetchPush")
    simulator, act = Simulator(task, 1), scripted.demonstrator(task)
    plain, _ = record(simulator, act, range(2), 3)
    there, _ = record(simulator, act, range(2), 3, Draws(simulator, Dirac(task.theta("default"), task.space)))
    np.testing.assert_array_equal(there.states, plain.states)
    drawn, _ = record(simulator, act, range(2), 3, Draws(simulator, prior(task.space)))
    later, _ = record(simulator, act, range(1, 2), 3, Draws(simulator, prior(task.space)))
    np.testing.assert_array_equal(drawn.states[1], later.states[0])
    np.testing.assert_array_equal(drawn.observations[:, 0], plain.observations[:, 0])
    goals = drawn.observations[:, 0, -3:]
    published = simulator.rollout(task.theta("default"), drawn.actions, drawn.states[:, 0], goals=goals)
    assert not any(np.array_equal(one, other) for one, other in zip(published.states, drawn.states, strict=True))


def test_a_controller_that_fails_is_given_up() -> None:
    simulator = Simulator(sipe.make_task("FetchPush"), 1)
    with pytest.raises(RuntimeError, match="0 of 10 attempts succeeded, expected 1; ask for fewer"):
        demonstrate(simulator, lambda seen, step, rngs: np.ones((len(seen), 4)), 1)
    with pytest.raises(ValueError, match="count: expected at least 1, got 0"):
        demonstrate(simulator, scripted.demonstrator(sipe.make_task("FetchPush")), 0)


def test_demonstrations_by_command_end_up_on_the_card(tmp_path: Path) -> None:
    runner, path, out = CliRunner(), tmp_path / "new" / "push.npz", tmp_path / "run"
    made = runner.invoke(app, ["data", "demonstrate", "FetchPush", "--count", "2", "--seed", "1", "--out", str(path)])
    assert made.exit_code == 0, made.output
    assert len(Trajectories.load(path)) == 2
    short = ["--steps", "60", "--start-steps", "50", "--batch", "8", "--evaluate-every", "30", "--hidden", "8,4"]
    learn = [
        "--demonstrations",
        str(path),
        "--demonstration-share",
        "0.5",
        "--episodes",
        "2",
        "--evaluation-episodes",
        "1",
    ]
    done = runner.invoke(app, ["train", "FetchPush", "--out", str(out), *short, *learn])
    assert done.exit_code == 0, done.output
    card = json.loads((out / "expert.json").read_text())
    assert card["demonstrations"] == facts_of(path)
    assert card["deviations"]["hidden"] == [8, 4]
    facts = card["demonstrations"]
    assert (facts["file"], facts["count"], facts["seed"], facts["by"]) == ("push.npz", 2, 1, "scripted controller")
    assert facts_of(tmp_path / "others.npz") == {"file": "others.npz"}
    path.with_suffix(".json").write_text("{")
    with pytest.raises(ValueError, match=r"push\.json: cannot be read"):
        facts_of(path)


def test_what_cannot_be_demonstrated_is_refused(tmp_path: Path) -> None:
    runner = CliRunner()
    for task, name, words in (
        ("Hopper", "out.npz", "expected one of FetchPush, FetchSlide, FetchPickAndPlace, Relocate, Door"),
        ("FetchPush", "out.csv", "expected a name that ends in .npz; call it out.npz"),
    ):
        refused = runner.invoke(app, ["data", "demonstrate", task, "--out", str(tmp_path / name)])
        assert refused.exit_code == 2
        assert words in refused.stderr
        assert refused.stderr.count("\n") == 1
    assert not list(tmp_path.iterdir())
