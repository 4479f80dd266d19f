"""Plans for the hand: synergies, the search on a known function, interruption, and a ball that is lifted."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sipe_bayes as sipe
from sipe_bayes.envs.tasks.adroit import Adroit
from sipe_bayes.rl import planning
from sipe_bayes.rl.planning import OUTLINES, Plan, Search, Synergies, plan
from sipe_bayes.simulation.simulator import Simulator

TASKS = tuple(OUTLINES)


def adroit(name: str) -> Adroit:
    task = sipe.make_task(name)
    assert isinstance(task, Adroit)
    return task


@pytest.mark.parametrize("name", TASKS)
def test_synergies_ask_for_what_the_outline_says(name: str) -> None:
    task = adroit(name)
    synergies = Synergies(task, 201)
    model = task.published
    zero = task.control(model, np.empty(0), synergies.actions(np.zeros_like(synergies.outline())))
    np.testing.assert_allclose(zero, 0, atol=1e-12)
    commands = task.control(model, np.empty(0), synergies.actions(synergies.outline()))
    for time, asked in OUTLINES[name].knots.items():
        for joint, value in asked.items():
            names = {"knuckles": ["FFJ2", "LFJ2"], "tips": ["MFJ1", "RFJ0"]}.get(joint, [joint])
            low, high = model.actuator_ctrlrange[model.actuator(f"A_{names[0]}").id]
            for actuator in names:
                found = commands[round(200 * time), model.actuator(f"A_{actuator}").id]
                assert found == pytest.approx(np.clip(value, low, high), abs=0.02), (time, actuator)
    with pytest.raises(KeyError):
        model.actuator("A_none")


def test_search_finds_the_best_of_a_known_function(monkeypatch: pytest.MonkeyPatch) -> None:
    simulator = Simulator(adroit("Relocate"), 1)
    start = Synergies(adroit("Relocate"), 200).outline()
    best = start + np.random.default_rng(0).uniform(-0.3, 0.3, start.shape)

    def distance(simulator: Any, synergies: Any, knots: np.ndarray, *_: Any) -> np.ndarray:
        return -((knots - best) ** 2).sum((1, 2))

    monkeypatch.setattr(planning, "_score", distance)
    found = plan(simulator, 0, Search(population=200, elites=20, iterations=60))
    assert isinstance(found, Plan)
    before, after = (float(np.sqrt(((knots - best) ** 2).mean())) for knots in (start, found.knots))
    assert after < before / 5, (before, after)


def test_an_interrupted_search_goes_on(tmp_path: Path) -> None:
    simulator, search = Simulator(adroit("Relocate"), 1), {"population": 4, "elites": 2, "repeats": 1}
    whole = plan(simulator, 1, Search(iterations=3, **search))  # type: ignore[arg-type]
    plan(simulator, 1, Search(iterations=1, **search), tmp_path / "plan")  # type: ignore[arg-type]
    lines: list[tuple[str, int, int]] = []
    resumed = plan(
        simulator,
        1,
        Search(iterations=3, **search),  # type: ignore[arg-type]
        tmp_path / "plan",
        lambda *line: lines.append(line),
    )
    assert [line[1:] for line in lines] == [(2, 3), (3, 3)]
    np.testing.assert_array_equal(whole.knots, resumed.knots)
    assert whole.score == resumed.score
    with pytest.raises(ValueError, match="belongs to another run"):
        plan(simulator, 2, Search(iterations=3, **search), tmp_path / "plan")  # type: ignore[arg-type]


def test_the_outline_already_lifts_the_ball() -> None:
    task = adroit("Relocate")
    simulator, synergies = Simulator(task, 1), Synergies(task, task.episode_steps)
    start, _ = task.initial_states(np.random.default_rng(0), 1)
    moved = simulator.rollout(task.theta("default"), synergies.actions(synergies.outline())[None], start)
    gap = np.linalg.norm(moved.observations[0, :, 36:], axis=-1)
    assert gap[0] > 0.15
    assert gap[-1] < 0.1
