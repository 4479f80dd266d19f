"""Noise of a chain of states: first guesses, and estimates that alternate with the smoother's steps.

Given the linearisation, the noise sds maximise the likelihood with states and theta integrated out (restricted
likelihood), found by L-BFGS with Fisher's gradient. Where the model is right the process noise shrinks until the
likelihood no longer cares.

Deviations:

- The noise is held at its optimum while theta and states are searched; that it is uncertain enters the normal of theta
  afterwards (``noise_average``).
- A coordinate's process noise q has a prior q^0.5 exp(-q / movement), movement being how far the coordinate moves in a
  control step: the likelihood leaves the process noise of an unmeasured coordinate open above, and any that is small
  enough open below, where an estimate of zero would be overconfident (Y. Chung, S. Rabe-Hesketh, V. Dorie, A. Gelman,
  J. Liu, "A nondegenerate penalized likelihood estimator for variance parameters in multilevel models", 2013,
  https://doi.org/10.1007/s11336-013-9328-2, have a whole power).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy.optimize

from sipe_bayes.core.arrays import BoolArray, FloatArray, IntArray
from sipe_bayes.inference.laplace.state_space.options import NoiseTuning
from sipe_bayes.inference.laplace.state_space.smoother import border
from sipe_bayes.likelihood.block_tridiagonal import Border, damped_box_step
from sipe_bayes.likelihood.noise import NORMAL_MAD
from sipe_bayes.likelihood.quadratic_prior import QuadraticPrior
from sipe_bayes.likelihood.state_space.chain import Chain
from sipe_bayes.likelihood.state_space.linearisation import (
    ChainLinearisation,
    ChainNoise,
    eliminate_states,
    expected_squares,
    integrate,
    restricted,
)


@dataclass(frozen=True)
class NoisePosterior:
    """What one linearisation says of its noise, by logarithms of the sds that are unknown and tell scales apart (F,).

    Args:
        chain: the logs.
        linear: the linearisation.
        noise: where its logarithms begin; sds that are given are kept.
        prior: on theta.
        theta: (N,), of the linearisation.
        movement: (D,), the scales of the process noises' priors.
        tuning: its numbers.
        held: as in ``restricted``.
    """

    chain: Chain
    linear: ChainLinearisation
    noise: ChainNoise
    prior: QuadraticPrior
    theta: FloatArray
    movement: FloatArray
    tuning: NoiseTuning
    held: bool = False

    @cached_property
    def hold(self) -> Border:
        """What holds theta besides the data."""
        return border(self.prior, self.theta, eliminate_states(self.linear, self.noise).gradient)

    @cached_property
    def promised(self) -> float:
        """Nats that a step of theta and states would gain at ``noise``, were all linear."""
        return (
            restricted(self.linear, self.noise, self.hold)[0] - restricted(self.linear, self.noise, self.hold, True)[0]
        )

    @property
    def freedom(self) -> float:
        """How many numbers of the log theta and states can follow: fitting its noise gains half as many nats."""
        done = integrate(self.linear, self.noise, self.hold, held=True)
        squares, _ = expected_squares(self.linear, done.solved, done.step, done.covariance)
        spread = squares - self.linear.observed * self.linear.residual**2
        return float((spread / self.noise.sd**2).sum())

    @cached_property
    def least(self) -> FloatArray:
        """Logarithms (C + D,) of the least sds."""
        least_sd, least_process = self.chain.least
        return np.log(np.concatenate([least_sd, np.maximum(least_process, self.tuning.least_share * self.movement)]))

    @cached_property
    def start(self) -> FloatArray:
        """Logarithms (C + D,) of ``noise``."""
        return np.maximum(np.log(np.concatenate([self.noise.sd, self.noise.process])), self.least)

    @cached_property
    def owner(self) -> IntArray:
        """(C + D,): of channels of one scale the first stands for all."""
        channels = len(self.noise.sd)
        return np.concatenate([_first(self.chain.scales), channels + np.arange(len(self.noise.process))])

    @cached_property
    def free(self) -> BoolArray:
        """(C + D,): which are unknown and stand for themselves."""
        unknown = np.concatenate([np.isnan(self.chain.fixed_sd), np.full(len(self.noise.process), True)])
        return unknown & (self.owner == np.arange(len(self.owner)))

    def at(self, logs: FloatArray) -> ChainNoise:
        """The noise of logarithms (F,)."""
        everything, channels, fixed = self.start.copy(), len(self.noise.sd), self.chain.fixed_sd
        everything[self.free] = logs
        everything = everything[self.owner]
        sd = np.where(np.isnan(fixed), np.exp(everything[:channels]), self.noise.sd)
        return replace(self.noise, sd=sd, process=np.exp(everything[channels:]))

    def loss(self, logs: FloatArray) -> tuple[float, FloatArray]:
        """-log posterior of logarithms (F,), up to a constant, and its slopes (F,)."""
        tried = self.at(logs)
        try:
            value, by_sd, by_process = restricted(self.linear, tried, self.hold, self.held)
        except np.linalg.LinAlgError:  # so far apart that rounding rules
            return 1e300, np.zeros(len(logs))  # L-BFGS takes no infinity
        slope = tried.process / self.movement - self.tuning.prior_power
        slopes = np.bincount(self.owner, np.concatenate([-by_sd, slope - by_process]), len(self.owner))
        return process_penalty(tried, self.movement, self.tuning) - value, np.asarray(slopes[self.free], float)


def infer_noise(posterior: NoisePosterior) -> tuple[ChainNoise, float]:
    """Noise that maximises the restricted likelihood of one linearisation, each sd within a factor of ten.

    Begins at its ``noise``. Returns the noise, and the nats that it gains.
    """
    tuning, free = posterior.tuning, posterior.free
    least, start = posterior.least[free], posterior.start[free]
    span = np.log(tuning.most_factor)
    bounds = [(max(low, s - span), s + span) for low, s in zip(least, start, strict=True)]
    before = posterior.loss(start)[0]
    limits = {"maxiter": tuning.search_steps, "maxfun": tuning.search_steps + 4}
    best = scipy.optimize.minimize(posterior.loss, start, jac=True, method="L-BFGS-B", bounds=bounds, options=limits)
    return posterior.at(best.x), float(before - best.fun)


def _first(scales: IntArray) -> IntArray:
    """The first channel (C,) of each channel's scale."""
    return np.unique(scales, return_index=True)[1][scales]


def process_penalty(noise: ChainNoise, movement: FloatArray, tuning: NoiseTuning) -> float:
    """-log prior of the process noises in their logarithms' place, up to a constant; movement (D,): their scales."""
    share = noise.process / movement
    return float((share - tuning.prior_power * np.log(share)).sum())


def regress(linear: ChainLinearisation, prior: QuadraticPrior, theta: FloatArray, tuning: NoiseTuning) -> FloatArray:
    """Theta (N,) after one reweighted least-squares step on the jumps, the states as they are.

    The weights are those of a Student t: contacts amplify the noise of a measurement manyfold.
    """
    scale = jump_scale(linear)
    weights = linear.linked[:, None] / (scale**2 * (1 + (linear.jump / scale) ** 2 / tuning.freedom))
    slopes, hold = linear.transition_theta, border(prior, theta, np.zeros_like(theta))
    hessian = np.einsum("kdn,kd,kdm->nm", slopes, weights, slopes, optimize=True) + hold.precision
    gradient = np.einsum("kdn,kd->n", slopes, weights * linear.jump) + hold.pull
    return np.asarray(np.clip(theta + damped_box_step(hessian, gradient, theta, damping=1e-6), 0.0, 1.0))


def jump_scale(linear: ChainLinearisation) -> FloatArray:
    """Robust sd (D,) of the jumps, from their median size; never zero."""
    size = NORMAL_MAD * np.median(np.abs(linear.jump[linear.linked]), axis=0)
    return np.asarray(np.maximum(size, 1e-9 * max(float(size.max()), 1e-300)))


def first_noise(chain: Chain, linear: ChainLinearisation, movement: FloatArray, tuning: NoiseTuning) -> ChainNoise:
    """A guess from the first guess of the states; movement (D,): of each coordinate in a control step.

    Measurement noise: what third differences of a channel leave, at most a third of the jumps of the coordinate that it
    measures. Process noise: as large as the jumps, or where states are what the commands lead to a share of a
    coordinate's movement.
    """
    jumps, fixed = jump_scale(linear), chain.fixed_sd
    least_sd, least_process = chain.least
    measured = chain.determined.all()
    direct = np.array([np.inf if c is None or not measured else jumps[c] / 3 for c in chain.coordinates])
    sd = np.where(np.isnan(fixed), np.maximum(np.minimum(roughness(chain), direct), least_sd), fixed)
    return ChainNoise(sd, np.maximum(jumps if measured else tuning.free_share * movement, least_process))


def likeliest_share(
    chain: Chain,
    linear: ChainLinearisation,
    noise: ChainNoise,
    prior: QuadraticPrior,
    theta: FloatArray,
    tuning: NoiseTuning,
) -> ChainNoise:
    """The noise with its process noise as small as the likelihood of one linearisation likes best.

    Tried are the given one and shares of it, each a tenth of the one before.
    """
    shares = [10.0**-k for k in range(tuning.shares)]
    tried = [ChainNoise(noise.sd, np.maximum(share * noise.process, chain.least[1])) for share in shares]

    def value(one: ChainNoise) -> float:
        try:
            return restricted(linear, one, border(prior, theta, eliminate_states(linear, one).gradient))[0]
        except np.linalg.LinAlgError:
            return -np.inf

    return max(tried, key=value)


def excess(chain: Chain, sd: FloatArray) -> FloatArray:
    """Fitted noise sds (C,) over each channel's scatter from sample to sample; zero where they were given.

    A channel that rests for more than half of the log, as a slow encoder does, scatters by its usual step: a count's
    error is even over that.
    """
    scatter = roughness(chain)
    steps = np.abs(np.diff(np.where(chain.observed, chain.measured, np.nan), axis=0)[chain.linked])
    for c in np.flatnonzero(scatter <= chain.least[0]):
        moved = steps[steps[:, c] > chain.least[0][c], c]
        scatter[c] = np.median(moved) / np.sqrt(12) if len(moved) else 0.0
    return np.where(np.isnan(chain.fixed_sd), sd / np.maximum(scatter, chain.least[0]), 0.0)


def roughness(chain: Chain) -> FloatArray:
    """Robust sd (C,) of what third differences of each channel leave of a smooth motion.

    Its spread where too few samples follow each other.
    """
    series = np.where(chain.observed, chain.measured, np.nan)
    within = chain.linked[2:] & chain.linked[1:-1] & chain.linked[:-2]
    third = np.diff(series, n=3, axis=0)[within]
    sd = np.full(series.shape[1], np.inf)
    for c, values in enumerate(third.T):
        sizes = np.abs(values[np.isfinite(values)])
        if len(sizes):
            sd[c] = NORMAL_MAD * np.median(sizes) / np.sqrt(20)  # 1 + 9 + 9 + 1
    spread = np.nanstd(series, axis=0)
    return np.where(np.isfinite(sd), sd, np.where(spread > 0, spread, 1.0))
