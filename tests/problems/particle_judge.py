"""A judge from another family: SMC^2, which linearises nothing, over bootstrap filters of a state-space model.

Thetas from the uniform prior go through the log sample by sample, each with a bootstrap filter of its own whose mean
weight is an unbiased estimate of the sample's likelihood (N. Gordon, D. Salmond, A. Smith 1993,
https://doi.org/10.1049/ip-f-2.1993.0015). Where few thetas are left, they are drawn anew and moved by Metropolis steps
with filters from the beginning (C. Andrieu, A. Doucet, R. Holenstein 2010,
https://doi.org/10.1111/j.1467-9868.2009.00736.x), so that they stay draws of the posterior however few particles a
filter has (N. Chopin, P. E. Jacob, O. Papaspiliopoulos, "SMC^2", 2013, https://arxiv.org/abs/1101.1528).

B rows are M thetas times P particles.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.likelihood.state_space.chain import Chain
from sipe_bayes.likelihood.state_space.linearisation import ChainNoise


class Particular(Protocol):
    """A state-space model, simulated."""

    samples: int

    def begins(self, k: int) -> bool:
        """Whether sample k is the first of a log."""

    def first(self, k: int, count: int, rng: np.random.Generator) -> FloatArray:
        """States (B, S) from p(state | first sample), whose likelihood is that of every theta."""

    def step(self, theta: FloatArray, states: FloatArray, k: int) -> tuple[FloatArray, FloatArray]:
        """Log p(sample k | state) (B,), and where states (B, S) end without process noise."""

    def scattered(self, ends: FloatArray, k: int, rng: np.random.Generator) -> FloatArray:
        """With the process noise that follows sample k."""


@dataclass(frozen=True)
class Judged:
    """Draws (M, N) of the posterior; the share that moved as often as asked for, and Metropolis steps accepted."""

    theta: FloatArray
    moved: float
    accepted: float


def advanced(
    model: Particular, theta: FloatArray, states: FloatArray, k: int, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Increments (M,) of the log likelihoods by sample k, and states (M, P, S) at the next one."""
    many, particles, size = states.shape
    weight, ends = model.step(np.repeat(theta, particles, axis=0), states.reshape(many * particles, size), k)
    weight, ends = weight.reshape(many, particles), ends.reshape(many, particles, -1)
    increment = np.zeros(many)
    if not model.begins(k):
        most = np.maximum(weight.max(1), -1e300)
        share = np.exp(weight - most[:, None])
        increment = most + np.log(np.maximum(share.mean(1), 1e-300))
        # systematic resampling, all thetas in one search: row m between m and m + 1
        cumulative = np.cumsum(share + 1e-300, axis=1)
        cumulative /= cumulative[:, -1:]
        comb = (np.arange(particles) + rng.random((many, 1))) / particles
        row = np.arange(many)[:, None]
        drawn = np.searchsorted((cumulative + row).ravel(), (comb + row).ravel()).reshape(many, particles)
        ends = ends[row, np.clip(drawn - row * particles, 0, particles - 1)]
    if k + 1 < model.samples and model.begins(k + 1):
        return increment, model.first(k + 1, many * particles, rng).reshape(many, particles, size)
    return increment, model.scattered(ends.reshape(many * particles, -1), k, rng).reshape(many, particles, -1)


def filtered(
    model: Particular, theta: FloatArray, particles: int, rng: np.random.Generator, until: int | None = None
) -> tuple[FloatArray, FloatArray]:
    """Estimates (M,) of log p(samples before ``until`` | theta (M, N)), their exponentials unbiased, and states."""
    states = model.first(0, len(theta) * particles, rng).reshape(len(theta), particles, -1)
    total = np.zeros(len(theta))
    for k in range(model.samples if until is None else until):
        increment, states = advanced(model, theta, states, k, rng)
        total += increment
    return total, states


def enough_particles(
    model: Particular, theta: FloatArray, rng: np.random.Generator, first: int = 64, most: int = 2048
) -> int:
    """Particles, doubled until estimates of the log likelihood at theta (N,) have an sd of one, or ``most``.

    With fewer a Metropolis chain sticks where an estimate came out too large (A. Doucet, M. Pitt, G. Deligiannidis,
    R. Kohn 2015, https://doi.org/10.1093/biomet/asu075).
    """
    particles = first
    while particles < most and filtered(model, np.tile(theta, (16, 1)), particles, rng)[0].std(ddof=1) > 1.0:
        particles *= 2
    return particles


def judge(
    model: Particular, size: int, thetas: int, particles: int, rng: np.random.Generator, times: int = 1, most: int = 8
) -> Judged:
    """Draws of the posterior of theta, uniform a priori in the unit cube of ``size`` dimensions.

    In the end they are moved until 19 of 20 have ``times``, by ``most`` steps at most: what was drawn alike parts.
    """
    theta = rng.random((thetas, size))
    states = model.first(0, thetas * particles, rng).reshape(thetas, particles, -1)
    total, log_weight = np.zeros(thetas), np.zeros(thetas)
    moves, accepted = np.zeros(thetas, int), list[float]()
    for k in range(model.samples):
        increment, states = advanced(model, theta, states, k, rng)
        total, log_weight = total + increment, log_weight + increment
        weight = np.exp(log_weight - log_weight.max())
        weight /= weight.sum()
        if k + 1 < model.samples and 1 / (weight**2).sum() > thetas / 2:
            continue
        centre = weight @ theta
        spread = np.atleast_2d((theta - centre).T @ ((theta - centre) * weight[:, None])) + 1e-12 * np.eye(size)
        root = np.linalg.cholesky(spread)
        chosen = np.searchsorted(np.cumsum(weight), (np.arange(thetas) + rng.random()) / thetas).clip(0, thetas - 1)
        theta, states, total = theta[chosen], states[chosen], total[chosen]
        log_weight, moves, last = np.zeros(thetas), np.zeros(thetas, int), k + 1 == model.samples
        for n in range(most):
            length = (2.4, 1.2)[n % 2] / np.sqrt(size)
            proposed = theta + length * rng.standard_normal((thetas, size)) @ root.T
            inside = ((proposed >= 0) & (proposed <= 1)).all(1)
            value, ends = filtered(model, np.clip(proposed, 0, 1), particles, rng, until=k + 1)
            taken = inside & (np.log(rng.random(thetas)) < value - total)
            theta, total = np.where(taken[:, None], proposed, theta), np.where(taken, value, total)
            states = np.where(taken[:, None, None], ends, states)
            moves, accepted = moves + taken, [*accepted, taken.mean()]
            if (moves >= times).mean() > 0.95 if last else (moves > 0).mean() > 0.5:
                break
    return Judged(theta, float((moves >= times).mean()), float(np.mean(accepted)))


class ChainModel:
    """A ``StateSpace``'s chain with its noise held, simulated by the batch engine.

    First states come from the prior and the channels that measure a coordinate directly, which must be all.
    """

    def __init__(self, chain: Chain, noise: ChainNoise) -> None:
        self.chain, self.noise, self.samples = chain, noise, len(chain.log)

    def begins(self, k: int) -> bool:
        """See ``Particular``."""
        return bool(self.chain.first[k])

    def first(self, k: int, count: int, rng: np.random.Generator) -> FloatArray:
        """See ``Particular``."""
        chain = self.chain
        at = np.array([k])
        predicted, _, _ = chain.simulate(np.full((1, chain.num_theta), 0.5), chain.reference[None, at], at)
        precision, pull = chain.prior_precision[k].copy(), np.zeros(chain.num_start)
        for c, coordinate in enumerate(chain.coordinates):
            if coordinate is None or not chain.observed[k, c]:
                raise ValueError("a first sample must measure coordinates directly")
            precision[coordinate] += self.noise.sd[c] ** -2.0
            pull[coordinate] += (chain.measured[k, c] - predicted[0, 0, c]) / self.noise.sd[c] ** 2
        tangent = pull / precision + rng.standard_normal((count, chain.num_start)) / np.sqrt(precision)
        return chain.moved(np.tile(chain.reference[k], (count, 1)), tangent)

    def step(self, theta: FloatArray, states: FloatArray, k: int) -> tuple[FloatArray, FloatArray]:
        """See ``Particular``."""
        chain, seen = self.chain, self.chain.observed[k]
        predicted, ends, valid = chain.simulate(theta, states[:, None], np.array([k]))
        gaps = (chain.measured[k] - predicted[:, 0])[:, seen] / self.noise.sd[seen]
        constant = np.log(self.noise.sd[seen]).sum() + 0.5 * seen.sum() * np.log(2 * np.pi)
        value = np.where(valid[:, 0], -0.5 * (gaps**2).sum(1) - constant, -np.inf)
        return value, np.where(valid[:, :1], ends[:, 0], chain.reference[k])

    def scattered(self, ends: FloatArray, k: int, rng: np.random.Generator) -> FloatArray:
        """See ``Particular``."""
        if k + 1 == self.samples:
            return ends
        sd = np.broadcast_to(self.noise.jump_sd, (self.samples - 1, self.chain.num_start))[k]
        return self.chain.moved(ends, sd * rng.standard_normal((len(ends), self.chain.num_start)))
