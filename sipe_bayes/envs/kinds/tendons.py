"""Targets of tendons: what damps, rubs and springs along their length, and how far each joint of a fixed one moves it.

A tendon's numbers act along its length. That is in m along sites and slides; of hinges alone it is in rad where their
coefficients are 1, and in what these are in, for each rad, where they are others: the model does not tell whether they
are radii of pulleys or ratios of gears, so that the unit stays a word, such as ``force/velocity``.

``tendon:NAME/JOINT.coef`` is the length for each rad or m of a joint of a fixed tendon: a pulley's radius, a belt's
ratio. Where the tendon's spring rests where those of its joints do, it goes on to do so whatever its coefficients.
"""

from __future__ import annotations

from collections.abc import Iterator
from xml.etree import ElementTree

import mujoco
import numpy as np

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.validation import nearest_name
from sipe_bayes.envs.target import Maker, Target, TargetError, entry

_BY_JOINT = int(mujoco.mjtWrap.mjWRAP_JOINT)
_SLIDE, _HINGE = int(mujoco.mjtJoint.mjJNT_SLIDE), int(mujoco.mjtJoint.mjJNT_HINGE)
_UNITS = {  # of a length's unit, "" where it is not known: what acts along it
    "m": {"force": "N", "stiffness": "N/m", "damping": "N s/m", "inertia": "kg", "length": "m", "velocity": "m/s"},
    "rad": {
        **{"force": "N m", "stiffness": "N m/rad", "damping": "N m s/rad", "inertia": "kg m^2"},
        **{"length": "rad", "velocity": "rad/s"},
    },
    "": {
        **{"force": "force", "stiffness": "force/position", "damping": "force/velocity", "inertia": "inertia"},
        **{"length": "position", "velocity": "velocity"},
    },
}


def tendon_unit(model: mujoco.MjModel, tendon: int, quantity: str) -> str:
    """The unit of what acts along a tendon.

    Args:
        model: that has the tendon.
        tendon: its number.
        quantity: force, stiffness, damping, inertia, length or velocity.

    Returns:
        Such as ``N s/m``; in words, such as ``force/velocity``, where the model does not tell what its length is in.
    """
    return _UNITS[_length_unit(model, tendon)][quantity]


def _length_unit(model: mujoco.MjModel, tendon: int) -> str:
    wraps = _wraps(model, tendon)
    if int(model.wrap_type[wraps.start]) != _BY_JOINT:
        return "m"
    kinds = set(model.jnt_type[model.wrap_objid[wraps]].tolist())
    if kinds == {_SLIDE}:
        return "m"
    return "rad" if kinds == {_HINGE} and bool((np.abs(model.wrap_prm[wraps]) == 1).all()) else ""


def _wraps(model: mujoco.MjModel, tendon: int) -> slice:
    """What a tendon runs over: its joints, or its sites and geoms."""
    first = int(model.tendon_adr[tendon])
    return slice(first, first + int(model.tendon_num[tendon]))


def _along(field: str, quantity: str, constants: bool = False) -> Maker:
    def make(model: mujoco.MjModel, spec: str, tendon: int) -> Target:
        unit = tendon_unit(model, tendon, quantity)
        return entry(field, unit, constants=constants, minimum=0.0)(model, spec, tendon)

    return make


def _rest(low: bool, high: bool) -> Maker:
    """The least and the greatest length at which a spring rests, or both as one."""

    def make(model: mujoco.MjModel, spec: str, tendon: int) -> Target:
        own_low, own_high = model.tendon_lengthspring[tendon].tolist()
        if low and high and own_low != own_high:
            raise TargetError(
                f"target {spec!r}: the model's spring rests from {own_low:g} to {own_high:g}; "
                "give springlength_low and springlength_high instead"
            )

        def write(other: mujoco.MjModel, value: float) -> None:
            ends = other.tendon_lengthspring[tendon]
            if low:
                ends[0], ends[1] = value, value if high else max(value, own_high)
            else:  # behind the lower one, which it is never below
                ends[1] = max(value, ends[0])

        by_joints = int(model.wrap_type[_wraps(model, tendon).start]) == _BY_JOINT
        least, value = -np.inf if by_joints else 0.0, own_low if low else own_high
        return Target(spec, tendon_unit(model, tendon, "length"), value, write, 1 if low else 2, minimum=least)

    return make


def _coefficient(model: mujoco.MjModel, spec: str, wrap: int) -> Target:
    tendon = int(np.searchsorted(model.tendon_adr, wrap, "right")) - 1
    wraps, length = _wraps(model, tendon), _length_unit(model, tendon)
    hinge = int(model.jnt_type[model.wrap_objid[wrap]]) == _HINGE
    joint = "rad" if hinge else "m"
    reference = model.qpos_spring[model.jnt_qposadr[model.wrap_objid[wraps]]]
    rests = bool(np.isclose(model.tendon_lengthspring[tendon], model.wrap_prm[wraps] @ reference, atol=1e-12).all())

    def write(other: mujoco.MjModel, value: float) -> None:
        other.wrap_prm[wrap] = value
        if rests:
            other.tendon_lengthspring[tendon] = other.wrap_prm[wraps] @ reference

    unit = "1" if length == joint else f"{length or 'position'}/{joint}"
    return Target(spec, unit, float(model.wrap_prm[wrap]), write, constants=True)


def wrap_index(model: mujoco.MjModel, name: str, spec: str) -> int:
    """Place among the model's wraps of TENDON/JOINT, whose names may hold a slash themselves.

    Args:
        model: that has the tendon.
        name: TENDON/JOINT.
        spec: the target, for the error.

    Raises:
        TargetError: where no fixed tendon runs over such a joint; it lists what there is.
    """
    places = {f"{tendon}/{joint}": wrap for tendon, joint, wrap in _fixed(model)}
    if name not in places:
        hint = nearest_name(name, places) or f"; the model has {list(places)}"
        raise TargetError(f"target {spec!r}: expected FIXED_TENDON/JOINT, got {name!r}{hint}")
    return places[name]


def _fixed(model: mujoco.MjModel) -> Iterator[tuple[str, str, int]]:
    """Tendon, joint and place of all that fixed tendons with a name run over."""
    for tendon in range(model.ntendon):
        wraps = _wraps(model, tendon)
        if model.tendon(tendon).name and int(model.wrap_type[wraps.start]) == _BY_JOINT:
            for wrap in range(wraps.start, wraps.stop):
                yield model.tendon(tendon).name, model.joint(int(model.wrap_objid[wrap])).name, wrap


def tendon_arms(model: mujoco.MjModel, data: mujoco.MjData) -> FloatArray:
    """How far each degree of freedom moves each tendon (ntendon, nv), at positions that MuJoCo has gone through."""
    arms = np.zeros((model.ntendon, model.nv))
    for row, first, count in zip(arms, model.ten_J_rowadr, model.ten_J_rownnz, strict=True):
        row[model.ten_J_colind[first : first + count]] = data.ten_J.ravel()[first : first + count]
    return arms


def copy_tendon(spec: mujoco.MjSpec, model: mujoco.MjModel, target: str) -> None:
    """Give a spec's tendon what the model's one has; its coefficients no MjSpec lets write: ``with_coefficients``.

    Args:
        spec: whose tendon.
        model: that has the numbers.
        target: any of the tendon.
    """
    name, _, attribute = target.removeprefix("tendon:").rpartition(".")
    if attribute == "coef":
        name = next(tendon for tendon, joint, _ in _fixed(model) if f"{tendon}/{joint}" == name)
    index, tendon = model.tendon(name).id, spec.tendon(name)
    tendon.stiffness[:] = [model.tendon_stiffness[index], *model.tendon_stiffnesspoly[index]]
    tendon.damping[:] = [model.tendon_damping[index], *model.tendon_dampingpoly[index]]
    tendon.frictionloss, tendon.armature = model.tendon_frictionloss[index], model.tendon_armature[index]
    tendon.springlength[:] = model.tendon_lengthspring[index]


def with_coefficients(xml: str, model: mujoco.MjModel) -> str:
    """MJCF in which fixed tendons have the coefficients of a model.

    Args:
        xml: as MuJoCo writes it.
        model: compiled, whose tendons are the file's but for their numbers.

    Returns:
        The MJCF, the same text where nothing differs.
    """
    if not any(True for _ in _fixed(model)):
        return xml
    root, changed = ElementTree.fromstring(xml), False
    by_name = {element.get("name"): element.findall("joint") for element in root.iterfind("tendon/fixed")}
    for tendon, joint, wrap in _fixed(model):
        value = float(f"{model.wrap_prm[wrap]:.6g}")
        for element in by_name[tendon]:
            if element.get("joint") == joint and float(element.get("coef", "1")) != value:
                element.set("coef", f"{value:g}")
                changed = True
    return ElementTree.tostring(root, encoding="unicode") if changed else xml


TENDONS: dict[str, Maker] = {
    "stiffness": _along("tendon_stiffness", "stiffness"),
    "damping": _along("tendon_damping", "damping"),
    "frictionloss": _along("tendon_frictionloss", "force"),
    "armature": _along("tendon_armature", "inertia", constants=True),
    "springlength": _rest(low=True, high=True),
    "springlength_low": _rest(low=True, high=False),
    "springlength_high": _rest(low=False, high=True),
    "coef": _coefficient,
}
