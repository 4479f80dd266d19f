"""Policy in the loop: every estimator, what it is given, the pace of its budget, convergence, resuming."""

from __future__ import annotations

import csv
import json
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import sipe_bayes as sipe
from sipe_bayes.core.checkpoint import CheckpointError
from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.envs.task import Solved, Task
from sipe_bayes.inference import ESTIMATORS
from sipe_bayes.inference.base import Estimator
from sipe_bayes.models.policy import Policy
from sipe_bayes.posterior import Dirac
from sipe_bayes.rl.loop_run import LoopRun, Plan, solves
from sipe_bayes.rl.policy_in_the_loop import CHECKPOINT, LoopResult, train_in_the_loop
from sipe_bayes.rl.settings import Settings
from sipe_bayes.simulation.simulator import Simulator
from tests.problems.checkpoints import contents
from tests.problems.planted import Ended
from tests.problems.quick import FORM

EPISODE, HORIZON = 30, 20
SMALL = Settings(hidden=(8, 8), batch=8, start_steps=60, updates_per_step=0.2)
ONE_STEP = sipe.Segments(0.05, noise="white", starts="recorded")  # a search for starts would take a larger budget
CHOSEN = {
    name: {"budget": budget, "likelihood": ONE_STEP, "candidates": 2}
    for name, budget in (("laplace", 300), ("mcmc", 1000))
}


def task(name: str = "Pendulum", **changes: Any) -> Task:
    return replace(sipe.make_task(name), **{"episode_steps": EPISODE, **changes})


def estimator(name: str, of: Task | None = None, seed: int = 1, **settings: Any) -> Estimator:
    chosen = {"budget": 80, **FORM.get(name, {}), **settings}
    return sipe.get_estimator(Simulator(of or task(), 1), name, seed=seed, **chosen)


def loop(of: Estimator, updates: int = 2, steps: int = 120, **settings: Any) -> LoopResult:
    given = {"trajectory_steps": HORIZON, "settings": SMALL, "evaluation_episodes": 2, **settings}
    return train_in_the_loop(of, "in_distribution", steps, updates=updates, **given)


class Told(Estimator[Ended]):
    """Keeps the trajectories it is given and answers with a corner of the cube; fails where it is told to."""

    name = "told"
    state_type = Ended
    fails: tuple[int, ...] = ()

    def start(self, trajectories: Trajectories) -> Ended:
        self.given = [*getattr(self, "given", []), trajectories]
        self.budgets = [*getattr(self, "budgets", []), self.budget]
        if len(self.given) in self.fails:
            raise ValueError("no idea")
        return Ended(False)

    def step(self, state: Ended, trajectories: Trajectories) -> Ended:
        self.rollouts = min(7, self.budget)
        return Ended(True)

    def posterior(self, state: Ended, trajectories: Trajectories) -> Dirac:
        return Dirac(np.full(len(self.space), 0.25), self.space)


def told(of: Task | None = None, fails: tuple[int, ...] = (), budget: int = 100) -> Told:
    made = Told(Simulator(of or task(), 1), budget=budget)
    made.fails = fails
    return made


def run_of(of: Estimator, updates: int = 2, steps: int = 120, **settings: Any) -> LoopRun:
    return LoopRun(of, "in_distribution", Plan(steps, updates, 2, HORIZON, 2, replace(SMALL, **settings)), threads=1)


@pytest.mark.parametrize("name", list(ESTIMATORS))
@pytest.mark.parametrize("environment", ["Pendulum", "HalfCheetahLinks"])
def test_every_estimator(name: str, environment: str) -> None:
    method = estimator(name, task(environment), **CHOSEN.get(name, {}))
    found = loop(method)
    assert [row.update for row in found.history] == [1, 2]
    assert [row.reference_rollouts for row in found.history] == [1, 2]
    spent = [row.rollouts for row in found.history]
    assert 0 < spent[0] < spent[1] <= method.budget
    assert not any(row.failure for row in found.history)
    assert found.history[0].mean != found.history[1].mean != tuple(method.prior.mean.tolist())
    truth = task(environment).theta("in_distribution")
    assert found.history[1].mean == tuple(found.posterior.mean.tolist())
    assert found.history[1].accuracy == pytest.approx(1 - np.abs(found.posterior.mean.numpy() - truth).mean())
    assert found.policy.task == environment


@pytest.mark.parametrize("name", ["simopt", "adr"])
def test_learned_rewards(name: str) -> None:
    plain, learned = (
        loop(estimator(name, reward=reward, **more))
        for reward, more in (("state_difference", {}), ("learned", {"discriminator_hidden": 8}))
    )
    assert plain.history[1].mean != learned.history[1].mean
    assert plain.history[1].rollouts == learned.history[1].rollouts == 80


@pytest.mark.parametrize("environment", ["Pendulum", "FetchPush"])
def test_the_estimator_gets_the_reference_under_the_actions_of_training(environment: str) -> None:
    """The trajectories are the truth's, from where the episodes began, with their actions and goals.

    Afterwards the agent trains where the estimate says.
    """
    of = task(environment)
    run = run_of(told(of), lanes=2, steps=4 * (EPISODE + HORIZON + 1), start_steps=10**6)
    run.iterate(None)
    (given,) = run.estimator.given  # type: ignore[attr-defined]
    assert given.actions.shape[:2] == (2, HORIZON)
    assert given.states is not None
    replayed = run.simulator.rollout(
        run.truth, given.actions, given.states[:, 0], goals=of.recorded_goals(given.observations[:, 0])
    )
    np.testing.assert_array_equal(replayed.observations, given.observations)
    replay = run.trainer.replay
    actions, seen = replay.actions.numpy(), replay.observations.numpy()
    for i in range(2):
        begins = np.argwhere((actions == given.actions[i, 0].astype(np.float32)).all(-1))
        (row, lane), *more = begins.tolist()
        assert not more
        np.testing.assert_array_equal(actions[row : row + HORIZON, lane], np.float32(given.actions[i]))
        np.testing.assert_array_equal(seen[row, lane], np.float32(given.observations[i, 0]))
        assert not np.array_equal(seen[row + HORIZON, lane], np.float32(given.observations[i, -1]))
    assert (run.trainer.episodes.theta != 0.25).all()
    run.iterate(None)
    np.testing.assert_array_equal(run.trainer.episodes.theta, 0.25)


def test_demonstrations_are_learnt_from_and_tell_runs_apart() -> None:
    of = sipe.make_task("FetchPush")
    shown, settings = sipe.demonstrations("FetchPush", count=2), replace(SMALL, demonstration_share=0.25)
    plan = Plan(200, 2, 1, HORIZON, 1, settings)
    one, other = (LoopRun(told(of), "default", plan, 1, demonstrations=shown[[i]]) for i in range(2))
    assert one.fingerprint != other.fingerprint
    for run, i in ((one, 0), (other, 1)):
        run.iterate(None)
        known = {row.tobytes() for row in np.float32(shown.actions[i])}
        assert sum(row.tobytes() in known for row in run.trainer._batch().actions.numpy()) >= 2  # of 8
    with pytest.raises(ValueError, match=r"demonstration_share: 0\.25 with demonstrations missing"):
        LoopRun(told(of), "default", plan, 1)


def test_an_agent_begins_as_a_given_policy() -> None:
    """It acts as that policy does, and stays it until the critic has learnt alone for a while."""
    of, settings = task(), replace(SMALL, normalise=True, exploration=0.0, actor_waits=100)
    rng = np.random.default_rng(0)
    layers = tuple(
        (rng.standard_normal((out, size)).astype(np.float32), rng.standard_normal(out).astype(np.float32))
        for size, out in ((len(of.channels), 8), (8, 8), (8, of.num_actions))
    )
    moments = rng.uniform(0.5, 2, (2, len(of.channels))).astype(np.float32)
    policy = Policy(of.name, layers, of.action_low, of.action_high, *moments)
    run = LoopRun(told(of), "default", Plan(200, 2, 1, HORIZON, 1, settings), 1, policy=policy)
    other = LoopRun(told(of), "default", Plan(200, 2, 1, HORIZON, 1, settings), 1)
    assert run.fingerprint != other.fingerprint
    run.iterate(None)  # 100 steps
    replay = run.trainer.replay
    rows = np.flatnonzero(replay.transition[:100, 0])
    np.testing.assert_allclose(
        replay.actions[rows, 0].numpy(), policy(replay.observations[rows, 0].numpy()), rtol=0, atol=1e-5
    )
    assert run.trainer.agent.updates > 0
    kept = run.trainer.policy()
    for (weight, bias), (own_weight, own_bias) in zip(policy.layers, kept.layers, strict=True):
        np.testing.assert_array_equal(own_weight, weight)
        np.testing.assert_array_equal(own_bias, bias)
    run.iterate(None)
    later = run.trainer.policy()
    assert not np.array_equal(later.layers[0][0], policy.layers[0][0])
    assert later.mean is not None
    assert later.scale is not None
    np.testing.assert_array_equal([later.mean, later.scale], moments)
    with pytest.raises(ValueError, match=r"policy: expected layers .*normalise False .*take the settings"):
        LoopRun(told(of), "default", Plan(200, 2, 1, HORIZON, 1, SMALL), 1, policy=policy)


def test_budgets_follow_the_training() -> None:
    """A fit gets what is left of its share so far, a search takes steps until it is level."""
    fitted = told(budget=100)
    assert [row.rollouts for row in loop(fitted, 4, 240).history] == [7, 14, 21, 28]
    assert fitted.budgets == [25, 43, 61, 79]
    assert fitted.budget == 100
    searched = loop(estimator("simopt", budget=60, updates=2, particles=5), 6, 360)
    assert [row.rollouts for row in searched.history] == [10, 20, 30, 40, 50, 60]
    slow = loop(estimator("simopt", budget=60, updates=6, particles=5), 6, 360)
    assert [row.rollouts for row in slow.history] == [30, 30, 30, 60, 60, 60]
    assert [row.reference_rollouts for row in slow.history] == [1, 1, 1, 2, 2, 2]


def test_a_failed_update_leaves_the_estimate() -> None:
    found = loop(told(fails=(2,)), 3, 180)
    assert [row.failure for row in found.history] == [None, "no idea", None]
    assert found.history[1].mean == (0.25,) * 3
    assert found.warnings == ("update 2: no idea",)
    with pytest.raises(ValueError, match=r"no idea \(the first of 3 updates, with 33 rollouts\)$"):
        loop(told(fails=(1,)), 3, 180)


class Straying:
    """Of the first draws every other one is outside the cube; then none, or all of them."""

    def __init__(self, for_ever: bool) -> None:
        self.calls, self.for_ever, self.space = 0, for_ever, task().space

    def sample(self, shape: tuple[int], generator: torch.Generator) -> torch.Tensor:
        self.calls += 1
        theta = torch.rand(*shape, 3, dtype=torch.float64, generator=generator)
        theta[:: 2 if self.calls == 1 else 1, 1] += float(self.calls == 1 or self.for_ever)
        return theta


def test_impossible_draws_are_drawn_anew_and_counted() -> None:
    run = run_of(told())
    run.draw.source = Straying(for_ever=False)  # type: ignore[assignment]
    theta = run.draw(np.random.default_rng(0), 7)
    assert theta.shape == (7, 3)
    assert ((theta >= 0) & (theta <= 1)).all()
    assert run.draw.redrawn == 4
    run.draw.source = Straying(for_ever=True)  # type: ignore[assignment]
    with pytest.raises(ValueError, match=r"100 draws of .* gave no model; narrow") as raised:
        run.draw(np.random.default_rng(0), 7)
    assert "\n" not in str(raised.value)


def test_a_diverging_draw_ends_its_episode_and_is_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    run = run_of(told())
    engine = run.trainer.simulator.engine
    advance, seen = engine.advance, []

    def diverging(*args: Any, **settings: Any) -> Any:
        states, derived, sound = advance(*args, **settings)
        seen.append(run.trainer.episodes.theta[0].copy())
        return states, derived, sound & (len(seen) != 10)

    monkeypatch.setattr(engine, "advance", diverging)
    run.iterate(None)
    assert run.history[0].diverged == 1
    assert (seen[9] == seen[0]).all()
    assert (seen[10] != seen[9]).all()
    (given,) = run.estimator.given  # type: ignore[attr-defined]
    assert sorted(given.length) in ([10, HORIZON], [HORIZON, HORIZON])


@pytest.mark.parametrize("threshold", [-1e9, 1e9])
def test_a_run_converges_where_its_policy_solves_the_environment(threshold: float) -> None:
    found = loop(told(task(solved=Solved("return", threshold))))
    assert found.converged == found.solved_reference == (threshold < 0)


def test_convergence_is_asked_of_the_simulators_trained_in_and_not_of_the_reference() -> None:
    run = run_of(told())
    run.iterate(None)
    (last,) = run.history
    last = replace(last, failure=None, simulation_success=None, reference_success=None)
    for inside, outside in ((-199.0, -201.0), (-201.0, -199.0)):
        run.history = [replace(last, simulation_return=inside, reference_return=outside)]
        assert run.result().converged == (inside >= -200)
        assert run.result().solved_reference == (outside >= -200)
    door = sipe.make_task("Door")
    assert solves(door, -1e9, door.solved.threshold)
    assert not solves(door, 1e9, door.solved.threshold - 0.01)
    assert not solves(door, 1e9, None)


@pytest.mark.parametrize(
    ("name", "settings"),
    [("simopt", {"reward": "learned", "discriminator_hidden": 8, "updates": 2}), ("adr", {}), ("cem", {}), ("abc", {})],
)
def test_a_resumed_run_is_the_undisturbed_one(tmp_path: Path, name: str, settings: dict[str, Any]) -> None:
    def again(folder: str, seed: int = 1, **more: Any) -> LoopResult:
        method = estimator(name, budget=96, seed=seed, **settings)
        return loop(method, 3, 330, settings=replace(SMALL, lanes=2), folder=tmp_path / folder, **more)

    def interrupt(line: str, step: int, steps: int) -> None:
        if step >= 300:
            raise KeyboardInterrupt

    whole = again("whole")
    with pytest.raises(KeyboardInterrupt):
        again("short", report=interrupt)
    assert not (tmp_path / "short" / "result.json").exists()
    with pytest.raises(ValueError, match="holds a run already; pass resume=True"):
        again("short")
    with pytest.raises(CheckpointError, match="belongs to another run"):
        again("short", seed=2, resume=True)
    resumed = again("short", resume=True)
    assert resumed.history == whole.history
    assert resumed.warnings == whole.warnings
    for kept in (resumed, again("short", resume=True)):
        for a, b in zip(whole.policy.layers, kept.policy.layers, strict=True):
            np.testing.assert_array_equal(a[0], b[0])
        draws = [f.posterior.sample((50,), generator=torch.Generator().manual_seed(0)) for f in (whole, kept)]
        assert torch.equal(*draws)
    states = [contents(tmp_path / folder / CHECKPOINT) for folder in ("whole", "short")]
    assert states[0].keys() == states[1].keys()
    for key, value in states[0].items():
        np.testing.assert_array_equal(value, states[1][key], err_msg=key)
    assert states[0]["trainer"]["agent"]["updates"] > 10


def test_what_the_folder_holds(tmp_path: Path) -> None:
    found = loop(estimator("adr"), folder=tmp_path)
    files = sorted(str(p.relative_to(tmp_path)) for p in tmp_path.rglob("*") if p.is_file())
    pairs = [f"checkpoint/{kind}-2.{end}" for kind in ("posterior", "proposal") for end in ("json", "safetensors")]
    own = ["history.csv", "policy.safetensors", "posterior.json", "posterior.safetensors", "result.json"]
    assert files == sorted([*pairs, "checkpoint/replay-2.npz", CHECKPOINT, *own])
    with (tmp_path / "history.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [float(row["accuracy"]) for row in rows] == [row.accuracy for row in found.history]
    assert [float(row["mean_length"]) for row in rows] == [row.mean[1] for row in found.history]
    said = json.loads((tmp_path / "result.json").read_text())
    history = [{**asdict(row), "mean": list(row.mean), "sd": list(row.sd)} for row in found.history]
    assert (said["converged"], said["estimator"], said["history"]) == (found.converged, "adr", history)
    assert torch.equal(sipe.load_posterior(tmp_path / "posterior").mean, found.posterior.mean)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"updates": 0}, "updates: expected at least 1, got 0"),
        ({"trajectories": 1.5}, "trajectories: expected a whole number"),
        (
            {"trajectory_steps": EPISODE + 1},
            f"trajectory_steps: expected at most an episode's {EPISODE}, got {EPISODE + 1}",
        ),
        ({"steps": 100}, "steps: 100 in 2 updates are too few .* expected 51 for each; raise steps"),
        ({"reference": "moon"}, "variant: no 'moon'"),
        ({"reference": [0.5, 0.5]}, "expected 3 parameters"),
        ({"reference": [0.5, np.nan, 0.5]}, "reference: expected a variant's name or 3 finite numbers"),
        ({"estimator": "simopt"}, "estimator: expected one on a task of `sipe envs`, got 'simopt'"),
    ],
)
def test_wrong_arguments_are_named_in_one_line(change: dict[str, Any], words: str) -> None:
    given = {"steps": 120, "updates": 2, "trajectory_steps": HORIZON, "settings": SMALL, **change}
    of = given.pop("estimator", None) or told()
    with pytest.raises(ValueError, match=words) as raised:
        train_in_the_loop(of, given.pop("reference", "default"), given.pop("steps"), **given)
    assert "\n" not in str(raised.value)


def test_an_estimator_that_is_not_fresh_is_refused(tmp_path: Path) -> None:
    used = told()
    loop(used)
    for stale in (used, estimator("adr", checkpoint=tmp_path / "own.safetensors")):
        with pytest.raises(ValueError, match="estimator: expected a fresh one without a checkpoint"):
            loop(stale)
