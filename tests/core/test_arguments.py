"""What a user may get wrong is named in one line when an estimator is made, not in its fit.

And the guide in the docstring runs.
"""

from __future__ import annotations

import inspect
import sys
import textwrap
import types
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from sipe_bayes.core.findings import Code
from sipe_bayes.inference import get_estimator
from sipe_bayes.inference.base import Estimator
from sipe_bayes.models.training import Training
from sipe_bayes.posterior import IndependentPrior
from tests.problems.pendulums import log, pendulum


@pytest.mark.parametrize(
    ("name", "settings", "words"),
    [
        ("npe", {"transforms": "3"}, "transforms: expected a whole number, got '3'"),
        ("npe", {"transforms": 2.7}, "transforms: expected a whole number, got 2.7"),
        ("npe", {"batch_size": 2.5}, "batch_size: expected a whole number, got 2.5"),
        ("npe", {"bins": 1}, "bins: expected at least 2, got 1"),
        ("npe", {"patience": 0}, "patience: expected at least 1, got 0"),
        ("npe", {"learning_rate": "x"}, "learning_rate: expected a positive number, got 'x'"),
        ("npe", {"held_out": "x"}, "held_out: expected a share above 0 and below 1, got 'x'"),
        ("npe", {"embedding": 3}, "embedding: expected one of transitions, regressed, robust, none, got 3"),
        ("npe", {"device": "meta"}, "device: 'meta' is not available here"),
        ("npe", {"device": 3.5}, "device: 3.5 is not available here"),
        ("abc", {"regression": "no"}, "regression: expected True or False, got 'no'"),
        ("abc", {"cache": 5}, "cache: expected a path, got 5"),
        ("abc", {"checkpoint": 5}, "checkpoint: expected a path, got 5"),
        ("abc", {"progress": 3}, "progress: expected a function .*, got 3"),
        ("laplace", {"likelihood": "white"}, r"likelihood: expected sipe.Segments\(...\), got 'white'"),
        ("laplace", {"restarts": 0}, "^restarts: expected at least 1, got 0$"),
        ("laplace", {"candidates": -1}, "^candidates: expected at least 0, got -1$"),
        ("mcmc", {"restarts": "a"}, "restarts: expected a whole number, got 'a'"),
        ("mcmc", {"walkers": 5}, "walkers: expected at least 6, got 5"),
        ("mcmc", {"effective": 0}, "effective: expected at least 1, got 0"),
        ("cem", {"reward": "learned"}, "cem: no setting 'reward'"),
        ("cem", {"learning_rate": 0.1}, "cem: no setting 'learning_rate'"),
        ("cem", {"discriminator_batch": 10}, "cem: no setting 'discriminator_batch'"),
    ],
)
def test_estimators(name: str, settings: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=words) as raised:
        get_estimator(pendulum(), name, **settings)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"batch": "x"}, "batch: expected a whole number, got 'x'"),
        ({"epochs": 0}, "epochs: expected at least 1, got 0"),
        ({"held_out": 1.0}, "held_out: expected a share"),
        ({"learning_rate": 0.0}, "learning_rate: expected a positive number"),
        ({"weight_decay": -1}, "weight_decay: expected at least 0, got -1"),
    ],
)
def test_training(settings: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        Training(**settings)


def test_too_few_simulations_are_not_called_invalid() -> None:
    trajectory = log(pendulum(), [0.6, 0.05], 1, steps=60)
    with pytest.raises(ValueError, match=r"^budget: 3 of 3 simulations are valid, abc needs 10; raise the budget$"):
        get_estimator(pendulum(), "abc", budget=3).fit(trajectory)


@pytest.mark.parametrize(
    ("name", "words"), [("simopt", "does not use the prior"), ("adr", "only to begin"), ("cem", "only to begin")]
)
def test_what_a_search_makes_of_a_prior_is_said(name: str, words: str) -> None:
    """The first generation of adr and cem comes from it: from a narrow one, within it."""
    simulator = pendulum()
    prior = IndependentPrior([0.9, 0.5], [1e-3, float("inf")], simulator.space)
    fit = get_estimator(simulator, name, prior=prior, budget=6)
    fit.fit(log(simulator, [0.6, 0.05], 1, steps=60))
    assert any(words in w for w in fit.warnings), fit.warnings
    began_there = bool((np.abs(fit.state.pool.theta[:, 0] - 0.9) < 0.01).all())  # type: ignore[union-attr]
    assert began_there == (words == "only to begin")


def test_the_guides_example_is_an_estimator(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its code, as printed: it spends the budget, keeps the best, resumes, and is better than the prior mean."""
    code = textwrap.dedent(inspect.getdoc(Estimator).split("keeps the best::")[1].split("``find``")[0])  # type: ignore[union-attr]
    module = types.ModuleType("a_users_own")
    monkeypatch.setitem(sys.modules, module.__name__, module)  # where its annotations are looked up
    exec(code, names := vars(module))
    simulator = pendulum()
    truth = simulator.space.normalise(np.array([0.45, 0.16]))
    made = [names["RandomSearch"](simulator, budget=60, seed=2, checkpoint=tmp_path / "state") for _ in "ab"]
    one, again = (fit.fit(log(simulator, [0.45, 0.16], 3)) for fit in made)
    assert made[0].rollouts == 60
    assert torch.equal(one.mean, again.mean)
    assert np.abs(one.mean.numpy() - truth).mean() < 0.5 * np.abs(0.5 - truth).mean()
    other = names["RandomSearch"](simulator, budget=60, seed=3)
    assert other.fit(log(simulator, [0.45, 0.16], 3)).mean.tolist() != one.mean.tolist()
    assert not set(other.state.theta[:, 0]) & set(made[0].state.theta[:, 0])
    lost = other.state.cost.copy()
    lost[int(lost.argmin())] = np.inf  # the best diverges
    assert (
        other.posterior(replace(other.state, cost=lost), None).mean.tolist()
        != other.posterior(other.state, None).mean.tolist()
    )
    (noticed,) = other.findings.of(Code.DIVERGED_COUNT_AS_WORST)
    assert noticed.text.startswith("1 of 60 simulations diverged")
