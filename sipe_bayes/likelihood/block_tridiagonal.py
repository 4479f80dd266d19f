"""Linear algebra of a chain of states with a common parameter: block-tridiagonal normal equations, theta on the border.

Linearised at (theta, x), what a chain of K states predicts is off by

    e_k = y_k - h(x_k, theta)  ->  e_k - H_k dx_k - G_k dtheta                       measurement, sd per channel,
    w_k = x_k+1 - f(x_k, theta)  ->  w_k + dx_k+1 - F_k dx_k - B_k dtheta            jump, sd per state coordinate,

and half the whitened sum of squares is quadratic in (dx, dtheta) with a block-tridiagonal matrix D for the states, which
LAPACK factorises as a banded one in O(K D^3). Eliminating the states leaves S for theta (Schur's complement), and the
likelihood with the states integrated out follows from log|D|. The covariances of neighbouring states come from the factor
by Takahashi's recursion (K. Takahashi, J. Fagan, M.-S. Chin, "Formation of a sparse bus impedance matrix and its
application to short circuit study", 1973, in the block form that Rauch, Tung and Striebel's smoother has; H. E. Rauch,
F. Tung, C. T. Striebel, "Maximum likelihood estimates of linear dynamic systems", 1965, https://doi.org/10.2514/3.3166).

The gradient by the log of a noise sd is that of Fisher's identity: the expected square of what it scales, less its number.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

_LEAST_EIGENVALUE = 1e-12  # of a precision scaled to ones on its diagonal


@dataclass(frozen=True)
class ChainNoise:
    """sd (C,) of the measurements, process (D,) of the jumps from one state to the next, but wide (D,) of those that are
    loose (K-1,); None: none is."""

    sd: FloatArray
    process: FloatArray
    wide: FloatArray | None = None
    loose: BoolArray | None = None

    @property
    def jump_sd(self) -> FloatArray:
        """(D,), or (K-1, D) where some are loose."""
        return self.process if self.loose is None else np.where(self.loose[:, None], self.loose_sd, self.process)

    @property
    def loose_sd(self) -> FloatArray:
        """(D,) of those that are loose."""
        return self.process if self.wide is None else np.maximum(self.wide, self.process)

    @property
    def tight(self) -> BoolArray:
        """Jumps (K-1, D), or all at once, whose sd is ``process``."""
        return np.array(True) if self.loose is None else ~self.loose[:, None] | (self.loose_sd <= self.process)


@dataclass(frozen=True)
class ChainLinearisation:
    """What was found at one point of K states of D coordinates, C channels, N parameters.

    residual (K, C), zero where not observed; jump (K-1, D), zero where not linked; offset (K, D): a first state from its
    prior's mean; observed (K, C), linked (K-1,); precision (K, D): the prior's, of first states, else zero. measurement
    (K, C, D), measurement_theta (K, C, N), transition (K-1, D, D), transition_theta (K-1, D, N): Jacobians. error (K-1, D):
    variance of a jump that they leave out, besides the process noise's."""

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


@dataclass(frozen=True)
class Eliminated:
    """Normal equations with the states eliminated: their best answer to dtheta is shift - slope @ dtheta.

    factor: banded Cholesky factor of D; slope (K, D, N), shift (K, D); precision (N, N) and gradient (N,) of theta;
    explained: twice the energy that the states alone gain; log_determinant of D."""

    factor: FloatArray
    slope: FloatArray
    shift: FloatArray
    precision: FloatArray
    gradient: FloatArray
    explained: float
    log_determinant: float

    def states(self, move: FloatArray) -> FloatArray:
        """Step (K, D) of the states that goes with a step (N,) of theta."""
        return self.shift - self.slope @ move


def energy(found: ChainLinearisation, noise: ChainNoise) -> float:
    """Half the whitened sum of squares of residuals, jumps and offsets."""
    rows, links = found.weights(noise)
    squares = (rows * found.residual**2).sum() + (links * found.jump**2).sum()
    return 0.5 * float(squares + (found.precision * found.offset**2).sum())


def pull(found: ChainLinearisation, noise: ChainNoise) -> FloatArray:
    """Negative gradient (K, D) of the energy by the states."""
    rows, links = found.weights(noise)
    jump = links * found.jump
    out = np.einsum("kcd,kc->kd", found.measurement, rows * found.residual) - found.precision * found.offset
    out[:-1] += np.einsum("kji,kj->ki", found.transition, jump)
    out[1:] -= jump
    return out


def eliminate(found: ChainLinearisation, noise: ChainNoise, damping: float = 0.0) -> Eliminated:
    """The normal equations of the states, factorised, and what they leave for theta."""
    rows, links = found.weights(noise)
    measured, transition = found.measurement, found.transition
    length, size = pull_shape = (len(measured), measured.shape[2])
    weighed = np.swapaxes(measured * rows[..., None], 1, 2)
    onward = links[..., None] * transition
    back = np.swapaxes(transition, 1, 2)
    diagonal, cross = weighed @ measured, weighed @ found.measurement_theta
    diagonal[:-1] += back @ onward
    index = np.arange(size)
    diagonal[1:, index, index] += links
    diagonal[:, index, index] += found.precision
    diagonal[:, index, index] *= 1 + damping
    driven = links[..., None] * found.transition_theta
    cross[:-1] += back @ driven
    cross[1:] -= driven
    factor = scipy.linalg.cholesky_banded(_banded(diagonal, -onward), lower=True, check_finite=False)
    force = pull(found, noise)
    right = np.concatenate([cross, force[..., None]], axis=-1).reshape(length * size, -1)
    solved = scipy.linalg.cho_solve_banded((factor, True), right, check_finite=False).reshape(*pull_shape, -1)
    slope, shift = solved[..., :-1], solved[..., -1]
    by_theta = found.measurement_theta
    precision = np.einsum("kcn,kc,kcm->nm", by_theta, rows, by_theta, optimize=True)
    precision += np.einsum("kdn,kdm->nm", found.transition_theta, driven) - np.einsum("kdn,kdm->nm", cross, slope)
    gradient = np.einsum("kcn,kc->n", by_theta, rows * found.residual)
    gradient += np.einsum("kdn,kd->n", driven, found.jump) - np.einsum("kdn,kd->n", cross, shift)
    determinant = 2 * float(np.log(factor[0]).sum())
    return Eliminated(factor, slope, shift, precision, gradient, float((force * shift).sum()), determinant)


def _banded(diagonal: FloatArray, below: FloatArray) -> FloatArray:
    """LAPACK's lower banded form (2D, K D) of blocks (K, D, D) and those (K-1, D, D) below them."""
    length, size = diagonal.shape[:2]
    bands = np.zeros((2 * size, length, size))
    for j in range(size):
        bands[: size - j, :, j] = diagonal[:, j:, j].T
        bands[size - j : 2 * size - j, :-1, j] = below[:, :, j].T
    return bands.reshape(2 * size, length * size)


def neighbours(factor: FloatArray, size: int) -> tuple[FloatArray, FloatArray]:
    """Covariances (K, D, D) of the states given theta, and (K-1, D, D) of each with the one before it."""
    bands = factor.reshape(2 * size, -1, size)
    length = bands.shape[1]
    own, below = np.zeros((length, size, size)), np.zeros((length - 1, size, size))
    for j in range(size):
        own[:, j:, j] = bands[: size - j, :, j].T
        below[:, :, j] = bands[size - j : 2 * size - j, :-1, j].T
    inverse = np.linalg.inv(own)
    covariance, gain = np.swapaxes(inverse, 1, 2) @ inverse, below @ inverse[:-1]
    for k in range(length - 2, -1, -1):
        covariance[k] += gain[k].T @ covariance[k + 1] @ gain[k]
    return covariance, -covariance[1:] @ gain


def log_likelihood(found: ChainLinearisation, noise: ChainNoise, solved: Eliminated) -> float:
    """log p(y | theta), the states integrated out; exact where measurement and transition are linear in them."""
    first = found.precision > 0
    scales = (found.observed * np.log(noise.sd)).sum() + 0.5 * (
        found.linked[:, None] * np.log(found.jump_variance(noise))
    ).sum()
    constants = 0.5 * np.log(found.precision[first]).sum() - 0.5 * np.log(2 * np.pi) * found.observed.sum()
    best = energy(found, noise) - 0.5 * solved.explained
    return float(constants - scales - best - 0.5 * solved.log_determinant)


@dataclass(frozen=True)
class Border:
    """What holds theta besides the data: prior precision (N, N), its pull (N,), and which parameters may move."""

    precision: FloatArray
    pull: FloatArray
    free: BoolArray

    def solve(self, solved: Eliminated) -> tuple[FloatArray, FloatArray, float]:
        """Best step (N,), covariance (N, N), zero where it may not move, and the log determinant of its inverse."""
        free = np.ix_(self.free, self.free)
        covariance, step = np.zeros(self.precision.shape), np.zeros(len(self.pull))
        covariance[free], determinant = inverse(solved.precision[free] + self.precision[free])
        step = covariance @ (solved.gradient + self.pull)
        return step, covariance, determinant


def inverse(precision: FloatArray) -> tuple[FloatArray, float]:
    """Covariance, positive definite also where rounding leaves a precision that is not, and log|precision|."""
    sd = 1 / np.sqrt(np.diag(precision))
    eigenvalues, axes = np.linalg.eigh(sd[:, None] * precision * sd)
    kept = np.maximum(eigenvalues, _LEAST_EIGENVALUE)
    return sd[:, None] * ((axes / kept) @ axes.T) * sd, float(np.log(kept).sum() - 2 * np.log(sd).sum())


def restricted(
    found: ChainLinearisation, noise: ChainNoise, border: Border, held: bool = False
) -> tuple[float, FloatArray, FloatArray]:
    """Log-likelihood of the noise, states and theta integrated out, up to a constant; its derivatives by log sd (C,) and
    by log process (D,). held: with states and theta where they are, not after the step that would be best were all linear."""
    solved = eliminate(found, noise)
    step, covariance, determinant = border.solve(solved)
    if held:
        solved, step = replace(solved, shift=np.zeros_like(solved.shift), explained=0.0), np.zeros_like(step)
    pulled = solved.gradient + border.pull
    value = log_likelihood(found, noise, solved) + 0.5 * float(step @ pulled) - 0.5 * determinant
    squares, jumps = expected_squares(found, solved, step, covariance)
    variance = found.jump_variance(noise)
    share = (found.linked[:, None] & noise.tight) * noise.process**2 / variance
    by_sd = squares.sum(0) / noise.sd**2 - found.observed.sum(0)
    return value, by_sd, (share * (jumps / variance - 1)).sum(0)


def expected_squares(
    found: ChainLinearisation, solved: Eliminated, step: FloatArray, covariance: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Expected squares of residuals (K, C), zero where not observed, and of jumps (K-1, D), after the best step."""
    moved = solved.states(step)
    own, cross = neighbours(solved.factor, moved.shape[1])
    measured, transition = found.measurement, found.transition
    residual = found.residual - np.einsum("kcd,kd->kc", measured, moved) - found.measurement_theta @ step
    by_theta = found.measurement_theta - measured @ solved.slope
    squares = residual**2 + _quadratic(measured, own) + _quadratic(by_theta, covariance)
    jump = found.jump + moved[1:] - np.einsum("kij,kj->ki", transition, moved[:-1]) - found.transition_theta @ step
    by_theta = transition @ solved.slope[:-1] - solved.slope[1:] - found.transition_theta
    mixed = np.einsum("kij,kij->ki", transition, cross)
    jumps = jump**2 + _quadratic(transition, own[:-1]) + np.einsum("kii->ki", own[1:]) - 2 * mixed
    jumps = jumps + _quadratic(by_theta, covariance)
    return found.observed * squares, jumps


def jump_normal(
    found: ChainLinearisation, solved: Eliminated, step: FloatArray, covariance: FloatArray, at: NDArray[np.int64]
) -> tuple[FloatArray, FloatArray]:
    """Posterior means (J, D) and covariances (J, D, D) of the jumps ``at`` (J,), after the best step."""
    moved = solved.states(step)
    own, cross = neighbours(solved.factor, moved.shape[1])
    turn = found.transition[at]
    back = np.swapaxes(turn, 1, 2)
    ahead = moved[at + 1] - np.einsum("kij,kj->ki", turn, moved[at])
    mean = found.jump[at] + ahead - found.transition_theta[at] @ step
    by_theta = turn @ solved.slope[at] - solved.slope[at + 1] - found.transition_theta[at]
    mixed = cross[at] @ back
    spread = own[at + 1] + turn @ own[at] @ back - mixed - np.swapaxes(mixed, 1, 2)
    return mean, spread + by_theta @ covariance @ np.swapaxes(by_theta, 1, 2)


def _quadratic(rows: FloatArray, covariance: FloatArray) -> FloatArray:
    """Variances (..., R) of rows (..., R, D) under covariances (..., D, D)."""
    return np.asarray(((rows @ covariance) * rows).sum(-1))
