"""URDF as MuJoCo reads it, without the meshes that are not there, and what is to be said of it.

Names such as ``package://arm_description/meshes/link.stl`` are looked for below each folder around the file. What is
not found, or is of a kind that MuJoCo does not read, is left out: inertias are those of the URDF.
"""

from __future__ import annotations

import re
from pathlib import Path

import mujoco

_KINDS = (".stl", ".obj", ".msh")
_NOTE = "urdf_note"
_SAID = 4  # names


def parsed(path: Path) -> mujoco.MjSpec:
    """MjSpec of an MJCF or URDF file; raises ValueError as MuJoCo does."""
    spec = mujoco.MjSpec.from_file(str(path))
    root = re.search(r"<(mujoco|robot)\b", path.read_text(encoding="utf-8", errors="replace"))
    if root is None or root[1] != "robot":
        return spec
    lost = {mesh.name for mesh in list(spec.meshes) if not _found(spec, mesh, path)}
    for geom in [geom for geom in list(spec.geoms) if geom.meshname in lost]:
        spec.delete(geom)
    for mesh in [mesh for mesh in list(spec.meshes) if mesh.name in lost]:
        spec.delete(mesh)
    if lost:
        some = ", ".join(sorted(lost)[:_SAID]) + f" and {len(lost) - _SAID} others" * (len(lost) > _SAID)
        _note(spec, f"meshes that are not there are left out: {some}; without them nothing touches these bodies")
    joints = [joint.name for joint in spec.joints if joint.type != mujoco.mjtJoint.mjJNT_FREE]
    if joints and not list(spec.actuators):
        motor = f'<actuator><motor name="{joints[0]}" joint="{joints[0]}"/></actuator>'
        _note(spec, f"a URDF has no actuators; where something drives a joint, save it as MJCF with such as {motor}")
    return spec


def notes_of(spec: mujoco.MjSpec) -> list[str]:
    """What is to be said of a model that was a URDF."""
    return [text.data for text in spec.texts if text.name.startswith(_NOTE)]


def _note(spec: mujoco.MjSpec, text: str) -> None:
    spec.add_text(name=f"{_NOTE}_{len(notes_of(spec))}", data=text)


def _found(spec: mujoco.MjSpec, mesh: mujoco.MjsMesh, path: Path) -> bool:
    """Whether a mesh has a file, which it then has by its whole name."""
    within = re.sub(r"^\w+:/+", "", mesh.file)
    folder = path.resolve().parent
    places = [folder / spec.compiler.meshdir / mesh.file, folder / spec.compiler.meshdir / Path(within).name]
    for around in (folder, *folder.parents):
        places += [around / within, around / Path(*Path(within).parts[1:])]  # the package by its name, or as its folder
    file = next((place for place in places if place.suffix.lower() in _KINDS and place.is_file()), None)
    if file is not None:
        mesh.file = str(file)
    return file is not None
