"""What simopt, adr and cem have in common, checked alike: budget, seed, support, resuming, divergence, several logs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from sipe_bayes.core.trajectory import Trajectory
from sipe_bayes.inference import get_estimator
from sipe_bayes.likelihood import BoundLikelihood
from sipe_bayes.simulation.simulator import Simulator
from tests.problems.pendulums import log, pendulum

VALUES = [0.45, 0.16]


class Interrupted(Exception):
    """Stands for a killed process."""


def problem(steps: int = 200) -> tuple[Simulator, Trajectory, np.ndarray]:
    """A pendulum, its log and the true theta, which is far from the prior's mean in both parameters."""
    simulator = pendulum()
    trajectory = log(simulator, VALUES, 3, steps=steps)
    return simulator, trajectory, simulator.space.normalise(np.array(VALUES))


def check_recovery(name: str, budget: int, factor: float, seeds: int = 3, **settings: Any) -> None:
    """The mean error, averaged over seeds, is ``factor`` times smaller than the prior mean's."""
    simulator, trajectory, theta = problem()
    errors = []
    for seed in range(seeds):
        fit = get_estimator(simulator, name, budget=budget, seed=seed, **settings)
        errors.append(float(np.abs(fit.fit(trajectory).mean.numpy() - theta).mean()))
        assert budget - fit.rollouts < 20 or fit.state.done
    trivial = float(np.abs(0.5 - theta).mean())
    print(name, settings, "mean |error|", np.round(errors, 4), "prior mean", round(trivial, 3))
    assert np.mean(errors) * factor < trivial, (errors, trivial)


def check_contract(name: str, budget: int, **settings: Any) -> None:
    """Two logs of different lengths: budget kept and used, same seed same posterior, other seed another, support."""
    simulator = pendulum()
    logs = [log(simulator, VALUES, 1, "a", steps=200), log(simulator, VALUES, 2, "b", steps=150)]
    logs[0].observations[20:40] = np.nan
    fits = [get_estimator(simulator, name, seed=s, budget=budget, **settings) for s in (1, 1, 2)]
    one, same, other = (f.fit(logs) for f in fits)
    assert torch.equal(one.theta, same.theta)
    assert torch.equal(one.weights, same.weights)
    assert not torch.equal(one.theta, other.theta)
    assert ((one.theta >= 0) & (one.theta <= 1)).all()
    assert budget - 2 < fits[0].rollouts <= budget
    assert one.chains is None
    assert not one.has_density


def check_resumes(name: str, budget: int, tmp_path: Path, **settings: Any) -> None:
    """Killed after its first step and started again, it gives the undisturbed posterior, and counts the same."""
    simulator, trajectory, _ = problem()
    whole = get_estimator(simulator, name, seed=4, budget=budget, **settings)
    expected = whole.fit(trajectory)

    def kill(*_: Any) -> None:
        raise Interrupted

    arguments = {"seed": 4, "budget": budget, "checkpoint": tmp_path / "state.safetensors", **settings}
    first = get_estimator(simulator, name, progress=kill, **arguments)
    first.checkpoint_seconds = -1.0
    with pytest.raises(Interrupted):
        first.fit(trajectory)
    assert 0 < first.rollouts < budget
    again = get_estimator(simulator, name, **arguments)
    resumed = again.fit(trajectory)
    assert again.rollouts == whole.rollouts
    assert torch.equal(resumed.theta, expected.theta)
    assert torch.equal(resumed.weights, expected.weights)


def check_divergence(name: str, budget: int, monkeypatch: pytest.MonkeyPatch, **settings: Any) -> None:
    """A tenth of the prior diverges: the rest is searched, and a warning says so. Where all diverge, an error does."""
    simulator, trajectory, theta = problem()
    plain = BoundLikelihood.simulate

    def partly(windows: Any, thetas: np.ndarray) -> np.ndarray:
        predicted = plain(windows, thetas).copy()
        predicted[thetas[:, 0] > limit, -1, 5:] = np.nan
        return predicted

    monkeypatch.setattr(BoundLikelihood, "simulate", partly)
    limit = 0.9
    fit = (
        get_estimator(simulator, name, seed=0, budget=budget, initial_mean=1.0, **settings)
        if name == "simopt"
        else (get_estimator(simulator, name, seed=0, budget=budget, **settings))
    )
    posterior = fit.fit(trajectory)
    assert fit.diagnostics["diverged"] > 0
    assert any("diverged" in sentence for sentence in fit.warnings)
    assert fit.rollouts <= budget
    assert float(posterior.mean[0]) < 0.9
    assert np.abs(posterior.mean.numpy() - theta).mean() < np.abs(0.5 - theta).mean()
    limit = -1.0
    with pytest.raises(ValueError, match="none of them valid"):
        get_estimator(simulator, name, seed=0, budget=budget, **settings).fit(trajectory)


def check_other_trajectories(name: str, **settings: Any) -> None:
    """Each step may look at other trajectories: the pool starts anew, the search goes on.

    A budget of too little says so.
    """
    simulator, trajectory, _ = problem()
    another = log(simulator, VALUES, 9, steps=120)
    fit = get_estimator(simulator, name, seed=0, budget=2000, **settings)
    fit.update_parameter_estimate(trajectory)
    used = fit.rollouts
    fit.update_parameter_estimate(another)
    assert fit.rollouts > used
    assert fit.state.simulated == fit.rollouts
    assert len(fit.state.pool.theta) <= fit.rollouts - used
    fit.get_parameter_estimate(another)
    with pytest.raises(ValueError, match="raise it"):
        get_estimator(simulator, name, budget=1, **settings).fit([trajectory, another])
