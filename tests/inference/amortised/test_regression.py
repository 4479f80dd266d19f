"""Linear regression by stochastic gradient: its gradient, its end, its inputs' units."""

from __future__ import annotations

import numpy as np
import torch

import sipe_bayes as sipe
from sipe_bayes.inference.amortised.regression import LinearMap, Regression
from tests.problems.linear_map import MATRIX, SPACE, TRUTH


def fitted(unit: np.ndarray | float = 1.0, **settings: float) -> tuple[Regression, np.ndarray]:
    """Of x = unit M theta the estimator and its estimate, in physical units."""
    simulator = sipe.CallableSimulator(lambda v: unit * (v @ MATRIX.T), SPACE, name="linear")
    method = Regression(simulator, budget=300, **settings)
    return method, SPACE.values(method.fit(unit * (MATRIX @ TRUTH)).mean.numpy())


def test_regression_descends_the_gradient_of_autograd() -> None:
    torch.manual_seed(0)
    network, inputs, targets = LinearMap(3, 2), torch.randn(7, 3), torch.randn(7, 2)
    slope, bias = torch.autograd.grad((network.map(inputs) - targets).square().mean(), list(network.parameters()))
    before = [p.detach().clone() for p in network.parameters()]
    network.descend(inputs, targets, 0.1)
    torch.testing.assert_close(network.slope.data, before[0] - 0.1 * slope)
    torch.testing.assert_close(network.bias.data, before[1] - 0.1 * bias)


def test_it_trains_to_its_end() -> None:
    """A linear function is inverted to 0.002 of the range; cut short, it is not."""
    method, found = fitted()
    print(found, method.diagnostics)
    np.testing.assert_allclose(found, TRUTH, atol=0.004)
    assert method.diagnostics["converged"]
    assert not method.warnings
    assert np.abs(fitted(iterations=500)[1] - TRUTH).max() > 0.3


def test_inputs_in_other_units_give_the_same() -> None:
    plain, other = (fitted(unit, learning_rate=1e-2)[1] for unit in (1.0, np.array([1e6, 1.0, 1e-9])))
    np.testing.assert_allclose(other, plain, atol=1e-3)


def test_whitened_inputs_have_unit_covariance_and_no_flat_direction() -> None:
    rng = torch.Generator().manual_seed(0)
    steps = torch.randn(5000, 4, generator=rng) @ torch.randn(4, 4, generator=rng)
    steps = torch.cat([steps, steps[:, :1] + steps[:, 1:2], torch.ones(5000, 1)], 1)
    steps[7] = torch.nan
    network = LinearMap(6, 2)
    network.fit_inputs(steps)
    inputs = network.inputs(steps[steps.isfinite().all(1)]).double()
    covariance, expected = torch.cov(inputs.T), torch.tensor([0.0, 0, 1, 1, 1, 1], dtype=torch.float64).diag()
    torch.testing.assert_close(covariance, expected, atol=1e-3, rtol=0)
