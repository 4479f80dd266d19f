"""Links of a robot, longer or shorter, in place: geometry, child frames, mass and inertia follow together.

A link is a named capsule or sphere of a moving body. Its target is ``"link:GEOM.length"`` (the distance between the
centres of a capsule's two ends, m) or ``"link:GEOM.radius"`` (of a sphere, m). Several links may share a body.

The convention. A capsule is stretched along its own axis and keeps its radius; a sphere grows about its centre. What
is attached to a link moves with the point of its axis that is nearest to it: not at all near the point that stays, as
far as the end does when it is beyond the end, so a chain stays joined and keeps its offsets sideways. The point that
stays is

- of a body's first link, the point of its axis nearest to the joint that moves the body (its first hinge or ball joint,
  or else the origin of its frame);
- of a further link in the body, which rides on the first, the end of its axis nearer to the first's axis, or the centre
  where no end is nearer.

Child bodies and sites ride on the link of the body nearest to them: a child where its joint is (the origin of its frame
where it has none), a site where it is. Frames do not turn, the joints of the body itself, cameras and lights stay.
Everything moves linearly in the factors by which the links grow.

Mass and inertia follow from the geoms at the density that they have in the model as compiled, with the compiler's own
conventions: one geom gives the body its frame of inertia, several are added up and diagonalised by ``mju_eig3`` (of
equal moments the axes are any two, here as there). MuJoCo's mj_setConst, which must follow, refreshes what else depends
on them.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import ClassVar

import mujoco
import numpy as np

from sipe_bayes.core.arrays import FloatArray, IntArray
from sipe_bayes.core.validation import nearest_name
from sipe_bayes.envs.inertia import body_frame_inertia
from sipe_bayes.envs.target import Target, TargetError
from sipe_bayes.envs.targets import bind
from sipe_bayes.envs.task import Task

_SPHERE, _CAPSULE = int(mujoco.mjtGeom.mjGEOM_SPHERE), int(mujoco.mjtGeom.mjGEOM_CAPSULE)
_TURNING = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_BALL))
_TARGET = re.compile(r"^link:(.+)\.(length|radius)$")
_SAME = 1e-9  # relative, to the compiled model; a distance in m when comparing which is nearer
_POWERS = np.array([[0], [1], [2], [3], [5]])  # of a link's factor in its mass and moments; the last is a sphere's
_UNIT = np.eye(3)
_INERTIAL = ("body_mass", "body_ipos", "body_iquat", "body_inertia")


@dataclass(frozen=True)
class _Groups:
    """The bodies of several geoms each."""

    bodies: list[int]  # (k,)
    rows: IntArray  # (n,), all their geoms among the links, body by body
    starts: IntArray  # (k,), where each body's begin
    shape: FloatArray  # (n, 2, 9), what the moments across and along a geom's axis add to its second moments

    @classmethod
    def of(cls, model: mujoco.MjModel, bodies: list[int], row: dict[int, int]) -> _Groups:
        """Those of ``bodies``; row: of each geom among the links."""
        geoms = [_geoms(model, b) for b in bodies]
        starts = np.cumsum([0] + [len(g) for g in geoms])[:-1]
        flat = [int(g) for own in geoms for g in own]
        axes = np.array([_matrix(model.geom_quat[g])[:, 2] for g in flat]).reshape(-1, 3)
        along = axes[:, :, None] * axes[:, None, :]
        shape = np.stack([along, _UNIT / 2 - along], axis=1).reshape(-1, 2, 9)
        return cls(bodies, np.array([row[g] for g in flat], int), starts, shape)

    def add(self, places: FloatArray, inertial: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Mass (k,), centre of mass (k, 3) and inertia about it (k, 3, 3) of the bodies.

        Args:
            places: the centres (G, 3) of all links.
            inertial: their mass and moments across and along the axis, (G, 3).
        """
        at, inertial = places[self.rows], inertial[self.rows]
        moment = inertial[:, :1] * at
        # second moments C of the mass about the body's origin; the inertia is tr(C) - C
        second = moment[:, :, None] * at[:, None, :] + (inertial[:, None, 1:] @ self.shape).reshape(-1, 3, 3)
        second = np.add.reduceat(second, self.starts)
        total, first = np.add.reduceat(inertial[:, 0], self.starts), np.add.reduceat(moment, self.starts)
        centre = first / total[:, None]
        second -= first[:, :, None] * centre[:, None, :]
        return total, centre, second.trace(axis1=1, axis2=2)[:, None, None] * _UNIT - second


class Links:
    """The links of a compiled model's bodies.

    Args:
        model: as published; it is never written to.
        bodies: which of them; by default all whose geoms are capsules and spheres.

    Raises:
        TargetError: where a geom is neither, or the mass of a body is not that of its geoms.
    """

    def __init__(self, model: mujoco.MjModel, bodies: Sequence[int] | None = None) -> None:
        self.model = model
        self._bodies = [b for b in range(1, model.nbody) if _linked(model, b)] if bodies is None else list(bodies)
        for body in self._bodies:
            if not _linked(model, body):
                raise TargetError(f"link: the geoms of body {model.body(body).name!r} are not all capsules and spheres")
        self._geoms = np.concatenate([_geoms(model, b) for b in self._bodies])
        self._row = {int(g): i for i, g in enumerate(self._geoms)}
        self._slot = np.where(model.geom_type[self._geoms] == _SPHERE, 0, 1)
        self._flat = 3 * self._geoms + self._slot  # in the flattened geom_size
        self._size = model.geom_size.ravel()[self._flat]
        self._children = np.array([b for b in range(model.nbody) if model.body_parentid[b] in self._bodies], int)
        self._sites = np.array([s for s in range(model.nsite) if model.site_bodyid[s] in self._bodies], int)
        self._move = self._moves()
        self._start = np.concatenate(
            [model.geom_pos[self._geoms], model.body_pos[self._children], model.site_pos[self._sites]]
        )
        self._coefficients = self._polynomials()
        self._check()
        several = [b for b in self._bodies if model.body_geomnum[b] > 1]
        self._groups = _Groups.of(model, several, self._row)
        single = [b for b in self._bodies if model.body_geomnum[b] == 1]
        self._single = _index([self._row[int(model.body_geomadr[b])] for b in single])
        self._single_bodies = _index(single)
        self._slices = _index(self._geoms), _index(self._children), _index(self._sites)

    def target(self, spec: str) -> Target:
        """The target ``link:GEOM.length`` or ``link:GEOM.radius``.

        Its write changes the size of the geom alone: ``refresh`` must follow, once for all links.

        Raises:
            TargetError: for another form, a name that is no link's, or a radius of a capsule.
        """
        match = _TARGET.match(spec)
        if not match:
            raise TargetError(f"target {spec!r}: expected link:GEOM.length or link:GEOM.radius")
        name, attribute = match.groups()
        names = [self.model.geom(int(g)).name for g in self._geoms]
        if name not in names:
            hint = nearest_name(name, names) or f"; the links are {[n for n in names if n]}"
            raise TargetError(f"target {spec!r}: no link {name!r}{hint}")
        row = names.index(name)
        geom, slot = int(self._geoms[row]), int(self._slot[row])
        if (attribute == "radius") != (slot == 0):
            raise TargetError(f"target {spec!r}: a capsule has a length and a sphere a radius to scale")
        double = 2.0 if slot else 1.0

        def write(other: mujoco.MjModel, value: float) -> None:
            other.geom_size[geom, slot] = value / double

        return Target(spec, "m", double * float(self._size[row]), write, constants=True, minimum=1e-6)

    def refresh(self, model: mujoco.MjModel) -> None:
        """Let everything follow the sizes of the links in ``model``, a copy of the published one."""
        factors = model.geom_size.ravel()[self._flat] / self._size
        growth = factors - 1
        places = self._start + (self._move @ growth).reshape(-1, 3)
        number, moved = len(self._geoms), len(self._geoms) + len(self._children)
        geoms, children, sites = self._slices
        model.geom_pos[geoms], model.body_pos[children] = places[:number], places[number:moved]
        model.site_pos[sites] = places[moved:]
        if not growth.any():  # the published model to the last bit
            for field in _INERTIAL:
                getattr(model, field)[self._bodies] = getattr(self.model, field)[self._bodies]
            return
        inertial = self._inertial(factors)
        single = inertial[self._single]
        model.body_mass[self._single_bodies] = single[:, 0]
        model.body_inertia[self._single_bodies] = single[:, (1, 1, 2)]
        model.body_ipos[self._single_bodies] = places[self._single]
        if self._groups.bodies:
            added = self._groups.add(places, inertial)
            for body, mass, centre, tensor in zip(self._groups.bodies, *added, strict=True):
                model.body_mass[body], model.body_ipos[body] = mass, centre
                mujoco.mju_eig3(model.body_inertia[body], np.empty(9), model.body_iquat[body], tensor.ravel())

    def _inertial(self, factors: FloatArray) -> FloatArray:
        """Mass and the moments of inertia across and along the axis of each link (G, 3)."""
        return np.asarray((self._coefficients @ factors[:, None, None] ** _POWERS)[:, :, 0])

    def _polynomials(self) -> FloatArray:
        """Coefficients (G, 3, 5) of the ``_POWERS`` of a link's factor in its mass and moments."""
        model, coefficients = self.model, np.zeros((len(self._geoms), 3, len(_POWERS)))
        for i, geom in enumerate(self._geoms):
            radius, half = model.geom_size[geom, :2]
            ball = 4 / 3 * np.pi * radius**3
            if self._slot[i] == 0:
                coefficients[i, 0, 3], coefficients[i, 1:, 4] = ball, 0.4 * ball * radius**2
                continue
            length, tube = 2 * half, 2 * np.pi * radius**2 * half
            coefficients[i, 0, :2] = ball, tube
            # of the tube and of its two half-balls, whose centres of mass lie 3/8 of the radius beyond its ends
            coefficients[i, 1, :4] = (
                0.4 * ball * radius**2,
                tube * radius**2 / 4 + ball * 3 / 8 * length * radius,
                ball * length**2 / 4,
                tube * length**2 / 12,
            )
            coefficients[i, 2, :2] = 0.4 * ball * radius**2, tube * radius**2 / 2
        owner, volume = model.geom_bodyid[self._geoms], np.zeros(model.nbody)
        np.add.at(volume, owner, coefficients[:, 0].sum(-1))
        return np.asarray(coefficients * (model.body_mass[owner] / volume[owner])[:, None, None])

    def _moves(self) -> FloatArray:
        """(3 (G + children + sites), G): how far each place moves as a link's factor grows by one."""
        model, number = self.model, len(self._geoms)
        moves = np.zeros((number + len(self._children) + len(self._sites), 3, number))
        for body in self._bodies:
            rows = [self._row[int(g)] for g in _geoms(model, body)]
            axes = [_Axis.of(model, int(self._geoms[i])) for i in rows]
            stays = [axes[0].nearest(_joint(model, body)), *(axis.seat(axes[0]) for axis in axes[1:])]

            ride = partial(_ride, rows=rows, axes=axes, stays=stays, count=number)
            for link, row in enumerate(rows):
                moves[row] = ride(model.geom_pos[self._geoms[row]], link)
            for k, child in enumerate(self._children):
                if model.body_parentid[child] == body:
                    point = model.body_pos[child] + _matrix(model.body_quat[child]) @ _joint(model, int(child))
                    moves[number + k] = ride(point, _closest(axes, point))
            for k, site in enumerate(self._sites):
                if model.site_bodyid[site] == body:
                    point = model.site_pos[site]
                    moves[number + len(self._children) + k] = ride(point, _closest(axes, point))
        return moves.reshape(-1, number)

    def _check(self) -> None:
        """The published model must itself follow from its geoms."""
        model, groups = self.model, _Groups.of(self.model, self._bodies, self._row)
        _, centres, tensors = groups.add(model.geom_pos[self._geoms], self._inertial(np.ones(len(self._geoms))))
        for body, centre, tensor in zip(self._bodies, centres, tensors, strict=True):
            own = body_frame_inertia(model, body)
            close = np.allclose(own, tensor, rtol=0, atol=_SAME * own.max())
            if not close or not np.allclose(centre, model.body_ipos[body], rtol=0, atol=_SAME):
                raise TargetError(
                    f"link: the inertia of body {model.body(body).name!r} is not that of its geoms at one density; "
                    "take its inertial out of the MJCF and give its geoms one density"
                )


@dataclass(frozen=True)
class _Axis:
    """The segment between the centres of a capsule's ends, of length 0 for a sphere, in the body's frame."""

    centre: FloatArray
    direction: FloatArray
    half: float

    @classmethod
    def of(cls, model: mujoco.MjModel, geom: int) -> _Axis:
        """The axis of a geom."""
        half = 0.0 if model.geom_type[geom] == _SPHERE else float(model.geom_size[geom, 1])
        return cls(model.geom_pos[geom].copy(), _matrix(model.geom_quat[geom])[:, 2], half)

    def nearest(self, point: FloatArray) -> float:
        """Coordinate along the axis, from its centre, of its point nearest to ``point`` (3,)."""
        return float(np.clip((point - self.centre) @ self.direction, -self.half, self.half))

    def at(self, coordinate: float) -> FloatArray:
        """The point (3,) at a coordinate."""
        return self.centre + coordinate * self.direction

    def distance(self, point: FloatArray) -> float:
        """From ``point`` (3,)."""
        return float(np.linalg.norm(point - self.at(self.nearest(point))))

    def seat(self, first: _Axis) -> float:
        """Coordinate of the end nearer to another axis, or 0 where none is nearer than the centre."""
        choices = (0.0, -self.half, self.half)
        return min(choices, key=lambda c: first.distance(self.at(c)) + (_SAME if c else 0.0))


def _ride(
    point: FloatArray, link: int, rows: Sequence[int], axes: Sequence[_Axis], stays: Sequence[float], count: int
) -> FloatArray:
    """How a point (3,) that rides on one of a body's links moves as all factors grow, (3, G).

    ``rows`` are the body's links among all ``count``, with their axes and the coordinates of the points that stay.
    """
    move = np.zeros((3, count))
    move[:, rows[link]] = (axes[link].nearest(point) - stays[link]) * axes[link].direction
    return move if link == 0 else move + _ride(axes[link].at(stays[link]), 0, rows, axes, stays, count)


class LinkTask(Task):
    """A task whose parameters may be links. A body whose link is a parameter has no parameter for its mass.

    ``start_noise``: half-width of the starting states' uniform distribution about the model's own.
    """

    start_noise: ClassVar[float]

    def initial_states(self, rng: np.random.Generator, count: int) -> tuple[FloatArray, FloatArray | None]:
        """The published draw: uniform positions, then velocities."""
        shape = count, self.published.nq
        qpos = self.published.qpos0 + rng.uniform(-self.start_noise, self.start_noise, shape)
        return self.states(qpos, self.initial_velocities(rng, (count, self.published.nv))), None

    def initial_velocities(self, rng: np.random.Generator, shape: tuple[int, int]) -> FloatArray:
        """Uniform (count, nv), as published of most robots."""
        return rng.uniform(-self.start_noise, self.start_noise, shape)

    @cached_property
    def links(self) -> Links | None:
        """The bodies of the links among the parameters' targets; None without any."""
        specs = [t for p in self.parameters for t in p.targets if t.startswith("link:")]
        model = self.published
        matches = [_TARGET.match(spec) for spec in specs]
        ids = [mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_GEOM, m.group(1)) for m in matches if m]
        bodies = sorted({int(model.geom_bodyid[g]) for g in ids if g >= 0})
        return Links(model, bodies) if bodies else None

    def bind(self, target: str) -> Target:
        """As every task's, and links."""
        if not target.startswith("link:"):
            return bind(self.published, target)
        return (self.links or Links(self.published)).target(target)

    def write(self, model: mujoco.MjModel, values: FloatArray, log: str | None = None) -> bool:
        """Write all targets of the parameters, and let what depends on the links follow."""
        physical = super().write(model, values, log)
        if self.links is not None and physical:
            self.links.refresh(model)
        return physical


def _index(ids: Sequence[int] | IntArray) -> slice | IntArray:
    """What indexes the rows ``ids``: a slice where they follow each other, which is several times as fast."""
    ids = np.asarray(ids, int)
    if len(ids) and (np.diff(ids) == 1).all():
        return slice(int(ids[0]), int(ids[-1]) + 1)
    return ids


def _geoms(model: mujoco.MjModel, body: int) -> IntArray:
    first = int(model.body_geomadr[body])
    return np.arange(first, first + int(model.body_geomnum[body]))


def _linked(model: mujoco.MjModel, body: int) -> bool:
    """Whether all geoms of a body are capsules and spheres."""
    types = model.geom_type[_geoms(model, body)]
    return bool(len(types)) and bool(np.isin(types, (_SPHERE, _CAPSULE)).all())


def _joint(model: mujoco.MjModel, body: int) -> FloatArray:
    """Where the body turns (3,): its first hinge or ball joint, or the origin of its frame."""
    first, count = int(model.body_jntadr[body]), int(model.body_jntnum[body])
    for joint in range(first, first + count):
        if int(model.jnt_type[joint]) in _TURNING:
            return np.asarray(model.jnt_pos[joint], float)
    return np.zeros(3)


def _closest(axes: Sequence[_Axis], point: FloatArray) -> int:
    """Which axis is nearest to the point; the first of equals."""
    return min(range(len(axes)), key=lambda i: axes[i].distance(point) + i * _SAME)


def _matrix(quaternion: FloatArray) -> FloatArray:
    matrix = np.empty(9)
    mujoco.mju_quat2Mat(matrix, quaternion)
    return matrix.reshape(3, 3)
