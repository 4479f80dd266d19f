"""Linear regression of theta on single control steps, by stochastic gradient: the SiPE paper's baseline.

B. Mehta, A. Handa, D. Fox, F. Ramos 2020, "A User's Guide to Calibrating Robotics Simulators", section 2.3 and
appendix: a single layer maps each concatenated (s, a, s') to theta; mean squared error, plain stochastic gradient,
learning rate 0.001, batch 320. The estimate is the average over the recorded control steps: a Dirac.

Deviations:

- s' enters as s' - s, and inputs x (F,) with mean m and covariance C = V diag(l) V' enter as
  z = diag(l)^-1/2 V' (x - m). The linear maps are the same ones, but the time of plain gradient descent goes as 1 / l,
  and half-cheetah's standardised inputs have l from 5 to 7e-4: its error is half-way from the prior mean's to least
  squares' after 10^5 steps, on z there after 10^4.
- At most 200 control steps of each simulation are used, spread evenly.
- Training stops when held-out simulations no longer improve.
- The average is clipped to the cube.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Generator, Tensor, from_numpy, nn

from sipe_bayes.core.options import Options, option
from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.inference.amortised.prior_sampling import (
    PriorSampling,
    PriorSamplingOptions,
    PriorSamplingState,
    recorded_steps,
)
from sipe_bayes.inference.amortised.simulations import Simulations
from sipe_bayes.models.training import EarlyStopping, TrainedNetwork, restore, split
from sipe_bayes.models.transitions import Standardise, control_steps
from sipe_bayes.posterior import Dirac

_FLAT = 1e-8  # of the largest variance: what float32's rounding leaves of none
_ROWS = 20_000  # whose covariance is taken at once, for memory alone


@dataclass(frozen=True)
class RegressionOptions(PriorSamplingOptions):
    """Options of ``Regression``."""

    learning_rate: float = option(1e-3, "of the stochastic gradient, as in the paper", above=0)
    batch: int = option(320, "of the stochastic gradient, as in the paper", "control steps", least=1)
    iterations: int = option(1_000_000, "gradient steps at most", least=1)
    held_out: float = option(0.1, "share of the simulations that is not trained on", above=0, below=1)
    patience: int = option(5, "looks at those, one pass or 500 steps apart, without a lower loss", least=1)


class Regression(PriorSampling[PriorSamplingState[TrainedNetwork], TrainedNetwork]):
    """Linear in single control steps, by stochastic gradient; amortised. A Dirac."""

    name: ClassVar[str] = "regression"
    options_type: ClassVar[type[Options]] = RegressionOptions
    state_type: ClassVar = PriorSamplingState[TrainedNetwork]
    options: RegressionOptions

    def train(self, simulations: Simulations, trajectories: Trajectories) -> TrainedNetwork:
        """The map, at its best look at the held-out simulations."""
        options, generator = self.options, Generator().manual_seed(self.seed)
        steps = from_numpy(control_steps(simulations.observations, trajectories.actions, trajectories.length))
        theta = torch.tensor(simulations.theta, dtype=torch.float32)
        network = LinearMap(steps.shape[-1], len(self.space))
        inside, outside = split(len(theta), options.held_out, generator)
        network.fit_inputs(steps[inside])
        network.bias.data.copy_(theta.mean(0))
        inputs, targets = _rows(network, steps[inside], theta[inside])
        held_inputs, held_targets = _rows(network, steps[outside], theta[outside])
        stopping, taken, looked = EarlyStopping(network, options.patience, 1e-8, relative=1e-4), 0, 0
        while taken < options.iterations:
            # a pass over the rows, or what is left of it
            order = torch.randperm(len(inputs), generator=generator).split(options.batch)
            for chosen in order[: options.iterations - taken]:
                network.descend(inputs[chosen], targets[chosen], options.learning_rate)
            taken += min(len(order), options.iterations - taken)
            # a look at the held-out rows, where the last one is 500 steps ago
            if taken < min(looked + 500, options.iterations):
                continue
            looked = taken
            if stopping.stops(float((network.map(held_inputs) - held_targets).square().mean().detach())):
                break
        trained = stopping.finish(taken)
        self.still_improving(trained.converged, taken, "gradient steps", "iterations, or learning_rate")
        return trained

    def infer(self, learned: TrainedNetwork, trajectories: Trajectories) -> Dirac:
        """The average over the recorded control steps."""
        steps = recorded_steps(trajectories)
        network = LinearMap(steps.shape[-1], len(self.space))
        restore(network, learned.weights)
        with torch.no_grad():
            estimate = network.map(network.inputs(steps)).double().mean(0)
        self.diagnostics |= learned.summary("iterations")
        return Dirac(estimate.clamp(0, 1), self.space)


class LinearMap(nn.Module):
    """Control steps (..., F), whitened, to theta (..., N)."""

    whiten: Tensor

    def __init__(self, features: int, n: int) -> None:
        super().__init__()
        self.standardise = Standardise(features)
        self.register_buffer("whiten", torch.eye(features))
        self.slope = nn.Parameter(torch.zeros(features, n))
        self.bias = nn.Parameter(torch.zeros(n))

    def fit_inputs(self, steps: Tensor) -> None:
        """Take mean and covariance from steps (..., F); directions in which they hardly vary become zero."""
        self.standardise.fit(steps)
        covariance = torch.zeros(self.whiten.shape, dtype=torch.float64)
        rows = steps[steps.isfinite().all(-1)]
        for part in self.standardise(rows).split(_ROWS):
            covariance.addmm_(part.double().T, part.double())
        variance, axes = torch.linalg.eigh(covariance / len(rows))
        scale = torch.where(variance > _FLAT * variance[-1], variance, torch.inf).rsqrt()
        self.whiten.copy_(axes * scale)

    def inputs(self, steps: Tensor) -> Tensor:
        """Control steps (..., F) as the map takes them."""
        return torch.as_tensor(self.standardise(steps) @ self.whiten)

    @torch.no_grad()
    def descend(self, inputs: Tensor, targets: Tensor, rate: float) -> None:
        """One step down the gradient of the mean squared error, written out: autograd would take most of the time.

        Args:
            inputs: (b, F), as ``inputs`` makes them.
            targets: (b, N).
            rate: of learning.
        """
        slope = (self.map(inputs) - targets) * (-2 * rate / targets.numel())
        self.slope.data.addmm_(inputs.T, slope)
        self.bias.data.add_(slope.sum(0))

    def map(self, inputs: Tensor) -> Tensor:
        """What theta (..., N) inputs (..., F) tell."""
        return inputs @ self.slope + self.bias


def _rows(network: LinearMap, steps: Tensor, theta: Tensor) -> tuple[Tensor, Tensor]:
    """Finite control steps (m, F), whitened, and the theta (m, N) that each was simulated with."""
    good = steps.isfinite().all(-1)
    return network.inputs(steps[good]), theta[:, None].expand(-1, steps.shape[1], -1)[good]
