"""Trajectory sets: what is stored comes back, damage is named; and the commands."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from typer.testing import CliRunner

import sipe_bayes as sipe
from sipe_bayes.cli.app import app
from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.datasets import acting, trajectory_sets
from sipe_bayes.datasets import demonstrations as demonstration
from sipe_bayes.datasets.generation import generate
from sipe_bayes.datasets.trajectory_sets import IN_PACKAGE, MANIFEST, SetName, TrajectorySetError
from sipe_bayes.simulation.simulator import Simulator
from tests.problems.policies import agent

STEPS = 15


def one_set(
    folder: Path, task: str = "Pendulum", type: Any = "random", variant: Any = "in_distribution", **settings: Any
) -> SetName:
    """The reference set of a task, made in ``folder``."""
    name = SetName(task, variant, "reference", type)
    (made,) = generate([name], folder, **{"steps": STEPS, "num_threads": 1, **settings})
    assert not made.missing
    return name


def run(*words: str) -> tuple[int, str]:
    result = CliRunner().invoke(app, ["data", *words])
    return result.exit_code, result.output


# What is stored


@pytest.mark.parametrize("task", ["Pendulum", "FetchPush", "Door", "Relocate", "HalfCheetahJoints", "HumanoidLinks"])
def test_what_was_simulated_comes_back(task: str, tmp_path: Path) -> None:
    """Starts and actions exactly, the rest within float32's rounding, at parameters that are not the default's."""
    one_set(tmp_path, task)
    env = sipe.make(task, "in_distribution")
    found = sipe.demonstrations(env, "random", steps=STEPS, folder=tmp_path)
    made = sipe.demonstrations(env, "random", steps=STEPS)
    assert found.states is not None
    assert made.states is not None
    assert found.names == made.names
    assert found.channels == made.channels
    np.testing.assert_array_equal(found.states[:, 0, 1:], made.states[:, 0, 1:])
    np.testing.assert_array_equal(found.actions, made.actions)
    np.testing.assert_allclose(found.states, made.states, rtol=1e-7, atol=1e-9)
    np.testing.assert_allclose(found.rewards, made.rewards, rtol=1e-7)
    error = np.sqrt(((found.observations - made.observations) ** 2).mean((0, 1)))
    spread = made.observations.std((0, 1))
    print(f"{task}: rms {(error / np.where(spread > 1e-9, spread, 1)).max():.1e} of the spread")
    assert (error <= 3e-5 * spread + 1e-7).all()
    again = env.simulator.rollout(env.theta, found.actions, found.states[:, 0], goals=goals_of(env.task, found))
    np.testing.assert_array_equal(again.states.astype(np.float32)[..., 1:], found.states[..., 1:].astype(np.float32))


def goals_of(task: Any, found: Trajectories) -> Any:
    return task.recorded_goals(found.observations[:, 0])


@pytest.mark.parametrize("task", ["HalfCheetahLinks", "Door"])
def test_loading_shows_what_is_stored_and_simulates_no_further(task: str, tmp_path: Path) -> None:
    """A jump in the stored motion is there, and what comes after it is as stored."""
    simulator, name = Simulator(sipe.make_task(task), 1), SetName(task, "default", "test", "random")
    theta = simulator.environment.theta("default")  # type: ignore[attr-defined]
    made, goals = acting.simulate(
        simulator, theta, acting.random(simulator.task), acting.Recording("test", 2, 0, STEPS)
    )
    states = made.states.copy()  # type: ignore[union-attr]
    column = simulator.environment.state_columns(simulator.model)[3]
    assert column is not None
    states[0, 7, column] += 0.25
    trajectory_sets.write(tmp_path, name, simulator, replace(made, states=states), goals, trajectory_sets.Origin(0))
    found = trajectory_sets.read(tmp_path, name, simulator, 2, STEPS)
    np.testing.assert_allclose(found.states, states, rtol=1e-7, atol=1e-9)
    moved = np.abs(found.observations[..., 3] - made.observations[..., 3]) > 0.1
    assert np.argwhere(moved).tolist() == [[0, 7]]


def test_the_same_command_gives_the_same_bytes(tmp_path: Path) -> None:
    for folder, settings in (("a", {}), ("b", {"num_threads": 2}), ("c", {"seed": 1})):
        name = one_set(tmp_path / folder, "HalfCheetahLinks", **settings)
    first, second, other = ((tmp_path / f / name.file).read_bytes() for f in "abc")
    assert first == second
    assert first != other


def test_the_benchmark_s_sets_are_disjoint(tmp_path: Path) -> None:
    """9 tasks, 3 variants, 3 splits, 3 agents; two cheetahs share the default variant's 9 files.

    No two sets of a task and variant have an action in common.
    """
    every = list(trajectory_sets.names())
    assert len({name.file for name in every}) == len(every) == 9 * 27 - 9
    agent(sipe.make_task("Pendulum")).save(tmp_path / "Pendulum-expert.safetensors")
    starts: list[bytes] = []
    for split in acting.SPLITS:
        for behaviour in acting.AGENTS:
            task = sipe.make_task("Pendulum")
            chosen = acting.random(task) if behaviour == "random" else acting.agent(task, agent(task), behaviour)
            found, _ = acting.simulate(
                Simulator(task, 1), task.theta("default"), chosen, acting.Recording(split, 5, 0, 1)
            )
            assert found.states is not None
            starts += [s.tobytes() for s in found.states[:, 0]]
    assert len(set(starts)) == len(starts) == 45


@pytest.mark.parametrize(("task", "owner"), list(trajectory_sets._SHARED.items()))
def test_tasks_that_share_files_are_one_model(task: str, owner: str) -> None:
    def written(name: str) -> bytes:
        simulator = Simulator(sipe.make_task(name), 1)
        model = simulator.written(simulator.space.default_theta)
        buffer = np.empty(mujoco.mj_sizeModel(model), np.uint8)
        mujoco.mj_saveModel(model, None, buffer)
        return buffer.tobytes()

    assert written(task) == written(owner)
    assert written("HumanoidJoints") != written("HumanoidLinks")


# When a stored set is taken


def test_a_stored_set_is_taken_where_it_fits(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What is stored tells itself by its rounded states."""
    monkeypatch.setenv("SIPE_BAYES_DATA", str(tmp_path))
    one_set(tmp_path / "trajectories", "HalfCheetahJoints", variant="default")
    env = sipe.make("HalfCheetahJoints")

    def stored(*args: Any, **settings: Any) -> bool:
        found = sipe.demonstrations(*args, "random", **settings)
        assert found.states is not None
        states = found.states[:, 1:, 1:]
        return bool((states == states.astype(np.float32)).all())

    for given in (env, "HalfCheetahJoints", "HalfCheetahLinks", "HalfCheetahAllJoints"):
        assert stored(given, steps=STEPS)
    assert stored(env, steps=STEPS, count=2)
    assert stored(env, steps=3, variant="default")
    assert not stored(env, steps=STEPS, count=6)
    assert not stored(env, steps=STEPS + 1)
    assert not stored(env, steps=STEPS, seed=1)
    assert not stored(env, steps=STEPS, split="test")
    assert not stored("HalfCheetahJoints", steps=STEPS, variant="in_distribution")
    env.set_parameters(np.full(15, 0.4))
    assert not stored(env, steps=STEPS)
    whole = sipe.demonstrations("HalfCheetahLinks", "random", steps=STEPS)
    np.testing.assert_array_equal(
        whole[1].slice(0, 3).observations, sipe.demonstrations("HalfCheetahLinks", "random", steps=3)[1].observations
    )


def test_a_task_with_other_defaults_is_another(tmp_path: Path) -> None:
    from sipe_bayes.envs.tasks.adroit import door

    one_set(tmp_path, "Door", variant="default", steps=2)
    assert len(sipe.demonstrations("Door", "random", steps=2, folder=tmp_path)) == 5
    with pytest.raises(TrajectorySetError, match="no random reference set of Door with these parameters"):
        sipe.demonstrations(door(latch_damping=0.05), "random", steps=2, folder=tmp_path)


def test_missing_agents_are_said_and_passed_over(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(demonstration, "AGENT_FILES", tmp_path)
    agent(sipe.make_task("Pendulum")).save(tmp_path / "Pendulum-expert.safetensors")
    names = trajectory_sets.names(["Pendulum"], ["default"], ["test"])
    made = {m.name.type: m for m in generate(names, tmp_path / "sets", count=2, steps=5, num_threads=1)}
    assert made["suboptimal"].missing == "no suboptimal agent of Pendulum is installed"
    assert not made["expert"].missing
    assert not made["random"].missing
    entries = trajectory_sets.manifest(tmp_path / "sets")
    assert [bool(e.agent_sha256) for _, e in sorted(entries.items())] == [True, False]
    found = sipe.demonstrations("Pendulum", split="test", count=2, steps=5, folder=tmp_path / "sets")
    simulated = sipe.demonstrations("Pendulum", split="test", count=2, steps=5)
    np.testing.assert_array_equal(found.actions, simulated.actions)


# Damage


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-40])


def flip(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(bytes(content))


@pytest.mark.parametrize(
    ("damage", "words"),
    [(cut, "cut short"), (flip, "corrupted or altered"), (Path.unlink, "cannot be read")],
    ids=["truncated", "corrupted", "removed"],
)
def test_a_damaged_file_is_named_and_refused(damage: Callable[[Path], None], words: str, tmp_path: Path) -> None:
    path = tmp_path / one_set(tmp_path).file
    assert trajectory_sets.verify(tmp_path) == []
    damage(path)
    with pytest.raises(TrajectorySetError, match=f"reference-random.npz: .*{words}.*; `sipe data install ARCHIVE`"):
        sipe.demonstrations("Pendulum", "random", variant="in_distribution", steps=STEPS, folder=tmp_path)
    (wrong,) = trajectory_sets.verify(tmp_path)
    assert str(path) in wrong
    code, said = run("verify", str(tmp_path))
    assert code == 1
    assert str(path) in said


@pytest.mark.parametrize("text", ["", "{", "[]", '{"format": "other", "sets": {}}', '{"sets": {"a": 3}}'])
def test_a_damaged_manifest_is_named_and_refused(text: str, tmp_path: Path) -> None:
    one_set(tmp_path)
    (tmp_path / MANIFEST).write_text(text)
    with pytest.raises(TrajectorySetError, match=f"{MANIFEST}: cannot be read"):
        sipe.demonstrations("Pendulum", "random", folder=tmp_path)
    assert run("verify", str(tmp_path))[0] == 2


def test_a_file_that_nobody_lists_is_named(tmp_path: Path) -> None:
    path = tmp_path / one_set(tmp_path).file
    path.with_name("other.npz").write_bytes(path.read_bytes())
    assert [w.endswith("other.npz: not in the manifest; delete it") for w in trajectory_sets.verify(tmp_path)] == [True]


def test_what_is_shipped_is_whole_and_of_today_s_parameters() -> None:
    assert trajectory_sets.verify(IN_PACKAGE) == []
    entries = trajectory_sets.manifest(IN_PACKAGE)
    assert sum(e.bytes for e in entries.values()) <= 60e6
    known = {name.file: name for name in trajectory_sets.names()}
    assert entries.keys() == known.keys()
    for file, entry in entries.items():
        actor = demonstration.agent_file(known[file].task, known[file].type)
        assert entry.agent_sha256 == (hashlib.sha256(actor.read_bytes()).hexdigest() if actor else ""), file
    for task in {known[file].task for file in entries}:
        simulator = Simulator(sipe.make_task(task), 1)
        mine = [(known[file], entry) for file, entry in entries.items() if known[file].task == task]
        assert all(trajectory_sets.fits(entry, simulator, name.variant) for name, entry in mine)


# The commands


def test_generate_verify_and_what_is_wrong(tmp_path: Path) -> None:
    out, words = str(tmp_path / "new"), ("--task", "Pendulum", "--variant", "default", "--count", "2", "--steps", "5")
    code, said = run("generate", *words, "--out", out, "--threads", "1")
    assert code == 0
    assert "3 sets in" in said  # the random ones
    assert "default-test-expert.npz: not made: no expert agent of Pendulum is installed" in said
    code, said = run("verify", out)
    assert (code, said[:8]) == (0, "3 files,")
    manifest = json.loads((tmp_path / "new" / MANIFEST).read_text())
    entry = manifest["sets"]["Pendulum/default-test-random.npz"]
    assert {"sha256", "bytes", "count", "steps", "seed", "values", "command", "versions"} <= entry.keys()
    assert entry["versions"]["mujoco"] == mujoco.__version__
    for wrong, expected in (
        (("generate", "--task", "Pendulums"), "--task Pendulums: expected one of"),
        (("generate", "--count", "0"), "--count 0: expected at least 1"),
        (("generate", "--type", "expert", "--task", "Pendulum", "--out", out), "9 not made"),
        (("verify", str(tmp_path)), "no manifest.json there"),
        (("export", "--minari", "a b", "--task", "Pendulum"), "dataset: expected a name such as"),
    ):
        code, said = run(*wrong)
        assert (code, expected in said) == (2, True), said
