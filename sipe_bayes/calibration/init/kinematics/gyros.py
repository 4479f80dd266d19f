"""How positions turn a rate gyro: the factor of each hinge's column by kinematics alone, without any dynamics.

A gyro at a site measures ``R' sum_j a_j dq_j/dt + b``: R is the site's orientation, a_j the axis of hinge j, b a
constant error. Of columns y_j as they are read, ``q_j = s_j y_j - z_j``. The factors s_j, which say unit and sign, the
zeros z_j and b are fitted by least squares; both sides are slopes of local quadratics over 60 ms, of positions and of
the integral of the rates, so that both are smoothed alike. A gyro that is late is taken earlier.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
import scipy.optimize

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.smoothing import smoothed
from sipe_bayes.core.trajectory import Trajectory

_ROWS = 300  # samples that are compared
_APART = 0.04  # s between them, at least
_LATEST = 0.06  # s, that a gyro may be late
_STARTS = 2  # factors from which is fitted, those that fit best
_ZERO = 0.5  # rad, sd of zeros
_WEIGHT = 0.02  # of the rates, the noise that this sd counts against


@dataclass(frozen=True)
class Turned:
    """What a gyro says of hinges' columns.

    Args:
        factors: (H,) what each column is to be multiplied by, so that it turns as the gyro says.
        errors: (H,) standard errors of these, relative.
        zeros: (H,) rad, of positions.
        share: of the rates' variance that the positions explain.
    """

    factors: FloatArray
    errors: FloatArray
    zeros: FloatArray
    share: float


@dataclass(frozen=True)
class _Motion:
    """Positions (n, H), their slopes (n, H), and rates (L, n, 3) with each lag that is tried, none first."""

    positions: FloatArray
    slopes: FloatArray
    rates: FloatArray


def hinges_of(model: mujoco.MjModel, sensor: str) -> list[int] | None:
    """Ids of the hinges that turn a gyro, from its body inwards; None where balls or free joints do as well."""
    body, out = int(model.site_bodyid[model.sensor(sensor).objid[0]]), list[int]()
    while body:
        for joint in range(model.body_jntadr[body], model.body_jntadr[body] + model.body_jntnum[body]):
            kind = int(model.jnt_type[joint])
            if kind == int(mujoco.mjtJoint.mjJNT_HINGE):
                out.append(joint)
            elif kind != int(mujoco.mjtJoint.mjJNT_SLIDE):
                return None
        body = int(model.body_parentid[body])
    return out


class Gyro:
    """A gyro of a model, the hinges that turn it, and how they did in logs.

    Args:
        model: compiled.
        sensor: its name.
        hinges: ids of the H hinges.
        logs: with a channel for each hinge, then three of the gyro, SI.
    """

    def __init__(self, model: mujoco.MjModel, sensor: str, hinges: Sequence[int], logs: Sequence[Trajectory]) -> None:
        self._model, self._data = model, mujoco.MjData(model)
        self._site = int(model.sensor(sensor).objid[0])
        self._places, self._dofs = model.jnt_qposadr[list(hinges)], model.jnt_dofadr[list(hinges)]
        parts = [_motion(log, len(hinges), sum(map(len, logs))) for log in logs]
        self._motion = _Motion(
            np.concatenate([part.positions for part in parts]),
            np.concatenate([part.slopes for part in parts]),
            np.concatenate([part.rates for part in parts], axis=1),
        )

    def turned(self, scales: Sequence[FloatArray], unit: float = 1.0) -> Turned:
        """What its rates say, each multiplied by ``unit``; scales (H,): factors that columns may have."""
        motion, rates = self._motion, unit * self._motion.rates
        begun = sorted((self._linear(scale, rates[0]) for scale in scales), key=lambda one: one[0])[:_STARTS]
        tried = [self._fitted(factors, rates[0]) for _, factors in begun]
        best = min(tried, key=lambda one: float(one.cost))
        count = len(self._dofs)
        seen = self._rates(best.x[:count] * motion.positions - best.x[count : 2 * count], best.x[:count]) + best.x[-3:]
        late = int(np.argmin(((rates - seen) ** 2).sum(axis=(1, 2))))
        if late:
            best = self._fitted(best.x[:count], rates[late])
        left, rows = best.fun[:-count], rates[late]
        noise = float(left @ left) / max(1, len(left) - len(best.x))
        errors = np.sqrt(noise * np.diag(np.linalg.pinv(best.jac.T @ best.jac)))[:count]
        share = 1 - float(left @ left) / max(float(((rows - rows.mean(axis=0)) ** 2).sum()), 1e-30)
        factors = best.x[:count]
        moves = np.linalg.norm(best.jac[:, :count], axis=0) > 0
        relative = np.where(moves, errors / np.maximum(np.abs(factors), 1e-30), np.inf)
        return Turned(factors, relative, best.x[count : 2 * count], share)

    def _columns(self, positions: FloatArray) -> FloatArray:
        """Rates in the gyro's axes (n, 3, H) of each hinge that turns by 1 rad/s at positions (n, H)."""
        model, data, out = self._model, self._data, np.empty((len(positions), 3, len(self._dofs)))
        jacobian = np.empty((3, model.nv))
        for row, at in zip(out, positions, strict=True):
            data.qpos[self._places] = at
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            mujoco.mj_jacSite(model, data, None, jacobian, self._site)
            row[:] = data.site_xmat[self._site].reshape(3, 3).T @ jacobian[:, self._dofs]
        return out

    def _rates(self, positions: FloatArray, factors: FloatArray) -> FloatArray:
        return np.asarray(np.einsum("nch,nh->nc", self._columns(positions), factors * self._motion.slopes))

    def _linear(self, scale: FloatArray, rates: FloatArray) -> tuple[float, FloatArray]:
        """Factors (H,) of the slopes with axes where ``scale`` puts the hinges, and what they leave."""
        by_hinge = self._columns(scale * self._motion.positions) * self._motion.slopes[:, None]
        constant = np.broadcast_to(np.eye(3), (len(by_hinge), 3, 3))
        design = np.concatenate([by_hinge, constant], axis=2).reshape(-1, by_hinge.shape[2] + 3)
        factors = np.linalg.lstsq(design, rates.ravel(), rcond=None)[0]
        left = rates.ravel() - design @ factors
        return float(left @ left), np.where(np.abs(factors[:-3]) > 0, factors[:-3], scale)

    def _fitted(self, factors: FloatArray, rates: FloatArray) -> scipy.optimize.OptimizeResult:
        """Least squares over factors, zeros and the constant error, in this order."""
        count, motion = len(factors), self._motion
        weight = _WEIGHT * float(np.sqrt(np.mean(rates**2))) / _ZERO

        def left(x: FloatArray) -> FloatArray:
            own, zeros = x[:count], x[count : 2 * count]
            seen = self._rates(own * motion.positions - zeros, own) + x[-3:]
            return np.concatenate([(seen - rates).ravel(), weight * zeros])

        sizes = np.concatenate([np.maximum(np.abs(factors), 1e-9), np.ones(count + 3)])
        begun = np.concatenate([factors, np.zeros(count + 3)])
        return scipy.optimize.least_squares(left, begun, x_scale=sizes, max_nfev=40)


def _motion(log: Trajectory, hinges: int, total: int) -> _Motion:
    """Some samples of a log, of as many as all logs have together."""
    sample, values = np.arange(len(log) + 1), log.observations.copy()
    for series in values.T:
        known = np.isfinite(series)
        series[:] = np.interp(sample, sample[known], series[known]) if known.any() else 0.0
    positions, rates = values[:, :hinges], values[:, hinges:]
    turned = np.concatenate([np.zeros((1, 3)), np.cumsum(0.5 * (rates[1:] + rates[:-1]) * log.dt, axis=0)])
    lags = np.arange(0, round(_LATEST / log.dt) + 1)[: max(1, len(log) // 4)]
    step = max(1, round(_APART / log.dt), total // _ROWS)
    rows = np.arange(0, len(values) - int(lags[-1]), step)
    slopes = smoothed(turned, log.dt, 1)
    steps = np.unique(np.round(np.linspace(0, lags[-1], min(len(lags), 13))).astype(int))
    tried = [slopes[rows + lag] for lag in np.resize(steps, 13)]
    return _Motion(smoothed(positions, log.dt)[rows], smoothed(positions, log.dt, 1)[rows], np.stack(tried))
