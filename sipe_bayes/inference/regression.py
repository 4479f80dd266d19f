"""Linear regression of theta on single control steps, by stochastic gradient: the SiPE paper's baseline.

B. Mehta, A. Handa, D. Fox, F. Ramos 2020, "A User's Guide to Calibrating Robotics Simulators", section 2.3 and appendix: a single
layer maps each concatenated (s, a, s') to theta; mean squared error, plain stochastic gradient, learning rate 0.001, batch 320.
The estimate is the average over the recorded control steps: a Dirac.

Deviations: inputs are standardised, and s' enters as s' - s (the same linear maps, better conditioned); at most 200 control
steps of each simulation are used, spread evenly; training stops when held-out simulations no longer improve; the
average is clipped to the cube.
"""

from __future__ import annotations

from typing import Any, ClassVar

import torch
from torch import nn

from sipe_bayes.checks import positive, share, whole
from sipe_bayes.inference.prior_sampling import PriorSampling, recorded_steps
from sipe_bayes.inference.simulations import Simulations
from sipe_bayes.inference.state import State
from sipe_bayes.models.training import EarlyStopping, restore, split, weights
from sipe_bayes.models.transitions import Standardise, control_steps
from sipe_bayes.posterior import Dirac
from sipe_bayes.trajectory import Trajectories


class Regression(PriorSampling):
    """A Dirac; see the module's docstring.

    learning_rate, batch: of the stochastic gradient, in control steps. epochs: passes at most. held_out: share of the
    simulations; patience: passes without a lower loss of theirs.
    """

    name: ClassVar[str] = "regression"

    def __init__(
        self,
        simulator: Any,
        *,
        learning_rate: float = 1e-3,
        batch: int = 320,
        epochs: int = 100,
        held_out: float = 0.1,
        patience: int = 5,
        **settings: Any,
    ) -> None:
        super().__init__(simulator, **settings)
        self.learning_rate = positive("learning_rate", learning_rate)
        self.batch, self.epochs = whole("batch", batch), whole("epochs", epochs)
        self.held_out, self.patience = share("held_out", held_out), whole("patience", patience)

    def settings(self) -> dict[str, Any]:
        own = ("learning_rate", "batch", "epochs", "held_out", "patience")
        return {**super().settings(), **{name: getattr(self, name) for name in own}}

    def train(self, simulations: Simulations, trajectories: Trajectories) -> State:
        generator = torch.Generator().manual_seed(self.seed)
        steps = torch.from_numpy(control_steps(simulations.observations, trajectories.actions, trajectories.length))
        theta = torch.tensor(simulations.theta, dtype=torch.float32)
        network = _Linear(steps.shape[-1], len(self.space))
        network.standardise.fit(steps)
        network.bias.data.copy_(theta.mean(0))
        inside, outside = split(len(theta), self.held_out, generator)
        inputs, targets = _rows(network, steps[inside], theta[inside])
        held_inputs, held_targets = _rows(network, steps[outside], theta[outside])
        stopping = EarlyStopping(network, self.patience, relative=1e-4)
        for _ in range(self.epochs):
            order = torch.randperm(len(inputs), generator=generator)
            with torch.no_grad():
                for chosen in order.split(self.batch):
                    network.descend(inputs[chosen], targets[chosen], self.learning_rate)
                loss = float((network.map(held_inputs) - held_targets).square().mean())
            if stopping.stops(loss):
                break
        stopping.restore()
        return {**weights(network), "held_out_loss": float(stopping.best)}

    def infer(self, state: State, trajectories: Trajectories) -> Dirac:
        steps = recorded_steps(trajectories)
        network = _Linear(steps.shape[-1], len(self.space))
        restore(network, state)
        with torch.no_grad():
            estimate = network.map(network.standardise(steps)).double().mean(0)
        self.diagnostics["held_out_loss"] = state["held_out_loss"]
        return Dirac(estimate.clamp(0, 1), self.space)


class _Linear(nn.Module):
    """Control steps (..., F) to theta (..., N)."""

    def __init__(self, features: int, n: int) -> None:
        super().__init__()
        self.standardise = Standardise(features)
        self.slope = nn.Parameter(torch.zeros(features, n))
        self.bias = nn.Parameter(torch.zeros(n))

    def descend(self, inputs: torch.Tensor, targets: torch.Tensor, rate: float) -> None:
        """One step down the gradient of the mean squared error, written out: autograd would take most of the time."""
        slope = (self.map(inputs) - targets) * (-2 * rate / targets.numel())
        self.slope.data.addmm_(inputs.T, slope)
        self.bias.data.add_(slope.sum(0))

    def map(self, standardised: torch.Tensor) -> torch.Tensor:
        return standardised @ self.slope + self.bias


def _rows(network: _Linear, steps: torch.Tensor, theta: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Finite control steps (m, F), standardised, and the theta (m, N) that each was simulated with."""
    good = steps.isfinite().all(-1)
    return network.standardise(steps[good]), theta[:, None].expand(-1, steps.shape[1], -1)[good]
