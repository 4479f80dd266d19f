"""Block-tridiagonal normal equations with a dense border: many unknowns in a row, each tied to the next, and theta.

    [ A   C ] [ x     ]   [ force    ]     x: K blocks of D unknowns, A block-tridiagonal,
    [ C'  B ] [ theta ] = [ gradient ]     theta: N unknowns on the border.

The blocks are the starts of windows that share a noise sample (``likelihood.restricted``), or the states of a chain
(``likelihood.state_space``). LAPACK factorises A as a banded matrix in O(K D^3). Eliminating x leaves Schur's
complement B - C' A^-1 C for theta, and the likelihood with x integrated out follows from log|A|. Covariances of
neighbouring blocks come from the factor by Takahashi's recursion, without the whole inverse:

- K. Takahashi, J. Fagan, M.-S. Chin, "Formation of a sparse bus impedance matrix and its application to short circuit
  study", 1973; in the block form that Rauch, Tung and Striebel's smoother has.
- H. E. Rauch, F. Tung, C. T. Striebel, "Maximum likelihood estimates of linear dynamic systems", 1965,
  https://doi.org/10.2514/3.3166.
"""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
from scipy.linalg.lapack import dpbtrf, dpbtrs

from sipe_bayes.core.arrays import BoolArray, FloatArray


@dataclass(frozen=True)
class Eliminated:
    """Normal equations whose blocks are eliminated: their best answer to a step of theta is shift - slope @ step.

    Args:
        factor: banded Cholesky factor (2 D, K D) of A.
        slope: A^-1 C (K, D, N).
        shift: A^-1 force (K, D).
        precision: (N, N) of theta with the blocks marginalised, without theta's prior.
        gradient: (N,) likewise.
        explained: force' A^-1 force, twice the energy that the blocks alone gain.
        log_determinant: of A.
    """

    factor: FloatArray
    slope: FloatArray
    shift: FloatArray
    precision: FloatArray
    gradient: FloatArray
    explained: float
    log_determinant: float

    def blocks(self, step: FloatArray) -> FloatArray:
        """Best step (K, D) of the blocks that goes with a step (N,) of theta."""
        return self.shift - self.slope @ step

    def solve(self, right: FloatArray) -> FloatArray:
        """A^-1 right, for right sides (K D, M)."""
        return np.asarray(dpbtrs(self.factor, right, lower=1)[0])

    def covariances(self) -> tuple[FloatArray, FloatArray]:
        """Blocks of A^-1: on the diagonal (K, D, D), and below it (K-1, D, D), of each with the one before it."""
        size = self.shift.shape[1]
        own, below = _blocks(self.factor, size)
        inverse = np.linalg.inv(own)
        covariance, gain = np.swapaxes(inverse, 1, 2) @ inverse, below @ inverse[:-1]
        # backwards: a block is what it is by itself, and what comes to it through the next one
        for k in range(len(own) - 2, -1, -1):
            covariance[k] += gain[k].T @ covariance[k + 1] @ gain[k]
        return covariance, -covariance[1:] @ gain


def eliminate(
    diagonal: FloatArray,
    below: FloatArray,
    coupling: FloatArray,
    force: FloatArray,
    precision: FloatArray,
    gradient: FloatArray,
) -> Eliminated:
    """Eliminate the blocks from the normal equations.

    Args:
        diagonal: A's blocks (K, D, D) on the diagonal.
        below: A's blocks (K-1, D, D) below it: rows of a block, columns of the one before.
        coupling: C (K, D, N).
        force: (K, D), the right side of the blocks.
        precision: B (N, N).
        gradient: (N,), the right side of theta.

    Raises:
        numpy.linalg.LinAlgError: where A is not positive definite.
    """
    length, size = force.shape
    if not size:
        return Eliminated(np.zeros((0, 0)), coupling, force, precision, gradient, 0.0, 0.0)
    factor, failed = dpbtrf(banded(diagonal, below), lower=1)
    if failed:
        raise np.linalg.LinAlgError("the blocks' matrix is not positive definite")
    right = np.concatenate([coupling, force[..., None]], axis=-1).reshape(length * size, -1)
    solved, _ = dpbtrs(factor, right, lower=1)
    solved = solved.reshape(length, size, -1)
    slope, shift = solved[..., :-1], solved[..., -1]
    return Eliminated(
        factor,
        slope,
        shift,
        precision - np.einsum("kdn,kdm->nm", coupling, slope),
        gradient - np.einsum("kdn,kd->n", coupling, shift),
        float((force * shift).sum()),
        2 * float(np.log(factor[0]).sum()),
    )


def banded(diagonal: FloatArray, below: FloatArray) -> FloatArray:
    """LAPACK's lower banded form (2 D, K D) of blocks (K, D, D) on the diagonal and (K-1, D, D) below it."""
    length, size = diagonal.shape[:2]
    bands = np.zeros((2 * size, length, size))
    for j in range(size):
        bands[: size - j, :, j] = diagonal[:, j:, j].T
        bands[size - j : 2 * size - j, :-1, j] = below[:, :, j].T
    return bands.reshape(2 * size, length * size)


def _blocks(factor: FloatArray, size: int) -> tuple[FloatArray, FloatArray]:
    """The blocks (K, D, D) and (K-1, D, D) of a banded lower triangle."""
    bands = factor.reshape(2 * size, -1, size)
    length = bands.shape[1]
    own, below = np.zeros((length, size, size)), np.zeros((length - 1, size, size))
    for j in range(size):
        own[:, j:, j] = bands[: size - j, :, j].T
        below[:, :, j] = bands[size - j : 2 * size - j, :-1, j].T
    return own, below


@dataclass(frozen=True)
class Border:
    """What holds theta besides the data: prior precision (N, N), its pull (N,), and which parameters may move (N,)."""

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
    """Covariance (N, N), positive definite also where rounding leaves a precision that is not, and log|precision|."""
    if not len(precision):  # every parameter is held, at its bound
        return precision, 0.0
    diagonal = np.diag(precision)
    sd = 1 / np.sqrt(np.maximum(diagonal, 1e-12 * np.abs(diagonal).max()))
    eigenvalues, axes = np.linalg.eigh(sd[:, None] * precision * sd)
    kept = np.maximum(eigenvalues, 1e-12)  # what rounding leaves of an open direction
    return sd[:, None] * ((axes / kept) @ axes.T) * sd, float(np.log(kept).sum() - 2 * np.log(sd).sum())


def damped_box_step(hessian: FloatArray, gradient: FloatArray, theta: FloatArray, damping: float) -> FloatArray:
    """Step (N,) within the unit cube around theta that maximises a quadratic model, by MuJoCo's mju_boxQP.

    Of the precision (N, N) and the pull (N,) there, damped by a share of the diagonal (Levenberg, Marquardt); zero
    where rounding leaves no positive definite model.
    """
    n = len(theta)
    # parameters that change nothing leave a zero on the diagonal
    damped = hessian + damping * np.diag(np.diag(hessian)) + 1e-12 * np.trace(hessian) / n * np.eye(n)
    step, factor, index = np.zeros(n), np.zeros((n, n + 7)), np.zeros(n, np.int32)
    rank = mujoco.mju_boxQP(step, factor, index, damped, -gradient, -theta, 1 - theta)
    return step if rank >= 0 else np.zeros(n)
