"""Minari: its own data sets are read, what is exported comes back, and nothing that a data set names is run."""

from __future__ import annotations

import json
import sys
import warnings
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from typer.testing import CliRunner

import sipe_bayes as sipe
from sipe_bayes.cli.app import app


@pytest.fixture
def minari(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    (tmp_path / "minari").mkdir()
    return pytest.importorskip("minari")


def run(*words: str) -> tuple[int, str]:
    result = CliRunner().invoke(app, ["data", *words])
    return result.exit_code, result.output


class Dictionary(gymnasium.Env[dict[str, Any], Any]):
    """A point that is pushed to a goal, observed as a goal-based environment is."""

    dt = 0.1

    def __init__(self) -> None:
        box = gymnasium.spaces.Box(-9, 9, (2,), np.float64)
        self.observation_space = gymnasium.spaces.Dict(
            {k: box for k in ("observation", "achieved_goal", "desired_goal")}
        )
        self.action_space = gymnasium.spaces.Box(-1, 1, (2,), np.float32)

    def _seen(self) -> dict[str, Any]:
        return {"observation": 2 * self.at, "achieved_goal": self.at.copy(), "desired_goal": np.array([5.0, 6.0])}

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[dict[str, Any], dict[str, Any]]:
        super().reset(seed=seed)
        self.at, self.left = np.array([1.0, 2.0]), 4
        return self._seen(), {}

    def step(self, action: Any) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        self.at, self.left = self.at + action, self.left - 1
        return self._seen(), 1.5, False, not self.left, {}


def collected(minari: Any, env: Any, dataset: str, episodes: int = 2, steps: int = 6) -> list[tuple[Any, Any, Any]]:
    """Minari's own collector at work; returns observations, actions and rewards of each episode as they came."""
    collector, kept = minari.DataCollector(env), []
    for i in range(episodes):
        seen, rewards, actions = [collector.reset(seed=i)[0]], [], []
        collector.action_space.seed(i)
        for _ in range(steps + i):
            actions.append(collector.action_space.sample())
            observation, reward, terminated, truncated, _ = collector.step(actions[-1])
            seen.append(observation)
            rewards.append(reward)
            if terminated or truncated:
                break
        kept.append((seen, actions, rewards))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        collector.create_dataset(dataset)
    collector.close()
    return kept


@pytest.mark.parametrize(("env", "dt"), [("HalfCheetah-v5", 0.05), ("Pendulum-v1", 0.05)])
def test_a_data_set_of_minari_s_own_collector(env: str, dt: float, minari: Any, tmp_path: Path) -> None:
    """By its id and by its folder; episodes of different lengths."""
    episodes = collected(minari, gymnasium.make(env), "tests/own-v0")
    for stored in (sipe.from_minari("tests/own-v0"), sipe.from_minari(tmp_path / "minari" / "tests" / "own-v0")):
        assert stored.length.tolist() == [6, 7]
        assert stored.dt.tolist() == [dt] * 2
        assert stored.states is None
        for one, (seen, actions, rewards) in zip(stored, episodes, strict=True):
            np.testing.assert_array_equal(one.observations, np.array(seen))
            np.testing.assert_array_equal(one.actions, np.array(actions))
            np.testing.assert_allclose(one.rewards, rewards)


def test_observations_that_are_dictionaries(minari: Any) -> None:
    """As in this library's Fetch tasks: observation, achieved goal, desired goal."""
    episodes = collected(minari, Dictionary(), "goals-v0", steps=4)
    with pytest.raises(ValueError, match="goals-v0 does not say how long a control step is; pass dt in seconds"):
        sipe.from_minari("goals-v0")
    stored = sipe.from_minari("goals-v0", dt=0.1)
    assert stored.length.tolist() == [4, 4]
    for one, (seen, _, _) in zip(stored, episodes, strict=True):
        at = np.array([s["achieved_goal"] for s in seen])
        np.testing.assert_array_equal(one.observations, np.hstack([2 * at, at, np.tile([5.0, 6.0], (5, 1))]))


@pytest.mark.parametrize("task", ["HalfCheetahLinks", "FetchPush"])
def test_what_is_exported_comes_back(task: str, minari: Any) -> None:
    words = ("--minari", f"sipe/{task}/random-v0", "--task", task, "--type", "random", "--steps", "4", "--count", "2")
    code, output = run("export", *words, "--variant", "in_distribution")
    assert code == 0, output
    stored = sipe.from_minari(f"sipe/{task}/random-v0")
    made = sipe.demonstrations(task, "random", variant="in_distribution", steps=4, count=2)
    for name in ("observations", "actions", "states", "rewards", "dt", "length"):
        np.testing.assert_array_equal(getattr(stored, name), getattr(made, name), err_msg=name)
    code, output = run("export", *words)
    assert code == 2
    assert "exists; choose another name" in output.replace("\n", " ")
    assert minari.load_dataset(f"sipe/{task}/random-v0").total_steps == 8


def test_what_a_data_set_names_is_not_run(minari: Any, tmp_path: Path) -> None:
    """Minari makes the environment of a data set without spaces, whatever its entry point is."""
    collected(minari, gymnasium.make("Pendulum-v1"), "tests/own-v0")
    metadata = tmp_path / "minari" / "tests" / "own-v0" / "data" / "metadata.json"
    plain = json.loads(metadata.read_text())
    spec = json.loads(plain.pop("env_spec"))
    spec |= {"id": "Other-v0", "entry_point": "pathlib:Path.touch", "kwargs": {"self": str(tmp_path / "run")}}
    for space in ("observation_space", "action_space"):
        metadata.write_text(json.dumps({**plain, "env_spec": json.dumps(spec), space: None}))
        with pytest.raises(ValueError, match=f"metadata.json: has no {space}, and what it names is not run"):
            sipe.from_minari("tests/own-v0")
    assert not (tmp_path / "run").exists()


def test_a_data_set_that_claims_more_than_there_is(minari: Any, tmp_path: Path) -> None:
    import h5py

    collected(minari, gymnasium.make("Pendulum-v1"), "tests/own-v0")
    with h5py.File(tmp_path / "minari" / "tests" / "own-v0" / "data" / "main_data.hdf5", "a") as file:
        file.create_dataset("episode_0/infos/many", (2**40,), "f4", chunks=(2**10,))
    with pytest.raises(ValueError, match=r"claims 4.1e\+03 GiB, the most is 1 .*; see `minari list local`"):
        sipe.from_minari("tests/own-v0")


def test_without_what_is_needed(minari: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ValueError, match="dataset: nothing/there-v0 cannot be read"):
        sipe.from_minari("nothing/there-v0")
    with pytest.raises(ValueError, match="cannot be read as a Minari data set"):
        sipe.from_minari(Path(__file__).parent)
    monkeypatch.setitem(sys.modules, "minari", None)
    with pytest.raises(ModuleNotFoundError, match=r"^Minari is not installed: pip install 'minari\[hdf5\]'$"):
        sipe.from_minari("nothing/there-v0")
