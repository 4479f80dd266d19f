"""Linear regression of theta on single control steps, by stochastic gradient: the SiPE paper's baseline.

B. Mehta, A. Handa, D. Fox, F. Ramos 2020, "A User's Guide to Calibrating Robotics Simulators", section 2.3 and appendix: a single
layer maps each concatenated (s, a, s') to theta; mean squared error, plain stochastic gradient, learning rate 0.001, batch 320.
The estimate is the average over the recorded control steps: a Dirac.

Deviations: s' enters as s' - s, and inputs x (F,) with mean m and covariance C = V diag(l) V' enter as z = diag(l)^-1/2 V' (x - m).
The linear maps are the same ones, but the time of plain gradient descent goes as 1 / l, and half-cheetah's standardised inputs have l
from 5 to 7e-4: its error is half-way from the prior mean's to least squares' after 10^5 steps, on z there after 10^4. At most 200
control steps of each simulation are used, spread evenly; training stops when held-out simulations no longer improve; the average is
clipped to the cube.
"""

from __future__ import annotations

from typing import Any, ClassVar

import torch
from torch import nn

from sipe_bayes.core.checkpoint import State
from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.core.validation import positive, share, whole
from sipe_bayes.inference.amortised.prior_sampling import PriorSampling, recorded_steps
from sipe_bayes.inference.amortised.simulations import Simulations
from sipe_bayes.models.training import EarlyStopping, restore, split, weights
from sipe_bayes.models.transitions import Standardise, control_steps
from sipe_bayes.posterior import Dirac

_LOOK = 500  # steps at least between two looks at the held-out simulations
_RELATIVE, _ABSOLUTE = 1e-4, 1e-8  # by which a look's loss must be lower
_FLAT = 1e-8  # of the largest variance: what float32's rounding leaves of none
_ROWS = 20_000  # whose covariance is taken at once


class Regression(PriorSampling):
    """A Dirac; see the module's docstring.

    learning_rate, batch: of the stochastic gradient, in control steps. iterations: gradient steps at most. held_out: share of the
    simulations; patience: looks at them, one pass or 500 steps apart, without a lower loss.
    """

    name: ClassVar[str] = "regression"

    def __init__(
        self,
        simulator: Any,
        *,
        learning_rate: float = 1e-3,
        batch: int = 320,
        iterations: int = 1_000_000,
        held_out: float = 0.1,
        patience: int = 5,
        **settings: Any,
    ) -> None:
        super().__init__(simulator, **settings)
        self.learning_rate = positive("learning_rate", learning_rate)
        self.batch, self.iterations = whole("batch", batch), whole("iterations", iterations)
        self.held_out, self.patience = share("held_out", held_out), whole("patience", patience)

    def settings(self) -> dict[str, Any]:
        own = ("learning_rate", "batch", "iterations", "held_out", "patience")
        return {**super().settings(), **{name: getattr(self, name) for name in own}}

    def train(self, simulations: Simulations, trajectories: Trajectories) -> State:
        generator = torch.Generator().manual_seed(self.seed)
        steps = torch.from_numpy(control_steps(simulations.observations, trajectories.actions, trajectories.length))
        theta = torch.tensor(simulations.theta, dtype=torch.float32)
        network = _Linear(steps.shape[-1], len(self.space))
        inside, outside = split(len(theta), self.held_out, generator)
        network.fit_inputs(steps[inside])
        network.bias.data.copy_(theta.mean(0))
        inputs, targets = _rows(network, steps[inside], theta[inside])
        held_inputs, held_targets = _rows(network, steps[outside], theta[outside])
        stopping, taken, looked = EarlyStopping(network, self.patience, absolute=_ABSOLUTE, relative=_RELATIVE), 0, 0
        while taken < self.iterations:
            order = torch.randperm(len(inputs), generator=generator).split(self.batch)
            for chosen in order[: self.iterations - taken]:
                network.descend(inputs[chosen], targets[chosen], self.learning_rate)
            taken += min(len(order), self.iterations - taken)
            if taken < min(looked + _LOOK, self.iterations):
                continue
            looked = taken
            if stopping.stops(float((network.map(held_inputs) - held_targets).square().mean().detach())):
                break
        stopping.restore()
        converged = stopping.waited >= self.patience
        self.still_improving(converged, taken, "gradient steps", "iterations, or learning_rate")
        loss = float(stopping.best)
        return {**weights(network), "held_out_loss": loss, "iterations": taken, "converged": converged}

    def infer(self, state: State, trajectories: Trajectories) -> Dirac:
        steps = recorded_steps(trajectories)
        network = _Linear(steps.shape[-1], len(self.space))
        restore(network, state)
        with torch.no_grad():
            estimate = network.map(network.inputs(steps)).double().mean(0)
        self.diagnostics.update({name: state[name] for name in ("held_out_loss", "iterations", "converged")})
        return Dirac(estimate.clamp(0, 1), self.space)


class _Linear(nn.Module):
    """Control steps (..., F) to theta (..., N)."""

    whiten: torch.Tensor

    def __init__(self, features: int, n: int) -> None:
        super().__init__()
        self.standardise = Standardise(features)
        self.register_buffer("whiten", torch.eye(features))
        self.slope = nn.Parameter(torch.zeros(features, n))
        self.bias = nn.Parameter(torch.zeros(n))

    def fit_inputs(self, steps: torch.Tensor) -> None:
        """Take mean and covariance from steps (..., F); directions in which they hardly vary become zero."""
        self.standardise.fit(steps)
        covariance = torch.zeros(self.whiten.shape, dtype=torch.float64)
        rows = steps[steps.isfinite().all(-1)]
        for part in self.standardise(rows).split(_ROWS):
            covariance.addmm_(part.double().T, part.double())
        variance, axes = torch.linalg.eigh(covariance / len(rows))
        scale = torch.where(variance > _FLAT * variance[-1], variance, torch.inf).rsqrt()
        self.whiten.copy_(axes * scale)

    def inputs(self, steps: torch.Tensor) -> torch.Tensor:
        """Control steps (..., F) as the map takes them."""
        return torch.as_tensor(self.standardise(steps) @ self.whiten)

    @torch.no_grad()
    def descend(self, inputs: torch.Tensor, targets: torch.Tensor, rate: float) -> None:
        """One step down the gradient of the mean squared error, written out: autograd would take most of the time."""
        slope = (self.map(inputs) - targets) * (-2 * rate / targets.numel())
        self.slope.data.addmm_(inputs.T, slope)
        self.bias.data.add_(slope.sum(0))

    def map(self, inputs: torch.Tensor) -> torch.Tensor:
        return inputs @ self.slope + self.bias


def _rows(network: _Linear, steps: torch.Tensor, theta: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Finite control steps (m, F), whitened, and the theta (m, N) that each was simulated with."""
    good = steps.isfinite().all(-1)
    return network.inputs(steps[good]), theta[:, None].expand(-1, steps.shape[1], -1)[good]
