"""Which experiment next? Command sequences ranked by what they are expected to tell of the parameters asked for.

For each candidate, the contraction of each parameter's sd that its Fisher information promises
(``diagnostics.expected``), averaged over draws of what is known now and over the parameters asked for. Candidates are
given, or generated within each actuator's limits:

- chirps: the frequency goes from one end of the band to the other, up or down, by equal factors in equal times;
- band-limited noise: white noise through a Butterworth band-pass filter of second order, scaled to its largest value;
- sums of sines of random phases, as many as the band holds multiples of 1 / duration, at most ten (M. Schroeder 1970,
  "Synthesis of low-peak-factor signals", https://doi.org/10.1109/TIT.1970.1054411, chooses phases; here they are
  drawn).

A candidate ends as it began, within a tenth of its duration, at zero or the middle of the limits. One that diverges at
a draw counts there as telling nothing. Whether the machine may go where a candidate takes it is not known here; so what
each reaches is stated, and those that take a measured quantity further than logs went, by more than half of what that
was in all, come after those that do not and tell half as much as the best at least.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import scipy.signal
import torch

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.options import Options, option
from sipe_bayes.diagnostics.expected import Plan, contraction, informations, knowledge
from sipe_bayes.likelihood import Noise, Segments
from sipe_bayes.posterior import Posterior
from sipe_bayes.simulation.simulator import Simulator

KINDS = ("chirp up", "chirp down", "noise", "sines")


@dataclass(frozen=True)
class SequenceOptions(Options):
    """How command sequences are made."""

    sizes: tuple[float, ...] = option((1.0, 0.5, 0.25), "in turn", "of the limits")
    sines: int = option(10, "at most, in a sum", least=1)
    beyond: float = option(0.5, "of what logs reached of a channel, beyond which a sequence strays", above=0)
    worth: float = option(0.5, "of the best score, from which a sequence that does not stray goes before", least=0)
    edge: float = option(0.05, "at either end, over which it begins and ends", "of the duration", above=0)


_OPTIONS = SequenceOptions()


@dataclass(frozen=True)
class Suggestion:
    """A plan and its worth.

    Args:
        plan: the experiment.
        score: mean contraction of the parameters asked for.
        contraction: (N,) expected of each parameter's sd.
        reach: (C, 2) lowest and highest value of each channel over the draws.
        diverged: at how many of the draws.
        strays: numbers of the channels that go far beyond what logs reached.
    """

    plan: Plan
    score: float
    contraction: FloatArray
    reach: FloatArray
    diverged: int
    strays: tuple[int, ...] = ()


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
    tell: Callable[[int, int], None] = lambda done, of: None,
) -> list[Suggestion]:
    """Plans, the most telling first of those that do not stray, then the others.

    Args:
        simulator: of the model.
        likelihood: that the log would be fitted with.
        plans: the candidates.
        noise: (C,) of the fitted channels.
        known: the prior, or the posterior so far.
        names: of the parameters that count; default all that are not of one log.
        reached: (C, 2) lowest and highest value of each channel in logs; default none, of which nothing strays.
        draws: of ``known``, over which the gain is averaged.
        seed: of the draws.
        tell: called with how many plans are done, and of how many.

    Raises:
        ValueError: for unknown names, and for those of one log.
    """
    space = known.space
    unknown = [name for name in names if name not in space.names]
    if unknown:
        raise ValueError(f"names: no parameter {unknown[0]!r}; there are {', '.join(space.names)}")
    old = [name for name in names if space[space.index(name)].log is not None]
    if old:
        raise ValueError(f"names: {old[0]!r} is of a log that is there already; a new one tells nothing of it")
    wanted = [j for j, p in enumerate(space) if (p.name in names if names else p.log is None)]
    thetas = known.sample((draws,), generator=torch.Generator().manual_seed(seed)).numpy()
    precision, ranked = knowledge(known), []
    nothing = np.zeros((len(space), len(space)))
    for number, plan in enumerate(plans):
        tell(number, len(plans))
        gains = informations(simulator, likelihood, plan, noise, thetas)
        lost = draws - len(gains)
        gain = contraction(precision, gains + [nothing] * lost)
        reach = _reach(simulator, plan, thetas)
        far = () if reached is None else _strays(reach, reached)
        ranked.append(Suggestion(plan, float(gain[wanted].mean()), gain, reach, lost, far))
    worth = _OPTIONS.worth * max((one.score for one in ranked), default=0.0)
    return sorted(ranked, key=lambda one: (bool(one.strays) or one.score < worth, -one.score))


def _strays(reach: FloatArray, reached: FloatArray) -> tuple[int, ...]:
    """Numbers of the channels of which a reach (C, 2) goes far beyond another."""
    room = _OPTIONS.beyond * np.diff(reached, axis=1)[:, 0]
    far = (reach[:, 0] < reached[:, 0] - room) | (reach[:, 1] > reached[:, 1] + room) | ~np.isfinite(reach).all(1)
    return tuple(np.flatnonzero(far & np.isfinite(reached).all(1)).tolist())


def _reach(simulator: Simulator, plan: Plan, thetas: FloatArray) -> FloatArray:
    start = simulator.default_state() if plan.start is None else plan.start
    motion = simulator.rollout(thetas, plan.actions[None], start[None], plan.dt, [plan.name] * len(thetas))
    seen = np.where(motion.valid[..., None], motion.observations, np.nan)
    return np.stack([np.nanmin(seen, axis=(0, 1)), np.nanmax(seen, axis=(0, 1))], axis=1)


def limits(simulator: Simulator, recorded: FloatArray | None = None) -> FloatArray:
    """Lowest and highest command of each actuator.

    Args:
        simulator: of the model, whose control ranges come first.
        recorded: (T, A) what was commanded before.

    Returns:
        (A, 2).

    Raises:
        ValueError: where neither tells.
    """
    environment, model = simulator.environment, simulator.model
    ranges = np.full((environment.num_actions, 2), np.nan)
    names = getattr(environment, "actuators", None)
    for j in range(environment.num_actions):
        actuator = model.actuator(names[j]).id if names is not None else None
        if actuator is not None and model.actuator_ctrllimited[actuator]:
            ranges[j] = model.actuator_ctrlrange[actuator]
        elif recorded is not None:
            ranges[j] = recorded[:, j].min(), recorded[:, j].max()
    if not (ranges[:, 0] < ranges[:, 1]).all():
        missing = "the model states no control range and in no log the command changes"
        raise ValueError(f"limits: {missing}; give the actuators ctrlrange")
    return ranges


def generate(
    count: int, duration: float, dt: float, bounds: FloatArray, band: tuple[float, float], seed: int = 0
) -> list[Plan]:
    """Plans of all kinds in turn, of all sizes in turn.

    Args:
        count: how many.
        duration: s.
        dt: s that a command is held.
        bounds: (A, 2) lowest and highest command.
        band: lowest and highest frequency, Hz.
        seed: of noise and phases.

    Raises:
        ValueError: for a band that the duration or dt cannot hold.
    """
    low, high = band
    steps = round(duration / dt)
    if not 1 / duration <= low < high < 0.5 / dt:
        raise ValueError(
            f"band: expected {1 / duration:.3g} <= low < high < {0.5 / dt:.3g} Hz for {duration:g} s of {dt:g} s "
            f"steps, got {low:g} and {high:g}"
        )
    rng = np.random.default_rng(seed)
    time = np.asarray(np.arange(steps) * dt, np.float64)
    edge = np.clip(np.minimum(time, time[-1] - time) / (_OPTIONS.edge * duration), 0.0, 1.0)
    plans = []
    for number in range(count):
        kind, size = KINDS[number % len(KINDS)], _OPTIONS.sizes[number // len(KINDS) % len(_OPTIONS.sizes)]
        waves = np.stack([_wave(kind, time, low, high, rng) for _ in bounds], axis=1)
        middle, half = bounds.mean(1), np.diff(bounds, axis=1)[:, 0] / 2
        rest = np.clip(0.0, bounds[:, 0], bounds[:, 1])
        actions = rest + edge[:, None] * (middle - rest + size * half * waves)
        plans.append(Plan(actions, dt, name=f"{kind}, {size:g} of the limits, {number}"))
    return plans


def _wave(kind: str, time: FloatArray, low: float, high: float, rng: np.random.Generator) -> FloatArray:
    """One actuator's wave (T,) within -1 and 1."""
    phase = rng.uniform(0, 2 * np.pi)
    if kind.startswith("chirp"):
        ends = (low, high) if kind.endswith("up") else (high, low)
        ratio = ends[1] / ends[0]
        swept = ends[0] * time[-1] / np.log(ratio) * (ratio ** (time / time[-1]) - 1)
        return np.asarray(np.sin(2 * np.pi * swept + phase))
    if kind == "noise":
        dt = time[1] - time[0]
        sections = scipy.signal.butter(2, [low, high], "bandpass", fs=1 / dt, output="sos")
        wave = scipy.signal.sosfiltfilt(sections, rng.standard_normal(len(time)), padlen=0)
    else:
        multiples = np.arange(np.ceil(low * time[-1]), np.floor(high * time[-1]) + 1)
        if not len(multiples):  # a narrow band
            multiples = np.array([np.sqrt(low * high) * time[-1]])
        chosen = rng.choice(multiples, min(_OPTIONS.sines, len(multiples)), replace=False) / time[-1]
        wave = np.sin(2 * np.pi * chosen * time[:, None] + rng.uniform(0, 2 * np.pi, len(chosen))).sum(1)
    return np.asarray(wave / np.abs(wave).max())


def to_dict(suggestions: Sequence[Suggestion], simulator: Simulator, names: Sequence[str]) -> dict[str, object]:
    """As JSON has it, the best first.

    Args:
        suggestions: as of ``rank``.
        simulator: of the model.
        names: of the parameters that count; default all.
    """
    space, channels = simulator.space, simulator.environment.channels
    return {
        "parameters": list(names or space.names),
        "candidates": [
            {
                "name": one.plan.name,
                "score": one.score,
                "contraction": dict(zip(space.names, one.contraction.tolist(), strict=True)),
                "reach": dict(zip(channels, one.reach.tolist(), strict=True)),
                "diverged": one.diverged,
                "strays": [channels[c] for c in one.strays],
            }
            for one in suggestions
        ],
    }
