"""The table of extensions that need no more than parameters: a row each.

A row says where the extension may be, what it is called, where it is described, and for each parameter its bounds, from
the sizes of the machine's motion, with the target that it writes. What edits the model, or hangs on more than one site,
is a class in one of the files beside this one.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.parameters import Parameter
from sipe_bayes.structure.extension import PROBE, WORLD, Extension, Kind, members
from sipe_bayes.structure.machine import Machine

Probes = tuple[tuple[tuple[float, ...], ...], ...]
"""Theta of the parameters at which a row is tried: of each shape its directions."""
_SPRING: Probes = (((PROBE, 0.25), (PROBE, 0.75)),)  # weak, at rest at either side: the force is a sum of the two
_OWNERS = {"channel": "sensor"}  # of targets, where not the kind itself
_OVER_RANGES: Probes = (((PROBE, 0.2),), ((PROBE, 0.5),), ((PROBE, 0.8),))  # a little of it, over three distances


@dataclass(frozen=True)
class Sizes:
    """What bounds are made of, in SI; nan of what a site does not have.

    Args:
        force: the usual one; of several actuators the largest.
        velocity: root-mean-square, of an actuator that of the joint that it drives.
        position: spread, of a tendon that of its length, of a channel what it measures.
        inertia: that a joint moves.
        command: the largest.
        length: a tendon's mean.
        least: a tendon's smallest.
        dt: shortest time between samples.
        step: of the physics.
    """

    force: float = math.nan
    velocity: float = math.nan
    position: float = math.nan
    inertia: float = math.nan
    command: float = math.nan
    length: float = math.nan
    least: float = math.nan
    dt: float = math.nan
    step: float = math.nan

    @classmethod
    def of(cls, machine: Machine, kind: Kind, site: str) -> Sizes:
        """At a site of a machine."""
        dt, step = machine.dt, machine.timestep
        if kind == "joint":
            joint = machine.joints[site]
            return cls(joint.force, joint.velocity, joint.position, joint.inertia, dt=dt, step=step)
        if kind == "tendon":
            own = machine.tendons[site]
            return cls(own.force, own.velocity, own.stretch, length=own.length, least=own.least, dt=dt, step=step)
        if kind in ("channel", "world"):
            return cls(position=machine.channels.get(site, math.nan), dt=dt, step=step)
        names = members(site)
        driven = machine.joint_of(site) if len(names) == 1 else None
        velocity = math.nan if driven is None else machine.joints[driven].velocity
        force, command = max(machine.forces[name] for name in names), max(machine.commands[name] for name in names)
        return cls(force, velocity, command=command or 1.0, dt=dt, step=step)

    def shortest(self, share: float, most: float) -> float:
        """A distance over which the usual force may be built up: a share of the usual one, at least what a step can."""
        return min(max(share * self.position, self.force * self.step**2 / self.inertia), most / 2)


Bound = float | Callable[[Sizes], float]


@dataclass(frozen=True)
class Unknown:
    """A parameter of a row: ``SITE.name``, bounds, the target behind the site's (by default its name), the prior."""

    name: str
    low: Bound
    high: Bound
    description: str
    target: str = ""
    scale: Literal["linear", "log"] = "linear"
    prior: tuple[float, float] | tuple[None, None] = (None, None)

    def at(self, kind: str, site: str, sizes: Sizes) -> Parameter:
        """At a site."""
        low, high = (bound if isinstance(bound, float) else bound(sizes) for bound in (self.low, self.high))
        owner, target = _OWNERS.get(kind, kind), self.target or self.name
        targets = (target,) if kind == WORLD else tuple(f"{owner}:{member}.{target}" for member in members(site))
        name = self.name if kind == WORLD else f"{site}.{self.name}"
        made = Parameter(name, low, high, scale=self.scale, targets=targets, description=self.description)
        return replace(made, prior_mean=self.prior[0], prior_sd=self.prior[1])


@dataclass(frozen=True, eq=False)
class Row(Extension):
    """An extension that needs no more than parameters.

    Args:
        name: in configurations.
        kind: what it is placed at.
        words: what it is, in the field's terms, with the site's name in braces.
        reference: where it is described.
        unknowns: its parameters.
        nearest: the element of MJCF that comes nearest; none where MJCF has one of its own.
        native: whether it has.
        tried: where other than by a small step of each parameter.
        alike: whether it may be the same at all actuators of one make.
        imitator: the attribute of the same site that does about the same.
        needs: whether a site has a place for it; by default every one.
    """

    name: str
    kind: Kind
    words: str
    reference: str
    unknowns: tuple[Unknown, ...]
    nearest: str = ""
    native: bool = True
    tried: Probes | Callable[[Machine, Parameter], Probes] = ()
    alike: bool = False
    imitator: str = ""
    needs: Callable[[Machine, str], bool] = lambda machine, site: True
    by_name: bool = False

    def sentence(self, site: str) -> str:
        """What it is."""
        return self.words.format(site)

    def parameters(self, machine: Machine, site: str) -> tuple[Parameter, ...]:
        """By the sizes of the motion there."""
        if not self.needs(machine, site):
            return ()
        sizes = Sizes.of(machine, self.kind, site)
        return tuple(unknown.at(self.kind, site, sizes) for unknown in self.unknowns)

    def groups(self, machine: Machine) -> tuple[tuple[str, ...], ...]:
        """Actuators of one make."""
        return machine.alike if self.alike else ()

    def imitators(self, site: str) -> tuple[str, ...]:
        """See ``imitator``."""
        return tuple(f"{self.kind}:{name}.{self.imitator}" for name in members(site)) if self.imitator else ()

    def probes(self, machine: Machine, parameters: tuple[Parameter, ...]) -> FloatArray:
        """See ``tried``."""
        tried = self.tried(machine, parameters[0]) if callable(self.tried) else self.tried
        return np.array(tried) if tried else super().probes(machine, parameters)


def _is_driven(machine: Machine, site: str) -> bool:
    return machine.joint_of(site) is not None and not machine.is_position(site)


def _one_sample(machine: Machine, parameter: Parameter) -> Probes:
    """Late by a sample, and at least by two physics steps."""
    return (((max(machine.dt, 2 * machine.timestep) / parameter.high,),),)


def _of_commands(machine: Machine, parameter: Parameter) -> Probes:
    """Shares of the largest command: a limit that is never met has no effect."""
    return tuple(((float(parameter.normalise(share * parameter.high)),),) for share in (0.9, 0.7, 0.5))


_LUGRE = 'actuator/dcmotor with input="none", LuGre friction'
_MEAN_GAIN = "actuator gain, at its mean over the motion"
_POLYNOMIAL = "MuJoCo documentation, polynomial forces"
_FOSSEN = "T. I. Fossen 2011, Handbook of Marine Craft Hydrodynamics and Motion Control"
_ROWS = (
    Row(
        "viscous_friction", "joint", "viscous friction at {}", "MuJoCo documentation, joint damping",
        (Unknown("viscous_friction", 0.0, lambda s: 2 * s.force / s.velocity, "force per velocity", "damping"),),
    ),
    Row(
        "dry_friction", "joint", "dry friction at {}", "C. A. Coulomb 1785, Theorie des machines simples",
        (Unknown("dry_friction", 0.0, lambda s: s.force, "level of dry friction", "frictionloss"),),
    ),
    Row(
        "armature", "joint", "armature (rotor inertia) at {}", "MuJoCo documentation, joint armature",
        (Unknown("armature", 0.0, lambda s: s.inertia, "reflected inertia"),),
    ),
    Row(
        "quadratic_damping", "joint", "drag (quadratic in the velocity) at {}", _POLYNOMIAL,
        (
            Unknown(
                "quadratic_damping", 0.0, lambda s: s.force / s.velocity**2, "force per squared velocity",
                "damping_quadratic",
            ),
        ),
    ),
    Row(
        "cubic_damping", "joint", "drag (cubic in the velocity) at {}", _POLYNOMIAL,
        (
            Unknown(
                "cubic_damping", 0.0, lambda s: s.force / s.velocity**3, "force per cubed velocity", "damping_cubic"
            ),
        ),
    ),
    Row(
        "spring", "joint", "a spring at {}", "MuJoCo documentation, joint stiffness and springref",
        (
            Unknown("spring", 0.0, lambda s: 2 * s.force / s.position, "stiffness of the spring", "stiffness"),
            Unknown(
                "spring_rest", lambda s: -2 * s.position, lambda s: 2 * s.position, "where the spring rests",
                "springref",
            ),
        ),
        tried=_SPRING,
    ),
    Row(
        "hardening_spring", "joint", "a hardening spring at {}", _POLYNOMIAL,
        (
            Unknown(
                "spring_quadratic", lambda s: -s.force / s.position**2, lambda s: s.force / s.position**2,
                "force per squared position", "stiffness_quadratic",
            ),
            Unknown(
                "spring_cubic", lambda s: -s.force / s.position**3, lambda s: s.force / s.position**3,
                "force per cubed position", "stiffness_cubic",
            ),
        ),
    ),
    Row(
        "direction_friction", "joint", "direction-dependent friction at {}",
        "B. Armstrong-Helouvry, P. Dupont, C. Canudas de Wit 1994, https://doi.org/10.1016/0005-1098(94)90209-7",
        (
            Unknown(
                "direction_friction", lambda s: -s.force / 2, lambda s: s.force / 2,
                "half the difference of dry friction forwards and backwards",
            ),
            Unknown(
                "direction_damping", lambda s: -s.force / s.velocity, lambda s: s.force / s.velocity,
                "half the difference of viscous friction forwards and backwards",
            ),
        ),
        "joint frictionloss and damping, alike both ways", native=False,
    ),
    Row(
        "stribeck", "joint", "Stribeck friction at {}",
        "R. Stribeck 1902; H. Olsson et al. 1998, https://doi.org/10.1016/S0947-3580(98)70113-X",
        (
            Unknown("stribeck_friction", 0.0, lambda s: s.force, "dry friction at rest above that at speed"),
            Unknown(
                "stribeck_velocity", lambda s: 0.01 * s.velocity, lambda s: s.velocity,
                "speed at which it has mostly gone", scale="log",
            ),
        ),
        _LUGRE, native=False, tried=(((PROBE, 0.25),), ((PROBE, 0.5),), ((PROBE, 0.75),)),
    ),
    Row(
        "presliding", "joint", "presliding friction at {}",
        "P. R. Dahl 1968, A solid friction model; C. Canudas de Wit et al. 1995, https://doi.org/10.1109/9.376053",
        (
            Unknown("presliding_friction", 0.0, lambda s: s.force, "level of dry friction"),
            Unknown(
                "presliding_range", lambda s: s.shortest(0.001, 0.2 * s.position), lambda s: 0.2 * s.position,
                "distance over which it is built up", scale="log",
            ),
        ),
        _LUGRE, native=False, tried=_OVER_RANGES,
    ),
    Row(
        "hysteresis", "joint", "hysteresis at {}, a force that lags behind the position",
        "W. D. Iwan 1966; F. Al-Bender, V. Lampaert, J. Swevers 2005, https://doi.org/10.1109/TAC.2005.858676",
        (
            Unknown("hysteresis_force", 0.0, lambda s: s.force, "largest force either way"),
            Unknown(
                "hysteresis_range", lambda s: s.shortest(0.02, 2.0 * s.position), lambda s: 2.0 * s.position,
                "distance at which the second of three springs gives way", scale="log",
            ),
        ),
        "joint springyield, one elasto-plastic spring", native=False, tried=_OVER_RANGES,
    ),
    Row(
        "load_friction", "joint", "load-dependent friction at {}",
        "M. Duclusaud et al. 2024, https://arxiv.org/abs/2410.08650",
        (Unknown("load_friction", 0.0, 1.0, "share of the transmitted torque"),),
        "joint frictionloss, at its mean over the motion", native=False,
    ),
    Row(
        "tendon_viscous_friction", "tendon", "viscous friction along {}", "MuJoCo documentation, tendon damping",
        (Unknown("viscous_friction", 0.0, lambda s: 2 * s.force / s.velocity, "force per velocity", "damping"),),
    ),
    Row(
        "tendon_dry_friction", "tendon", "dry friction along {}", "MuJoCo documentation, tendon frictionloss",
        (Unknown("dry_friction", 0.0, lambda s: s.force, "level of dry friction", "frictionloss"),),
    ),
    Row(
        "tendon_spring", "tendon", "a spring along {}", "MuJoCo documentation, tendon stiffness and springlength",
        (
            Unknown("spring", 0.0, lambda s: 2 * s.force / s.position, "stiffness of the spring", "stiffness"),
            Unknown(
                "spring_rest", lambda s: max(s.length - 2 * s.position, s.least), lambda s: s.length + 2 * s.position,
                "length at which the spring rests", "springlength",
            ),
        ),
        tried=_SPRING,
    ),
    Row(
        "delay", "actuator", "a delay of {}", "MuJoCo documentation, actuator delay",
        (Unknown("delay", 0.0, lambda s: min(0.1, 20 * s.dt), "from command to force"),),
        tried=_one_sample, alike=True, imitator="lag",
    ),
    Row(
        "offset", "actuator", "an offset of {}", "-",
        (Unknown("offset", lambda s: -s.command, lambda s: s.command, "added to the command"),),
    ),
    Row(
        "back_emf", "actuator", "back-EMF of {}", "MuJoCo documentation, actuator/dcmotor",
        (Unknown("back_emf", lambda s: -2 * s.force / s.velocity, 0.0, "force per velocity", "bias_velocity"),),
        needs=_is_driven,
    ),
    Row(
        "force_limit", "actuator", "a limit of the force of {}", "MuJoCo documentation, actuator forcerange",
        (Unknown("force_limit", lambda s: s.force / 3, lambda s: 5 * s.force, "largest force either way"),),
        tried=(((0.143,),), ((0.214,),), ((0.3,),)),  # from the usual force on: a limit that is never met has no effect
    ),
    Row(  # of an actuator whose force hangs on the motion too; elsewhere it is a limit of the force
        "command_limit", "actuator", "a limit of the command of {}", "MuJoCo documentation, actuator ctrlrange",
        (Unknown("command_limit", lambda s: 0.1 * s.command, lambda s: s.command, "largest command either way"),),
        tried=_of_commands,
        needs=lambda machine, site: bool(machine.commands[site]) and machine.is_position(site),
    ),
    Row(
        "force_drop", "actuator", "a gain of {} that changes with its force", "-",
        (
            Unknown(
                "force_drop", lambda s: -0.25 / s.force, lambda s: 0.25 / s.force, "relative loss per force",
            ),
        ),
        _MEAN_GAIN, native=False, alike=True,
    ),
    Row(
        "direction_gain", "actuator", "a gain of {} that differs by direction", _FOSSEN,
        (Unknown("direction_gain", -0.5, 0.5, "share of the force, more forward and less backward"),),
        _MEAN_GAIN, native=False, alike=True,
    ),
    Row(
        "power", "actuator", "a force of {} that follows a power of its command", _FOSSEN,
        (
            Unknown(
                "exponent", 1 / 2.5, 2.5, "power of the command that the force goes with", scale="log"
            ),
            Unknown(
                "exponent_force", lambda s: s.force / 5, lambda s: 5 * s.force,
                "force that is the model's whatever the power", scale="log",
            ),
        ),
        _MEAN_GAIN, native=False, tried=(((0.5 + PROBE, 0.5),),), alike=True,
    ),
    Row(
        "dead_zone", "actuator", "a dead zone of {}",
        "G. Tao and P. V. Kokotovic 1996, Adaptive Control of Systems with Actuator and Sensor Nonlinearities",
        (Unknown("dead_zone", 0.0, lambda s: s.force, "force of which nothing arrives"),),
        "dry friction, where the actuator drives a joint", native=False, alike=True,
    ),
    Row(
        "sensor_offset", "channel", "a zero error of {}", "-",
        (Unknown("offset", lambda s: -s.position / 2, lambda s: s.position / 2, "added to the measurement", "bias"),),
    ),
    Row(  # MuJoCo knows no such sensor: sipe_bayes does it to what is simulated
        "sensor_scale", "channel", "a factor of {}", "-",
        (Unknown("scale", 0.5, 1.5, "measured for what there is", prior=(1.0, 0.2)),), native=False,
    ),
    Row(  # MuJoCo takes each body for the box or ellipsoid of its inertia
        "medium_drag", "world", "drag of the medium around it",
        "MuJoCo documentation, passive forces, option density and viscosity",
        (
            Unknown("medium_density", 0.0, 1200.0, "of the medium; air has 1.2, brine 1200", "option.density"),
            Unknown("medium_viscosity", 0.0, 1.5, "of the medium; air has 2e-5, glycerine 1.5", "option.viscosity"),
        ),
    ),
)  # fmt: skip
ROWS = {row.name: row for row in _ROWS}
