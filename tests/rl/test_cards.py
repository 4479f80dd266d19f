"""Agents that are kept, evaluated and installed, with their cards."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import sipe_bayes as sipe
from sipe_bayes.cli.app import app
from sipe_bayes.models.policy import load_policy
from sipe_bayes.rl.evaluation import check_agents, evaluate, install, references, write_card
from sipe_bayes.rl.train import CurvePoint, choose
from tests.problems.policies import policy


def test_choice_of_the_agents() -> None:
    earned = ((10, 5.0), (20, 9.0), (30, 1.0), (40, 3.0), (50, 2.0))
    rows = [CurvePoint(step, mean, 0.0, None, 0.0, 0.0) for step, mean in earned]
    assert choose(rows, 50) == {"suboptimal": 30, "expert": 40}
    assert choose(rows[:1], 10) == {"suboptimal": 10, "expert": 10}


def test_evaluation_is_that_of_single_episodes() -> None:
    agent = policy(task="FetchPush", normalised=False)
    found = evaluate(agent, "FetchPush", episodes=3, seed=5, theta=np.array([0.2, 0.9]))
    returns, success = [], []
    environment = sipe.make("FetchPush")
    for lane in range(3):
        environment.np_random = np.random.default_rng([5, lane])
        observation, _ = environment.reset(options={"theta": np.array([0.2, 0.9])})
        total, over = 0.0, False
        while not over:
            observation, reward, terminated, truncated, info = environment.step(agent(observation[None])[0])
            total, over = total + reward, terminated or truncated
        returns.append(total)
        success.append(info["success"])
    assert found.mean == pytest.approx(np.mean(returns))
    assert found.sd == pytest.approx(np.std(returns, ddof=1))
    assert found.success_rate == np.mean(success)


def test_cards_are_checked(tmp_path: Path) -> None:
    path = tmp_path / "Pendulum-expert.safetensors"
    policy().save(path)
    task = sipe.make_task("Pendulum")
    write_card(path, task, {"seed": 0}, references(task, 20), episodes=20)
    (row,) = check_agents(tmp_path, episodes=20)
    assert row.agrees, row
    card = json.loads(path.with_suffix(".json").read_text())
    card["evaluation"]["mean"] += 10 * card["evaluation"]["standard_error"]
    path.with_suffix(".json").write_text(json.dumps(card))
    (row,) = check_agents(tmp_path, episodes=20)
    assert not row.agrees
    path.with_suffix(".json").unlink()
    with pytest.raises(FileNotFoundError, match=r"Pendulum-expert\.json: no such file; expected the card of Pend"):
        list(check_agents(tmp_path))
    with pytest.raises(FileNotFoundError, match="no agents"):
        list(check_agents(tmp_path / "nowhere"))


def test_a_pair_is_installed_with_its_cards(tmp_path: Path) -> None:
    made, there = tmp_path / "run", tmp_path / "agents"
    for seed, name in enumerate(("expert", "suboptimal")):
        policy(seed).save(made / f"{name}.safetensors")
        with pytest.raises(FileNotFoundError, match=r"expert|suboptimal"):
            install(made, there)  # the card, or the other agent, is missing
        assert not there.exists()
        (made / f"{name}.json").write_text(name)
    paths = install(made, there)
    assert paths == [there / "Pendulum-expert.safetensors", there / "Pendulum-suboptimal.safetensors"]
    assert len(list(there.iterdir())) == 4
    for seed, (path, name) in enumerate(zip(paths, ("expert", "suboptimal"), strict=True)):
        assert path.with_suffix(".json").read_text() == name
        np.testing.assert_array_equal(load_policy(path).layers[0][0], policy(seed).layers[0][0])


def test_commands_train_write_cards_and_check_them(tmp_path: Path) -> None:
    out, runner = tmp_path / "run", CliRunner()
    short = ["--start-steps", "60", "--batch", "8", "--evaluate-every", "50", "--evaluation-episodes", "1"]
    arguments = ["train", "FetchPush", "--steps", "100", "--episodes", "3", "--out", str(out), "--clip-targets", *short]
    done = runner.invoke(app, arguments)
    assert done.exit_code == 0, done.output
    assert f"how it goes: {out / 'curve.csv'}; tensorboard --logdir {out / 'tensorboard'}" in done.output
    assert (out / "curve.csv").read_text().startswith("step,return_mean,")
    assert "expert: return" in done.output
    card = json.loads((out / "suboptimal.json").read_text())
    assert card["deviations"] == {"batch": 8, "start_steps": 60, "clip_targets": True}
    assert (card["kept_at_step"], card["steps"], card["evaluation"]["episodes"]) == (50, 100, 3)
    assert {"idle", "random", "command", "wall_seconds", "versions", "solved_at"} <= card.keys()
    assert list((out / "tensorboard").glob("events*"))
    refused = runner.invoke(app, arguments)
    assert refused.exit_code == 2
    assert "add --resume" in refused.stderr
    card["evaluation"]["mean"] = 1.0
    (out / "suboptimal.json").write_text(json.dumps(card))
    checked = runner.invoke(app, ["agents", str(out), "--episodes", "3"])
    assert checked.exit_code == 1
    assert "BEYOND" in checked.output
