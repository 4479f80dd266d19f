"""Neural posterior estimation and its flow, against exact posteriors.

Networks are small, so tolerances are those of networks of 1,500 simulations: half an sd; a wrong posterior is off by
far more.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import sipe_bayes as sipe
from sipe_bayes.core.parameters import Parameter, ParameterSpace
from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.inference.amortised.npe import NPE
from sipe_bayes.posterior import Flow, IndependentPrior, load_posterior
from sipe_bayes.posterior.flow import spline_flow, to_cube, to_line
from tests.problems import quick
from tests.problems.noisy_sums import QUIET, SPACE, exact, linear, seen
from tests.problems.pendulums import log, pendulum

SMALL: dict[str, Any] = {**quick.SMALL["npe"], "likelihood": QUIET, "patience": 8, "calibration": 0.0}


def seeded(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


@pytest.fixture(scope="module")
def trained() -> tuple[NPE, Flow]:
    method = NPE(linear(), budget=1500, seed=1, **SMALL)
    posterior = method.fit(seen(0.4, 0.5))
    assert isinstance(posterior, Flow)
    return method, posterior


@pytest.mark.parametrize("x", [(0.4, 0.5), (0.02, 0.3), (0.7, 0.6)])
def test_the_exact_posterior_without_training_again(trained: tuple[NPE, Flow], x: tuple[float, float]) -> None:
    """Also where a bound cuts it off (a = 0.02)."""
    method, _ = trained
    assert method.state is not None
    posterior = method.posterior(method.state, Trajectories.stack(seen(*x)))
    mean, sd = exact(*x)
    print(x, (posterior.mean.numpy() - mean) / sd, posterior.stddev.numpy() / sd)
    np.testing.assert_array_less(np.abs(posterior.mean.numpy() - mean), 0.5 * sd)
    np.testing.assert_allclose(posterior.stddev.numpy(), sd, rtol=0.35)
    assert method.rollouts == 1500


def test_the_flow_is_a_density_on_the_cube(trained: tuple[NPE, Flow]) -> None:
    posterior = trained[1]
    uniforms = torch.rand(40_000, 2, dtype=torch.float64, generator=seeded(0))
    density = posterior.log_prob(uniforms).exp()
    assert float(density.mean()) == pytest.approx(1, abs=5 * float(density.std()) / 200)
    draws = posterior.sample((5000,), generator=seeded(1))
    assert ((draws > 0) & (draws < 1)).all()
    assert posterior.log_prob(torch.tensor([1.2, 0.5])) == -torch.inf
    error = (density[:, None] * uniforms).std(0) / 200 + draws.std(0) / 70
    assert ((density[:, None] * uniforms).mean(0) - draws.mean(0)).abs().le(5 * error).all()
    assert float(posterior.log_prob(posterior.mode)) >= float(posterior.log_prob(draws).max())


def test_what_is_saved_is_what_was_fitted(trained: tuple[NPE, Flow], tmp_path: Path) -> None:
    posterior = trained[1]
    posterior.save(tmp_path / "posterior")
    loaded = load_posterior(tmp_path / "posterior")
    draws = posterior.sample((100,), generator=seeded(2))
    assert torch.equal(loaded.sample((100,), generator=seeded(2)), draws)
    assert torch.equal(loaded.log_prob(draws), posterior.log_prob(draws))


def test_the_line_and_the_cube() -> None:
    theta = torch.tensor([1e-5, 0.3, 0.5, 1 - 1e-5], dtype=torch.float64)
    torch.testing.assert_close(to_cube(to_line(theta)), theta)
    assert to_line(torch.tensor([0.0, 1.0])).isfinite().all()


@pytest.mark.parametrize("n", [1, 3, 12])
def test_a_random_flow_of_any_size(n: int) -> None:
    """Drawing and density are inverse to each other: the noise comes back."""
    with torch.random.fork_rng():
        torch.manual_seed(0)
        net = spline_flow(n, 4, 2, 8, 4)
    space = ParameterSpace([Parameter(f"p{j}", 0.0, 1.0) for j in range(n)])
    architecture = {"transforms": 2, "hidden": 8, "bins": 4}
    flow = Flow(net.state_dict(), torch.ones(4), torch.zeros(n), torch.ones(n), space, **architecture)
    draws = flow.sample((50,), generator=seeded(3))
    noise = torch.randn(50, n, dtype=torch.float64, generator=seeded(3))
    torch.testing.assert_close(flow._given().transform(to_line(draws)), noise, atol=1e-6, rtol=1e-6)
    assert flow.marginal([space.names[0]]).mean.shape == (1,)
    with pytest.raises(ValueError, match="weights: expected"):
        Flow(net.state_dict(), torch.ones(5), torch.zeros(n), torch.ones(n), space, **architecture)
    with pytest.raises(ValueError, match="sd: expected positive"):
        Flow(net.state_dict(), torch.ones(4), torch.zeros(n), torch.zeros(n), space, **architecture)


TINY = {**SMALL, "max_epochs": 3, "budget": 120}


def test_the_same_seed_gives_the_same_posterior_and_nothing_global_changes() -> None:
    torch.manual_seed(5)
    before = torch.get_rng_state(), np.random.get_state()[1]  # noqa: NPY002
    one, other, third = (NPE(linear(), seed=s, **TINY).fit(seen(0.4, 0.5)) for s in (3, 3, 4))
    assert torch.equal(torch.get_rng_state(), before[0])
    np.testing.assert_array_equal(np.random.get_state()[1], before[1])  # noqa: NPY002
    draws = [p.sample((50,), generator=seeded(0)) for p in (one, other, third)]
    assert torch.equal(draws[0], draws[1])
    assert not torch.equal(draws[0], draws[2])


def test_sbi_leaves_argument_validation_as_it_was() -> None:
    """In new processes, because sbi does it when first imported; without us it is off afterwards."""
    import subprocess
    import sys

    code = (
        "import os\nfrom torch.distributions import Distribution as D\nimport pyro\n"
        "parent = os.fork() > 0\nD.set_default_validate_args(parent)\n"
        "from sipe_bayes.models.sbi_tools import import_sbi\nimport_sbi('inference')\n"
        "if parent: os.wait()\n"  # one line at a time
        "print('kept' if D._validate_args == parent else 'changed', flush=True)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["kept", "kept"]


def test_a_prior_that_is_not_uniform() -> None:
    """Its draws are what it was trained on: no correction, and the exact posterior under that prior."""
    prior = IndependentPrior([0.6, 0.3], [0.1, 0.15], SPACE)
    posterior = NPE(linear(), prior=prior, budget=1500, seed=2, **SMALL).fit(seen(0.4, 0.4))
    mean, sd = exact(0.4, 0.4, prior)
    print((posterior.mean.numpy() - mean) / sd, posterior.stddev.numpy() / sd)
    np.testing.assert_array_less(np.abs(posterior.mean.numpy() - mean), 0.5 * sd)
    np.testing.assert_allclose(posterior.stddev.numpy(), sd, rtol=0.2)


def test_rounds_sharpen_and_stay_exact() -> None:
    """Two rounds of 400 against one of 800, at a log in a corner: where the truncated prior is small."""
    mean, sd = exact(0.15, 0.2)
    errors, many_steps = {}, {**SMALL, "batch_size": 50, "learning_rate": 3e-3, "max_epochs": 60}
    for rounds in (1, 2):
        method = NPE(linear(), budget=800, seed=0, rounds=rounds, **many_steps)
        posterior = method.fit(seen(0.15, 0.2))
        errors[rounds] = (
            np.abs((posterior.mean.numpy() - mean) / sd).max(),
            np.abs(np.log(posterior.stddev.numpy() / sd)).max(),
        )
        assert method.rollouts == 800
    print(errors, method.diagnostics)
    assert method.diagnostics["truncated_prior_2"] < 0.6
    assert not method.amortised
    assert errors[2][0] < 0.4
    assert errors[2][1] < 0.25
    assert sum(errors[2]) < sum(errors[1]) + 0.15
    assert method.state is not None
    with pytest.raises(ValueError, match="use rounds=1, or fit again"):
        method.posterior(method.state, Trajectories.stack(seen(0.5, 0.5)))


class Interrupted(Exception):
    """Stands for a killed process."""


@pytest.mark.parametrize(("rounds", "stop"), [(1, 2), (2, 2), (2, 4)])
def test_an_interrupted_fit_resumes_to_the_same_posterior(rounds: int, stop: int, tmp_path: Path) -> None:
    trajectory, steps = seen(0.4, 0.5), 0

    def interrupt(*_: Any) -> None:
        nonlocal steps
        steps += 1
        if steps == stop:
            raise Interrupted

    settings: dict[str, Any] = {**TINY, "budget": 230, "rounds": rounds, "seed": 1}
    whole = NPE(linear(), **settings).fit(trajectory)
    first = NPE(linear(), checkpoint=tmp_path / "state.safetensors", progress=interrupt, **settings)
    first.checkpoint_seconds = 0.0
    with pytest.raises(Interrupted):
        first.fit(trajectory)
    resumed = NPE(linear(), checkpoint=tmp_path / "state.safetensors", **settings).fit(trajectory)
    assert torch.equal(whole.sample((50,), generator=seeded(0)), resumed.sample((50,), generator=seeded(0)))


def test_trajectories_of_a_pendulum_with_missing_samples() -> None:
    """Two logs of different lengths through the embedding of control steps."""
    simulator = pendulum()
    logs = [log(simulator, [0.6, 0.05], 1, "a", steps=120), log(simulator, [0.6, 0.05], 2, "b", steps=80)]
    logs[0].observations[20:40] = np.nan
    settings = {k: v for k, v in SMALL.items() if k not in ("embedding", "likelihood")}
    method = NPE(simulator, budget=600, seed=0, **settings)
    posterior = method.fit(logs)
    truth = simulator.space.normalise(np.array([0.6, 0.05]))
    print(posterior.mean, posterior.stddev, truth, method.diagnostics)
    assert method.rollouts == 600
    assert (np.abs(posterior.mean.numpy() - truth) < 4 * posterior.stddev.numpy()).all()
    assert posterior.stddev[0] < 0.2


def test_a_log_unlike_all_simulations_is_reported() -> None:
    method = NPE(linear(), **TINY)
    method.fit(seen(4.0, -3.0))
    assert any("unlike" in w for w in method.warnings)
    method = NPE(linear(), **TINY)
    method.fit(seen(0.4, 0.5))
    assert not any("unlike" in w for w in method.warnings)


def test_wrong_input() -> None:
    simulator = linear()
    gap = sipe.Trajectory(np.array([[0.0, 0.0], [np.nan, 0.1]]), np.zeros((1, 0)), 1.0)
    missing = log(pendulum(), [0.6, 0.05], 1, steps=60)
    missing.observations[1::2] = np.nan
    longer = sipe.Trajectory(np.zeros((3, 2)), np.zeros((2, 0)), 1.0)
    trained = NPE(simulator, **TINY)
    trained.fit(seen(0.4, 0.5))
    assert trained.state is not None
    table: list[tuple[Any, str]] = [
        (lambda: NPE(simulator, embedding="lstm"), "embedding: expected one of transitions, regressed, robust, none"),
        (lambda: NPE(simulator, rounds=0), "rounds: expected at least 1"),
        (lambda: NPE(simulator, bins=1), "bins: expected at least 2"),
        (lambda: NPE(simulator, learning_rate=0.0), "learning_rate"),
        (lambda: NPE(simulator, **TINY).fit(gap), r"x: npe learns from whole ones, but x\[0\] is NaN"),
        (lambda: NPE(pendulum(), embedding="none", budget=50).fit(missing), "use 'transitions'"),
        (lambda: NPE(pendulum(), max_epochs=1, budget=50, embedding="transitions").fit(missing), "no control step"),
        (lambda: NPE(simulator, **{**TINY, "budget": 5}).fit(seen(0.4, 0.5)), "raise the budget"),
        (lambda: trained.posterior(trained.state, Trajectories.stack(longer)), "logs of one length only"),
    ]
    for call, words in table:
        with pytest.raises(ValueError, match=words):
            call()
