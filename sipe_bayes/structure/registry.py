"""The only list of extensions, and how one of the user's own is found.

What is no extension: a column that switches the torque off for a part of a log. It is known and not unknown, and no
number of a model stands for it: a motor without torque is a motor with command zero, a servo without torque has no
gains. Cut such parts out; by themselves, under a model without the actuators, they tell friction and inertia apart from
the drive, as a prior for the rest.
"""

from __future__ import annotations

import importlib
import importlib.util
import sys
from pathlib import Path

from sipe_bayes.core.validation import nearest_name
from sipe_bayes.structure.extension import KINDS, Extension

_PACKAGE = "sipe_bayes.structure.extensions"
EXTENSIONS: dict[str, str] = {  # name: module and class
    "viscous_friction": "joint.viscous_friction:ViscousFriction",
    "dry_friction": "joint.dry_friction:DryFriction",
    "armature": "joint.armature:Armature",
    "quadratic_damping": "joint.quadratic_damping:QuadraticDamping",
    "cubic_damping": "joint.cubic_damping:CubicDamping",
    "spring": "joint.spring:Spring",
    "hardening_spring": "joint.hardening_spring:HardeningSpring",
    "direction_friction": "joint.direction_friction:DirectionFriction",
    "stribeck": "joint.stribeck:Stribeck",
    "presliding": "joint.presliding:Presliding",
    "hysteresis": "joint.hysteresis:Hysteresis",
    "gear_compliance": "elastic.gear_compliance:GearCompliance",
    "link_compliance": "elastic.link_compliance:LinkCompliance",
    "gear_backlash": "elastic.gear_backlash:GearBacklash",
    "link_backlash": "elastic.link_backlash:LinkBacklash",
    "load_friction": "joint.load_friction:LoadFriction",
    "tendon_viscous_friction": "tendon.viscous_friction:TendonViscousFriction",
    "tendon_dry_friction": "tendon.dry_friction:TendonDryFriction",
    "tendon_spring": "tendon.spring:TendonSpring",
    "delay": "actuator.delay:Delay",
    "lag": "actuator.lag:Lag",
    "offset": "actuator.offset:Offset",
    "back_emf": "actuator.back_emf:BackEmf",
    "force_limit": "actuator.force_limit:ForceLimit",
    "command_limit": "actuator.command_limit:CommandLimit",
    "force_drop": "actuator.force_drop:ForceDrop",
    "direction_gain": "actuator.direction_gain:DirectionGain",
    "power": "actuator.power:Power",
    "dead_zone": "actuator.dead_zone:DeadZone",
    "cogging": "actuator.cogging:Cogging",
    "gain": "actuator.gain:Gain",
    "log_gain": "actuator.log_gain:LogGain",
    "mass": "body.mass:Mass",
    "log_mass": "body.log_mass:LogMass",
    "centre_of_mass": "body.centre_of_mass:CentreOfMass",
    "sensor_offset": "world.sensor_offset:SensorOffset",
    "sensor_scale": "world.sensor_scale:SensorScale",
    "sensor_delay": "world.sensor_delay:SensorDelay",
    "sensor_filter": "world.sensor_filter:SensorFilter",
    "gravity_tilt": "world.gravity_tilt:GravityTilt",
    "base_compliance": "elastic.base_compliance:BaseCompliance",
    "supply_sag": "world.supply_sag:SupplySag",
    "medium_drag": "world.medium_drag:MediumDrag",
    "residual": "world.residual:Residual",
}


def get_extension(name: str) -> Extension:
    """One of the registry's, or the user's own: ``package.module:Class`` or ``path/to/file.py:Class``.

    Raises:
        ValueError: for a name that is neither; one line with the remedy.
    """
    if name in EXTENSIONS:
        module, _, kind = EXTENSIONS[name].partition(":")
        return _made(f"{_PACKAGE}.{module}", kind, name)
    module, _, kind = name.rpartition(":")
    if not module:
        hint = nearest_name(name, EXTENSIONS) or f"; known are {', '.join(EXTENSIONS)}"
        raise ValueError(f"structure: no extension {name!r}{hint}; one of your own is package.module:Class")
    return _made(module, kind, name)


def _made(module: str, kind: str, name: str) -> Extension:
    try:
        loaded = _from_file(Path(module)) if module.endswith(".py") else importlib.import_module(module)
        made = getattr(loaded, kind)()
    except Exception as error:  # the user's own code may raise anything
        reason = " ".join(f"{type(error).__name__}: {error}".split())
        raise ValueError(f"structure: extension {name!r} cannot be loaded ({reason}); correct it") from None
    if not isinstance(made, Extension):
        raise ValueError(f"structure: {name!r} is no Extension; make it a subclass of sipe_bayes.structure.Extension")
    missing = [word for word in ("name", "kind", "reference") if not isinstance(getattr(made, word, None), str)]
    if missing or made.kind not in KINDS:
        remedy = f"give it a {missing[0]}" if missing else f"its kind is one of {', '.join(KINDS)}, got {made.kind!r}"
        raise ValueError(f"structure: extension {name!r} is not complete; {remedy}")
    return made


def _from_file(path: Path) -> object:
    spec = importlib.util.spec_from_file_location(f"sipe_extension_{path.stem}", path)
    if spec is None or spec.loader is None or not path.is_file():
        raise FileNotFoundError(f"no file {path}")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module
