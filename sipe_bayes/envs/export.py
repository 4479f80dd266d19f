"""Write a model with calibrated values back out as MJCF.

MuJoCo's writer keeps six significant digits. The file is compiled again and compared with the model in memory field by
field before it gets its name, so what is written is what was calibrated.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.files import replacing
from sipe_bayes.core.findings import Code, Finding, finding
from sipe_bayes.envs.inertia import body_frame_inertia
from sipe_bayes.envs.internal.elastic import ELASTIC, NUMBERS, motor_side
from sipe_bayes.envs.kinds.contacts import pair_index
from sipe_bayes.envs.kinds.tendons import copy_tendon, with_coefficients
from sipe_bayes.envs.laws.registry import LAW_OF
from sipe_bayes.envs.mjcf import MjcfEnvironment
from sipe_bayes.envs.targets import split

_INERTIA_FROM_GEOMS, _INERTIA_AUTO = 1, 2  # mjtInertiaFromGeom, which Python does not have
_PRINCIPAL = ("body_iquat", "body_inertia")
_SIX_DIGITS = {"rtol": 1e-4, "atol": 1e-10}  # what a file of six digits may change in derived fields
NO_NUMBERS = ("bvh", "oct", "tex", "name", "path", "_")
"""What the names of a model's fields begin with that hold none of its numbers."""


class ExportError(RuntimeError):
    """The written model is not the calibrated one."""


def write_identified(environment: MjcfEnvironment, values: FloatArray, path: Path, note: str = "") -> list[Finding]:
    """Write the MJCF at some values of its parameters. Those that differ between logs take their mean.

    Args:
        environment: whose MJCF.
        values: (N,), in physical units.
        path: the file.
        note: a comment at its head.

    Returns:
        Sensor biases, which have no place in a model.

    Raises:
        ExportError: where the written model would not be the calibrated one.
    """
    model = environment.compile()
    environment.write(model, values)
    mujoco.mj_setConst(model, mujoco.MjData(model))
    spec = environment.spec()
    _absolute_assets(spec, environment.source)
    for parameter in environment.parameters:
        for target in parameter.targets:
            if not target.startswith("sensor:"):
                _copy(spec, model, target)
    _write(spec, model, path, note)
    biased = [p.name for p in environment.parameters if any(t.startswith("sensor:") for t in p.targets)]
    return [finding(Code.BIAS_NOT_EXPORTED, parameters=[name]) for name in biased]


def write_edited(environment: MjcfEnvironment, path: Path, note: str = "") -> None:
    """Write the MJCF with the environment's edits, its values as they are.

    Args:
        environment: whose MJCF.
        path: the file.
        note: a comment at its head.

    Raises:
        ExportError: where the written model would not be the edited one.
    """
    spec = environment.spec()
    _absolute_assets(spec, environment.source)
    _write(spec, environment.compile(), path, note)


def _write(spec: mujoco.MjSpec, model: mujoco.MjModel, path: Path, note: str) -> None:
    """Write an MJCF that compiles to a model."""
    with replacing(path) as temporary:
        try:
            spec.compile()
            temporary.write_text(_noted(with_coefficients(spec.to_xml(), model), note), encoding="utf-8")
            written = mujoco.MjModel.from_xml_path(str(temporary))
        except ValueError as error:  # six digits can break A + B >= C of a flat body
            reason = " ".join(str(error).split())
            raise ExportError(f"{path.name}: the written model does not compile: {reason}") from None
        differing = differing_fields(model, written)
        if differing:
            raise ExportError(f"{path.name}: the written model differs in {', '.join(differing)}; nothing was written")


def _noted(xml: str, note: str) -> str:
    """MJCF with a comment, in which no two dashes may stand together."""
    return f"<!-- {note.replace('--', '- -')} -->\n{xml}" if note else xml


def differing_fields(a: mujoco.MjModel, b: mujoco.MjModel) -> list[str]:
    """Names of the numeric fields in which two models differ by more than six digits explain.

    Of bodies the inertia as a whole: where two principal moments are alike, their axes may be any.
    """
    differing = []
    if a.nbody == b.nbody:
        x, y = (np.stack([body_frame_inertia(model, k) for k in range(model.nbody)]) for model in (a, b))
        if not np.allclose(x, y, _SIX_DIGITS["rtol"], 1e-5 * float(np.abs(x).max()) + _SIX_DIGITS["atol"]):
            differing.append("the inertia of bodies")
    for name, x in number_fields(a).items():
        if name in _PRINCIPAL and a.nbody == b.nbody:
            continue
        y, scale = getattr(b, name), float(np.abs(x).max())
        if x.shape != y.shape or not np.allclose(x, y, _SIX_DIGITS["rtol"], 1e-5 * scale + _SIX_DIGITS["atol"]):
            differing.append(name)
    return differing


def number_fields(model: mujoco.MjModel) -> dict[str, FloatArray]:
    """A model's fields of floating-point numbers by name, views of its memory."""
    named = ((name, getattr(model, name)) for name in sorted(dir(model)) if not name.startswith(NO_NUMBERS))
    return {name: x for name, x in named if isinstance(x, np.ndarray) and x.dtype.kind == "f" and x.size}


def _absolute_assets(spec: mujoco.MjSpec, source: str) -> None:
    """Let the written file find meshes and textures from any folder."""
    if source.lstrip().startswith("<"):
        return
    folder = Path(source).resolve().parent
    for attribute in ("meshdir", "texturedir"):
        if spec.meshes or spec.textures:
            setattr(spec, attribute, str(folder / getattr(spec, attribute)))


def _copy(spec: mujoco.MjSpec, model: mujoco.MjModel, target: str) -> None:
    kind, name, attribute = split(target)
    if (kind, attribute) in LAW_OF:
        _copy_numeric(spec, model, f"{kind}:{name}.{LAW_OF[kind, attribute][0].name}")
    elif kind == "body":
        _copy_inertial(spec, model, name)
    elif kind == "joint" and attribute in {number.attribute for number in NUMBERS}:
        _copy_elastic(spec, model, name)
    elif kind == "joint":
        _copy_joint(spec, model, name, attribute)
    elif kind == "tendon":
        copy_tendon(spec, model, target)
    elif kind == "actuator":
        _copy_actuator(spec, model, name)
    elif kind == "geom":
        _copy_contacts(spec.geom(name), model.geom(name))
    elif kind == "pair":
        index = pair_index(model, name, target)
        _copy_contacts(spec.pairs[index], model.pair(index))
    else:
        for field in ("gravity", "wind"):
            getattr(spec.option, field)[:] = getattr(model.opt, field)
        for field in ("density", "viscosity", "impratio"):
            setattr(spec.option, field, getattr(model.opt, field))


def _copy_contacts(element: Any, model: Any) -> None:
    """Of a spec's geom or pair what the model's one has."""
    for field in ("friction", "solref", "solimp"):
        getattr(element, field)[:] = getattr(model, field)
    element.margin = float(model.margin[0])


def _copy_inertial(spec: mujoco.MjSpec, model: mujoco.MjModel, name: str) -> None:
    compiler = spec.compiler
    everything = compiler.inertiafromgeom == _INERTIA_FROM_GEOMS or compiler.settotalmass > 0
    if everything:  # both would overrule an inertial that is written down
        compiler.inertiafromgeom, compiler.settotalmass = _INERTIA_AUTO, -1
    for body in spec.bodies:
        index = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, body.name) if body.name else body.id
        if body.name == name or (everything and index > 0 and model.body_mass[index] > 0):
            body.explicitinertial = True
            body.mass = model.body_mass[index]
            body.ipos[:], body.iquat[:] = model.body_ipos[index], model.body_iquat[index]
            body.inertia[:] = model.body_inertia[index]
            body.fullinertia[:] = np.nan


def _copy_numeric(spec: mujoco.MjSpec, model: mujoco.MjModel, label: str) -> None:
    numeric, index = next(n for n in spec.numerics if n.name == label), model.numeric(label).id
    first = int(model.numeric_adr[index])
    numeric.data = model.numeric_data[first : first + int(model.numeric_size[index])]


def _copy_joint(spec: mujoco.MjSpec, model: mujoco.MjModel, name: str, attribute: str) -> None:
    joint, index = spec.joint(name), model.joint(name).id
    dof = int(model.jnt_dofadr[index])
    if attribute.startswith("damping"):
        joint.damping[:] = [model.dof_damping[dof], *model.dof_dampingpoly[dof]]
    elif attribute.startswith("stiffness"):
        joint.stiffness[:] = [model.jnt_stiffness[index], *model.jnt_stiffnesspoly[index]]
    elif attribute == "springref":
        value = float(model.qpos_spring[int(model.jnt_qposadr[index])])
        hinge = int(model.jnt_type[index]) == int(mujoco.mjtJoint.mjJNT_HINGE)
        joint.springref = np.degrees(value) if hinge and spec.compiler.degree else value
        for tendon, lengths in zip(spec.tendons, model.tendon_lengthspring, strict=True):
            tendon.springlength[:] = lengths  # without one of its own it would rest where the joint's spring does
    elif attribute == "armature" and motor_side(model, name) >= 0:
        spec.tendon(model.tendon(motor_side(model, name)).name).armature = model.tendon_armature[
            motor_side(model, name)
        ]
    else:
        setattr(joint, attribute, float(getattr(model, f"dof_{attribute}")[dof]))


def _copy_elastic(spec: mujoco.MjSpec, model: mujoco.MjModel, name: str) -> None:
    _copy_numeric(spec, model, f"joint:{name}.{ELASTIC}")
    for attribute in ("stiffness", "damping", "armature"):
        _copy_joint(spec, model, name, attribute)
    joint, index = spec.joint(name), model.joint(name).id
    hinge = int(model.jnt_type[index]) == int(mujoco.mjtJoint.mjJNT_HINGE)
    joint.limited = bool(model.jnt_limited[index])
    joint.range = np.degrees(model.jnt_range[index]) if hinge and spec.compiler.degree else model.jnt_range[index]


def _copy_actuator(spec: mujoco.MjSpec, model: mujoco.MjModel, name: str) -> None:
    actuator, index = spec.actuator(name), model.actuator(name).id
    actuator.gear[:] = model.actuator_gear[index]
    actuator.gainprm[:] = model.actuator_gainprm[index]
    actuator.biasprm[:] = model.actuator_biasprm[index]
    actuator.biastype = mujoco.mjtBias(int(model.actuator_biastype[index]))
    actuator.dynprm[:] = model.actuator_dynprm[index]
    actuator.delay = float(model.actuator_delay[index])
    control = int(model.actuator_ctrladr[index])
    if control >= 0 and model.actuator_ctrllimited[control]:
        actuator.ctrllimited, actuator.ctrlrange[:] = True, model.actuator_ctrlrange[control]
    if model.actuator_forcelimited[index]:
        actuator.forcelimited, actuator.forcerange[:] = True, model.actuator_forcerange[index]
