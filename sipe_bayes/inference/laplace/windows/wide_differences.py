"""An optimum's normal by differences as long as it is wide, where those at the optimum make it too narrow.

At a kink, as of dry friction, a short difference may be mostly jump: a slope that no other point has, and a normal
several times narrower than the posterior. Points two sds to each side along the normal's axes, to which the windows'
starts follow, tell: the slopes between them average over the jumps, as ``likelihood.state_space.differences`` does for
chains of states. Where their normal is wider it takes the other's place, and is asked in turn. Points that still fit
better than the normal says are a finding, and draws may take its place.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.inference.laplace.strategy import SearchProblem
from sipe_bayes.inference.laplace.windows.energy import WindowEnergy
from sipe_bayes.inference.laplace.windows.state import WindowOptimum
from sipe_bayes.likelihood.noise import Noise
from sipe_bayes.likelihood.windows import Windows


@dataclass(frozen=True)
class WideDifferences:
    """What points to both sides of an optimum along its normal's axes say.

    Args:
        jacobian: (W, L, C, N + D), of theta by these differences.
        missing: nats by which a point fits better than the normal says, which is too narrow; zero where it is not.
    """

    jacobian: FloatArray
    missing: float

    @classmethod
    def of(
        cls,
        problem: SearchProblem,
        windows: Windows,
        optimum: WindowOptimum,
        noise: Noise,
        residual: FloatArray,
        jacobian: FloatArray,
    ) -> WideDifferences:
        """2 N rollouts, around an optimum of residual (W, L, C) and jacobian (W, L, C, N + D) for a noise (C,).

        An axis along which the cube leaves no room, or a simulation diverges, keeps the slope at the optimum; so does a
        parameter whose differences are long already, at which the axes are cut.
        """
        theta, tuning, n = optimum.theta, problem.options.tuning.importance, len(optimum.theta)
        precision = np.linalg.inv(optimum.covariance)
        free = np.flatnonzero(windows.least_steps(theta) == 0)
        num = len(free)
        eigenvalues, axes = np.linalg.eigh(np.linalg.inv(precision[np.ix_(free, free)]))
        ways = np.zeros((num, n))
        ways[:, free] = tuning.probe * (axes * np.sqrt(eigenvalues)).T
        ways = np.concatenate([ways, -ways])
        room = np.where(ways > 0, 1 - theta, theta) / np.maximum(np.abs(ways), 1e-300)
        share = np.minimum(1.0, room.min(1))
        points = np.clip(theta + share[:, None] * ways, 0.0, 1.0)
        starts = optimum.starts - np.einsum("wdn,bn->bwd", optimum.slope, points - theta)
        predicted, valid = windows.predict(points, starts, in_float64=True)
        here = np.where(windows.observed, windows.measured - residual, np.nan)
        change = np.where(windows.observed, windows.continued(predicted, here) - here, 0.0)
        # along each axis, starts following, and from there by theta alone
        local, by_starts = jacobian[..., :n], jacobian[..., n:]
        following = np.einsum("wlcd,wdn->wlcn", by_starts, optimum.slope)
        length = share[:num] + share[num:]
        usable = valid[:num] & valid[num:] & (length > problem.options.tuning.wide.least_room)
        along = (local - following) @ ways[:num].T
        along[..., usable] = np.moveaxis(change[:num] - change[num:], 0, -1)[..., usable] / length[usable]
        wide = local.copy()
        wide[..., free] = along @ np.linalg.inv(ways[:num, free].T) + following[..., free]
        # how much the points fit worse, and should
        energy, gaps = WindowEnergy(windows, noise, problem.quadratic_prior), points - optimum.mean
        falls = np.array([energy(p, s, residual - c) for p, s, c in zip(points, starts, change, strict=True)])
        falls = np.where(valid, falls - energy(theta, optimum.starts, residual), np.inf)
        middle = theta - optimum.mean
        foretold = 0.5 * (np.einsum("bi,ij,bj->b", gaps, precision, gaps) - middle @ precision @ middle)
        narrow = falls + tuning.slack < tuning.least_fall * (foretold + tuning.slack)
        missing = float(np.where(narrow, foretold - falls, 0.0).max())
        return cls(np.concatenate([wide, by_starts], axis=-1), missing)
