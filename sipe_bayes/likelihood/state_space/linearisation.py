"""A chain of states linearised at one point, and the likelihood of theta and of the noise that follows from it.

Linearised at (theta, x), what a chain of K states predicts is off by

    e_k = y_k - h(x_k, theta)  ->  e_k - H_k dx_k - G_k dtheta                 measurement, sd per channel,
    w_k = x_k+1 - f(x_k, theta)  ->  w_k + dx_k+1 - F_k dx_k - B_k dtheta      jump, sd per state coordinate,

and half the whitened sum of squares is quadratic in (dx, dtheta), with a block-tridiagonal matrix for the states and
theta on its border (``likelihood.block_tridiagonal``). The gradient by the log of a noise sd is that of Fisher's
identity: the expected square of what it scales, less its number.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sipe_bayes.core.arrays import BoolArray, FloatArray, IntArray
from sipe_bayes.likelihood.block_tridiagonal import Border, Eliminated, eliminate


@dataclass(frozen=True)
class ChainNoise:
    """Sds of what is independent from sample to sample.

    Args:
        sd: (C,) of the measurements.
        process: (D,) of the jumps from one state to the next.
        wide: (D,) of the jumps that are outliers; at least ``process`` counts.
        outliers: which jumps (K-1,) are; None: none is.
    """

    sd: FloatArray
    process: FloatArray
    wide: FloatArray | None = None
    outliers: BoolArray | None = None

    @property
    def jump_sd(self) -> FloatArray:
        """(D,), or (K-1, D) where some are outliers."""
        return (
            self.process if self.outliers is None else np.where(self.outliers[:, None], self.outlier_sd, self.process)
        )

    @property
    def outlier_sd(self) -> FloatArray:
        """(D,) of the jumps that are outliers."""
        return self.process if self.wide is None else np.maximum(self.wide, self.process)

    @property
    def regular(self) -> BoolArray:
        """Jumps (K-1, D), or all at once, whose sd is ``process``."""
        if self.outliers is None:
            return np.array(True)
        return ~self.outliers[:, None] | (self.outlier_sd <= self.process)


@dataclass(frozen=True)
class ChainLinearisation:
    """A chain of K states of D coordinates at one point; C channels, N parameters.

    Args:
        residual: (K, C), zero where not observed.
        jump: (K-1, D), zero where not linked.
        offset: (K, D), a first state from its prior's mean, else zero.
        observed: (K, C).
        linked: (K-1,), false between two logs.
        precision: (K, D) of the prior of first states, else zero.
        measurement: (K, C, D), derivatives of the measurements by the states.
        measurement_theta: (K, C, N), by theta.
        transition: (K-1, D, D), derivatives of the ends of control steps by the states.
        transition_theta: (K-1, D, N), by theta.
        error: (K-1, D), variance of a jump that these leave out, besides the process noise's.
    """

    residual: FloatArray
    jump: FloatArray
    offset: FloatArray
    observed: BoolArray
    linked: BoolArray
    precision: FloatArray
    measurement: FloatArray
    measurement_theta: FloatArray
    transition: FloatArray
    transition_theta: FloatArray
    error: FloatArray

    def weights(self, noise: ChainNoise) -> tuple[FloatArray, FloatArray]:
        """Precisions of the residuals (K, C) and jumps (K-1, D)."""
        return self.observed * noise.sd**-2.0, self.linked[:, None] / self.jump_variance(noise)

    def jump_variance(self, noise: ChainNoise) -> FloatArray:
        """(K-1, D)."""
        return np.asarray(noise.jump_sd**2 + self.error)


def energy(linear: ChainLinearisation, noise: ChainNoise) -> float:
    """Half the whitened sum of squares of residuals, jumps and offsets."""
    rows, links = linear.weights(noise)
    squares = (rows * linear.residual**2).sum() + (links * linear.jump**2).sum()
    return 0.5 * float(squares + (linear.precision * linear.offset**2).sum())


def pull(linear: ChainLinearisation, noise: ChainNoise) -> FloatArray:
    """Negative gradient (K, D) of the energy by the states."""
    rows, links = linear.weights(noise)
    jump = links * linear.jump
    out = np.einsum("kcd,kc->kd", linear.measurement, rows * linear.residual) - linear.precision * linear.offset
    out[:-1] += np.einsum("kji,kj->ki", linear.transition, jump)
    out[1:] -= jump
    return out


def eliminate_states(linear: ChainLinearisation, noise: ChainNoise, damping: float = 0.0) -> Eliminated:
    """Normal equations of the states, and what they leave for theta.

    Args:
        linear: the linearisation.
        noise: sds of measurements and jumps.
        damping: Levenberg and Marquardt's, relative, of the states' block.

    Raises:
        numpy.linalg.LinAlgError: where rounding leaves the states' block no longer positive definite.
    """
    rows, links = linear.weights(noise)
    measured, transition, by_theta = linear.measurement, linear.transition, linear.measurement_theta
    weighed = np.swapaxes(measured * rows[..., None], 1, 2)
    onward = links[..., None] * transition
    back = np.swapaxes(transition, 1, 2)
    # what measurements and jumps say of each state, and of each together with theta
    diagonal, cross = weighed @ measured, weighed @ by_theta
    diagonal[:-1] += back @ onward
    index = np.arange(measured.shape[2])
    diagonal[1:, index, index] += links
    diagonal[:, index, index] += linear.precision
    diagonal[:, index, index] *= 1 + damping
    driven = links[..., None] * linear.transition_theta
    cross[:-1] += back @ driven
    cross[1:] -= driven
    # what they say of theta alone: jumps first, whose large precisions the states all but cancel
    force, precision = pull(linear, noise), np.einsum("kdn,kdm->nm", linear.transition_theta, driven)
    solved = eliminate(diagonal, -onward, cross, force, precision, np.einsum("kdn,kd->n", driven, linear.jump))
    # as einsum of all three does, which looks anew for the best order each time
    measured_precision = np.tensordot(np.einsum("kcn,kc->ckn", by_theta, rows), by_theta, ((0, 1), (1, 0)))
    return replace(
        solved,
        precision=measured_precision + solved.precision,
        gradient=np.einsum("kcn,kc->n", by_theta, rows * linear.residual) + solved.gradient,
    )


def log_likelihood(linear: ChainLinearisation, noise: ChainNoise, solved: Eliminated) -> float:
    """Log-likelihood of theta, the states integrated out; exact where measurement and transition are linear in them."""
    first = linear.precision > 0
    scales = (linear.observed * np.log(noise.sd)).sum() + 0.5 * (
        linear.linked[:, None] * np.log(linear.jump_variance(noise))
    ).sum()
    constants = 0.5 * np.log(linear.precision[first]).sum() - 0.5 * np.log(2 * np.pi) * linear.observed.sum()
    best = energy(linear, noise) - 0.5 * solved.explained
    return float(constants - scales - best - 0.5 * solved.log_determinant)


@dataclass(frozen=True)
class Integrated:
    """States and theta integrated out of the likelihood of one linearisation.

    Args:
        value: restricted log-likelihood of the noise, up to a constant.
        solved: the states eliminated; where they are, if they are held.
        step: (N,) of theta, zero if held.
        covariance: (N, N) of theta.
    """

    value: float
    solved: Eliminated
    step: FloatArray
    covariance: FloatArray


def integrate(linear: ChainLinearisation, noise: ChainNoise, border: Border, held: bool = False) -> Integrated:
    """Integrate states and theta out.

    Args:
        linear: the linearisation.
        noise: where it is evaluated.
        border: what holds theta besides the data.
        held: with states and theta where they are, not after the step that would be best were all linear.

    Raises:
        numpy.linalg.LinAlgError: where rounding leaves the states' block no longer positive definite.
    """
    solved = eliminate_states(linear, noise)
    step, covariance, determinant = border.solve(solved)
    if held:
        solved, step = replace(solved, shift=np.zeros_like(solved.shift), explained=0.0), np.zeros_like(step)
    pulled = solved.gradient + border.pull
    value = log_likelihood(linear, noise, solved) + 0.5 * float(step @ pulled) - 0.5 * determinant
    return Integrated(value, solved, step, covariance)


def restricted(
    linear: ChainLinearisation, noise: ChainNoise, border: Border, held: bool = False
) -> tuple[float, FloatArray, FloatArray]:
    """Restricted log-likelihood of the noise, of arguments as in ``integrate``.

    Returns:
        The value up to a constant, and its derivatives by log sd (C,) and by log process (D,).
    """
    done = integrate(linear, noise, border, held)
    squares, jumps = expected_squares(linear, done.solved, done.step, done.covariance)
    variance = linear.jump_variance(noise)
    share = (linear.linked[:, None] & noise.regular) * noise.process**2 / variance
    by_sd = squares.sum(0) / noise.sd**2 - linear.observed.sum(0)
    return done.value, by_sd, (share * (jumps / variance - 1)).sum(0)


def expected_squares(
    linear: ChainLinearisation, solved: Eliminated, step: FloatArray, covariance: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Expected squares after a step (N,) of theta, whose covariance (N, N) is given.

    Of the residuals (K, C), zero where not observed, and of the jumps (K-1, D).
    """
    moved = solved.blocks(step)
    own, cross = solved.covariances()
    measured, transition = linear.measurement, linear.transition
    residual = linear.residual - np.einsum("kcd,kd->kc", measured, moved) - linear.measurement_theta @ step
    by_theta = linear.measurement_theta - measured @ solved.slope
    squares = residual**2 + _quadratic(measured, own) + _quadratic(by_theta, covariance)
    jump = linear.jump + moved[1:] - np.einsum("kij,kj->ki", transition, moved[:-1]) - linear.transition_theta @ step
    by_theta = transition @ solved.slope[:-1] - solved.slope[1:] - linear.transition_theta
    mixed = np.einsum("kij,kij->ki", transition, cross)
    jumps = jump**2 + _quadratic(transition, own[:-1]) + np.einsum("kii->ki", own[1:]) - 2 * mixed
    jumps = jumps + _quadratic(by_theta, covariance)
    return linear.observed * squares, jumps


def jump_normal(
    linear: ChainLinearisation, solved: Eliminated, step: FloatArray, covariance: FloatArray, at: IntArray
) -> tuple[FloatArray, FloatArray]:
    """Means (J, D) and covariances (J, D, D) of the jumps ``at`` (J,) after a step (N,) of theta."""
    moved = solved.blocks(step)
    own, cross = solved.covariances()
    turn = linear.transition[at]
    back = np.swapaxes(turn, 1, 2)
    ahead = moved[at + 1] - np.einsum("kij,kj->ki", turn, moved[at])
    mean = linear.jump[at] + ahead - linear.transition_theta[at] @ step
    by_theta = turn @ solved.slope[at] - solved.slope[at + 1] - linear.transition_theta[at]
    mixed = cross[at] @ back
    spread = own[at + 1] + turn @ own[at] @ back - mixed - np.swapaxes(mixed, 1, 2)
    return mean, spread + by_theta @ covariance @ np.swapaxes(by_theta, 1, 2)


def _quadratic(rows: FloatArray, covariance: FloatArray) -> FloatArray:
    """Variances (..., R) of rows (..., R, D) under covariances (..., D, D)."""
    return np.asarray(((rows @ covariance) * rows).sum(-1))
