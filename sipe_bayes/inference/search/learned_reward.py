"""A learned reward of a simulation: how well a discriminator takes it for a recording.

B. Mehta, M. Diaz, F. Golemo, C. Pal, L. Paull 2019, "Active Domain Randomization", https://arxiv.org/abs/1904.04762, with
the sign of B. Mehta, A. Handa, D. Fox, F. Ramos 2020, "A User's Guide to Calibrating Robotics Simulators",
https://arxiv.org/abs/2011.08985: simulations that cannot be told from recordings are rewarded,

    r(theta) = mean over the simulation's control steps of log D(s, a, s'),

D being trained by binary cross-entropy on recorded control steps against those simulated at the thetas that a method looks at.
It compares sets of control steps, not step with step, so that starting states and actions need not match: ``features`` takes
simulations of others. But they must reach about the same states under about the same actions: D tells simulations by those as
well, and of one short recording it soon knows every step. So ``simopt`` and ``adr`` simulate from the recorded
starting states with the recorded actions; with others they are not offered.

Deviations: a step enters as (s, a, s' - s), which is as much as (s, a, s') and shows small changes; features are
standardised by the recorded steps; simulated steps get the recorded observations' noise, which would otherwise give them
away; D is trained on the method's pool of recent simulations, not the latest alone; of a simulation at most 200 steps,
evenly spread, are looked at.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch.nn.functional import logsigmoid

from sipe_bayes.likelihood.noise_level import noise_level
from sipe_bayes.likelihood.windows import Windows
from sipe_bayes.models.discriminator import HIDDEN, Discriminator, Training
from sipe_bayes.models.transitions import control_steps

FloatArray = NDArray[np.float64]
Features = NDArray[np.float32]
State = dict[str, Any]

_PREFIX = "reward_"


class LearnedReward:
    """Reward of simulations of ``windows``; what is learned lives in the entries ``reward_*`` of a flat State.

    learning_rate, batch: of Adam; half of a batch is recorded, half simulated. updates: Adam's steps at each ``train``. hidden:
    units of the discriminator's two layers.
    Raises ValueError where fewer than two whole control steps were recorded, as in an observed x of a function.
    """

    def __init__(
        self,
        windows: Windows,
        *,
        seed: int = 0,
        learning_rate: float = 0.001,
        batch: int = 320,
        updates: int = 30,
        hidden: int = HIDDEN,
    ) -> None:
        self.windows, self.seed, self.hidden = windows, seed, hidden
        self.learning_rate, self.batch, self.updates = learning_rate, batch, updates
        sd = noise_level(windows.trajectories, windows.settings)
        self.noise = sd[windows.channels]
        steps = int(windows.steps.sum())
        recorded = control_steps(windows.measured[None], windows.actions, windows.steps, steps)[0]
        self.recorded = torch.from_numpy(recorded[np.isfinite(recorded).all(-1)])
        if len(self.recorded) < 2:
            raise ValueError(
                f"trajectories: expected control steps with all channels recorded, got {len(self.recorded)}; fit fewer channels, "
                'or use reward="state_difference"'
            )

    def start(self) -> State:
        """An untrained discriminator's entries of the State."""
        training = self._training(None)
        training.network.standardise.fit(self.recorded)
        return _prefixed(training)

    def features(self, predicted: FloatArray | None, unmatched: Windows | None = None) -> Features:
        """Control steps (B, M, F) of predictions (B, W, L, C), NaN throughout where they diverged; none of None. unmatched: windows
        with other starting states and actions, where the predictions are theirs."""
        windows = unmatched or self.windows
        if predicted is None:
            predicted = np.empty((0, *windows.measured.shape))
        inside = np.arange(predicted.shape[2]) <= windows.steps[:, None]
        good = np.all(np.isfinite(predicted).all(-1) | ~inside, axis=(1, 2))
        return control_steps(np.where(good[:, None, None, None], predicted, np.nan), windows.actions, windows.steps)

    def train(self, state: State, features: Features) -> State:
        """The entries after some steps on recorded control steps against those of ``features`` (B, M, F)."""
        training = self._training(state)
        rows = features.reshape(-1, features.shape[-1])
        simulated = torch.from_numpy(rows[np.isfinite(rows).all(-1)])
        half = self.batch // 2
        for _ in range(self.updates if len(simulated) else 0):
            random = np.random.default_rng([self.seed, 1, training.steps])
            real = self.recorded[torch.from_numpy(random.integers(len(self.recorded), size=half))]
            fake = simulated[torch.from_numpy(random.integers(len(simulated), size=half))]
            training.step(real, self._noisy(fake, random))
        return _prefixed(training)

    def __call__(self, state: State, features: Features) -> FloatArray:
        """Reward (B,) of features (B, M, F): the mean of log D, -inf where the simulation diverged."""
        network = self._training(state).network
        good = np.asarray(np.isfinite(features).all(-1))
        x = torch.from_numpy(np.where(good[..., None], features, 0.0).astype(np.float32))
        x = self._noisy(x, np.random.default_rng([self.seed, 2]))
        with torch.no_grad():
            score = logsigmoid(network(x)).numpy().astype(float)
        total = np.where(good, score, 0.0).sum(1)
        count = good.sum(1)
        return np.where(count > 0, total / np.maximum(count, 1), -np.inf)

    def _noisy(self, steps: torch.Tensor, random: np.random.Generator) -> torch.Tensor:
        """Control steps (..., F) with the noise of the recorded samples s and s' added."""
        if not self.noise.any():
            return steps
        channels, shape = len(self.noise), (*steps.shape[-2:-1], len(self.noise))
        here, there = (torch.from_numpy((self.noise * random.standard_normal(shape)).astype(np.float32)) for _ in "ab")
        out = steps.clone()
        out[..., :channels] += here
        out[..., -channels:] += there - here
        return out

    def _training(self, state: State | None) -> Training:
        training = Training(Discriminator(self.recorded.shape[1], self.seed, self.hidden), self.learning_rate)
        if state is not None:
            training.load({k[len(_PREFIX) :]: v for k, v in state.items() if k.startswith(_PREFIX)})
        return training


def _prefixed(training: Training) -> State:
    return {_PREFIX + k: v for k, v in training.state().items()}
