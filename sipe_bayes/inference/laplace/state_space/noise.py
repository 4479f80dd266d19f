"""Noise of a chain of states: first guesses, and estimates that alternate with the smoother's steps.

Given the linearisation, the noise sds maximise the likelihood with states and theta integrated out (restricted
likelihood), found by L-BFGS with Fisher's gradient. Where the model is right the process noise shrinks until the
likelihood no longer cares.

Deviations:

- The noise is held at its optimum: the posterior of theta does not widen for it.
- A coordinate's process noise q has a prior q^0.5 exp(-q / movement), movement being how far the coordinate moves in a
  control step: the likelihood leaves the process noise of an unmeasured coordinate open above, and any that is small
  enough open below, where an estimate of zero would be overconfident (Y. Chung, S. Rabe-Hesketh, V. Dorie, A. Gelman,
  J. Liu, "A nondegenerate penalized likelihood estimator for variance parameters in multilevel models", 2013,
  https://doi.org/10.1007/s11336-013-9328-2, have a whole power).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import scipy.optimize

from sipe_bayes.core.arrays import FloatArray, IntArray
from sipe_bayes.inference.laplace.state_space.options import NoiseTuning
from sipe_bayes.inference.laplace.state_space.smoother import border
from sipe_bayes.likelihood.minimise import damped_box_step
from sipe_bayes.likelihood.noise import NORMAL_MAD
from sipe_bayes.likelihood.quadratic_prior import QuadraticPrior
from sipe_bayes.likelihood.state_space.chain import Chain
from sipe_bayes.likelihood.state_space.linearisation import ChainLinearisation, ChainNoise, eliminate_states, restricted


def infer_noise(
    chain: Chain,
    linear: ChainLinearisation,
    noise: ChainNoise,
    prior: QuadraticPrior,
    theta: FloatArray,
    movement: FloatArray,
    tuning: NoiseTuning,
    held: bool = False,
) -> tuple[ChainNoise, float]:
    """Noise that maximises the restricted likelihood of one linearisation, each sd within a factor of ten.

    Begins at ``noise``; ``movement`` (D,) are the scales of the process noises' priors, ``held`` as in ``restricted``.
    Returns the noise, and the nats that it gains.
    """
    channels, fixed = len(noise.sd), chain.fixed_sd
    hold = border(prior, theta, eliminate_states(linear, noise).gradient)
    least_sd, least_process = chain.least
    least = np.log(np.concatenate([least_sd, np.maximum(least_process, tuning.least_share * movement)]))
    start = np.maximum(np.log(np.concatenate([noise.sd, noise.process])), least)
    # of channels of one scale the first stands for all
    owner = np.concatenate([_first(chain.scales), channels + np.arange(len(noise.process))])
    free = np.concatenate([np.isnan(fixed), np.full(len(noise.process), True)]) & (owner == np.arange(len(owner)))

    def split(logs: FloatArray) -> ChainNoise:
        everything = start.copy()
        everything[free] = logs
        everything = everything[owner]
        sd = np.where(np.isnan(fixed), np.exp(everything[:channels]), noise.sd)
        return replace(noise, sd=sd, process=np.exp(everything[channels:]))

    def objective(logs: FloatArray) -> tuple[float, FloatArray]:
        tried = split(logs)
        try:
            value, by_sd, by_process = restricted(linear, tried, hold, held)
        except np.linalg.LinAlgError:  # so far apart that rounding rules
            return 1e300, np.zeros(len(logs))  # L-BFGS takes no infinity
        slope = tried.process / movement - tuning.prior_power
        slopes = np.bincount(owner, np.concatenate([-by_sd, slope - by_process]), len(owner))
        return process_penalty(tried, movement, tuning) - value, slopes[free]

    span = np.log(tuning.most_factor)
    bounds = [(max(low, s - span), s + span) for low, s in zip(least[free], start[free], strict=True)]
    before = objective(start[free])[0]
    limits = {"maxiter": tuning.search_steps, "maxfun": tuning.search_steps + 4}
    best = scipy.optimize.minimize(objective, start[free], jac=True, method="L-BFGS-B", bounds=bounds, options=limits)
    return split(best.x), float(before - best.fun)


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
    measured = chain.determined.all() and chain.settings.starts == "estimated"
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
