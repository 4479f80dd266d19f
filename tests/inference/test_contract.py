"""The Estimator contract, for every method of the registry."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from sipe_bayes.core.checkpoint import CheckpointError
from sipe_bayes.core.findings import Code
from sipe_bayes.core.parameters import Parameter, ParameterSpace
from sipe_bayes.core.trajectory import Trajectories, Trajectory
from sipe_bayes.inference import ESTIMATORS, get_estimator
from sipe_bayes.inference.base import Estimator
from sipe_bayes.inference.registry import arguments, estimator_class
from sipe_bayes.posterior import IndependentPrior, Posterior, load_posterior, uniform
from sipe_bayes.simulation.simulator import Simulator
from tests.problems.pendulums import log, pendulum
from tests.problems.quick import FORM

NAMES = list(ESTIMATORS)
BUDGET = 150
TRUTH = [0.6, 0.05]


def quick(name: str, budget: int = BUDGET) -> dict[str, Any]:
    """Budget and settings where only form counts."""
    return {"budget": budget, **FORM.get(name, {})}


def draws(posterior: Posterior, count: int = 200) -> torch.Tensor:
    return posterior.sample((count,), generator=torch.Generator().manual_seed(0))


class Fragile(Simulator):
    """A pendulum that diverges half-way wherever its rod is among the heaviest tenth."""

    def __init__(self) -> None:
        super().__init__(pendulum().environment, num_threads=1)
        self.lost = 0

    def rollout(self, theta: Any, *args: Any, **settings: Any) -> Trajectories:
        made = super().rollout(theta, *args, **settings)
        half = made.observations.shape[1] // 2
        bad = np.broadcast_to(np.atleast_2d(theta)[:, 0] > 0.9, (len(made),))
        self.lost += int(bad.sum())
        late = bad[:, None] & (np.arange(made.observations.shape[1]) >= half)
        return replace(
            made, observations=np.where(late[..., None], np.nan, made.observations), valid=made.valid & ~late
        )


def recorded() -> list[Trajectory]:
    """Two logs of different lengths with missing samples."""
    logs = [log(pendulum(), TRUTH, 1, "a", steps=120), log(pendulum(), TRUTH, 2, "b", steps=90)]
    logs[0].observations[20:40] = np.nan
    return logs


@cache
def undisturbed(name: str) -> tuple[Estimator, Posterior]:
    """A fit of ``recorded`` that nothing interrupts."""
    estimator = get_estimator(pendulum(), name, seed=3, **quick(name))
    return estimator, estimator.fit(recorded())


@pytest.mark.parametrize("name", NAMES)
def test_support_seeds_budget_and_files(name: str, tmp_path: Path) -> None:
    """The same seed gives the same bits; a saved posterior is the same."""
    estimator, one = undisturbed(name)
    other = get_estimator(pendulum(), name, seed=3, **quick(name)).fit(recorded())
    assert draws(one).dtype == torch.float64
    assert draws(one).shape == (200, 2)
    assert ((draws(one) >= 0) & (draws(one) <= 1)).all()
    assert one.mean.shape == one.stddev.shape == one.mode.shape == (2,)
    assert 0 < estimator.rollouts <= estimator.budget
    assert torch.equal(draws(one), draws(other))
    one.save(tmp_path / "posterior")
    again = load_posterior(tmp_path / "posterior")
    assert torch.equal(draws(one), draws(again))
    assert torch.equal(one.mean, again.mean)
    if one.has_density:
        theta = torch.rand(50, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
        assert torch.equal(one.log_prob(theta), again.log_prob(theta))


@pytest.mark.parametrize("name", NAMES)
def test_every_setting_is_part_of_what_tells_runs_apart(name: str) -> None:
    """Whatever an estimator takes by name changes the result, but for where it works and what it tells.

    And for a budget with more of which a fit goes on.
    """
    silent = {"simulator", "settings", "options", "checkpoint", "progress", "cache", "device"}
    silent |= {"budget"} if estimator_class(name).goes_on else set()
    taken = {p for c in estimator_class(name).__mro__[:-1] for p in inspect.signature(c).parameters}
    stated = get_estimator(pendulum(), name).settings()
    assert taken - silent <= set(stated), taken - silent - set(stated)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda s: get_estimator(s, "abc", seed="one"), "seed: expected a whole number, got 'one'"),
        (lambda s: get_estimator(s, "abc", seed=None), "seed: expected a whole number, got None"),
        (lambda s: get_estimator(s, "abc", seed=0.5), "seed: expected a whole number, got 0.5"),
        (lambda s: get_estimator(s, "abc", seed=-1), "seed: expected at least 0, got -1"),
        (lambda s: get_estimator(s, "abc", budget="all"), "budget: expected a whole number, got 'all'"),
        (lambda s: get_estimator(s, "abc", budget=True), "budget: expected a whole number"),
        (lambda s: get_estimator(s, "abc", budget=0), "budget: expected at least 1 rollout, got 0"),
        (lambda s: get_estimator(s, "abc", prior="file"), "prior: expected a posterior with a density"),
        (lambda s: get_estimator(s, "abc", accepted="few"), "accepted: expected a share above 0 and at most 1"),
        (lambda s: get_estimator(s, "abc", accepted=1.5), "accepted: expected a share above 0 and at most 1"),
        (lambda s: get_estimator(s, "regression", held_out=1.0), "held_out: expected a share"),
        (lambda s: get_estimator(s, "maml", spread=0), "spread: expected a positive number"),
        (lambda s: get_estimator(s, "maml", look_every=1.5), "look_every: expected a whole number"),
        (lambda s: get_estimator(s, "bayessim", hidden=1), "hidden: expected at least 2"),
        (lambda s: get_estimator(s, "bayessim", summary_features=0), "summary_features: expected at least 1"),
        (lambda s: get_estimator(s, "bayessim", training={"epochs": 3}), "training: expected models.training.Training"),
        (lambda s: get_estimator(s, "bayessim", truncated=0), "truncated: expected a share"),
        (lambda s: get_estimator(s, "simopt", damping=-1), "damping: expected at least 0"),
        (lambda s: get_estimator(s, "simopt", discriminator_batch=1), "discriminator_batch: expected at least 2"),
        (lambda s: get_estimator(s, "adr", ridge=0), "ridge: expected a positive number"),
        (lambda s: get_estimator(s, "bayesopt", growth=0.5), "growth: expected at least 1"),
        (lambda s: get_estimator([s], "abc"), "simulator: expected a Simulator"),
        (lambda s: Simulator("Pendulum"), r"environment: expected an Environment.*make_task"),
        (lambda s: Simulator(s.environment, num_threads=0), "num_threads: expected at least 1"),
        (lambda s: ParameterSpace({"mass": (0, 1)}), "parameters: expected a list of Parameters, got a dict"),
        (lambda s: ParameterSpace("mass"), "parameters: expected a list of Parameters, got a str"),
        (lambda s: ParameterSpace(["mass"]), "parameters: expected a list of Parameters, got a list of other"),
        (lambda s: ParameterSpace(Parameter("mass")), "parameters: expected a list of Parameters, got a Parameter"),
        (lambda s: Parameter("mass", low="0"), "'mass': expected a number as low, got '0'"),
        (lambda s: Parameter(3), "parameter name: expected a non-empty string, got 3"),
        (lambda s: s.space.values("abc"), "expected numbers, 2 parameters"),
        (lambda s: uniform(s.space).values(-1), "n: expected at least 0, got -1"),
        (lambda s: uniform(s.space).values("ten"), "n: expected a whole number"),
        (lambda s: uniform(s.space).sample(10), r"sample_shape: expected sizes such as \(1000,\)"),
        (lambda s: uniform(s.space).sample((-5,)), "sample_shape: expected at least 0"),
        (lambda s: uniform(s.space).quantile("half"), "q: expected a number"),
    ],
)
def test_wrong_arguments_are_named_in_one_line(call: Callable[[Simulator], Any], words: str) -> None:
    with pytest.raises(ValueError, match=words) as raised:
        call(pendulum())
    assert "\n" not in str(raised.value)


class Interrupted(Exception):
    """Stands for a killed process."""


@pytest.mark.parametrize("name", NAMES)
def test_an_interrupted_fit_resumes_to_the_same_posterior(name: str, tmp_path: Path) -> None:
    simulator = pendulum()
    trajectory = log(simulator, TRUTH, 1, steps=100)
    whole = get_estimator(simulator, name, seed=5, **quick(name))
    posterior = whole.fit(trajectory)
    steps = 0

    def interrupt(*_: Any) -> None:
        nonlocal steps
        steps += 1
        if steps == 1:
            raise Interrupted

    checkpoint = tmp_path / "checkpoint.safetensors"
    settings = {"seed": 5, "checkpoint": checkpoint, **quick(name)}
    first = get_estimator(simulator, name, progress=interrupt, **settings)
    first.checkpoint_seconds = 0.0
    with pytest.raises(Interrupted):
        first.fit(trajectory)
    assert checkpoint.exists()
    for _ in ("in mid-run", "at its end"):
        again = get_estimator(pendulum(), name, **settings)
        assert torch.equal(draws(posterior), draws(again.fit(trajectory)))
        assert repr(again.diagnostics) == repr(whole.diagnostics)
        assert (again.warnings, again.doubts) == (whole.warnings, whole.doubts)
    with pytest.raises(CheckpointError, match="belongs to another run"):
        get_estimator(simulator, name, **{**settings, "seed": 6}).fit(trajectory)
    checkpoint.write_bytes(b"nonsense")
    with pytest.raises(CheckpointError, match="delete it"):
        get_estimator(simulator, name, **settings).fit(trajectory)


def test_a_doubt_survives_an_interruption(tmp_path: Path) -> None:
    class Doubting(type(get_estimator(pendulum(), "cem"))):  # type: ignore[misc]
        def step(self, state: Any, trajectories: Any) -> Any:
            self.find(Code.SEARCH_UNSETTLED, steps=2)
            return super().step(state, trajectories)

    def fitted() -> Any:
        doubting = Doubting(pendulum(), checkpoint=tmp_path / "checkpoint.safetensors", **quick("cem"))
        doubting.fit(log(pendulum(), TRUTH, 1, steps=100))
        return doubting

    first, again = fitted(), fitted()  # the second one only reads
    assert again.findings.blocking == first.findings.blocking
    assert [item.code for item in first.findings.blocking] == [Code.SEARCH_UNSETTLED]
    first.checkpoint = None
    first.step = super(Doubting, first).step
    first.fit(log(pendulum(), TRUTH, 1, steps=100))
    assert not first.doubts


@pytest.mark.parametrize("name", NAMES)
def test_trajectories_of_another_environment_are_refused(name: str) -> None:
    other = Trajectory(np.zeros((101, 3)), np.zeros((100, 1)), 0.01)
    with pytest.raises(ValueError, match="expected observations of the 1 channels"):
        get_estimator(pendulum(), name, budget=BUDGET).fit(other)
    other = Trajectory(np.zeros((101, 1)), np.zeros((100, 2)), 0.01)
    with pytest.raises(ValueError, match="expected 1 actions"):
        get_estimator(pendulum(), name, budget=BUDGET).fit(other)


@pytest.mark.parametrize("name", NAMES)
def test_diverging_simulations_are_survived(name: str) -> None:
    """A tenth of the prior diverges.

    The fit says so and goes on, its mean within a quarter of the range of what it is without.
    """
    simulator, (_, sound) = Fragile(), undisturbed(name)
    fragile = get_estimator(simulator, name, seed=3, **quick(name))
    posterior = fragile.fit(recorded())
    print(name, posterior.mean, sound.mean, fragile.warnings)
    said = any("simulations" in w and "diverged" in w for w in fragile.warnings)
    assert said == (simulator.lost > 0) or estimator_class(name).searches  # to those, a start that diverges is none
    assert torch.isfinite(draws(posterior)).all()
    assert (posterior.mean - sound.mean).abs().max() < 0.25


SUSPICION = {Code.AT_BOUND, Code.BEST_AT_BOUND, Code.UNLIKE_SIMULATIONS}
"""Of which a truth beyond the bounds has to raise one: the base class notes the first where a narrow posterior's median
lies at a bound, methods that simulate the prior the last."""


@pytest.mark.parametrize("name", NAMES)
def test_a_truth_outside_the_prior_raises_suspicion(name: str) -> None:
    """The rod is three times as heavy as the bounds allow. A truth well inside raises none."""
    heavy = light()
    outside = get_estimator(heavy, name, seed=2, **quick(name, 2 * BUDGET))
    outside.fit(log(pendulum(), [0.99, 0.01], 1, steps=200))
    noticed = {item.code for item in outside.findings}
    assert noticed & SUSPICION, (
        f"{name}: expected one of {sorted(map(str, SUSPICION))}, got "
        f"{sorted(map(str, noticed))}; where the base class does not see it, as "
        "the estimate cannot come near a bound, note Code.BEST_AT_BOUND in posterior(), as search/bayesopt.py does"
    )
    inside = get_estimator(heavy, name, seed=2, **quick(name, 2 * BUDGET))
    inside.fit(log(heavy, [0.2, 0.1], 1, steps=200))
    assert not {item.code for item in inside.findings} & SUSPICION, inside.warnings


def light() -> Simulator:
    """A pendulum whose rod is believed to be between 0.1 and 0.3 kg."""
    from sipe_bayes.envs.mjcf import MjcfEnvironment
    from tests.problems.pendulums import XML

    parameters = [
        Parameter("rod_mass", 0.1, 0.33, targets=("body:rod.mass",)),
        Parameter("damping", 0.0, 0.2, targets=("joint:hinge.damping",)),
    ]
    return Simulator(
        MjcfEnvironment.build(XML.replace('mass="0.6"', 'mass="0.2"'), parameters, ["motor"], ["joint:hinge.position"]),
        num_threads=1,
    )


@pytest.mark.parametrize("name", [n for n in NAMES if estimator_class(n).uses_prior])
def test_a_prior_counts(name: str) -> None:
    """A narrow prior far from the data's answer pulls the posterior to it."""
    simulator = pendulum()
    trajectory = log(simulator, TRUTH, 1, steps=100)
    prior = IndependentPrior([0.9, 0.5], [1e-3, float("inf")], simulator.space)
    posterior = get_estimator(simulator, name, prior=prior, **quick(name)).fit(trajectory)
    assert abs(float(posterior.mean[0]) - 0.9) < 2e-2


@pytest.mark.parametrize("name", NAMES)
def test_the_papers_loop(name: str) -> None:
    """update_parameter_estimate as often as one likes, get_parameter_estimate in between; no budget is overdrawn."""
    simulator = pendulum()
    trajectory = log(simulator, TRUTH, 1, steps=100)
    estimator = get_estimator(simulator, name, **quick(name))
    with pytest.raises(ValueError, match="nothing is fitted"):
        estimator.get_parameter_estimate(trajectory)
    for _ in range(40):
        estimator.update_parameter_estimate(trajectory)
    assert estimator.rollouts <= estimator.budget
    assert torch.isfinite(estimator.get_parameter_estimate(trajectory).mean).all()


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
@pytest.mark.parametrize("name", [name for name in NAMES if "device" in arguments(name)])
def test_networks_train_on_a_gpu(name: str) -> None:
    """The posterior comes back to the CPU, in double precision, about the truth as the CPU's does."""
    simulator = pendulum()
    recorded = log(simulator, TRUTH, 1, steps=60)
    there, here = (
        get_estimator(simulator, name, seed=0, device=device, **quick(name)).fit(recorded) for device in ("cuda", "cpu")
    )
    assert draws(there).dtype == torch.float64
    assert draws(there).device.type == "cpu"
    assert torch.allclose(there.mean, here.mean, atol=0.3)
