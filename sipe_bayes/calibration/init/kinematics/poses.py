"""The unit of a rate gyro on a body whose orientation is measured: how fast the orientation turns."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np

from sipe_bayes.calibration.init.draft import Draft, Reading
from sipe_bayes.calibration.init.machine import Machine
from sipe_bayes.calibration.init.windows import Source, loaded
from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.rotations import inverse, product, quaternions, turned
from sipe_bayes.core.smoothing import smoothed, smoothed_rotations
from sipe_bayes.core.trajectory import Trajectory
from sipe_bayes.core.units import find_unit

_UNITS = ("rad/s", "deg/s")
_NEAR = 0.2  # relative: beyond, a unit is none
_EXPLAINED = 0.8  # share of the rates' variance, from which the gyro is where the model has it
_LATEST = 0.1  # s, that one of the two may be late


def with_pose_rates(
    draft: Draft, model: mujoco.MjModel, machine: Machine, sources: Sequence[Source], folder: Path
) -> Draft:
    """The draft with gyros in the unit in which they turn as the measured orientation of their body does.

    A gyro whose unit its name tells is held against it as well.
    """
    readings = {r.match.target: r for r in draft.measurements}
    for name, kind in machine.sensors:
        own = readings.get(f"sensor:{name}")
        if kind != "gyro" or own is None:
            continue
        site = int(model.sensor(name).objid[0])
        body = int(model.body_weldid[model.site_bodyid[site]])
        pose = readings.get(f"body:{model.body(body).name}.orientation")
        if pose is not None:
            part = replace(draft, measurements=(pose, own), commands=())
            logs = loaded(part, sources, folder)
            readings[own.match.target] = judged(own, *ratio_of(logs, _turn(model, body, site)), pose.match.column)
    return replace(draft, measurements=tuple(readings[r.match.target] for r in draft.measurements))


def _turn(model: mujoco.MjModel, body: int, site: int) -> FloatArray:
    """The quaternion (4,) of a site in the axes of a body that carries it."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    quaternion = np.empty(4)
    mujoco.mju_mat2Quat(quaternion, data.site_xmat[site])
    return product(inverse(data.xquat[body][None]), quaternion[None])[0]


def ratio_of(logs: Sequence[Trajectory], turn: FloatArray) -> tuple[float, float]:
    """How many times as fast the gyro turns as the orientation does, and the share of its variance that this explains.

    Of logs that measure a rotation vector and the gyro, whichever of the two is the later one.
    """
    pairs = [_rates(log, turn) for log in logs]
    most = max(1, round(_LATEST / max(log.dt for log in logs)))
    best = (0.0, -np.inf)
    if not any(len(a) > 2 * most for a, _ in pairs):
        return best
    for lag in range(-most, most + 1):
        rows = [(a[max(0, lag) : len(a) + min(0, lag)], b[max(0, -lag) : len(b) + min(0, -lag)]) for a, b in pairs]
        pose, gyro = (np.concatenate(some) for some in zip(*rows, strict=True))
        gyro = gyro - gyro.mean(axis=0)  # a constant error
        pose = pose - pose.mean(axis=0)
        ratio = float((pose * gyro).sum() / max(float((pose**2).sum()), 1e-30))
        share = 1 - float(((gyro - ratio * pose) ** 2).sum()) / max(float((gyro**2).sum()), 1e-30)
        best = max(best, (ratio, share), key=lambda one: one[1])
    return best


def _rates(log: Trajectory, turn: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Rates (n, 3) of the orientation and of the gyro, in the gyro's axes, where both are known."""
    known = np.flatnonzero(np.isfinite(log.observations).all(axis=1))
    if not len(known):
        return np.zeros((0, 3)), np.zeros((0, 3))
    every = np.arange(known[0], known[-1] + 1)
    values = np.stack([np.interp(every, known, y[known]) for y in log.observations.T], axis=-1)
    own, spin = smoothed_rotations(values[:, :3], log.dt)
    body = turned(inverse(quaternions(own)), spin)
    return turned(inverse(turn[None]), body), smoothed(values[:, 3:], log.dt)


def judged(reading: Reading, ratio: float, share: float, pose: str) -> Reading:
    """The gyro's reading with the unit that fits, or with a doubt."""
    if share < _EXPLAINED:
        doubt = f"it does not turn as {pose!r} does ({max(0.0, share):.0%} of its variance): how is it mounted?"
        return replace(reading, doubts=(*reading.doubts, doubt)) if np.isfinite(share) else reading
    size, now = ratio / find_unit(reading.unit).factor, reading.unit  # the column's numbers for each rad/s
    fits = [word for word in _UNITS if abs(np.log(max(size, 1e-9) * find_unit(word).factor)) < _NEAR]
    if not fits:
        doubt = f"{now}, but it turns {ratio:.3g} times as fast as {pose!r}: look at its unit and at its sign"
        return replace(reading, doubts=(*reading.doubts, doubt))
    if now in fits:
        return replace(reading, notes=(f"{now}: as fast as {pose!r}", *reading.notes))
    if reading.match.label.unit:
        doubt = f"its name says {now}, but it turns as fast as {pose!r} in {fits[0]}"
        return replace(reading, doubts=(*reading.doubts, doubt), instead=(*reading.instead, f'unit = "{fits[0]}"'))
    return replace(reading, unit=fits[0], notes=(f"{fits[0]}: as fast as {pose!r}", *reading.notes))
