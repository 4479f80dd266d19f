"""A Gymnasium wrapper that gives every episode parameters drawn from a posterior: domain randomisation.

Code that takes Gymnasium's environments takes it (tested: Stable-Baselines3, and Gymnasium's vector environments, as
CleanRL uses them; RLlib's ``register_env(name, lambda config: ...)`` is not tried). ``sipe_bayes.rl.randomization``
says what is drawn, and what happens to draws that no model can have.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, SupportsFloat, cast

import gymnasium
import numpy as np
from gymnasium.utils import RecordConstructorArgs
from numpy.typing import ArrayLike

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.seeding import torch_generator_from
from sipe_bayes.posterior import Posterior
from sipe_bayes.rl.randomization import Disturbances, Draws, Randomization, randomization
from sipe_bayes.simulation.simulator import Simulator

Environment = gymnasium.Env[FloatArray, FloatArray]
Write = Callable[[Environment, dict[str, float]], None]
"""Gives an environment the parameters' values, by name, in their units."""


class RandomizedEnv(gymnasium.Wrapper[FloatArray, FloatArray, FloatArray, FloatArray], RecordConstructorArgs):
    """An environment under a posterior of its parameters, or a ``Randomization`` with noise and delay as well.

    ``reset(seed=...)`` seeds environment and draws, and the first reset without a seed takes a random one.
    ``info["theta"]`` (N,) is the episode's; ``redrawn`` counts draws that no model can have, ``diverged`` the
    simulations that did. ``reset(options={"theta": ...})`` overrules the draw of one episode. Noise makes the
    observation space unbounded; it needs a flat Box there, a delay flat and bounded actions.

    Args:
        env: of ``sipe.make`` or ``gymnasium.make("sipe/...")``, wrapped or not; any other one needs ``write``.
        posterior: what is drawn from.
        write: called with the environment and the values by name before each reset.

    Raises:
        ValueError: for a posterior over other parameters than the environment's; it names them.
    """

    def __init__(self, env: Environment, posterior: Posterior | Randomization, write: Write | None = None) -> None:
        RecordConstructorArgs.__init__(self, posterior=posterior, write=write)
        gymnasium.Wrapper.__init__(self, env)
        self.randomization, self.diverged = randomization(posterior), 0
        simulator = getattr(env.unwrapped, "simulator", None)
        if not isinstance(simulator, Simulator) and write is None:
            raise ValueError(
                f"env: {type(env.unwrapped).__name__} is not of sipe.make; pass write(env, values), which gives it the "
                "parameters"
            )
        if write is not None and not callable(write):
            raise ValueError(
                f"write: expected a function of the environment and a dict of values by name, got {write!r}"
            )
        self._write, self._draws = write, None
        if write is None:
            assert isinstance(simulator, Simulator)
            self._draws = Draws(simulator, self.randomization.posterior)
        self._generator = np.random.default_rng()
        self._noisy = bool(np.any(np.asarray(self.randomization.observation_noise, float)))
        self._disturbances = self._disturbed() if self.randomization.disturbs else None

    @property
    def redrawn(self) -> int:
        """Draws so far that no model can have."""
        return 0 if self._draws is None else self._draws.redrawn

    def reset(
        self, *, seed: int | None = None, options: dict[str, object] | None = None
    ) -> tuple[FloatArray, dict[str, object]]:
        """Begin an episode.

        Args:
            seed: of environment and draws; None goes on.
            options: "theta" overrules the draw; with "allow_outside" it may lie outside [0, 1].

        Returns:
            The first observation and what there is to say.

        Raises:
            ValueError: for another theta.
        """
        if seed is not None:
            self._generator = np.random.default_rng([seed, 1])
            if self._disturbances is not None:
                self._disturbances.generator = np.random.default_rng([seed, 2])
        options = dict(options or {})
        given = options.get("theta")
        space = self.randomization.posterior.space
        theta = self._drawn() if given is None else np.array(space.check_shape(cast(ArrayLike, given)))
        if self._write is None:
            options["theta"] = theta
        else:
            options.pop("theta", None)
            if not ((theta >= 0) & (theta <= 1)).all() and not options.pop("allow_outside", False):
                raise ValueError(
                    f'theta: expected numbers in [0, 1], got {theta.tolist()}; options={{"allow_outside": True}} takes '
                    "others"
                )
            self._write(self.env, dict(zip(space.names, space.values(theta).tolist(), strict=True)))
        observation, info = self.env.reset(seed=seed, options=options or None)
        self._theta = theta.copy()
        if self._disturbances is not None:
            self._disturbances.begin(np.ones(1, bool))
        return self._seen(observation), {**info, "theta": theta.copy()}

    def step(self, action: FloatArray) -> tuple[FloatArray, SupportsFloat, bool, bool, dict[str, object]]:
        """One control step, as Gymnasium has it."""
        if self.randomization.action_delay and self._disturbances is not None:
            action = self._disturbances.delayed(np.asarray(action, float)[None], np.zeros(1, bool))[0]
        observation, reward, terminated, truncated, info = self.env.step(action)
        self.diverged += info.get("valid", True) is False
        return self._seen(observation), reward, terminated, truncated, {**info, "theta": self._theta.copy()}

    def _drawn(self) -> FloatArray:
        if self._draws is not None:
            return np.asarray(self._draws(self._generator, 1)[0])

        generator = torch_generator_from(self._generator)
        return np.asarray(self.randomization.posterior.sample(generator=generator).numpy())

    def _seen(self, observation: FloatArray) -> FloatArray:
        if not self._noisy or self._disturbances is None:
            return observation
        noisy = self._disturbances.noisy(np.asarray(observation, float)[None])[0]
        return np.asarray(noisy, self.observation_space.dtype)

    def _disturbed(self) -> Disturbances:
        observations, actions = self.env.observation_space, self.env.action_space
        channels, goal_size, middle = 0, 0, np.zeros(0)
        if self._noisy:
            channels = _flat(observations, "noise needs a flat Box as its observation_space").shape[0]
            goal_size = int(getattr(getattr(self.env.unwrapped, "task", None), "goal_size", 0))
            unbounded = gymnasium.spaces.Box(-np.inf, np.inf, (channels,), observations.dtype)  # type: ignore[arg-type]
            self.observation_space = unbounded  # type: ignore[assignment]
        if self.randomization.action_delay:
            box = _flat(actions, "a delay needs a flat Box as its action_space")
            low, high = np.asarray(box.low, float), np.asarray(box.high, float)
            if not (np.isfinite(low) & np.isfinite(high)).all():
                raise ValueError("env: a delay needs bounds on the actions, got infinite ones; clip the actions first")
            middle = (low + high) / 2
        noise = self.randomization if self._noisy else replace(self.randomization, observation_noise=0.0)
        return noise.disturbances(1, channels, goal_size, middle, self._generator)


def _flat(space: gymnasium.Space[Any], needed: str) -> gymnasium.spaces.Box:
    if not isinstance(space, gymnasium.spaces.Box) or len(space.shape) != 1:
        raise ValueError(f"env: {needed}, got {space}")
    return space
