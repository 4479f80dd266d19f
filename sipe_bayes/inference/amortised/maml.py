"""Model-agnostic meta-learning: a regression that a few gradient steps adapt to where the estimate lies.

C. Finn, P. Abbeel, S. Levine 2017, "Model-Agnostic Meta-Learning for Fast Adaptation of Deep Networks"
(https://arxiv.org/abs/1703.03400), in the regression setting of the SiPE paper (Mehta, Handa, Fox, Ramos 2020,
appendix): two hidden layers of 60 units map a control step (s, a, s') to theta; inner and outer rate 0.005; the outer
gradient is taken through the inner step (second order). A task is a random theta. Its support are simulations near it,
its query its own,

    w' = w - alpha grad L(w; support),    w <- w - beta grad sum_tasks L(w'; query),

so that training rehearses what happens at test time: ``gradient_steps`` times, simulate a few theta near the present
estimate, take one inner step on them, and estimate again from the recorded control steps. The answer is a Dirac. A
second ``fit`` keeps what meta-training has learned and adapts to its own log.

Deviations:

- The papers do not say what the data at test time are, since the recorded trajectory has no labels; simulations near
  the estimate give them. Neighbours in training are the nearest other simulations of the prior.
- The outer step is Adam's.
- Inputs are standardised; s' enters as s' - s; training stops when held-out tasks no longer improve.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import torch
from torch import Generator, Tensor, from_numpy, nn
from torch.func import functional_call, grad, vmap

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.budget import BudgetExhausted
from sipe_bayes.core.findings import Code
from sipe_bayes.core.options import Options, option
from sipe_bayes.core.seeding import seed_integer
from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.inference.amortised.prior_sampling import (
    PriorSampling,
    PriorSamplingOptions,
    PriorSamplingState,
    recorded_steps,
)
from sipe_bayes.inference.amortised.simulations import Simulations
from sipe_bayes.inference.recorded import digest
from sipe_bayes.models.training import (
    EarlyStopping,
    TrainedNetwork,
    Weights,
    check_device,
    descend,
    restore,
    split,
    weights,
)
from sipe_bayes.models.transitions import Standardise, control_steps
from sipe_bayes.posterior import Dirac

Tensors = dict[str, Tensor]
TaskLoss = Callable[[Tensor, Tensor, Generator], Tensor]


@dataclass(frozen=True)
class MAMLOptions(PriorSamplingOptions):
    """Options of ``MAML``."""

    gradient_steps: int = option(5, "at test time", least=0)
    neighbours: int = option(5, "simulations that one of them takes", least=1)
    spread: float = option(0.1, "sd of their theta about the estimate", "of the range", above=0)
    hidden: int = option(60, "units of both layers, as in the paper", least=1)
    learning_rate: float = option(0.005, "of the inner and the outer loop, as in the paper", above=0)
    tasks: int = option(10, "in a meta-batch", least=1)
    steps_per_simulation: int = option(40, "that enter one gradient", "control steps", least=1)
    iterations: int = option(1000, "outer steps at most", least=1)
    held_out: float = option(0.1, "share of the simulations that is not trained on", above=0, below=1)
    patience: int = option(8, "looks at those without improvement that end the training", least=1)
    look_every: int = option(50, "between two looks", "outer steps", least=1)
    device: str = option("cpu", "where meta-training runs")

    def __post_init__(self) -> None:
        """Check, also the device."""
        super().__post_init__()
        check_device(self.device)


@dataclass(frozen=True)
class Adapted:
    """Where test time has come to.

    Attributes:
        weights: of the network.
        steps: gradient steps taken.
        near: simulations near the estimate.
        invalid: of these.
    """

    weights: Weights
    steps: int = 0
    near: int = 0
    invalid: int = 0


@dataclass(frozen=True)
class MAMLState(PriorSamplingState[TrainedNetwork]):
    """How far a fit is. adapted: None before the first gradient step at test time."""

    adapted: Adapted | None = None


class MAML(PriorSampling[MAMLState, TrainedNetwork]):
    """Second-order meta-learning, gradient steps on simulations near the estimate. A Dirac."""

    name: ClassVar[str] = "maml"
    amortised: ClassVar[bool] = False  # it simulates for every log
    options_type: ClassVar[type[Options]] = MAMLOptions
    state_type: ClassVar = MAMLState
    options: MAMLOptions

    @property
    def reserved(self) -> int:
        """Those that test time takes."""
        return self.options.gradient_steps * self.options.neighbours

    def step(self, state: MAMLState, trajectories: Trajectories) -> MAMLState:
        """A block of simulations, the meta-training, or one gradient step at test time."""
        if state.learned is not None:
            return self._adapt(state, trajectories)
        state = super().step(state, trajectories)
        return replace(state, done=state.learned is not None and not self.options.gradient_steps)

    def recall(self, state: MAMLState, trajectories: Trajectories) -> MAMLState:
        """After meta-training, before test time."""
        return replace(state, log=digest(trajectories), adapted=None, done=not self.options.gradient_steps)

    def train(self, simulations: Simulations, trajectories: Trajectories) -> TrainedNetwork:
        """Meta-training; ``passes`` are outer steps."""
        options, seed = self.options, seed_integer([self.seed, 3])
        generator = Generator().manual_seed(seed)
        steps = from_numpy(control_steps(simulations.observations, trajectories.actions, trajectories.length))
        theta = torch.tensor(simulations.theta, dtype=torch.float32)
        network = self._network(steps.shape[-1], seed)
        network.standardise.fit(steps)
        network.begin_at(theta.mean(0))
        network.to(options.device)
        with torch.no_grad():
            inputs = network.standardise(steps.to(options.device)).nan_to_num()
        good, targets = steps.isfinite().all(-1).float().to(options.device), theta.to(options.device)
        loss = self._meta_loss(network, inputs, targets, good)
        inside, outside = split(len(theta), options.held_out, generator)
        parameters = list(network.parameters())
        optimiser = torch.optim.Adam(parameters, options.learning_rate, foreach=True)
        stopping = EarlyStopping(network, options.patience, absolute=1e-5)
        for k in range(1, options.iterations + 1):
            # an outer step on a meta-batch
            chosen = inside[torch.randint(len(inside), (options.tasks,), generator=generator)]
            descend(optimiser, parameters, loss(chosen, inside, generator).mean())
            # a look at a hundred held-out tasks, always with the same draws
            if k % options.look_every and k < options.iterations:
                continue
            fixed = Generator().manual_seed(seed)
            if stopping.stops(float(loss(outside[:100], inside, fixed).mean().detach())):
                break
        trained = stopping.finish(k)
        self.still_improving(trained.converged, k, "iterations", "iterations")
        return trained

    def _meta_loss(self, network: Regressor, inputs: Tensor, theta: Tensor, good: Tensor) -> TaskLoss:
        """Query losses (t,) after the inner step, of tasks (t,), the rows of their neighbours, and a generator."""
        options = self.options

        def inner(weights: Tensors, steps: Tensor, target: Tensor, weight: Tensor) -> Tensor:
            error = (functional_call(network, weights, (steps,)) - target[:, None]).square().mean(-1)
            return (error * weight).sum() / weight.sum().clamp_min(1)

        def adapted_loss(weights: Tensors, support: tuple[Tensor, ...], query: tuple[Tensor, ...]) -> Tensor:
            gradient = grad(inner)(weights, *support)
            moved = {name: w - options.learning_rate * gradient[name] for name, w in weights.items()}
            return inner(moved, *query)

        batched = vmap(adapted_loss, in_dims=(None, 0, 0))

        def loss(tasks: Tensor, pool: Tensor, generator: Generator) -> Tensor:
            # the nearest others in the pool
            distance = torch.cdist(theta[tasks], theta[pool])
            distance = distance + (tasks[:, None] == pool).to(distance) * 1e6
            near = pool[distance.topk(min(options.neighbours, len(pool) - 1), largest=False).indices.cpu()]
            # some of the control steps, the same ones of all
            count = min(options.steps_per_simulation, inputs.shape[1])
            picked = torch.randint(inputs.shape[1], (count,), generator=generator)
            support = (inputs[near][:, :, picked], theta[near], good[near][:, :, picked])
            query = (inputs[tasks][:, None, picked], theta[tasks][:, None], good[tasks][:, None, picked])
            return batched(dict(network.named_parameters()), support, query)

        return loss

    def _adapt(self, state: MAMLState, trajectories: Trajectories) -> MAMLState:
        """One gradient step on simulations near the estimate; raises BudgetExhausted."""
        options, count = self.options, self.options.neighbours
        if self.rollouts + count * len(trajectories) > self.budget:
            raise BudgetExhausted(f"{count} simulations near the estimate are not left of {self.budget} rollouts")
        before = self._adapted(state)
        steps = recorded_steps(trajectories)
        network = self._restored(before, steps)
        # simulations about the estimate
        rng = np.random.default_rng([self.seed, 4, before.steps])
        around = options.spread * rng.standard_normal((count, len(self.space)))
        made = self.simulate(np.clip(_estimate(network, steps) + around, 0, 1), trajectories, rng)
        self.rollouts += count * len(trajectories)
        # one step down their gradient
        usable = made.usable()
        if len(usable):
            inputs = from_numpy(control_steps(usable.observations, trajectories.actions, trajectories.length))
            targets = torch.tensor(usable.theta, dtype=torch.float32)[:, None].expand(-1, inputs.shape[1], -1)
            good = inputs.isfinite().all(-1)
            error = (network(network.standardise(inputs[good])) - targets[good]).square().mean()
            parameters = list(network.parameters())
            for parameter, slope in zip(parameters, torch.autograd.grad(error, parameters), strict=True):
                parameter.data.sub_(options.learning_rate * slope)
        near, invalid = before.near + count, before.invalid + count - len(usable)
        adapted = Adapted(weights(network), before.steps + 1, near, invalid)
        return replace(state, adapted=adapted, done=adapted.steps == options.gradient_steps)

    def posterior(self, state: MAMLState, trajectories: Trajectories) -> Dirac:
        """As the base's, of the network as it is adapted so far."""
        adapted = state.adapted
        if adapted is not None and state.learned is not None:
            now = replace(state.learned, content=replace(state.learned.content, weights=adapted.weights))
            state = replace(state, learned=now)
        estimate = super().posterior(state, trajectories)
        near, invalid = (0, 0) if adapted is None else (adapted.near, adapted.invalid)
        self.diagnostics.update(near=near, near_invalid=invalid)
        if invalid:
            failure = self.simulator.failure
            self.find(Code.INVALID_NEAR_ESTIMATE, invalid=invalid, made=near, failure=failure)
        assert isinstance(estimate, Dirac)  # as infer makes it
        return estimate

    def infer(self, learned: TrainedNetwork, trajectories: Trajectories) -> Dirac:
        """The network's estimate."""
        steps = recorded_steps(trajectories)
        self.diagnostics |= learned.summary("iterations")
        return Dirac(_estimate(self._restored(Adapted(learned.weights), steps), steps), self.space)

    def _adapted(self, state: MAMLState) -> Adapted:
        """Where test time has come to, also before its first step."""
        if state.adapted is not None:
            return state.adapted
        assert state.learned is not None  # meta-training comes first
        return Adapted(state.learned.content.weights)

    def _restored(self, adapted: Adapted, steps: Tensor) -> Regressor:
        network = self._network(steps.shape[-1], 0)
        restore(network, adapted.weights)
        return network

    def _network(self, features: int, seed: int) -> Regressor:
        with torch.random.fork_rng():
            torch.manual_seed(seed)
            return Regressor(features, self.options.hidden, len(self.space))


class Regressor(nn.Module):
    """Standardised control steps (..., F) to theta (..., N): two hidden layers."""

    def __init__(self, features: int, hidden: int, n: int) -> None:
        super().__init__()
        self.standardise = Standardise(features)
        self.layers = nn.Sequential(
            nn.Linear(features, hidden), nn.ReLU(), nn.Linear(hidden, hidden), nn.ReLU(), nn.Linear(hidden, n)
        )

    def begin_at(self, theta: Tensor) -> None:
        """Answer with about theta (N,) at first."""
        last = self.layers[-1]
        with torch.no_grad():
            last.weight.mul_(0.1)  # type: ignore[operator]
            last.bias.copy_(theta)  # type: ignore[operator]

    def forward(self, steps: Tensor) -> Tensor:
        """What theta (..., N) steps (..., F) tell."""
        out: Tensor = self.layers(steps)
        return out


def _estimate(network: Regressor, steps: Tensor) -> FloatArray:
    """Mean (N,) over recorded control steps (M, F), in the cube."""
    with torch.no_grad():
        mean: FloatArray = network(network.standardise(steps)).double().mean(0).numpy()
    return np.clip(mean, 0, 1)
