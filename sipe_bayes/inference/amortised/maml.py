"""Model-agnostic meta-learning: a regression that a few gradient steps adapt to where the estimate lies.

C. Finn, P. Abbeel, S. Levine 2017, "Model-Agnostic Meta-Learning for Fast Adaptation of Deep Networks"
(https://arxiv.org/abs/1703.03400), in the regression setting of the SiPE paper (Mehta, Handa, Fox, Ramos 2020, appendix): two
hidden layers of 60 units map a control step (s, a, s') to theta; inner and outer rate 0.005; the outer gradient is taken
through the inner step (second order). A task is a random theta. Its support are simulations near it, its query its own,

    w' = w - alpha grad L(w; support),    w <- w - beta grad sum_tasks L(w'; query),

so that training rehearses what happens at test time: ``gradient_steps`` times, simulate a few theta near the present
estimate, take one inner step on them, and estimate again from the recorded control steps. The answer is a Dirac.

Deviations: the papers do not say what the data at test time are, since the recorded trajectory has no labels; simulations
near the estimate give them. Neighbours in training are the nearest other simulations of the prior. The outer step is Adam's.
Inputs are standardised; s' enters as s' - s; training stops when held-out tasks no longer improve.
"""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.func import functional_call, grad, vmap

from sipe_bayes.core.checkpoint import State
from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.core.validation import positive, share, whole
from sipe_bayes.inference.amortised.prior_sampling import PriorSampling, recorded_steps
from sipe_bayes.inference.amortised.simulations import Simulations
from sipe_bayes.likelihood.settings import BudgetExhausted
from sipe_bayes.models.training import EarlyStopping, check_device, restore, split, weights
from sipe_bayes.models.transitions import Standardise, control_steps
from sipe_bayes.posterior import Dirac

Weights = dict[str, Tensor]


class MAML(PriorSampling):
    """A Dirac; see the module's docstring.

    gradient_steps: at test time, 0 or more. neighbours: simulations that one of them takes, their theta drawn around the
    estimate with sd ``spread`` of the range. hidden: units of both layers. learning_rate: of the inner and the outer loop.
    tasks: in a meta-batch. steps_per_simulation: control steps that enter one gradient. iterations: outer steps at most. held_out:
    share of the simulations; patience: looks at them, every ``look_every`` outer steps, without improvement. device: where
    meta-training runs.
    """

    name: ClassVar[str] = "maml"
    amortised: ClassVar[bool] = False

    def __init__(
        self,
        simulator: Any,
        *,
        gradient_steps: int = 5,
        neighbours: int = 5,
        spread: float = 0.1,
        hidden: int = 60,
        learning_rate: float = 0.005,
        tasks: int = 10,
        steps_per_simulation: int = 40,
        iterations: int = 1000,
        held_out: float = 0.1,
        patience: int = 8,
        look_every: int = 50,
        device: str = "cpu",
        **settings: Any,
    ) -> None:
        super().__init__(simulator, **settings)
        self.gradient_steps = whole("gradient_steps", gradient_steps, 0)
        self.neighbours, self.spread = whole("neighbours", neighbours), positive("spread", spread)
        self.hidden, self.learning_rate = whole("hidden", hidden), positive("learning_rate", learning_rate)
        self.tasks = whole("tasks", tasks)
        self.steps_per_simulation = whole("steps_per_simulation", steps_per_simulation)
        self.iterations, self.held_out = whole("iterations", iterations), share("held_out", held_out)
        self.patience, self.look_every = whole("patience", patience), whole("look_every", look_every)
        self.device = check_device(device)

    @property
    def reserved(self) -> int:
        return self.gradient_steps * self.neighbours

    def settings(self) -> dict[str, Any]:
        own = ("gradient_steps", "neighbours", "spread", "hidden", "learning_rate", "tasks", "iterations")
        rest = ("steps_per_simulation", "held_out", "patience", "look_every", "device")
        return {**super().settings(), **{name: getattr(self, name) for name in own + rest}}

    def step(self, state: State, trajectories: Trajectories) -> State:
        """A block of simulations, the meta-training, or one gradient step at test time."""
        if not state["trained"]:
            state = super().step(state, trajectories)
            return {**state, "adapted": 0, "done": state["trained"] and not self.gradient_steps}
        return self._adapted(state, trajectories)

    def train(self, simulations: Simulations, trajectories: Trajectories) -> State:
        seed = int(np.random.SeedSequence([self.seed, 3]).generate_state(1)[0])
        generator = torch.Generator().manual_seed(seed)
        steps = torch.from_numpy(control_steps(simulations.observations, trajectories.actions, trajectories.length))
        theta = torch.tensor(simulations.theta, dtype=torch.float32)
        network = self._network(steps.shape[-1], seed)
        network.standardise.fit(steps)
        network.begin_at(theta.mean(0))
        network.to(self.device)
        with torch.no_grad():
            inputs = network.standardise(steps.to(self.device)).nan_to_num()
        good, targets = steps.isfinite().all(-1).float().to(self.device), theta.to(self.device)
        loss = self._meta_loss(network, inputs, targets, good)
        inside, outside = split(len(theta), self.held_out, generator)
        parameters = list(network.parameters())
        optimiser = torch.optim.Adam(parameters, self.learning_rate, foreach=True)
        stopping = EarlyStopping(network, self.patience, absolute=1e-5)
        for k in range(1, self.iterations + 1):
            chosen = inside[torch.randint(len(inside), (self.tasks,), generator=generator)]
            optimiser.zero_grad(set_to_none=True)
            loss(chosen, inside, generator).mean().backward()
            torch.nn.utils.clip_grad_norm_(parameters, 5.0)
            optimiser.step()
            if k % self.look_every and k < self.iterations:
                continue
            fixed = torch.Generator().manual_seed(seed)
            now = float(loss(outside[:100], inside, fixed).mean().detach())
            if stopping.stops(now):
                break
        stopping.restore()
        converged = stopping.waited >= self.patience
        self.still_improving(converged, k, "iterations", "iterations")
        return {
            **weights(network),
            "held_out_loss": float(stopping.best),
            "iterations": k,
            "converged": converged,
            "near": 0,
            "near_invalid": 0,
        }

    def _meta_loss(self, network: _Regressor, inputs: Tensor, theta: Tensor, good: Tensor) -> Any:
        """A function of tasks (t,), the rows their neighbours come from, and a generator: query losses (t,) after the inner
        step."""

        def inner(weights: Weights, steps: Tensor, target: Tensor, weight: Tensor) -> Tensor:
            error = (functional_call(network, weights, (steps,)) - target[:, None]).square().mean(-1)
            return (error * weight).sum() / weight.sum().clamp_min(1)

        def adapted_loss(weights: Weights, support: tuple[Tensor, ...], query: tuple[Tensor, ...]) -> Tensor:
            gradient = grad(inner)(weights, *support)
            moved = {name: w - self.learning_rate * gradient[name] for name, w in weights.items()}
            return inner(moved, *query)

        batched = vmap(adapted_loss, in_dims=(None, 0, 0))

        def loss(tasks: Tensor, pool: Tensor, generator: torch.Generator) -> Tensor:
            distance = torch.cdist(theta[tasks], theta[pool])
            distance = distance + (tasks[:, None] == pool).to(distance) * 1e6
            near = pool[distance.topk(min(self.neighbours, len(pool) - 1), largest=False).indices.cpu()]
            picked = torch.randint(
                inputs.shape[1], (min(self.steps_per_simulation, inputs.shape[1]),), generator=generator
            )
            support = (inputs[near][:, :, picked], theta[near], good[near][:, :, picked])
            query = (inputs[tasks][:, None, picked], theta[tasks][:, None], good[tasks][:, None, picked])
            return batched(dict(network.named_parameters()), support, query)

        return loss

    def _adapted(self, state: State, trajectories: Trajectories) -> State:
        """One gradient step on simulations near the estimate; raises BudgetExhausted."""
        if self.rollouts + self.neighbours * len(trajectories) > self.budget:
            raise BudgetExhausted(
                f"{self.neighbours} simulations near the estimate are not left of {self.budget} rollouts"
            )
        steps = recorded_steps(trajectories)
        network = self._network(steps.shape[-1], 0)
        restore(network, state)
        rng = np.random.default_rng([self.seed, 4, state["adapted"]])
        theta = np.clip(
            self._estimate(network, steps) + self.spread * rng.standard_normal((self.neighbours, self.n)), 0, 1
        )
        made = self.simulate(theta, trajectories, rng)
        self.rollouts += self.neighbours * len(trajectories)
        if made.valid.any():
            inputs = torch.from_numpy(
                control_steps(made.observations[made.valid], trajectories.actions, trajectories.length)
            )
            targets = torch.tensor(made.theta[made.valid], dtype=torch.float32)[:, None].expand(-1, inputs.shape[1], -1)
            good = inputs.isfinite().all(-1)
            error = (network(network.standardise(inputs[good])) - targets[good]).square().mean()
            parameters = list(network.parameters())
            for parameter, slope in zip(parameters, torch.autograd.grad(error, parameters), strict=True):
                parameter.data.sub_(self.learning_rate * slope)
        adapted = state["adapted"] + 1
        near = {"near": state["near"] + len(made), "near_invalid": state["near_invalid"] + int((~made.valid).sum())}
        return {**state, **weights(network), **near, "adapted": adapted, "done": adapted == self.gradient_steps}

    def infer(self, state: State, trajectories: Trajectories) -> Dirac:
        steps = recorded_steps(trajectories)
        network = self._network(steps.shape[-1], 0)
        restore(network, state)
        told = ("held_out_loss", "iterations", "converged", "near", "near_invalid")
        self.diagnostics.update({name: state[name] for name in told})
        if state["near_invalid"]:
            self.warn(
                f"{state['near_invalid']} of {state['near']} simulations near the estimate {self.simulator.failure}; the "
                "gradient steps took the others"
            )
        return Dirac(self._estimate(network, steps), self.space)

    @property
    def n(self) -> int:
        """N."""
        return len(self.space)

    def _estimate(self, network: _Regressor, steps: Tensor) -> NDArray[np.float64]:
        with torch.no_grad():
            mean: NDArray[np.float64] = network(network.standardise(steps)).double().mean(0).numpy()
        return np.clip(mean, 0, 1)

    def _network(self, features: int, seed: int) -> _Regressor:
        with torch.random.fork_rng():
            torch.manual_seed(seed)
            return _Regressor(features, self.hidden, self.n)


class _Regressor(nn.Module):
    """Standardised control steps (..., F) to theta (..., N)."""

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
        out: Tensor = self.layers(steps)
        return out
