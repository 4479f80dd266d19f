"""A plain reference for links in place: the MJCF edited point by point, and a comparison of compiled models."""

from __future__ import annotations

import warnings
from typing import Any

import mujoco
import numpy as np

TURNING = (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_BALL)


def read(source: str) -> Any:
    """MjSpec of a path, without its textures, or of MJCF text."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        if source.lstrip().startswith("<"):
            return mujoco.MjSpec.from_string(source)
        spec = mujoco.MjSpec.from_file(source)
        spec.compiler.discardvisual = True
        return spec


def compiled(spec: Any) -> Any:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        model = spec.compile()
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_WARMSTART
    return model


def edited(path: str, factors: dict[str, float]) -> Any:
    """MjSpec of ``path`` with the geoms of ``factors`` longer, as sipe_bayes.envs.tasks.links says.

    Masses and densities written out, so that nothing is scaled to a total mass.
    """
    spec, model = read(path), compiled(read(path))
    plain = read(path)
    plain.compiler.settotalmass = spec.compiler.settotalmass = -1
    density = model.body_mass.sum() / compiled(plain).body_mass.sum()
    for geom in spec.geoms:
        geom.density *= density
    for body in spec.bodies[1:]:
        _stretch(body, _Body(model, body, factors))
    return spec


class _Body:
    """How points move that are attached to a body's links."""

    def __init__(self, model: Any, body: Any, factors: dict[str, float]) -> None:
        self.factors, self.ends = [factors.get(g.name, 1.0) for g in body.geoms], []
        for geom in body.geoms:
            compiled_geom = model.geom(geom.name)
            turn = np.empty(9)
            mujoco.mju_quat2Mat(turn, compiled_geom.quat)
            half = compiled_geom.size[1] if geom.type == mujoco.mjtGeom.mjGEOM_CAPSULE else 0.0
            arm = half * turn[2::3]
            self.ends.append((compiled_geom.pos - arm, compiled_geom.pos + arm))
        if self.ends:
            self.stays = [self.nearest(0, joint_of(body)), *(self._seat(i) for i in range(1, len(self.ends)))]

    def nearest(self, i: int, point: Any) -> Any:
        a, b = self.ends[i]
        along = (point - a) @ (b - a) / max((b - a) @ (b - a), 1e-300)
        return a + np.clip(along, 0, 1) * (b - a)

    def distance(self, i: int, point: Any) -> float:
        return float(np.linalg.norm(point - self.nearest(i, point)))

    def _seat(self, i: int) -> Any:
        a, b = self.ends[i]
        best = min((a, b), key=lambda p: self.distance(0, p))
        middle = (a + b) / 2
        return best if self.distance(0, best) < self.distance(0, middle) - 1e-9 else middle

    def moved(self, i: int, point: Any) -> Any:
        """Where a point attached to link i goes."""
        shift = (self.factors[i] - 1) * (self.nearest(i, point) - self.stays[i])
        return point + shift + (0 if i == 0 else self.moved(0, self.stays[i]) - self.stays[i])

    def carried(self, point: Any) -> Any:
        return self.moved(min(range(len(self.ends)), key=lambda i: self.distance(i, point) + 1e-9 * i), point)


def joint_of(body: Any) -> Any:
    return next((np.array(j.pos) for j in body.joints if j.type in TURNING), np.zeros(3))


def _stretch(body: Any, links: _Body) -> None:
    if not links.ends:
        return
    for i, geom in enumerate(body.geoms):
        if geom.type == mujoco.mjtGeom.mjGEOM_SPHERE:
            geom.pos[:] = links.moved(i, np.array(geom.pos))
            geom.size[0] *= links.factors[i]
        elif np.isfinite(geom.fromto[0]):
            start, end = geom.fromto[:3].copy(), geom.fromto[3:].copy()
            geom.fromto[:3], geom.fromto[3:] = links.moved(i, start), links.moved(i, end)
        else:
            geom.pos[:] = links.moved(i, np.array(geom.pos))
            geom.size[1] *= links.factors[i]
    for child in body.bodies:
        turn = np.empty(9)
        mujoco.mju_quat2Mat(turn, child.quat / np.linalg.norm(child.quat))
        joint = child.pos + turn.reshape(3, 3) @ joint_of(child)
        child.pos[:] = child.pos + links.carried(joint) - joint
    for site in body.sites:
        site.pos[:] = links.carried(np.array(site.pos))


def differences(a: Any, b: Any) -> dict[str, float]:
    """For every field but ``stat`` and the bounding volumes the largest difference, in units of its largest entry or 1.

    Principal axes are compared where the moments of inertia differ, and the inertia itself everywhere.
    """
    found = {}
    for name in dir(a):
        x, y = getattr(a, name), getattr(b, name)
        if name.startswith(("_", "bvh_")) or not isinstance(x, np.ndarray) or not x.size or x.dtype.kind not in "fiub":
            continue
        assert x.shape == y.shape, name
        if name == "body_iquat":
            x, y = _inertia(a), _inertia(b)
            moments = np.sort(a.body_inertia, axis=1)
            distinct = (np.diff(moments, axis=1) > 1e-6 * moments[:, 2:]).all(1) | (a.body_geomnum == 1)
            found["axes"] = float(np.abs(a.body_iquat - b.body_iquat)[distinct].max(initial=0.0))
        difference = np.abs(x.astype(float) - y.astype(float)).max()
        found[name] = float(difference / max(1.0, np.abs(y.astype(float)).max()))
    return found


def _inertia(model: Any) -> Any:
    matrices = np.empty((model.nbody, 9))
    for matrix, quaternion in zip(matrices, model.body_iquat, strict=True):
        mujoco.mju_quat2Mat(matrix, quaternion)
    turns = matrices.reshape(-1, 3, 3)
    return (turns * model.body_inertia[:, None]) @ turns.transpose(0, 2, 1)
