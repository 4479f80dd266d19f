"""Open-loop plans for the Adroit hand by the cross-entropy method, from which demonstrations are made.

Rubinstein, "The Cross-Entropy Method for Combinatorial and Continuous Optimization", 1999,
https://doi.org/10.1023/A:1010091220143: draw candidates from N(mean, diag(sd^2)), keep the best, move mean and sd to
theirs, again and again. A candidate holds a few knots of a few synergies: commands linear between knots for the arm,
the wrist, the thumb's joints, and two curls that bend four fingers at once, each in the actions' unit. All candidates
of an iteration are one batch of the engine.

Deviations:

- mean and sd move by a share of the way, and sd has a floor: both keep it from stopping too soon;
- the best candidates of an iteration take part in the next;
- actions carry noise, so that what is found bears it;
- a task says where it starts (``Outline``: what a hand that reaches, closes and pulls would do, roughly) and what is
  added to its own reward, which says nothing of the way to the handle or the ball.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import numpy as np

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.checkpoint import load_state, save_state
from sipe_bayes.core.options import Options, option
from sipe_bayes.envs.tasks.adroit import Adroit
from sipe_bayes.rl.scripted import Demonstrator
from sipe_bayes.simulation.simulator import Simulator

Report = Callable[[str, int, int], None]

_CURLS = {"knuckles": ("FFJ2", "MFJ2", "RFJ2", "LFJ2"), "tips": tuple(f"{f}FJ{i}" for f in "FMRL" for i in (1, 0))}
_ARM = ("ARTx", "ARTy", "ARTz", "ARRx", "ARRy", "ARRz", "WRJ1", "WRJ0")
_THUMB = ("THJ4", "THJ3", "THJ1", "THJ0")


@dataclass(frozen=True)
class Search(Options):
    """Settings of the search."""

    population: int = option(40, "candidates of an iteration", least=2)
    elites: int = option(6, "best ones that mean and sd move to", least=1)
    iterations: int = option(60, "of the search", least=0)
    sd: float = option(0.15, "of candidates at first", "actions", above=0)
    floor: float = option(0.02, "least sd of candidates", "actions", least=0)
    share: float = option(0.7, "how far mean and sd go in an iteration", above=0, most=1)
    noise: float = option(0.05, "sd of the noise on actions", "actions", least=0)
    repeats: int = option(8, "rollouts of each finalist", least=1)


@dataclass(frozen=True)
class SearchState:
    """After an iteration: mean and sd of candidates (K, D), and the elites (E, K, D)."""

    iteration: int
    mean: FloatArray
    sd: FloatArray
    elites: FloatArray


@dataclass(frozen=True)
class Outline:
    """Where a task's search starts.

    Args:
        knots: the actuators' commands by the share of the episode at which they are given; what is not named is at
            zero. (The arm's joints settle at 2.5 times the command, less what gravity takes.)
        progress: (...,) of observations (..., O), added to the reward of each step.
        search: what suits the task: a grasp is fragile, so Relocate's looks close by, with less noise.
    """

    knots: dict[float, dict[str, float]]
    progress: Callable[[FloatArray], FloatArray]
    search: Search = field(default_factory=Search)


def _relocate(observations: FloatArray) -> FloatArray:
    to_ball, to_target = (np.linalg.norm(observations[..., i : i + 3], axis=-1) for i in (30, 36))
    return np.asarray(-2 * to_ball - 10 * to_target)


def _door(observations: FloatArray) -> FloatArray:
    to_handle = np.linalg.norm(observations[..., 35:38], axis=-1)
    return np.asarray(observations[..., 27] + 5 * observations[..., 28] - 2 * to_handle)


_OVER = {"ARTz": 0.068, "THJ4": 0.9, "THJ3": 0.3}
_GRASP = {**_OVER, "ARRx": 0.078, "knuckles": 1.55, "tips": 1.3, "THJ3": 1.0, "THJ1": -0.3, "THJ0": -0.8}
_REACH = {"ARRx": -0.2, "ARRy": -0.06, "WRJ0": 0.3, "ARTz": 0.12}
_HOOK = {**_REACH, "knuckles": 1.2, "tips": 1.0}
_TURN = {**_HOOK, "ARRx": 0.1, "ARRy": 0.05}
OUTLINES: dict[str, Outline] = {
    "Relocate": Outline(
        {
            0.0: {},
            0.2: _OVER,
            0.35: {**_OVER, "ARRx": 0.078},
            0.5: _GRASP,
            0.7: {**_GRASP, "ARTy": 0.17},
            1.0: {**_GRASP, "ARTy": 0.17},
        },
        _relocate,
        Search(iterations=30, sd=0.05, floor=0.01, noise=0.02),
    ),
    "Door": Outline(
        {
            0.0: {},
            0.12: {**_REACH, "ARTz": 0.0},
            0.25: _REACH,
            0.36: _HOOK,
            0.5: {**_TURN, "ARRx": 0.0},
            0.6: _TURN,
            0.7: {**_TURN, "ARTz": 0.05},
            0.8: {**_TURN, "ARTz": -0.05, "ARRy": -0.02},
            0.9: {**_TURN, "ARTz": -0.1, "ARRy": -0.1},
            1.0: {**_TURN, "ARTz": -0.12, "ARRy": -0.2},
        },
        _door,
    ),
}


@dataclass(frozen=True)
class Plan:
    """knots (K, D) of the synergies, in actions; score: mean return and progress of its noisy rollouts at the end."""

    knots: FloatArray
    score: float
    iterations: int


@dataclass
class Synergies:
    """How knots (..., K, D) become actions (..., T, A).

    Args:
        task: whose actuators.
        steps: T.
    """

    task: Adroit
    steps: int
    names: list[str] = field(init=False)

    def __post_init__(self) -> None:
        actuators = [self.task.published.actuator(i).name.removeprefix("A_") for i in range(self.task.num_actions)]
        self.names = [n for n in (*_ARM, *_CURLS, *_THUMB) if n in actuators or n in _CURLS]
        self._times = np.array(sorted(OUTLINES[self.task.name].knots)) * (self.steps - 1)
        self._members = np.array([[a in _CURLS.get(n, (n,)) for a in actuators] for n in self.names], float)
        low, high = self.task.published.actuator_ctrlrange.T
        self._half = (high - low) / 2
        self._rest = -((low + high) / 2) / self._half  # the actions that ask for zero
        steps = np.arange(self.steps)
        self._weights = np.stack([np.interp(steps, self._times, row) for row in np.eye(len(self._times))], 1)

    def outline(self) -> FloatArray:
        """The task's outline as knots (K, D)."""
        outline = OUTLINES[self.task.name].knots
        knots = np.zeros((len(outline), len(self.names)))
        for row, time in zip(knots, sorted(outline), strict=True):
            for name, value in outline[time].items():
                member = self._members[self.names.index(name)]
                row[self.names.index(name)] = value / self._half[member > 0][0]
        return knots

    def actions(self, knots: FloatArray) -> FloatArray:
        """Actions (..., T, A) of knots (..., K, D)."""
        return np.clip(self._rest + self._weights @ (knots @ self._members), -1, 1)


def plan(
    simulator: Simulator,
    seed: int = 0,
    search: Search | None = None,
    checkpoint: Path | None = None,
    report: Report | None = None,
) -> Plan:
    """Search a plan for a task of ``OUTLINES``.

    Args:
        simulator: of the task.
        seed: of candidates and noise.
        search: its settings; default what suits the task.
        checkpoint: a file to go on from and to write after each iteration.
        report: is told how far it is.

    Raises:
        CheckpointError: for a checkpoint of another search.
    """
    task = simulator.environment
    assert isinstance(task, Adroit)
    search = search or OUTLINES[task.name].search
    synergies = Synergies(task, task.episode_steps)
    start, _ = task.initial_states(np.random.default_rng(0), 1)
    outline = synergies.outline()
    described = [task.name, seed, {**asdict(search), "iterations": 0, "repeats": 0}, outline.tolist()]
    fingerprint = hashlib.sha256(json.dumps([described, simulator.checksum()]).encode()).hexdigest()
    state = SearchState(0, outline, np.full_like(outline, search.sd), outline[None])
    if checkpoint is not None and checkpoint.is_file():
        state = load_state(checkpoint, SearchState, fingerprint)
    while state.iteration < search.iterations:
        rng = np.random.default_rng([seed, state.iteration])
        # candidates: the best so far, and others about the mean
        count = search.population - len(state.elites)
        drawn = state.mean + state.sd * rng.standard_normal((count, *state.mean.shape))
        knots = np.concatenate([state.elites, drawn])
        # the best of them, to which mean and sd move
        scores = _score(simulator, synergies, knots, start, search.noise, rng)
        best = np.argsort(-scores, kind="stable")[: search.elites]
        elites = knots[best]
        state = replace(
            state,
            iteration=state.iteration + 1,
            mean=state.mean + search.share * (elites.mean(0) - state.mean),
            sd=np.maximum(state.sd + search.share * (elites.std(0) - state.sd), search.floor),
            elites=elites,
        )
        if checkpoint is not None:
            save_state(checkpoint, state, fingerprint)
        if report is not None:
            report(f"{task.name}: best {scores[best[0]]:.0f}", state.iteration, search.iterations)
    # of the finalists the best under noise
    finalists = np.concatenate([state.mean[None], state.elites])
    rng = np.random.default_rng([seed, search.iterations, 1])
    repeated = _score(simulator, synergies, np.repeat(finalists, search.repeats, axis=0), start, search.noise, rng)
    scores = repeated.reshape(len(finalists), -1).mean(1)
    return Plan(finalists[scores.argmax()], float(scores.max()), search.iterations)


def demonstrator(task: Adroit, plan: Plan) -> Demonstrator:
    """The plan with noise."""
    actions, noise = Synergies(task, task.episode_steps).actions(plan.knots), OUTLINES[task.name].search.noise

    def act(observations: FloatArray, step: int, rngs: Sequence[np.random.Generator]) -> FloatArray:
        return actions[step] + noise * np.stack([rng.standard_normal(task.num_actions) for rng in rngs])

    return act


def _score(
    simulator: Simulator,
    synergies: Synergies,
    knots: FloatArray,
    start: FloatArray,
    noise: float,
    rng: np.random.Generator,
) -> FloatArray:
    """Return and progress (B,) of knots (B, K, D) under noise; minus infinity where a simulation diverges."""
    actions = synergies.actions(knots)
    actions = np.clip(actions + noise * rng.standard_normal(actions.shape), -1, 1)
    moved = simulator.rollout(simulator.space.default_theta, actions, start)
    assert moved.rewards is not None
    progress = OUTLINES[synergies.task.name].progress(np.nan_to_num(moved.observations[:, 1:]))
    return np.where(moved.valid[:, -1], (moved.rewards + progress).sum(1), -np.inf)
