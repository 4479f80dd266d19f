"""What amortised methods learned is kept: for which logs, and in a checkpoint."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import sipe_bayes as sipe
from sipe_bayes.core.checkpoint import CheckpointError
from sipe_bayes.core.findings import Code
from sipe_bayes.core.trajectory import Trajectories, Trajectory
from sipe_bayes.inference import get_estimator
from sipe_bayes.inference.base import Estimator
from sipe_bayes.posterior import Posterior
from sipe_bayes.simulation.simulator import Simulator
from tests.problems.counted import TRUTH, Counting
from tests.problems.pendulums import log, pendulum, repeated
from tests.problems.quick import FORM

METHODS = ("abc", "bayessim", "npe", "regression", "maml")
BUDGET, TEST_TIME = 100, 25  # rollouts; of these what maml takes at test time
NOISE = 0.01  # rad, of ``repeated``
ACTIONS = log(pendulum(), TRUTH, 1, steps=60).actions


def draws(posterior: Posterior) -> torch.Tensor:
    return posterior.sample((50,), generator=torch.Generator().manual_seed(0))


def made(simulator: Simulator, name: str, **settings: Any) -> Estimator:
    """Its noise is stated, so that training depends on nothing that was observed."""
    stated = {"likelihood": sipe.Segments(noise_sd=(NOISE,)), "budget": BUDGET, "seed": 1}
    return get_estimator(simulator, name, **{**stated, **FORM.get(name, {}), **settings})


def at_test_time(name: str) -> int:
    return TEST_TIME if name == "maml" else 0


def states_log(simulator: Simulator, seed: int) -> Trajectory:
    return repeated(simulator, ACTIONS, states=True, seed=seed)


def trained(name: str = "abc") -> tuple[Simulator, Estimator, Trajectory]:
    simulator = pendulum()
    recorded = log(simulator, TRUTH, 1, steps=60)
    estimator = get_estimator(simulator, name, budget=100, **FORM.get(name, {}))
    estimator.fit(recorded)
    return simulator, estimator, recorded


@pytest.mark.parametrize("name", ["abc", "npe"])
def test_a_log_of_the_same_experiment_needs_no_other_simulations(name: str) -> None:
    simulator, estimator, recorded = trained(name)
    estimator.get_parameter_estimate(repeated(simulator, recorded.actions))
    assert not any("another experiment" in w for w in estimator.warnings), estimator.warnings


@pytest.mark.parametrize("name", ["abc", "npe"])
@pytest.mark.parametrize("what", ["actions", "starting states", "number or lengths"])
def test_a_log_of_another_experiment_is_named(name: str, what: str) -> None:
    simulator, estimator, recorded = trained(name)
    logs = {
        "actions": repeated(simulator, recorded.actions + 0.05),
        "starting states": repeated(simulator, recorded.actions, angle=0.5),
        "number or lengths": repeated(simulator, recorded.actions[:50]),
    }
    estimator.get_parameter_estimate(logs[what])
    said = [w for w in estimator.warnings if "another experiment; fit again" in w]
    assert len(said) == 1, estimator.warnings
    assert f"the log's {what} differ" in said[0]


def test_recorded_starting_states_are_compared_exactly() -> None:
    """A velocity does not show in the first sample of an angle."""
    simulator = pendulum()
    actions = log(simulator, TRUTH, 1, steps=60).actions
    estimator = get_estimator(simulator, "abc", budget=100)
    whole = repeated(simulator, actions, states=True)
    estimator.fit(whole)
    estimator.get_parameter_estimate(whole)
    assert not any("another experiment" in w for w in estimator.warnings)
    assert whole.states is not None
    moving = whole.states.copy()
    moving[:, 2] += 0.1
    estimator.get_parameter_estimate(replace(whole, states=moving))
    assert any("starting states differ" in w for w in estimator.warnings)


def of_training(estimator: Estimator) -> list[str]:
    """Its warnings, without what the log in hand says."""
    return [item.text for item in estimator.findings if item.code is not Code.AT_BOUND]


@pytest.mark.parametrize("name", METHODS)
def test_a_second_fit_conditions(name: str) -> None:
    """No simulations but those of maml's test time, and what conditioning by hand and a fit of its own give."""
    simulator = Counting()
    estimator = made(simulator, name)
    estimator.fit(states_log(simulator, 5))
    assert estimator.rollouts == BUDGET
    warnings, other = of_training(estimator), states_log(simulator, 6)
    simulator.lanes, began = 0, time.perf_counter()
    posterior = estimator.fit(other)
    print(f"{name}: second fit {time.perf_counter() - began:.3f} s")
    assert simulator.lanes == estimator.rollouts == at_test_time(name)
    assert of_training(estimator) == warnings
    by_hand = estimator.posterior(estimator.state, Trajectories.stack(other))
    assert torch.equal(draws(posterior), draws(by_hand))
    alone = made(pendulum(), name)
    assert torch.equal(draws(posterior), draws(alone.fit(other)))
    assert estimator.diagnostics == alone.diagnostics


@pytest.mark.parametrize("name", METHODS)
def test_retrain_begins_from_nothing(name: str) -> None:
    """Also for a measured log, from whose noise and start the first training was."""
    simulator = Counting()
    first, other = (repeated(simulator, ACTIONS, seed=k) for k in (5, 6))
    estimator = made(simulator, name)
    estimator.fit(first)
    simulator.lanes = 0
    posterior = estimator.fit(other, retrain=True)
    assert simulator.lanes == estimator.rollouts == BUDGET
    assert torch.equal(draws(posterior), draws(made(pendulum(), name).fit(other)))
    simulator.lanes = 0
    estimator.fit(first)
    assert simulator.lanes == at_test_time(name)


def test_any_method_takes_retrain() -> None:
    """Where nothing is learned that lasts, a checkpoint is replaced."""
    method = made(pendulum(), "cem")
    recorded = log(pendulum(), TRUTH, 1, steps=60)
    assert torch.equal(draws(method.fit(recorded)), draws(method.fit(recorded, retrain=True)))
    with pytest.raises(ValueError, match="retrain: expected True or False, got 'yes'"):
        method.fit(recorded, retrain="yes")  # type: ignore[arg-type]


def lacking(trajectory: Trajectory) -> Trajectory:
    observations = trajectory.observations.copy()
    observations[20:25] = np.nan
    return replace(trajectory, observations=observations)


OTHER_FORMS: dict[str, Callable[[Simulator], Any]] = {
    "actions": lambda s: repeated(s, ACTIONS + 0.05),
    "starting states": lambda s: repeated(s, ACTIONS, angle=0.5),
    "number or lengths": lambda s: repeated(s, ACTIONS[:50]),
    "missing samples": lambda s: lacking(repeated(s, ACTIONS, seed=6)),
    "noise levels": lambda s: repeated(s, ACTIONS, seed=6, sd=0.05),
}


@pytest.mark.parametrize("what", OTHER_FORMS)
def test_trajectories_of_another_form_are_trained_for_anew(what: str) -> None:
    """What a new estimator finds, with a note of why it took so long, which is no warning."""
    simulator = Counting()
    estimator, other = made(simulator, "bayessim", likelihood=sipe.Segments()), OTHER_FORMS[what](simulator)
    estimator.fit(repeated(simulator, ACTIONS))
    simulator.lanes = 0
    posterior = estimator.fit(other)
    assert simulator.lanes == estimator.rollouts == BUDGET
    assert [f"the log's {what} differ" in f.text for f in estimator.findings.of(Code.TRAINED_ANEW)] == [True]
    alone = made(pendulum(), "bayessim", likelihood=sipe.Segments())
    assert torch.equal(draws(posterior), draws(alone.fit(other)))
    assert estimator.warnings == alone.warnings


def test_coarse_logs_with_stated_noise_are_of_one_form() -> None:
    """Of a benchmark's task at 20 Hz, whose start the smoothing of noisy samples misses by many sds."""
    simulator = sipe.Simulator(sipe.make_task("Pendulum"), num_threads=1)
    whole = sipe.demonstrations(simulator, "random", variant="in_distribution", count=1, steps=30)
    theta = np.random.default_rng(1).random((3, len(simulator.space)))
    motion = simulator.replay(theta, whole)
    sd, rng = 0.01 * whole.observations[0].std(0), np.random.default_rng(0)
    noisy = motion.observations + sd * rng.standard_normal(motion.observations.shape)
    logs = replace(motion, observations=noisy, states=None, rewards=None)
    estimator = made(simulator, "bayessim", likelihood=sipe.Segments(noise_sd=tuple(sd)))
    for k, rollouts in enumerate((BUDGET, 0, 0)):
        estimator.fit(logs[k : k + 1])
        assert estimator.rollouts == rollouts, estimator.findings.of(Code.TRAINED_ANEW)


def test_several_logs_are_of_one_form_together() -> None:
    simulator = Counting()
    estimator = made(simulator, "abc")
    pairs = [[repeated(simulator, ACTIONS, seed=2 * k + i) for i in range(2)] for k in range(2)]
    estimator.fit(pairs[0])
    simulator.lanes = 0
    estimator.fit(pairs[1])
    assert simulator.lanes == 0
    estimator.fit(pairs[1][0])
    assert simulator.lanes == BUDGET


def test_another_setting_trains_anew() -> None:
    simulator = Counting()
    estimator = made(simulator, "abc")
    estimator.fit(states_log(simulator, 5))
    estimator.seed = 2
    posterior = estimator.fit(states_log(simulator, 6))
    assert estimator.rollouts == BUDGET
    assert torch.equal(draws(posterior), draws(made(pendulum(), "abc", seed=2).fit(states_log(pendulum(), 6))))


def test_observed_x_of_a_function_are_of_one_form() -> None:
    """And those that only say what is left out are."""
    space = sipe.ParameterSpace([sipe.Parameter("a", 0.0, 1.0), sipe.Parameter("b", 0.0, 1.0)])
    calls: list[int] = []

    def function(values: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        calls.append(len(values))
        return values + 0.1 * rng.standard_normal(values.shape)

    estimator = made(sipe.CallableSimulator(function, space), "bayessim", likelihood=None)  # type: ignore[arg-type]
    estimator.fit([0.4, 0.5])
    calls.clear()
    posterior = estimator.fit([0.7, 0.2])
    assert not calls
    assert posterior.mean[0] > posterior.mean[1]


@pytest.mark.parametrize(
    ("name", "settings"), [*((name, {}) for name in METHODS), ("bayessim", {"features": "random_fourier"})]
)
def test_a_checkpoint_holds_what_was_learned(name: str, settings: dict[str, Any], tmp_path: Path) -> None:
    """For another estimator with the same settings and another log; one of another form is refused."""
    settings = {**settings, "checkpoint": tmp_path / "checkpoint.safetensors"}
    simulator = Counting()
    first = made(simulator, name, **settings)
    first.fit(states_log(simulator, 5))
    for block in tmp_path.glob("simulations/*/*"):
        block.unlink()
    second, other = made(simulator, name, **settings), states_log(simulator, 6)
    simulator.lanes = 0
    posterior = second.fit(other)
    assert simulator.lanes == second.rollouts == at_test_time(name)
    assert torch.equal(draws(posterior), draws(first.fit(other)))
    longer = repeated(simulator, np.tile(ACTIONS, (2, 1)))
    with pytest.raises(CheckpointError, match=r"trajectories of another form; .* fit\(..., retrain=True\)"):
        made(simulator, name, **settings).fit(longer)
    replaced = made(simulator, name, **settings).fit(longer, retrain=True)
    assert torch.equal(draws(replaced), draws(made(simulator, name, **settings).fit(longer)))


@pytest.mark.parametrize("name", ["bayessim", "npe"])
def test_rounds_target_one_observation(name: str) -> None:
    simulator = Counting()
    estimator, other = made(simulator, name, rounds=2), states_log(simulator, 6)
    estimator.fit(states_log(simulator, 5))
    simulator.lanes = 0
    posterior = estimator.fit(other)
    assert simulator.lanes == estimator.rollouts == BUDGET
    assert torch.equal(draws(posterior), draws(made(pendulum(), name, rounds=2).fit(other)))


def test_what_steps_have_learned_is_kept_too() -> None:
    simulator = Counting()
    estimator = made(simulator, "abc")
    recorded, other = (states_log(simulator, k) for k in (5, 6))
    while not estimator.ended:
        estimator.update_parameter_estimate(recorded)
    simulator.lanes = 0
    estimator.fit(other)
    assert simulator.lanes == estimator.rollouts == 0
