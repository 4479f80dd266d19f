"""Steps of the search for theta, states and noise of ``StateSpace``: an iterated Kalman smoother with theta on its border.

Given the noise, theta and all states minimise half the whitened squares of residuals and jumps plus the priors, by damped
Gauss-Newton steps on the block-tridiagonal normal equations (``sipe_bayes.likelihood.block_tridiagonal``), theta within the unit cube. Given
the linearisation, the noise sds maximise the likelihood with states and theta integrated out (restricted likelihood),
found by L-BFGS with Fisher's gradient. The two alternate; where the model is right the process noise shrinks until the
likelihood no longer cares.

Contacts make the energy many-valleyed: a state smoothed from its own noisy measurement settles on the wrong side of a
contact, and little process noise then keeps it there, with an estimate that is overconfident. What the past says of a
state is sharper than its measurement, so after each of the first few estimates of the noise an extended Kalman filter
(B. D. O. Anderson, J. B. Moore, "Optimal Filtering", 1979) runs through the logs and linearises each step where it stands;
Gauss-Newton goes on from its states where that ends lower.

Where it still settles on a wrong side, a few jumps stand out and are let go (``inference.loose_jumps``).

It begins with states as measured, and theta by reweighted least squares of the jumps, weights of a Student t with four degrees of
freedom: contacts amplify the noise of a measurement manyfold. Where some coordinate is not measured, it begins with the filter's states
about those that the commands lead to. (Of all this, a search from known first states uses the steps and the noise only; it linearises
over what is still open, ``inference.posterior_linearisation``.)

Deviations: the noise is held at its optimum, the posterior of theta does not widen for it. A coordinate's process noise q
has a prior q^0.5 exp(-q / movement), movement being how far the coordinate moves in a control step: the likelihood leaves the
process noise of an unmeasured coordinate open above, and any that is small enough open below, where an estimate of zero would
be overconfident (Y. Chung, S. Rabe-Hesketh, V. Dorie, A. Gelman, J. Liu, "A nondegenerate penalized likelihood estimator for
variance parameters in multilevel models", 2013, https://doi.org/10.1007/s11336-013-9328-2, have a whole power). In the filter,
channels that are read late are left out and no jump is loose; it only proposes.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy.optimize
from numpy.typing import NDArray

from sipe_bayes.likelihood.block_tridiagonal import Border
from sipe_bayes.likelihood.minimise import damped_box_step
from sipe_bayes.likelihood.quadratic_prior import FLAT_PRECISION, QuadraticPrior
from sipe_bayes.likelihood.state_space.chain import Chain
from sipe_bayes.likelihood.state_space.linearisation import (
    ChainLinearisation,
    ChainNoise,
    eliminate_states,
    energy,
    restricted,
)

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

_DAMPING_UP, _DAMPING_DOWN, _DAMPING_MIN, _DAMPING_MAX = 8.0, 0.2, 1e-9, 1e6
_SPAN, _SEARCH = np.log(10.0), 12  # how far a noise sd may move at a time, steps of its search
_FREEDOM = 4.0  # of the Student t
_WIDER = 4.0  # of the first state's covariance, where the filter begins
_FILTER_STEP = 1e-5
_FREE = 0.1  # of a coordinate's movement in a control step: process noise where not every coordinate is measured
_SHARES = (1.0, 0.1, 0.01, 1e-3)  # of that, to begin with
_STIFFEST = 1e-5  # of a coordinate's movement: process noise at least, for the sake of rounding
_LOUDER = 3.0
_OFF_ZERO = 0.5  # power of a process noise in its prior
_NEVER = 1e300  # nats


@dataclass(frozen=True)
class Point:
    """theta (N,), states (K, S), energy with the priors of theta, and damping of the next step."""

    theta: FloatArray
    states: FloatArray
    energy: float
    damping: float


def penalty(prior: QuadraticPrior, theta: FloatArray) -> float:
    """-log prior of theta, with the flat normal that closes open directions."""
    return prior.energy(theta) + 0.5 * FLAT_PRECISION * float(((theta - 0.5) ** 2).sum())


def border(prior: QuadraticPrior, theta: FloatArray, gradient: FloatArray) -> Border:
    """The prior at theta; a parameter that ``gradient`` (N,) presses against a bound may not move."""
    flat = FLAT_PRECISION * np.eye(len(theta))
    pull = prior.pull(theta) + FLAT_PRECISION * (0.5 - theta)
    total = gradient + pull
    held = ((theta <= 0) & (total < 0)) | ((theta >= 1) & (total > 0))
    return Border(prior.precision + flat, pull, ~held)


def descend(
    chain: Chain, found: ChainLinearisation, noise: ChainNoise, prior: QuadraticPrior, here: Point, tolerance: float
) -> tuple[Point, bool]:
    """The first of ever shorter damped steps that lowers the energy; True where it would by less than ``tolerance``, or
    none does."""
    value, damping = energy(found, noise) + penalty(prior, here.theta), here.damping
    hold = border(prior, here.theta, np.zeros_like(here.theta))
    while damping <= _DAMPING_MAX:
        try:
            solved = eliminate_states(found, noise, damping)
        except np.linalg.LinAlgError:
            damping = max(damping, 1e-4) * _DAMPING_UP
            continue
        hessian, gradient = solved.precision + hold.precision, solved.gradient + hold.pull
        move = damped_box_step(hessian, gradient, here.theta, damping)
        expected = float(gradient @ move - 0.5 * move @ hessian @ move) + 0.5 * solved.explained
        if expected < tolerance:
            return replace(here, energy=value), True
        theta = np.clip(here.theta + move, 0.0, 1.0)
        states = chain.moved(here.states, solved.blocks(move))
        there = chain.compare(theta[None], states[None], found)[0]
        after = np.inf if there is None else energy(there, noise) + penalty(prior, theta)
        if after < value:
            return Point(theta, states, after, max(_DAMPING_MIN, damping * _DAMPING_DOWN)), False
        damping = max(damping, 1e-4) * _DAMPING_UP
    return replace(here, energy=value), True


def sound(found: ChainLinearisation, noise: ChainNoise) -> ChainNoise:
    """The noise, its process noise raised as far as the normal equations need it to be solved in spite of rounding."""
    while True:
        try:
            eliminate_states(found, noise)
        except np.linalg.LinAlgError:
            noise = replace(noise, process=_LOUDER * noise.process)
        else:
            return noise


def process_penalty(noise: ChainNoise, movement: FloatArray) -> float:
    """-log prior of the process noises in their logarithms' place, up to a constant; movement (D,): their scales."""
    share = noise.process / movement
    return float((share - _OFF_ZERO * np.log(share)).sum())


def infer_noise(
    chain: Chain,
    found: ChainLinearisation,
    noise: ChainNoise,
    prior: QuadraticPrior,
    theta: FloatArray,
    movement: FloatArray,
    held: bool = False,
) -> tuple[ChainNoise, float]:
    """Noise that maximises the restricted likelihood of one linearisation, each sd within a factor of ten, and the nats
    that it gains. movement (D,): scales of the process noises' priors. held: as in ``restricted``."""
    channels, fixed = len(noise.sd), chain.fixed_sd
    hold = border(prior, theta, eliminate_states(found, noise).gradient)
    least_sd, least_process = chain.least
    least = np.log(np.concatenate([least_sd, np.maximum(least_process, _STIFFEST * movement)]))
    start = np.maximum(np.log(np.concatenate([noise.sd, noise.process])), least)
    free = np.concatenate([np.isnan(fixed), np.full(len(noise.process), True)])

    def split(logs: FloatArray) -> ChainNoise:
        everything = start.copy()
        everything[free] = logs
        sd = np.where(np.isnan(fixed), np.exp(everything[:channels]), noise.sd)
        return replace(noise, sd=sd, process=np.exp(everything[channels:]))

    def objective(logs: FloatArray) -> tuple[float, FloatArray]:
        tried = split(logs)
        try:
            value, by_sd, by_process = restricted(found, tried, hold, held)
        except np.linalg.LinAlgError:  # so far apart that rounding rules
            return _NEVER, np.zeros(len(logs))
        slope = tried.process / movement - _OFF_ZERO
        return process_penalty(tried, movement) - value, np.concatenate([-by_sd, slope - by_process])[free]

    bounds = [(max(low, s - _SPAN), s + _SPAN) for low, s in zip(least[free], start[free], strict=True)]
    before = objective(start[free])[0]
    limits = {"maxiter": _SEARCH, "maxfun": _SEARCH + 4}
    best = scipy.optimize.minimize(objective, start[free], jac=True, method="L-BFGS-B", bounds=bounds, options=limits)
    return split(best.x), float(before - best.fun)


def regress(found: ChainLinearisation, prior: QuadraticPrior, theta: FloatArray) -> FloatArray:
    """One reweighted least-squares step of theta (N,) on the jumps, the states as they are."""
    weights = found.linked[:, None] / (scale(found) ** 2 * (1 + (found.jump / scale(found)) ** 2 / _FREEDOM))
    slopes, hold = found.transition_theta, border(prior, theta, np.zeros_like(theta))
    hessian = np.einsum("kdn,kd,kdm->nm", slopes, weights, slopes, optimize=True) + hold.precision
    gradient = np.einsum("kdn,kd->n", slopes, weights * found.jump) + hold.pull
    return np.asarray(np.clip(theta + damped_box_step(hessian, gradient, theta, 1e-6), 0.0, 1.0))


def scale(found: ChainLinearisation) -> FloatArray:
    """Robust sd (D,) of the jumps, from their median size; never zero."""
    size = 1.4826 * np.median(np.abs(found.jump[found.linked]), axis=0)
    return np.asarray(np.maximum(size, 1e-9 * max(float(size.max()), 1e-300)))


def first_noise(chain: Chain, found: ChainLinearisation, movement: FloatArray) -> ChainNoise:
    """A guess from the first guess of the states. Measurement noise: what third differences of a channel leave, at most a
    third of the jumps of the coordinate that it measures. Process noise: as large as the jumps, or where states are what the commands
    lead to a share of a coordinate's movement."""
    jumps, fixed = scale(found), chain.fixed_sd
    least_sd, least_process = chain.least
    whole = chain.placed.all() and chain.settings.starts == "estimated"
    direct = np.array([np.inf if c is None or not whole else jumps[c] / 3 for c in chain.coordinates])
    sd = np.where(np.isnan(fixed), np.maximum(np.minimum(roughness(chain), direct), least_sd), fixed)
    return ChainNoise(sd, np.maximum(jumps if whole else _FREE * movement, least_process))


def quietest(
    chain: Chain, found: ChainLinearisation, noise: ChainNoise, prior: QuadraticPrior, theta: FloatArray
) -> ChainNoise:
    """The noise with its process noise as small as the likelihood of one linearisation likes best, of a few shares."""
    tried = [ChainNoise(noise.sd, np.maximum(share * noise.process, chain.least[1])) for share in _SHARES]

    def value(one: ChainNoise) -> float:
        try:
            return restricted(found, one, border(prior, theta, eliminate_states(found, one).gradient))[0]
        except np.linalg.LinAlgError:
            return -np.inf

    return max(tried, key=value)


def roughness(chain: Chain) -> FloatArray:
    """Robust sd (C,) of what third differences of each channel leave of a smooth motion; their spread where too few
    samples follow each other."""
    series = np.where(chain.observed, chain.measured, np.nan)
    within = chain.linked[2:] & chain.linked[1:-1] & chain.linked[:-2]
    third = np.diff(series, n=3, axis=0)[within]
    found = np.full(series.shape[1], np.inf)
    for c, values in enumerate(third.T):
        there = np.abs(values[np.isfinite(values)])
        if len(there):
            found[c] = 1.4826 * np.median(there) / np.sqrt(20)
    spread = np.nanstd(series, axis=0)
    return np.where(np.isfinite(found), found, np.where(spread > 0, spread, 1.0))


def filtered(
    chain: Chain, found: ChainLinearisation, noise: ChainNoise, theta: FloatArray, states: FloatArray
) -> FloatArray | None:
    """States (K, S) by an extended Kalman filter through every log at once; None where its simulation diverges.

    Measurements are linear about ``states``, where ``found`` was taken; each control step is linearised where the filter
    stands."""
    size, timed = chain.num_start, ~chain.late
    covariance = eliminate_states(found, noise).covariances()[0][chain.first] * _WIDER
    at, out = np.flatnonzero(chain.first), states.copy()
    here, thetas = states[at], np.tile(theta, (1 + size, 1))
    steps = np.concatenate([np.zeros((1, size)), _FILTER_STEP * np.eye(size)])
    while True:
        here, covariance = _update(chain, found, noise, timed, at, here, covariance, states)
        out[at] = here
        on = np.append(chain.linked, False)[at]
        if not on.any():
            return out
        at, here, covariance = at[on], here[on], covariance[on]
        lanes = chain.moved(here[None], steps[:, None])
        _, ends, valid = chain.simulate(thetas, lanes, at)
        if not valid[0].all():
            return None
        turned = chain.difference(ends[1:], ends[0]) / _FILTER_STEP
        transition = np.moveaxis(np.where(valid[1:, :, None], turned, 0.0), 0, -1)
        covariance = transition @ covariance @ np.swapaxes(transition, 1, 2) + np.diag(noise.process**2)
        at = at + 1
        here = chain.moved(chain.reference[at], chain.difference(ends[0], chain.reference[at]))


def _update(
    chain: Chain,
    found: ChainLinearisation,
    noise: ChainNoise,
    timed: BoolArray,
    at: NDArray[np.int64],
    here: FloatArray,
    covariance: FloatArray,
    states: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Means (R, S) and covariances (R, D, D) after the measurements of the chain's states ``at`` (R,)."""
    rows = found.measurement[at][:, timed]
    away = chain.difference(here, states[at])
    surprise = found.residual[at][:, timed] - np.einsum("rcd,rd->rc", rows, away) * found.observed[at][:, timed]
    cross = rows @ covariance
    spread = cross @ np.swapaxes(rows, 1, 2) + np.diag(noise.sd[timed] ** 2)
    gain = np.swapaxes(np.linalg.solve(spread, cross), 1, 2)
    covariance = covariance - gain @ cross
    moved = chain.moved(here, np.einsum("rdc,rc->rd", gain, surprise))
    return moved, 0.5 * (covariance + np.swapaxes(covariance, 1, 2))
