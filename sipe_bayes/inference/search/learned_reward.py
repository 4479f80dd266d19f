"""A learned reward of a simulation: how well a discriminator takes it for a recording.

B. Mehta, M. Diaz, F. Golemo, C. Pal, L. Paull 2019, "Active Domain Randomization", https://arxiv.org/abs/1904.04762,
with the sign of B. Mehta, A. Handa, D. Fox, F. Ramos 2020, "A User's Guide to Calibrating Robotics Simulators",
https://arxiv.org/abs/2011.08985: simulations that cannot be told from recordings are rewarded,

    r(theta) = mean over the simulation's control steps of log D(s, a, s'),

D being trained by binary cross-entropy on recorded control steps against those simulated at the thetas that a method
looks at. It compares sets of control steps, not step with step, so that starting states and actions need not match:
``features`` takes simulations of others. But they must reach about the same states under about the same actions: D
tells simulations by those as well, and of one short recording it soon knows every step. So ``simopt`` and ``adr``
simulate from the recorded starting states with the recorded actions; with others they are not offered.

Deviations:

- A step enters as (s, a, s' - s), which is as much as (s, a, s') and shows small changes.
- Features are standardised by the recorded steps.
- Simulated steps get the recorded observations' noise, which would otherwise give them away.
- D is trained on the method's pool of recent simulations, not the latest alone.
- Of a simulation at most 200 steps, evenly spread, are looked at.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch.nn.functional import logsigmoid

from sipe_bayes.core.arrays import Float32Array, FloatArray
from sipe_bayes.core.options import Options, option
from sipe_bayes.likelihood import BoundLikelihood, noise_level
from sipe_bayes.models.discriminator import Discriminator, Training, TrainingState
from sipe_bayes.models.transitions import control_steps

REWARDS = ("state_difference", "learned")


@dataclass(frozen=True)
class RewardOptions(Options):
    """What a search rewards, and how a discriminator learns it."""

    reward: str = option("state_difference", "minus the mean squared difference of states, or learned", among=REWARDS)
    learning_rate: float = option(0.001, "of the discriminator's Adam", above=0)
    discriminator_batch: int = option(320, "control steps in a batch, half recorded and half simulated", least=2)
    discriminator_updates: int = option(30, "steps of Adam after each draw", least=1)
    discriminator_hidden: int = option(128, "units of each of the discriminator's two layers", least=1)


class LearnedReward:
    """Reward of simulations.

    Args:
        windows: the logs, whose control steps are the recorded ones.
        options: of the discriminator and its training.
        seed: of its first weights, batches and noise.

    Raises:
        ValueError: where fewer than two whole control steps were recorded, as in an observed x of a function.
    """

    def __init__(self, windows: BoundLikelihood, options: RewardOptions | None = None, seed: int = 0) -> None:
        self.windows, self.options, self.seed = windows, options or RewardOptions(), seed
        sd = noise_level(windows.trajectories, windows.settings, windows.simulator)
        self.noise = sd[windows.channels]
        steps = int(windows.steps.sum())
        recorded = control_steps(windows.measured[None], windows.actions, windows.steps, steps)[0]
        self.recorded = torch.from_numpy(recorded[np.isfinite(recorded).all(-1)])
        if len(self.recorded) < 2:
            raise ValueError(
                f"trajectories: expected control steps with all channels recorded, got {len(self.recorded)}; fit fewer "
                'channels, or use reward="state_difference"'
            )

    def start(self) -> TrainingState:
        """An untrained discriminator."""
        training = self._training(None)
        training.network.standardise.fit(self.recorded)
        return training.state()

    def features(self, predicted: FloatArray | None, unmatched: BoundLikelihood | None = None) -> Float32Array:
        """Control steps of simulations.

        Args:
            predicted: (B, W, L, C), or None for no simulation.
            unmatched: windows with other starting states and actions, where the predictions are theirs.

        Returns:
            (B, M, F), NaN throughout where a simulation diverged.
        """
        windows = unmatched or self.windows
        if predicted is None:
            predicted = np.empty((0, *windows.measured.shape))
        inside = np.arange(predicted.shape[2]) <= windows.steps[:, None]
        good = np.all(np.isfinite(predicted).all(-1) | ~inside, axis=(1, 2))
        return control_steps(np.where(good[:, None, None, None], predicted, np.nan), windows.actions, windows.steps)

    def train(self, state: TrainingState, features: Float32Array) -> TrainingState:
        """The discriminator after some steps on recorded control steps against those of ``features`` (B, M, F)."""
        training = self._training(state)
        rows = features.reshape(-1, features.shape[-1])
        simulated = torch.from_numpy(rows[np.isfinite(rows).all(-1)])
        half = self.options.discriminator_batch // 2
        for _ in range(self.options.discriminator_updates if len(simulated) else 0):
            random = np.random.default_rng([self.seed, 1, training.steps])
            real = self.recorded[torch.from_numpy(random.integers(len(self.recorded), size=half))]
            fake = simulated[torch.from_numpy(random.integers(len(simulated), size=half))]
            training.step(real, self._noisy(fake, random))
        return training.state()

    def __call__(self, state: TrainingState, features: Float32Array) -> FloatArray:
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
        before, after = (
            torch.from_numpy((self.noise * random.standard_normal(shape)).astype(np.float32)) for _ in "ab"
        )
        out = steps.clone()
        out[..., :channels] += before
        out[..., -channels:] += after - before
        return out

    def _training(self, state: TrainingState | None) -> Training:
        network = Discriminator(self.recorded.shape[1], self.seed, self.options.discriminator_hidden)
        training = Training(network, self.options.learning_rate)
        if state is not None:
            training.load(state)
        return training
