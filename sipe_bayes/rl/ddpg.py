"""DDPG: a deterministic actor that climbs its critic, learnt off policy.

Lillicrap et al., "Continuous control with deep reinforcement learning", 2016, https://arxiv.org/abs/1509.02971, in the
form that Fujimoto, van Hoof, Meger tuned, "Addressing Function Approximation Error in Actor-Critic Methods", 2018,
https://arxiv.org/abs/1802.09477 ("our DDPG"). Of a batch of transitions (s, a, r, s') the critic follows

    Q(s, a)  ->  y = r + gamma (1 - terminated) Q'(s', pi'(s')),     loss: the mean of (Q(s, a) - y)^2,

the actor then climbs the mean of Q(s, pi(s)), and the targets Q' and pi' follow their networks by tau. An episode that
runs out of time is not terminated, so its last value is asked for as any other's.

Deviations from the 2018 paper's DDPG:

- hidden layers of 256 and 256, Adam at 3e-4 and batches of 256, as its authors later had them in their repository;
  before: 400 and 300, 1e-3, 100;
- random actions at the start: 25,000 steps on every task.

Options (``sipe_bayes.rl.settings``), each off unless asked for and each a deviation:

- ``normalise`` (observations);
- ``layer_norm`` (critic's hidden layers; Ba, Kiros, Hinton, "Layer Normalization", 2016,
  https://arxiv.org/abs/1607.06450);
- ``n_step`` (returns);
- ``demonstration_share`` (of each batch, from trajectories given beforehand);
- ``cloning``: the actor's loss also has the squared distance, in half ranges, from what the batch's demonstrations do,
  their mean: Nair et al., "Overcoming Exploration in Reinforcement Learning with Demonstrations", 2018,
  https://arxiv.org/abs/1709.10089, without their filter and in units of the mean |Q|, as Fujimoto, Gu, "A Minimalist
  Approach to Offline Reinforcement Learning", 2021, https://arxiv.org/abs/2106.06860;
- ``actor_waits``: the critic learns alone at first, of an actor that begins as a given policy (``begin``): climbing a
  critic that knows nothing would undo it. A policy's file holds neither critic nor optimisers;
- ``end_hopeless``: episodes of the training end where the humanoid has fallen, as the published class's;
- ``lanes``: environments stepped together before the updates;
- ``updates_per_step``, ``clip_targets``, ``action_penalty`` and ``random_share``: those of hindsight experience replay
  (Andrychowicz et al., 2017, https://arxiv.org/abs/1707.01495).

The two networks are small and of one kind, so gradients are written out by hand on flat vectors of parameters: the
actor's step needs no gradient of the critic's weights, and Adam and the targets take a call each.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor

from sipe_bayes.core.arrays import Float32Array, FloatArray
from sipe_bayes.models.policy import Policy
from sipe_bayes.models.training import check_device
from sipe_bayes.rl.normaliser import Moments, Normaliser
from sipe_bayes.rl.replay import Batch
from sipe_bayes.rl.settings import Settings

_OBSERVATION_CLIP = 5.0  # of normalised observations, in spreads


@dataclass(frozen=True)
class Layer:
    """What ``Network.backward`` needs of a layer.

    Args:
        inputs: (B, in).
        outputs: after ReLU (B, out); None of the last layer.
        statistics: of the normalisation: before it (B, out), mean and inverse spread (B, 1); empty without one.
    """

    inputs: Tensor
    outputs: Tensor | None = None
    statistics: tuple[Tensor, ...] = ()


@dataclass(frozen=True)
class AgentState:
    """An agent between two updates: parameters and moments by name, the normaliser's, and the number of updates."""

    tensors: dict[str, Float32Array]
    normaliser: Moments | None
    updates: int


class Network:
    """An MLP with ReLU, perhaps normalised hidden layers, in one flat vector (P,); forward and backward by hand.

    Args:
        sizes: of inputs, hidden layers and outputs.
        layer_norm: normalise hidden layers.
        device: where the vector lies.
    """

    def __init__(self, sizes: tuple[int, ...], layer_norm: bool = False, device: str = "cpu") -> None:
        self.sizes, self.layer_norm = sizes, layer_norm
        self._shapes: list[tuple[int, ...]] = []
        for i, (before, after) in enumerate(pairwise(sizes)):
            self._shapes += [(after, before), (after,)]
            if layer_norm and i < len(sizes) - 2:
                self._shapes += [(after,), (after,)]
        self.parameters = torch.zeros(sum(int(np.prod(s)) for s in self._shapes), device=device)
        self.gradients = torch.zeros_like(self.parameters)
        self.layers, self._slopes = self._views(self.parameters), self._views(self.gradients)

    def initialise(self, rng: np.random.Generator) -> None:
        """Weights and biases uniform within 1 / sqrt(inputs), as torch.nn.Linear has them."""
        for weight, bias, *norm in self.layers:
            bound = weight.shape[1] ** -0.5
            for part in (weight, bias):
                part.copy_(torch.from_numpy(rng.uniform(-bound, bound, tuple(part.shape))))
            if norm:
                norm[0].fill_(1.0)

    def forward(self, x: Tensor) -> tuple[Tensor, list[Layer]]:
        """Outputs (B, out) of x (B, in), and what ``backward`` needs."""
        tape: list[Layer] = []
        for weight, bias, *norm in self.layers[:-1]:
            z = torch.addmm(bias, x, weight.t())
            if norm:
                normal, *statistics = torch.native_layer_norm(z, z.shape[1:], norm[0], norm[1], 1e-5)
                outputs, kept = normal.relu_(), (z, *statistics)
            else:
                outputs, kept = z.relu_(), ()
            tape.append(Layer(x, outputs, kept))
            x = outputs
        weight, bias = self.layers[-1]
        tape.append(Layer(x))
        return torch.addmm(bias, x, weight.t()), tape

    def backward(self, tape: list[Layer], slope: Tensor, weights: bool = True, inputs: bool = False) -> Tensor | None:
        """The gradients of a scalar.

        Args:
            tape: of ``forward``.
            slope: the scalar's gradient in the outputs (B, out).
            weights: whether to fill ``gradients``.
            inputs: whether to return the gradient in the inputs.

        Returns:
            (B, in), or None.
        """
        for i in range(len(self.layers) - 1, -1, -1):
            layer, (weight, _, *norm), out = tape[i], self.layers[i], self._slopes[i]
            # back through ReLU
            if layer.outputs is not None:
                slope = torch.ops.aten.threshold_backward(slope, layer.outputs, 0)
            # back through the normalisation
            if norm:
                before, *statistics = layer.statistics
                slope, gain, shift = torch.ops.aten.native_layer_norm_backward(
                    slope, before, before.shape[1:], *statistics, *norm, [True, weights, weights]
                )
                if weights:
                    out[2].copy_(gain)
                    out[3].copy_(shift)
            # back through the linear map
            if weights:
                torch.mm(slope.t(), layer.inputs, out=out[0])
                torch.sum(slope, 0, out=out[1])
            if i or inputs:
                slope = torch.mm(slope, weight)
        return slope if inputs else None

    def copy(self) -> Network:
        """Another network with the same parameters."""
        other = Network(self.sizes, self.layer_norm, str(self.parameters.device))
        other.parameters.copy_(self.parameters)
        return other

    def _views(self, flat: Tensor) -> list[list[Tensor]]:
        """Weight, bias and, if any, gain and shift of each layer."""
        parts = [
            p.view(s) for p, s in zip(flat.split([int(np.prod(s)) for s in self._shapes]), self._shapes, strict=True)
        ]
        starts = [i for i, s in enumerate(self._shapes) if len(s) == 2] + [len(parts)]
        return [parts[a:b] for a, b in pairwise(starts)]


class Agent:
    """Actor, critic, their targets and optimisers.

    Args:
        observation_size: O.
        action_size: A.
        action_low: bound of every action.
        action_high: bound of every action.
        settings: how it learns.
        rng: of the first weights.
        device: where it learns.
    """

    def __init__(
        self,
        observation_size: int,
        action_size: int,
        action_low: float,
        action_high: float,
        settings: Settings,
        rng: np.random.Generator,
        device: str = "cpu",
    ) -> None:
        self.settings, self.observation_size, self._device = settings, observation_size, check_device(device)
        self.action_low, self.action_high = action_low, action_high
        self._half, self._middle = (action_high - action_low) / 2, (action_high + action_low) / 2
        self.actor = Network((observation_size, *settings.hidden, action_size), device=device)
        self.critic = Network((observation_size + action_size, *settings.hidden, 1), settings.layer_norm, device)
        self.actor.initialise(rng)
        self.critic.initialise(rng)
        self.target_actor, self.target_critic = self.actor.copy(), self.critic.copy()
        self._actor_optimiser, self._critic_optimiser = _adam(self.actor, settings), _adam(self.critic, settings)
        self.normaliser = Normaliser(observation_size, _OBSERVATION_CLIP) if settings.normalise else None
        self.updates = 0

    def act(self, observations: FloatArray) -> FloatArray:
        """Actions (B, A) of observations (B, O), without noise."""
        x = self._normalised(torch.from_numpy(observations.astype(np.float32)).to(self._device))
        return np.asarray(self._bounded(self.actor.forward(x)[0].tanh_()).cpu().numpy(), float)

    def begin(self, policy: Policy) -> None:
        """Act as a policy does, whose statistics of observations stay; raises ValueError where the networks differ."""
        given, made = ((x.layers, x.mean is not None, x.action_low, x.action_high) for x in (policy, self.policy("")))
        shapes = [[tuple(w.shape) for w, _ in layers] for layers in (given[0], made[0])]
        if shapes[0] != shapes[1] or given[1:] != made[1:]:
            raise ValueError(
                f"policy: expected layers {shapes[1]}, normalise {made[1]} and actions from {made[2]} to {made[3]}, "
                f"got {shapes[0]}, {given[1]} and {given[2]} to {given[3]}; take the settings that it was trained with"
            )
        for network in (self.actor, self.target_actor):
            for (weight, bias), layer in zip(policy.layers, network.layers, strict=True):
                layer[0].copy_(torch.from_numpy(weight))
                layer[1].copy_(torch.from_numpy(bias))
        if self.normaliser is not None and policy.mean is not None and policy.scale is not None:
            mean, scale = policy.mean.astype(float), policy.scale.astype(float)
            self.normaliser.restore(Moments(np.ones(1), mean, scale**2))

    def update(self, batch: Batch, climb: bool = True) -> None:
        """One step of the critic, the actor (if it is to ``climb``) and the targets; the batch is on the device."""
        observations, following = (self._normalised(x) for x in (batch.observations, batch.next_observations))
        actions = batch.actions
        # the critic follows its target
        targets = self._targets(following, batch.returns, batch.discounts)
        pairs = torch.cat([observations, actions], 1)
        values, tape = self.critic.forward(pairs)
        self.critic.backward(tape, (values - targets).mul_(2 / len(values)))
        self._critic_optimiser.step()
        # the actor climbs the critic, and the targets follow
        if climb:
            self._climb(observations, actions)
        for network, target in ((self.actor, self.target_actor), (self.critic, self.target_critic)):
            target.parameters.lerp_(network.parameters, self.settings.tau)
        self.updates += 1

    def policy(self, task: str, goal_size: int = 0) -> Policy:
        """What has been learnt so far."""
        layers = tuple((w.cpu().numpy().copy(), b.cpu().numpy().copy()) for w, b in self.actor.layers)
        low, high = self.action_low, self.action_high
        if self.normaliser is None:
            return Policy(task, layers, low, high, goal_size=goal_size)
        seen = self.normaliser
        return Policy(task, layers, low, high, seen.mean.copy(), seen.scale.copy(), seen.clip, goal_size)

    def state(self) -> AgentState:
        """From which ``restore`` goes on bit for bit."""
        tensors = {name: tensor.cpu().numpy().copy() for name, tensor in self._tensors().items()}
        return AgentState(tensors, None if self.normaliser is None else self.normaliser.state(), self.updates)

    def restore(self, state: AgentState) -> None:
        """Go on from what ``state`` gave."""
        for name, tensor in self._tensors().items():
            tensor.copy_(torch.from_numpy(state.tensors[name]).reshape(tensor.shape))  # a file's scalar is (1,)
        if self.normaliser is not None and state.normaliser is not None:
            self.normaliser.restore(state.normaliser)
        self.updates = state.updates

    def _tensors(self) -> dict[str, Tensor]:
        networks = ("actor", "critic", "target_actor", "target_critic")
        tensors = {name: getattr(self, name).parameters for name in networks}
        for name, optimiser in (("actor", self._actor_optimiser), ("critic", self._critic_optimiser)):
            moments = optimiser.state[tensors[name]]
            tensors |= {f"{name}.{k}": moments[k] for k in ("exp_avg", "exp_avg_sq", "step")}
        return tensors

    def _normalised(self, observations: Tensor) -> Tensor:
        return observations if self.normaliser is None else self.normaliser.apply(observations)

    def _bounded(self, squashed: Tensor) -> Tensor:
        return squashed * self._half + self._middle

    def _targets(self, following: Tensor, returns: Tensor, discounts: Tensor) -> Tensor:
        """``y`` (B, 1)."""
        actions = self._bounded(self.target_actor.forward(following)[0].tanh_())
        values = self.target_critic.forward(torch.cat([following, actions], 1))[0]
        targets = torch.addcmul(returns[:, None], discounts[:, None], values)
        return targets.clamp_(-1 / (1 - self.settings.discount), 0.0) if self.settings.clip_targets else targets

    def _climb(self, observations: Tensor, actions: Tensor) -> None:
        """The actor's step: along the critic's slope in the action, times what squashes it."""
        outputs, tape = self.actor.forward(observations)
        squashed = outputs.tanh_()
        values, along = self.critic.forward(torch.cat([observations, self._bounded(squashed)], 1))
        slope = self.critic.backward(along, torch.full_like(values, -1 / len(values)), weights=False, inputs=True)
        assert slope is not None
        inner = slope[:, self.observation_size :] * self._half
        if self.settings.action_penalty:
            inner = inner.add_(squashed, alpha=2 * self.settings.action_penalty / squashed.numel())
        if self.settings.cloning:
            shown = self.settings.demonstrated
            away = squashed[-shown:] - (actions[-shown:] - self._middle).div_(self._half)
            inner[-shown:] += 2 * self.settings.cloning * values.abs().mean() / shown * away
        self.actor.backward(tape, inner.mul_(1 - squashed * squashed))
        self._actor_optimiser.step()


def _adam(network: Network, settings: Settings) -> torch.optim.Adam:
    """The fused Adam of torch on a network's flat vector."""
    network.parameters.grad = network.gradients
    adam = torch.optim.Adam([network.parameters], settings.learning_rate, fused=True)
    adam.step()  # makes the moments; a step along gradients of zero moves nothing
    adam.state[network.parameters]["step"].zero_()
    return adam
