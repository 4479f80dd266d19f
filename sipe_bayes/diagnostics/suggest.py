"""Which experiment next? Command sequences ranked by what they are expected to tell of the parameters asked for.

At theta the simulation of planned commands is linearised, initial states marginalised, noise as given; what is left is
the Fisher information I(theta) = J' V^-1 J. With the present knowledge, a normal of precision P, the experiment leaves
the covariance (P + I)^-1 (D. Lindley 1956, "On a measure of the information provided by an experiment",
https://doi.org/10.1214/aoms/1177728069). The score is the A-criterion (K. Chaloner, I. Verdinelli 1995,
https://doi.org/10.1214/ss/1177009939) in sds: the contraction of each parameter's sd, averaged over draws of theta and
over the parameters asked for. At a draw where a candidate diverges it tells nothing.

Candidates that take a measured quantity further than logs went, by more than half of what that was in all, come after
those that do not and tell half as much as the best at least: whether the machine may go there is not known here.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.signal
import torch

from sipe_bayes.core.arrays import BoolArray, FloatArray
from sipe_bayes.core.trajectory import Trajectories, Trajectory
from sipe_bayes.likelihood import UNIFORM_PRECISION, Noise, Segments, bind
from sipe_bayes.posterior import Posterior
from sipe_bayes.simulation.simulator import Simulator

KINDS = ("chirp up", "chirp down", "sines")


@dataclass(frozen=True)
class Plan:
    """An experiment from the model's own initial state: actions (T, A), each held for dt s."""

    actions: FloatArray
    dt: float
    name: str = "planned"


@dataclass(frozen=True)
class Suggestion:
    """A plan, the expected contraction of each parameter's sd, and the mean over those asked for (``score``).

    ``reach`` is the lowest and highest value of each channel over the draws, ``diverged`` the number of these that did,
    ``strays`` the channels that go far beyond what logs reached.
    """

    plan: Plan
    score: float
    contraction: dict[str, float]
    reach: dict[str, tuple[float, float]]
    diverged: int
    strays: tuple[str, ...] = ()

    def to_dict(self) -> dict[str, object]:
        """As JSON has it, without the commands."""
        return {"name": self.plan.name} | {key: value for key, value in vars(self).items() if key != "plan"}


def rank(
    simulator: Simulator,
    likelihood: Segments,
    plans: Sequence[Plan],
    noise: Noise,
    known: Posterior,
    names: Sequence[str] = (),
    *,
    reached: FloatArray | None = None,
    draws: int = 4,
    seed: int = 0,
) -> list[Suggestion]:
    """Plans, the most telling first of those that do not stray, then the others.

    The log would be fitted with ``likelihood`` beside ``noise`` (C,) of the fitted channels. The gain is averaged over
    ``draws`` of what is ``known``, the prior or the posterior so far, and over the parameters ``names``, by default all
    that are not of one log. ``reached`` (C, 2), the lowest and highest value of each channel in logs, is by default
    none, of which nothing strays.

    Raises:
        ValueError: for unknown names, and for those of one log.
    """
    space = known.space
    for name in names:
        if name not in space.names:
            raise ValueError(f"names: no parameter {name!r}; there are {', '.join(space.names)}")
        if space[space.index(name)].log is not None:
            raise ValueError(f"names: {name!r} is of a log that is there already; a new one tells nothing of it")
    wanted = [j for j, p in enumerate(space) if (p.name in names if names else p.log is None)]
    thetas = known.sample((draws,), generator=torch.Generator().manual_seed(seed)).numpy()
    start, channels, ranked = simulator.default_state(), simulator.environment.channels, []
    precision = np.asarray(np.linalg.inv(known.covariance.numpy() + 1e-12 * np.eye(len(space))), np.float64)
    for plan in plans:
        gains = [information(simulator, likelihood, plan, noise, theta) for theta in thetas]
        gain = contraction(precision, [np.zeros_like(precision) if gain is None else gain for gain in gains])
        lost = sum(gain is None for gain in gains)
        motion = simulator.rollout(thetas, plan.actions[None], start[None], plan.dt, [plan.name] * draws)
        seen = np.where(motion.valid[..., None], motion.observations, np.nan)
        reach = np.stack([np.nanmin(seen, axis=(0, 1)), np.nanmax(seen, axis=(0, 1))], axis=1)
        far = [] if reached is None else np.flatnonzero(_strays(reach, reached)).tolist()
        each = dict(zip(space.names, gain.tolist(), strict=True))
        ends = dict(zip(channels, map(tuple, reach.tolist()), strict=True))
        ranked.append(Suggestion(plan, float(gain[wanted].mean()), each, ends, lost, tuple(channels[c] for c in far)))
    worth = 0.5 * max((one.score for one in ranked), default=0.0)
    return sorted(ranked, key=lambda one: (bool(one.strays) or one.score < worth, -one.score))


def information(
    simulator: Simulator, likelihood: Segments, plan: Plan, noise: Noise, theta: FloatArray
) -> FloatArray | None:
    """Fisher information (N, N) of a plan at theta (N,), its own nuisances marginalised; None where it diverges."""
    start = simulator.default_state()[None]
    motion = simulator.rollout(theta[None], plan.actions[None], start, plan.dt, [plan.name])
    if motion.states is None or not motion.valid.all():
        return None
    log = Trajectory(
        motion.observations[0], plan.actions, plan.dt, motion.states[0], plan.name, simulator.environment.channels
    )
    windows = bind(likelihood, simulator, Trajectories.stack(log))
    windows.start_precision = windows.weak_precision  # without noise it would seem to be measured exactly
    linearisation = windows.linearise(theta, windows.no_starts())
    if not linearisation.valid:
        return None
    normal, space = windows.moments(linearisation).normal(noise), simulator.space
    plain = windows.eliminate(normal, windows.num_theta).precision
    # in place of each nuisance of one log a new value, marginalised: the simulation takes the mean of K logs for it,
    # whose uniform prior is that of K values K times as uncertain
    own, shared = ([j for j, p in enumerate(space) if (p.log is None) == common] for common in (False, True))
    logs = Counter(space[j].targets for j in own)
    loose = np.array([UNIFORM_PRECISION / logs[space[j].targets] for j in own])
    cross, inner = plain[np.ix_(shared, own)], plain[np.ix_(own, own)] + np.diag(loose)
    marginal = np.zeros_like(plain)
    marginal[np.ix_(shared, shared)] = plain[np.ix_(shared, shared)] - cross @ np.linalg.solve(inner, cross.T)
    return marginal


def contraction(precision: FloatArray, gains: Sequence[FloatArray]) -> FloatArray:
    """Expected 1 - sd afterwards / sd now (N,), by the precision (N, N) now and informations (N, N) of the plan."""
    after = np.mean([np.sqrt(np.diag(np.linalg.inv(precision + gain))) for gain in gains], axis=0)
    return np.asarray(1 - after / np.sqrt(np.diag(np.linalg.inv(precision))))


def _strays(reach: FloatArray, reached: FloatArray) -> BoolArray:
    """Of which channels (C,) a reach (C, 2) goes far beyond another."""
    room = 0.5 * np.diff(reached, axis=1)[:, 0]
    far = (reach[:, 0] < reached[:, 0] - room) | (reach[:, 1] > reached[:, 1] + room) | ~np.isfinite(reach).all(1)
    return np.asarray(far & np.isfinite(reached).all(1))


def limits(simulator: Simulator, recorded: FloatArray | None = None) -> FloatArray:
    """Lowest and highest command (A, 2) of each actuator: its control range, else of what was ``recorded`` (T, A).

    Raises:
        ValueError: where neither tells.
    """
    environment, model = simulator.environment, simulator.model
    ranges = np.full((environment.num_actions, 2), np.nan)
    if recorded is not None:
        ranges[:] = np.stack([recorded.min(0), recorded.max(0)], axis=1)
    for j, name in enumerate(getattr(environment, "actuators", None) or ()):
        if model.actuator_ctrllimited[model.actuator(name).id]:
            ranges[j] = model.actuator_ctrlrange[model.actuator(name).id]
    if not (ranges[:, 0] < ranges[:, 1]).all():
        missing = "the model states no control range and in no log the command changes"
        raise ValueError(f"limits: {missing}; give the actuators ctrlrange")
    return ranges


def generate(
    count: int, duration: float, dt: float, bounds: FloatArray, band: tuple[float, float], seed: int = 0
) -> list[Plan]:
    """So many plans of all kinds and sizes in turn, of commands within ``bounds`` (A, 2), each held for ``dt`` s.

    Chirps go from one end of the ``band``, in Hz, to the other by equal factors in equal times; sums of at most ten
    sines have random phases, at multiples of 1 / ``duration`` in s. In 5 % of it
    a plan rises from, and falls to, the command that is nearest to zero.

    Raises:
        ValueError: for a band that the duration or dt cannot hold.
    """
    low, high = band
    if not 1 / duration <= low < high < 0.5 / dt:
        expected = f"{1 / duration:.3g} <= low < high < {0.5 / dt:.3g} Hz for {duration:g} s of {dt:g} s steps"
        raise ValueError(f"band: expected {expected}, got {low:g} and {high:g}")
    rng = np.random.default_rng(seed)
    time = np.asarray(np.arange(round(duration / dt)) * dt, np.float64)
    edge = np.clip(np.minimum(time, time[-1] - time) / (0.05 * duration), 0.0, 1.0)
    plans = []
    for number in range(count):
        kind, size = KINDS[number % len(KINDS)], (1.0, 0.5, 0.25)[number // len(KINDS) % 3]
        waves = np.stack([_wave(kind, time, low, high, rng) for _ in bounds], axis=1)
        middle, half = bounds.mean(1), np.diff(bounds, axis=1)[:, 0] / 2
        rest = np.clip(0.0, bounds[:, 0], bounds[:, 1])
        actions = rest + edge[:, None] * (middle - rest + size * half * waves)
        plans.append(Plan(actions, dt, name=f"{kind}, {size:g} of the limits, {number}"))
    return plans


def _wave(kind: str, time: FloatArray, low: float, high: float, rng: np.random.Generator) -> FloatArray:
    """One actuator's wave (T,) within -1 and 1."""
    if kind.startswith("chirp"):
        begin, end = (low, high) if kind.endswith("up") else (high, low)
        return np.asarray(scipy.signal.chirp(time, begin, time[-1], end, "logarithmic", rng.uniform(0, 360)))
    multiples = np.arange(np.ceil(low * time[-1]), np.floor(high * time[-1]) + 1)
    if not len(multiples):  # a narrow band
        multiples = np.array([np.sqrt(low * high) * time[-1]])
    chosen = rng.choice(multiples, min(10, len(multiples)), replace=False) / time[-1]
    wave = np.sin(2 * np.pi * chosen * time[:, None] + rng.uniform(0, 2 * np.pi, len(chosen))).sum(1)
    return np.asarray(wave / np.abs(wave).max())
