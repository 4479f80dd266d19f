"""The table of extensions: a row each, with what it is called, where it is described, and its parameters' bounds."""

from __future__ import annotations

from functools import partial

import numpy as np

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.parameters import Parameter
from sipe_bayes.envs.internal.elastic import Gear, Link
from sipe_bayes.structure.extension import PROBE, Extension
from sipe_bayes.structure.extensions import sites
from sipe_bayes.structure.extensions.row import Probes, Row, Unknown
from sipe_bayes.structure.machine import Machine

_SPRING: Probes = (((PROBE, 0.25), (PROBE, 0.75)),)  # weak, at rest at either side: the force is a sum of the two
_OVER_RANGES: Probes = (((PROBE, 0.2),), ((PROBE, 0.5),), ((PROBE, 0.8),))  # a little of it, over three distances
_COMPLIANCES: Probes = (((0.05, 0.5),), ((0.15, 0.5),), ((0.4, 0.5),))  # of the softest spring: far from linear
_BASES: Probes = (((0.05, 0.5, 0.5),), ((0.15, 0.5, 0.5),), ((0.4, 0.5, 0.5),))  # of five times the machine's mass
_GAPS: Probes = (((0.03,),), ((0.1,),), ((0.3,),))  # of the widest gap: the effect is far from linear
_ALONE: Probes = (((),),)  # of what has no parameters


def _is_driven(machine: Machine, site: str) -> bool:
    return machine.joint_of(site) is not None and not machine.is_position(site)


def _of_commands(machine: Machine, parameter: Parameter) -> FloatArray:
    """Shares of the largest command: a limit that is never met has no effect."""
    return np.array([[[float(parameter.normalise(share * parameter.high))]] for share in (0.9, 0.7, 0.5)])


_LUGRE = 'actuator/dcmotor with input="none", LuGre friction'
_MEAN_GAIN = "actuator gain, at its mean over the motion"
_POLYNOMIAL = "MuJoCo documentation, polynomial forces"
_FOSSEN = "T. I. Fossen 2011, Handbook of Marine Craft Hydrodynamics and Motion Control"
_SPONG = "M. W. Spong 1987, Modeling and control of elastic joint robots, https://doi.org/10.1115/1.3143860"
_NORDIN = "M. Nordin, P.-O. Gutman 2002, https://doi.org/10.1016/S0005-1098(02)00047-X"
_INERTIAL = "MuJoCo documentation, body inertial"
_ROWS: tuple[Extension, ...] = (
    Row("viscous_friction", "joint", "viscous friction at {}", "MuJoCo documentation, joint damping",
        [Unknown("viscous_friction", 0.0, lambda s: 2 * s.force / s.velocity, "force per velocity", "damping")]),
    Row("dry_friction", "joint", "dry friction at {}", "C. A. Coulomb 1785, Theorie des machines simples",
        [Unknown("dry_friction", 0.0, lambda s: s.force, "level of dry friction", "frictionloss")]),
    Row("armature", "joint", "armature (rotor inertia) at {}", "MuJoCo documentation, joint armature",
        [Unknown("armature", 0.0, lambda s: s.inertia, "reflected inertia")]),
    Row("quadratic_damping", "joint", "drag (quadratic in the velocity) at {}", _POLYNOMIAL,
        [Unknown("quadratic_damping", 0.0, lambda s: s.force / s.velocity**2, "force per squared velocity",
                 "damping_quadratic")]),
    Row("cubic_damping", "joint", "drag (cubic in the velocity) at {}", _POLYNOMIAL,
        [Unknown("cubic_damping", 0.0, lambda s: s.force / s.velocity**3, "force per cubed velocity",
                 "damping_cubic")]),
    Row("spring", "joint", "a spring at {}", "MuJoCo documentation, joint stiffness and springref",
        [Unknown("spring", 0.0, lambda s: 2 * s.force / s.position, "stiffness of the spring", "stiffness"),
         Unknown("spring_rest", lambda s: -2 * s.position, lambda s: 2 * s.position, "where the spring rests",
                 "springref")], tried=_SPRING),
    Row("hardening_spring", "joint", "a hardening spring at {}", _POLYNOMIAL,
        [Unknown("spring_quadratic", lambda s: -s.force / s.position**2, lambda s: s.force / s.position**2,
                 "force per squared position", "stiffness_quadratic"),
         Unknown("spring_cubic", lambda s: -s.force / s.position**3, lambda s: s.force / s.position**3,
                 "force per cubed position", "stiffness_cubic")]),
    Row("direction_friction", "joint", "direction-dependent friction at {}",
        "B. Armstrong-Helouvry, P. Dupont, C. Canudas de Wit 1994, https://doi.org/10.1016/0005-1098(94)90209-7",
        [Unknown("direction_friction", lambda s: -s.force / 2, lambda s: s.force / 2,
                 "half the difference of dry friction forwards and backwards"),
         Unknown("direction_damping", lambda s: -s.force / s.velocity, lambda s: s.force / s.velocity,
                 "half the difference of viscous friction forwards and backwards")],
        "joint frictionloss and damping, alike both ways", native=False),
    Row("stribeck", "joint", "Stribeck friction at {}",
        "R. Stribeck 1902; H. Olsson et al. 1998, https://doi.org/10.1016/S0947-3580(98)70113-X",
        [Unknown("stribeck_friction", 0.0, lambda s: s.force, "dry friction at rest above that at speed"),
         Unknown("stribeck_velocity", lambda s: 0.01 * s.velocity, lambda s: s.velocity,
                 "speed at which it has mostly gone", scale="log")],
        _LUGRE, native=False, tried=(((PROBE, 0.25),), ((PROBE, 0.5),), ((PROBE, 0.75),))),
    Row("presliding", "joint", "presliding friction at {}",
        "P. R. Dahl 1968, A solid friction model; C. Canudas de Wit et al. 1995, https://doi.org/10.1109/9.376053",
        [Unknown("presliding_friction", 0.0, lambda s: s.force, "level of dry friction"),
         Unknown("presliding_range", lambda s: s.shortest(0.001, 0.2 * s.position), lambda s: 0.2 * s.position,
                 "distance over which it is built up", scale="log")], _LUGRE, native=False, tried=_OVER_RANGES),
    Row("hysteresis", "joint", "hysteresis at {}, a force that lags behind the position",
        "W. D. Iwan 1966; F. Al-Bender, V. Lampaert, J. Swevers 2005, https://doi.org/10.1109/TAC.2005.858676",
        [Unknown("hysteresis_force", 0.0, lambda s: s.force, "largest force either way"),
         Unknown("hysteresis_range", lambda s: s.shortest(0.02, 2.0 * s.position), lambda s: 2.0 * s.position,
                 "distance at which the second of three springs gives way", scale="log")],
        "joint springyield, one elasto-plastic spring", native=False, tried=_OVER_RANGES),
    Row("load_friction", "joint", "load-dependent friction at {}",
        "M. Duclusaud et al. 2024, https://arxiv.org/abs/2410.08650",
        [Unknown("load_friction", 0.0, 1.0, "share of the transmitted torque")],
        "joint frictionloss, at its mean over the motion", native=False),
    Row("tendon_viscous_friction", "tendon", "viscous friction along {}", "MuJoCo documentation, tendon damping",
        [Unknown("viscous_friction", 0.0, lambda s: 2 * s.force / s.velocity, "force per velocity", "damping")]),
    Row("tendon_dry_friction", "tendon", "dry friction along {}", "MuJoCo documentation, tendon frictionloss",
        [Unknown("dry_friction", 0.0, lambda s: s.force, "level of dry friction", "frictionloss")]),
    Row("tendon_spring", "tendon", "a spring along {}", "MuJoCo documentation, tendon stiffness and springlength",
        [Unknown("spring", 0.0, lambda s: 2 * s.force / s.position, "stiffness of the spring", "stiffness"),
         Unknown("spring_rest", lambda s: max(s.length - 2 * s.position, s.least), lambda s: s.length + 2 * s.position,
                 "length at which the spring rests", "springlength")], tried=_SPRING),
    Row("delay", "actuator", "a delay of {}", "MuJoCo documentation, actuator delay",
        [Unknown("delay", 0.0, lambda s: min(0.1, 20 * s.dt), "from command to force")],
        tried=sites.one_sample, alike=True, imitator="lag"),
    Row("offset", "actuator", "an offset of {}", "-",
        [Unknown("offset", lambda s: -s.command, lambda s: s.command, "added to the command")]),
    Row("back_emf", "actuator", "back-EMF of {}", "MuJoCo documentation, actuator/dcmotor",
        [Unknown("back_emf", lambda s: -2 * s.force / s.velocity, 0.0, "force per velocity", "bias_velocity")],
        needs=_is_driven),
    # tried from the usual force on: a limit that is never met has no effect
    Row("force_limit", "actuator", "a limit of the force of {}", "MuJoCo documentation, actuator forcerange",
        [Unknown("force_limit", lambda s: s.force / 3, lambda s: 5 * s.force, "largest force either way")],
        tried=(((0.143,),), ((0.214,),), ((0.3,),))),
    # of an actuator whose force hangs on the motion too; elsewhere it is a limit of the force
    Row("command_limit", "actuator", "a limit of the command of {}", "MuJoCo documentation, actuator ctrlrange",
        [Unknown("command_limit", lambda s: 0.1 * s.command, lambda s: s.command, "largest command either way")],
        tried=_of_commands, needs=lambda machine, site: bool(machine.commands[site]) and machine.is_position(site)),
    Row("force_drop", "actuator", "a gain of {} that changes with its force", "-",
        [Unknown("force_drop", lambda s: -0.25 / s.force, lambda s: 0.25 / s.force, "relative loss per force")],
        _MEAN_GAIN, native=False, alike=True),
    Row("direction_gain", "actuator", "a gain of {} that differs by direction", _FOSSEN,
        [Unknown("direction_gain", -0.5, 0.5, "share of the force, more forward and less backward")],
        _MEAN_GAIN, native=False, alike=True),
    Row("power", "actuator", "a force of {} that follows a power of its command", _FOSSEN,
        [Unknown("exponent", 1 / 2.5, 2.5, "power of the command that the force goes with", scale="log"),
         Unknown("exponent_force", lambda s: s.force / 5, lambda s: 5 * s.force,
                 "force that is the model's whatever the power", scale="log")],
        _MEAN_GAIN, native=False, tried=(((0.5 + PROBE, 0.5),),), alike=True),
    Row("dead_zone", "actuator", "a dead zone of {}",
        "G. Tao and P. V. Kokotovic 1996, Adaptive Control of Systems with Actuator and Sensor Nonlinearities",
        [Unknown("dead_zone", 0.0, lambda s: s.force, "force of which nothing arrives")],
        "dry friction, where the actuator drives a joint", native=False, alike=True),
    Row("sensor_offset", "channel", "a zero error of {}", "-",
        [Unknown("offset", lambda s: -s.position / 2, lambda s: s.position / 2, "added to the measurement", "bias")]),
    # MuJoCo knows no such sensor: sipe_bayes does it to what is simulated
    Row("sensor_scale", "channel", "a factor of {}", "-",
        [Unknown("scale", 0.5, 1.5, "measured for what there is", prior=(1.0, 0.2))], native=False),
    # MuJoCo takes each body for the box or ellipsoid of its inertia
    Row("medium_drag", "world", "drag of the medium around it",
        "MuJoCo documentation, passive forces, option density and viscosity",
        [Unknown("medium_density", 0.0, 1200.0, "of the medium; air has 1.2, brine 1200", "option.density"),
         Unknown("medium_viscosity", 0.0, 1.5, "of the medium; air has 2e-5, glycerine 1.5", "option.viscosity")]),
    # the position is measured behind the gear, at the joint
    Row("gear_compliance", "joint", "gear compliance at {}", _SPONG, partial(sites.compliance, "gear"),
        tried=_COMPLIANCES, edit=partial(sites.spring, Gear)),
    # the position is measured before the link, at the motor
    Row("link_compliance", "joint", "link or shaft compliance behind {}", _SPONG, partial(sites.compliance, "link"),
        tried=_COMPLIANCES, edit=partial(sites.spring, Link)),
    Row("gear_backlash", "joint", "backlash between the motor and {}", _NORDIN, partial(sites.backlash, "gear"),
        tried=_GAPS, edit=partial(sites.spring, Gear)),
    Row("link_backlash", "joint", "backlash behind {}", _NORDIN, partial(sites.backlash, "link"),
        tried=_GAPS, edit=partial(sites.spring, Link)),
    Row("lag", "actuator", "a first-order lag of {}", 'MuJoCo documentation, actuator dyntype="filterexact"',
        [Unknown("lag", 0.0, lambda s: min(0.2, 50 * s.dt), "time constant from command to force")],
        tried=sites.one_sample, alike=True, imitator="delay", edit=sites.filtered_command),
    Row("cogging", "actuator", "cogging at the joint of {}", "MuJoCo documentation, actuator/dcmotor, cogging",
        sites.cogging, "actuator/dcmotor, cogging", native=False, tried=sites.numbers_of_poles),
    Row("gain", "actuator", "a gain error of {}", "-", sites.gain,
        wholes=lambda machine, site: (float(machine.model.actuator(site).gainprm[0]),),
        error="a {share:.3g} % error of the gain of {site}"),
    Row("log_gain", "actuator", "a gain of {} that differs between the logs", "-", sites.log_gain, per_log=True),
    Row("mass", "body", "a mass error of {}", _INERTIAL, sites.mass,
        wholes=lambda machine, site: (machine.bodies[site].mass,), error="a {share:.3g} % error of the mass of {site}"),
    Row("log_mass", "body", "a mass of {} that differs between the logs", _INERTIAL, sites.log_mass, per_log=True),
    # as where CAD has left out motors and cables
    Row("centre_of_mass", "body", "a centre of mass offset of {}", _INERTIAL, sites.centre_of_mass,
        wholes=lambda machine, site: (machine.bodies[site].reach,) * sum(machine.bodies[site].turned),
        error="an error of the centre of mass of {site} by {share:.3g} % of its reach"),
    sites.SensorDelay(),
    Row("sensor_filter", "channel", "a low-pass filter of {}", "-",
        [Unknown("filter", 0.0, lambda s: min(0.05, 20 * s.dt), "time constant of a low-pass filter")],
        native=False, imitator="delay", memory=lambda dt: 3 * min(0.05, 20 * dt)),
    Row("gravity_tilt", "world", "a base that is tilted", "-", sites.gravity_tilt),
    Row("base_compliance", "world", "a base that moves under the machine", "-", sites.base,
        tried=_BASES, edit=sites.base_joints),
    Row("supply_sag", "world", "a supply whose voltage falls with the force of all motors", "-", sites.supply_sag,
        _MEAN_GAIN, native=False),
    Row("physics_step", "world", "physics steps an eighth as long", "L. F. Richardson 1911", [],
        tried=_ALONE, fixed=True, slow=8, error="the effect of the physics step", edit=sites.shorter_steps),
    Row("hard_friction", "world", "dry friction that does not creep (solreffriction, solimpfriction)",
        "MuJoCo documentation, joint solreffriction and solimpfriction", [],
        tried=_ALONE, fixed=True, edit=sites.hard_friction),
    Row("residual", "joint", "an unstructured residual force at {}",
        "A. Rahimi, B. Recht 2007, Random Features for Large-Scale Kernel Machines",
        sites.residual, native=False, by_name=True, edit=sites.residual_lengths),
)  # fmt: skip
ROWS = {row.name: row for row in _ROWS}
