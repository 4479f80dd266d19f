"""Meta-learning: both gradient steps, its budget, what it counts, and what it knows."""

from __future__ import annotations

import numpy as np
import torch
from torch.func import functional_call

import sipe_bayes as sipe
from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.inference import get_estimator
from sipe_bayes.inference.amortised.maml import MAML, _estimate
from sipe_bayes.inference.amortised.prior_sampling import recorded_steps
from sipe_bayes.models.training import restore
from sipe_bayes.models.transitions import control_steps
from tests.problems.counted import TRUTH, Breaking, Counting
from tests.problems.linear_map import MATRIX, SPACE
from tests.problems.linear_map import TRUTH as CORNER
from tests.problems.pendulums import log, pendulum
from tests.problems.quick import FORM


def test_mamls_outer_gradient_goes_through_the_inner_step() -> None:
    """Against plain autograd with create_graph, one task; the first-order gradient differs."""
    method = MAML(pendulum(), neighbours=2, hidden=5)
    network = method._network(3, 0)
    rng = torch.Generator().manual_seed(0)
    inputs, theta, good = torch.randn(4, 6, 3, generator=rng), torch.rand(4, 2, generator=rng), torch.ones(4, 6)
    tasks, pool = torch.tensor([0]), torch.arange(4)
    fixed = torch.Generator().manual_seed(1)
    ours = method._meta_loss(network, inputs, theta, good)(tasks, pool, fixed).sum()
    parameters = dict(network.named_parameters())
    outer = torch.autograd.grad(ours, list(parameters.values()))
    picked = torch.randint(6, (6,), generator=torch.Generator().manual_seed(1))
    near = (theta[1:] - theta[0]).norm(dim=1).argsort()[:2] + 1

    def mean_square(weights: dict[str, torch.Tensor], rows: torch.Tensor) -> torch.Tensor:
        out = functional_call(network, weights, (inputs[rows][:, picked],))
        return (out - theta[rows][:, None]).square().mean()

    inner = torch.autograd.grad(mean_square(parameters, near), list(parameters.values()), create_graph=True)
    moved = {n: w - method.options.learning_rate * g for (n, w), g in zip(parameters.items(), inner, strict=True)}
    plain = torch.autograd.grad(mean_square(moved, tasks), list(parameters.values()))
    for a, b in zip(outer, plain, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-7)


def test_maml_without_gradient_steps_simulates_nothing_more() -> None:
    simulator = Counting()
    recorded = log(simulator, TRUTH, 1, steps=60)
    simulator.lanes = 0
    for steps, reserved in ((0, 0), (2, 10)):
        estimator = get_estimator(simulator, "maml", budget=100, gradient_steps=steps, iterations=20)
        estimator.fit(recorded)
        assert estimator.rollouts == 100
        assert estimator.reserved == reserved
    assert simulator.lanes == 200


def trained(budget: int = 150) -> tuple[MAML, Counting, Trajectories]:
    """After meta-training, before the first step at test time."""
    simulator = Counting()
    method = MAML(simulator, budget=budget, **FORM["maml"])
    recorded = Trajectories.stack(log(simulator, TRUTH, 1, steps=60))
    while method.state is None or method.state.learned is None:
        method.update_parameter_estimate(recorded)
    return method, simulator, recorded


def test_a_step_at_test_time_goes_down_the_gradient() -> None:
    """Against plain autograd on the same simulations near the estimate."""
    method, _, recorded = trained()
    state = method.state
    assert state is not None
    steps = recorded_steps(recorded)
    network = method._network(steps.shape[-1], 0)
    assert state.learned is not None
    restore(network, state.learned.content.weights)
    rng = np.random.default_rng([method.seed, 4, 0])
    theta = _estimate(network, steps) + method.options.spread * rng.standard_normal((method.options.neighbours, 2))
    made = method.simulate(np.clip(theta, 0, 1), recorded, rng)
    inputs = torch.from_numpy(control_steps(made.observations, recorded.actions, recorded.length))
    targets = torch.tensor(made.theta, dtype=torch.float32)[:, None]

    def loss() -> torch.Tensor:
        return (network(network.standardise(inputs)) - targets).square().mean()

    before = float(loss().detach())
    slopes = torch.autograd.grad(loss(), list(network.parameters()))
    expected = [
        p.detach() - method.options.learning_rate * g for p, g in zip(network.parameters(), slopes, strict=True)
    ]
    adapted = method.step(state, recorded).adapted
    assert adapted is not None
    restore(network, adapted.weights)
    for found, wanted in zip(network.parameters(), expected, strict=True):
        torch.testing.assert_close(found.detach(), wanted)
    assert float(loss().detach()) < before


def test_adapting_ends_where_the_budget_does() -> None:
    """Trained for one log, adapted to two: 25 rollouts are left, a step takes 10."""
    method, simulator, _ = trained()
    both = [log(simulator, TRUTH, k, steps=60) for k in (1, 2)]
    simulator.lanes = 0
    for _ in range(10):
        method.update_parameter_estimate(both)
    assert simulator.lanes == 20
    assert method.rollouts == 145
    assert method.ended
    assert any("ran out" in w for w in method.warnings)


def test_invalid_simulations_near_the_estimate_are_counted() -> None:
    recorded, simulator = log(pendulum(), TRUTH, 1, steps=60), Breaking()
    method = MAML(simulator, budget=150, spread=0.3, **FORM["maml"])
    method.fit(recorded)
    lost = simulator.broken - method.diagnostics["invalid_simulations"]
    assert lost > 0
    assert any(w.startswith(f"{lost} of 25 simulations near the estimate diverged") for w in method.warnings)


def test_it_knows_more_than_the_prior() -> None:
    """A linear function, the truth in a corner: an eighth of the prior mean's error."""
    simulator = sipe.CallableSimulator(lambda v: v @ MATRIX.T, SPACE, name="linear")
    found = MAML(simulator, budget=200, iterations=60, tasks=5).fit(MATRIX @ CORNER).mean.numpy()
    error = np.abs(found - SPACE.normalise(CORNER)).mean()
    trivial = np.abs(0.5 - SPACE.normalise(CORNER)).mean()
    print(error, trivial)
    assert error < trivial / 8
