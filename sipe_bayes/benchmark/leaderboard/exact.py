"""Four problems whose posterior can be drawn from exactly, truths drawn from the prior.

Tasks T.1, T.2, T.5 and T.8 of J.-M. Lueckmann, J. Boelts, D. Greenberg, P. Goncalves, J. Macke 2021, "Benchmarking
Simulation-Based Inference" (https://arxiv.org/abs/2101.04653). Each observation is one x.

- gaussian_linear: theta ~ N(0, .1 I), x ~ N(theta, .1 I), 10 dimensions.
- gaussian_linear_uniform: theta ~ U(-1, 1)^10, x ~ N(theta, .1 I).
- gaussian_mixture: theta ~ U(-10, 10)^2, x ~ .5 N(theta, I) + .5 N(theta, .01 I).
- two_moons: theta ~ U(-1, 1)^2, x = (r cos a + .25, r sin a) + (-|theta_1 + theta_2|, theta_2 - theta_1) / sqrt(2),
  a ~ U(-pi/2, pi/2), r ~ N(.1, .01^2).

Deviations: the paper's tasks have ten observations, here there are twenty; the normal prior of the first is cut at four
sds, beyond which 6e-4 of its mass lie. The first two state their noise, so that likelihoods can be written down; the
others make their own.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy.stats import truncnorm

from sipe_bayes.benchmark.leaderboard.task import Case, Kind, Problem, Task
from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.parameters import Parameter, ParameterSpace
from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.likelihood import Segments, default_likelihood
from sipe_bayes.simulation.callable_simulator import CallableSimulator

_OBSERVATIONS, _BUDGET, _DRAWS = 20, 10_000, 2000
_SD = float(np.sqrt(0.1))
_CUT = 4.0  # sds of the normal prior

Sampler = Callable[[FloatArray, int, np.random.Generator], FloatArray]
"""Exact draws (M, N), physical, of an observation (D,)."""


@dataclass(frozen=True)
class _Exact:
    """One of the four: its unknowns, how it simulates, how it is drawn from."""

    parameters: tuple[Parameter, ...]
    simulate: Callable[..., FloatArray]
    draw: Sampler
    sd: float | None = None  # of the noise beside ``simulate``, None where that makes its own


def tasks() -> list[Task]:
    """The four."""
    about = f"{_OBSERVATIONS} observations of truths from the prior; the exact posterior is known"
    return [Task(name, Kind.EXACT, about, _BUDGET, partial(_problem, name)) for name in _ALL]


def _problem(name: str) -> Problem:
    exact = _ALL[name]
    space = ParameterSpace(exact.parameters)
    simulator = CallableSimulator(exact.simulate, space, exact.sd, name=f"leaderboard {name}")
    prior_draws = np.random.default_rng([2, list(_ALL).index(name)])
    cases = []
    for number in range(_OBSERVATIONS):
        truth = _from_prior(space, prior_draws)
        if exact.sd is None:
            x = exact.simulate(truth[None], prior_draws)[0]
        else:
            x = exact.simulate(truth[None])[0] + exact.sd * prior_draws.standard_normal(len(truth))
        drawn = exact.draw(x, _DRAWS, np.random.default_rng([3, number]))
        logs = Trajectories.stack(simulator.trajectory(x))
        cases.append(Case(f"x {number}", logs, space.normalise(truth), reference=np.clip(space.normalise(drawn), 0, 1)))
    likelihood = default_likelihood(simulator)
    assert isinstance(likelihood, Segments)  # as of every function
    return Problem(simulator, likelihood, tuple(cases))


def _from_prior(space: ParameterSpace, rng: np.random.Generator) -> FloatArray:
    """Physical values (N,)."""
    if space[0].prior_sd is None:
        return space.values(rng.random(len(space)))
    return np.asarray(_SD * truncnorm.rvs(-_CUT, _CUT, size=len(space), random_state=rng))


def _itself(values: FloatArray) -> FloatArray:
    return values


def _gaussian(x: FloatArray, count: int, rng: np.random.Generator) -> FloatArray:
    """The mean of prior and x, half the variance, cut where the prior is."""
    mean, sd, limit = x / 2, _SD / np.sqrt(2), _CUT * _SD
    return _cut_normal(mean, sd, limit, count, rng)


def _gaussian_uniform(x: FloatArray, count: int, rng: np.random.Generator) -> FloatArray:
    return _cut_normal(x, _SD, 1.0, count, rng)


def _cut_normal(mean: FloatArray, sd: float, limit: float, count: int, rng: np.random.Generator) -> FloatArray:
    ends = (-limit - mean) / sd, (limit - mean) / sd
    return np.asarray(truncnorm.rvs(*ends, mean, sd, size=(count, len(mean)), random_state=rng))


def _two_widths(values: FloatArray, rng: np.random.Generator) -> FloatArray:
    wide = rng.random((len(values), 1)) < 0.5
    return values + np.where(wide, 1.0, 0.1) * rng.standard_normal(values.shape)


def _mixture(x: FloatArray, count: int, rng: np.random.Generator) -> FloatArray:
    """By rejection: theta given x is x with the noise's distribution, within the prior's square."""
    return _within(lambda n: _two_widths(np.tile(x, (n, 1)), rng), 10.0, count)


def _crescent(count: int, rng: np.random.Generator) -> FloatArray:
    angle, radius = rng.uniform(-np.pi / 2, np.pi / 2, count), rng.normal(0.1, 0.01, count)
    return np.stack([radius * np.cos(angle) + 0.25, radius * np.sin(angle)], axis=1)


def _moons(values: FloatArray, rng: np.random.Generator) -> FloatArray:
    shift = np.stack([-np.abs(values.sum(1)), values[:, 1] - values[:, 0]], axis=1) / np.sqrt(2)
    return _crescent(len(values), rng) + shift


def _two_moons(x: FloatArray, count: int, rng: np.random.Generator) -> FloatArray:
    """The map from theta to the crescent keeps areas, so that theta given x is a crescent mapped back, either sign."""

    def draw(n: int) -> FloatArray:
        crescent = _crescent(n, rng)
        size, t = crescent[:, 0] - x[0], x[1] - crescent[:, 1]
        u = size * rng.choice([-1.0, 1.0], n)
        theta = np.stack([u - t, u + t], axis=1) / np.sqrt(2)
        return np.asarray(theta[size >= 0])

    return _within(draw, 1.0, count)


def _within(draw: Callable[[int], FloatArray], limit: float, count: int) -> FloatArray:
    """So many of the draws that lie within a square about zero."""
    kept: list[FloatArray] = []
    while sum(map(len, kept)) < count:
        some = draw(count)
        kept.append(some[(np.abs(some) <= limit).all(1)])
    return np.concatenate(kept)[:count]


def _uniform(count: int, limit: float) -> tuple[Parameter, ...]:
    return tuple(Parameter(f"theta_{j + 1}", -limit, limit) for j in range(count))


_NORMAL = tuple(Parameter(f"theta_{j + 1}", -_CUT * _SD, _CUT * _SD, prior_mean=0.0, prior_sd=_SD) for j in range(10))
_ALL = {
    "gaussian_linear": _Exact(_NORMAL, _itself, _gaussian, _SD),
    "gaussian_linear_uniform": _Exact(_uniform(10, 1.0), _itself, _gaussian_uniform, _SD),
    "gaussian_mixture": _Exact(_uniform(2, 10.0), _two_widths, _mixture),
    "two_moons": _Exact(_uniform(2, 1.0), _moons, _two_moons),
}
