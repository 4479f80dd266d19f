"""What rows of the table ask of a machine beyond the sizes of one site's motion: parameters, edits, probes.

A step of h seconds moves a simulation by an error of the order h: MuJoCo's Euler steps, explicit or implicit in the
velocity, lead an accelerated joint by about h/2. A step of h/n has an error of h/(2n), so it changes (n - 1)/n of all
that steps do (L. F. Richardson 1911, https://doi.org/10.1098/rsta.1911.0009). MuJoCo's dry friction is a soft
constraint: a joint at rest under a force creeps, by the time constant of ``solreffriction`` and the impedance of
``solimpfriction``.

Between a motor without inertia and its joint nothing can give way that shows: where the model has no armature there,
the extension ``armature`` is found first, and compliances beside it. A base moves along x and y of the world, as soft
and as heavy either way.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import partial

import mujoco
import numpy as np

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.parameters import Parameter
from sipe_bayes.envs.channels import is_rotation
from sipe_bayes.envs.internal.elastic import Base, Elastic, Gear, Link
from sipe_bayes.envs.internal.states import UNSETTLED, declare_start
from sipe_bayes.envs.laws.bound import LawNumbers
from sipe_bayes.envs.laws.registry import LAWS
from sipe_bayes.envs.mjcf import Edit
from sipe_bayes.envs.sensing import sensed_channels, vector_of
from sipe_bayes.structure.extension import PROBE, Extension, members
from sipe_bayes.structure.extensions.row import Unknown
from sipe_bayes.structure.machine import Machine

_MOST_POLES = 60.0  # of a motor: periods of its cogging in a turn
_SOFTEST = 2.0  # times the motion's own frequency: the lowest resonance, of a base under the machine alone
_LEAST_RANGE = 20.0  # of the softest spring to the stiffest that the physics step resolves
_LOSSES = 0.005, 0.3  # time constants of elastic joints, of the motion's own


@dataclass(frozen=True)
class FilteredCommand:
    """Actuators that follow their commands through a first-order lag, exactly integrated, none by default.

    ``unsettled`` is how far a window may start from the command before it.
    """

    actuators: tuple[str, ...]
    unsettled: float

    def __call__(self, spec: mujoco.MjSpec) -> None:
        """Give them the filter; raises ValueError for one that has dynamics of its own."""
        for name in self.actuators:
            actuator = spec.actuator(name)
            if int(actuator.dyntype) != int(mujoco.mjtDyn.mjDYN_NONE):
                raise ValueError(f"actuator {name!r}: has dynamics of its own; add its lag as a parameter")
            actuator.dyntype, actuator.actearly = mujoco.mjtDyn.mjDYN_FILTEREXACT, True
            actuator.dynprm = np.zeros(len(actuator.dynprm))
            declare_start(spec, f"actuator:{name}", [self.unsettled])


def filtered_command(machine: Machine, site: str) -> FilteredCommand:
    """The filter of a lag."""
    names = members(site)
    return FilteredCommand(names, UNSETTLED * (max(machine.commands[name] for name in names) or 1.0))


def one_sample(machine: Machine, parameter: Parameter) -> FloatArray:
    """Late by a sample, and at least by two physics steps."""
    return np.array([[[max(machine.dt, 2 * machine.timestep) / parameter.high]]])


def cogging(machine: Machine, site: str) -> tuple[Unknown, ...]:
    """Up to a third of the usual force, with 1 to 60 poles; of an actuator that turns a hinge."""
    joint = machine.joint_of(site)
    if joint is None or not machine.is_hinge(joint):
        return ()
    most, at = machine.joints[joint].force / 3, f"joint:{joint}.cogging"
    return (
        Unknown("cogging_sin", -most, most, "sine part", (f"{at}_sin",)),
        Unknown("cogging_cos", -most, most, "cosine part", (f"{at}_cos",)),
        Unknown("cogging_poles", 1.0, _MOST_POLES, "periods in a turn", (f"{at}_poles",), "log"),
    )


def numbers_of_poles(machine: Machine, parameter: Parameter) -> FloatArray:
    """A little of either phase of cogging, for numbers of poles that the motion's range tells apart."""
    range_of = 2 * machine.joints[parameter.targets[0].removeprefix("joint:").rpartition(".")[0]].position
    apart = max(np.pi / max(range_of, 0.1) / 1.5, 1.0)  # whole periods, or as far as the range tells apart
    poles = np.log(np.arange(1.0, _MOST_POLES, apart)) / np.log(_MOST_POLES)
    return np.array([[[0.5 + a, 0.5 + b, n] for a, b in ((PROBE, 0.0), (0.0, PROBE))] for n in poles])


def gain(machine: Machine, site: str) -> tuple[Unknown, ...]:
    """A half to three halves of the model's, where gear and gain are known and the force is one number's multiple."""
    index = machine.model.actuator(site).id
    own, bias = float(machine.model.actuator_gainprm[index, 0]), machine.model.actuator_biasprm[index]
    scaled = {f"actuator:{site}.{number}" for number in ("gear", "gain", "kp")}
    servo = bias[1] == -own and not bias[0]
    if not own or scaled & machine.written() or not (servo or not bias[:3].any()):
        return ()
    return (_gain(own, servo, "force for each unit of command"),)


def log_gain(machine: Machine, site: str) -> tuple[Unknown, ...]:
    """The same of each of several logs: a battery's charge or a motor's temperature change it."""
    own = float(machine.model.actuator_gainprm[machine.model.actuator(site).id, 0])
    return (_gain(own, machine.is_position(site), "gain in this log"),) if own and len(machine.logs) > 1 else ()


def _gain(own: float, servo: bool, description: str) -> Unknown:
    low, high = sorted((0.5 * own, 1.5 * own))
    return Unknown("gain", low, high, description, "kp" if servo else "gain", prior=(own, 0.1 * abs(own)))


def mass(machine: Machine, site: str) -> tuple[Unknown, ...]:
    """From a quarter to four times the model's, of a body whose mass is known and the same in all logs."""
    head, own = f"body:{site}.", machine.bodies[site].mass
    known = any(target.startswith((f"{head}mass", f"{head}inertia")) for target in machine.written())
    if known or any(added.target == f"{head}mass" for added in machine.environment.added):
        return ()
    return (Unknown("mass", 0.25 * own, 4.0 * own, "mass; the inertia scales with it", prior=(own, 0.5 * own)),)


def log_mass(machine: Machine, site: str) -> tuple[Unknown, ...]:
    """The same of each of two to twelve logs: a payload that was put on, a tool that was changed."""
    few, description = 2 <= len(machine.logs) <= 12, "mass in this log; the inertia scales with it"
    return tuple(replace(one, description=description) for one in mass(machine, site)) if few else ()


def centre_of_mass(machine: Machine, site: str) -> tuple[Unknown, ...]:
    """Its place in the body's frame along each axis where it matters, in shares of the radius of gyration."""
    body, far, sd = machine.bodies[site], 1.5 * machine.bodies[site].gyration, 0.3 * machine.bodies[site].gyration
    return tuple(
        Unknown(f"com_{axis}", place - far, place + far, "centre of mass", prior=(place, sd))
        for axis, place, turned in zip("xyz", body.centre, body.turned, strict=True)
        if turned
    )


class SensorDelay(Extension):
    """A measurement that comes late. MuJoCo knows no such sensor: sipe_bayes does it to what is simulated."""

    name, kind = "sensor_delay", "channel"
    reference = "-"
    native = False

    def sentence(self, site: str) -> str:
        """What it is."""
        return f"a delay of the measurement{'s' * (len(members(site)) > 1)} {_short(site)}"

    def parameters(self, machine: Machine, site: str) -> tuple[Parameter, ...]:
        """Up to a tenth of a second, or twenty samples; an orientation has one as a whole, never a part of it."""
        names, channels = members(site), machine.environment.measurements
        sensed = [one for target in machine.written() if (one := sensed_channels(target, channels)) is not None]
        if {channels[k].label for attribute, own in sensed if attribute == "delay" for k in own}.intersection(names):
            return ()  # it is unknown already
        turning = {vector_of(channel.label) for channel in channels if is_rotation(channel)}
        if any(0 < len([name for name in names if vector_of(name) == whole]) < 3 for whole in turning):
            return ()
        whole = [own if (own := vector_of(name)) in turning else name for name in names]
        targets = tuple(dict.fromkeys(f"sensor:{name}.delay" for name in whole))
        most, description = self.memory(machine.dt), "age of the measurement"
        return (Parameter(f"{_short(site)}.delay", 0.0, most, targets=targets, description=description),)

    def wholes(self, machine: Machine, site: str) -> tuple[float, ...]:
        """From sample to sample."""
        return (machine.dt,)

    def off(self, site: str, share: float) -> str:
        """See ``Extension``."""
        return f"an error of the time stamps of {_short(site)} by {100 * share:.3g} % of a sample"

    def memory(self, dt: float) -> float:
        """The longest delay."""
        return min(0.1, 20 * dt)

    def groups(self, machine: Machine) -> tuple[tuple[str, ...], ...]:
        """What one instrument tells: the pose of a body, the numbers of a sensor."""
        instruments: dict[str, list[str]] = {}
        for channel in machine.environment.measurements:
            if not channel.target.startswith("joint:"):
                instrument = channel.target.rpartition(".")[0] or channel.target.partition("[")[0]
                instruments.setdefault(instrument, []).append(channel.label)
        return tuple(tuple(names) for names in instruments.values())

    def imitators(self, site: str) -> tuple[str, ...]:
        """A low-pass filter."""
        return tuple(f"sensor:{name}.filter" for name in members(site))


def _short(site: str) -> str:
    """Of a site that is many the first and the last."""
    names = members(site)
    return site if len(names) < 3 else f"{names[0]} to {names[-1]}"


def gravity_tilt(machine: Machine, site: str) -> tuple[Unknown, ...]:
    """Up to three degrees either way: bases are put up with a level."""
    most, names = 0.05 * float(np.linalg.norm(machine.model.opt.gravity)), ("gravity_x", "gravity_y")
    return tuple(Unknown(name, -most, most, "of a tilted base", f"option.{name}") for name in names if most)


def supply_sag(machine: Machine, site: str) -> tuple[Unknown, ...]:
    """Up to a half of every force at the usual ones of all motors; one by itself has ``force_drop``."""
    driving = [a for a in machine.environment.actuators if machine.joint_of(a) is not None]
    if len(driving) < 2:
        return ()
    most, targets = 0.5 / sum(machine.forces[a] for a in driving), tuple(f"actuator:{a}.supply_sag" for a in driving)
    return (Unknown("supply_sag", 0.0, most, "relative loss of every force per force of all", targets),)


def residual(machine: Machine, site: str) -> tuple[Unknown, ...]:
    """Twelve weights, with normal priors of a tenth of the usual force."""
    sd, names = machine.joints[site].force / 10, [number.attribute for number in LAWS["residual"].numbers[3:]]
    return tuple(Unknown(name, -5 * sd, 5 * sd, "weight of a random feature", prior=(0.0, sd)) for name in names)


def residual_lengths(machine: Machine, site: str) -> LawNumbers:
    """The usual position, velocity and command are the lengths of the Gaussian process."""
    sizes, names = machine.joints[site], (number.attribute for number in LAWS["residual"].numbers[:3])
    driving = [a for a in machine.environment.actuators if machine.joint_of(a) == site]
    command = machine.commands[driving[0]] / 2 if driving else 1.0
    lengths = (sizes.position, sizes.velocity, command or 1.0)
    return LawNumbers(f"joint:{site}", "residual", tuple(zip(names, lengths, strict=True)))


def shorter_steps(machine: Machine, site: str) -> Edit:
    """Physics steps an eighth as long."""
    return partial(_shortened, timestep=machine.timestep / 8)


def hard_friction(machine: Machine, site: str) -> Edit | None:
    """As hard as the physics step allows, of all joints and tendons; none where nothing has friction."""
    known = (*machine.model.dof_frictionloss, *machine.model.tendon_frictionloss)
    if not any(known) and not any(target.endswith(".frictionloss") for target in machine.written()):
        return None
    return partial(_hardened, timeconst=2 * machine.timestep, impedance=0.999)


def _shortened(spec: mujoco.MjSpec, timestep: float) -> None:
    """With histories of commands and measurements that are as long as before."""
    times = max(1, math.ceil(spec.option.timestep / timestep * (1 - 1e-9)))
    spec.option.timestep = min(timestep, spec.option.timestep)
    for owner in (*spec.actuators, *spec.sensors):
        owner.nsample *= times


def _hardened(spec: mujoco.MjSpec, timeconst: float, impedance: float) -> None:
    for owner in (*spec.joints, *spec.tendons):
        owner.solref_friction[0] = min(timeconst, owner.solref_friction[0])
        owner.solimp_friction[:2] = np.maximum(owner.solimp_friction[:2], impedance)


def compliance(side: str, machine: Machine, site: str) -> tuple[Unknown, ...]:
    """From rigid to a spring whose resonance lies at twice the frequency of the motion; and its loss."""
    if (elastic := _elastic(machine, site)) is None:
        return ()
    softest, losses = elastic[1:]
    return (
        Unknown(f"{side}_compliance", 0.0, 1 / softest, "twist per force", f"{side}.compliance"),
        Unknown(f"{side}_compliance_loss", *losses, "damping over stiffness", f"{side}.compliance_loss", "log"),
    )


def backlash(side: str, machine: Machine, site: str) -> tuple[Unknown, ...]:
    """Up to half the usual position."""
    most = 0.5 * machine.joints[site].position
    gap = Unknown(f"{side}_backlash", 0.0, most, "width of the gap", f"{side}.play")
    return () if _elastic(machine, site) is None else (gap,)


def spring(kind: type[Gear] | type[Link], machine: Machine, site: str) -> Gear | Link | None:
    """The edit of a gear or a link."""
    elastic = _elastic(machine, site)
    return None if elastic is None else kind(site, elastic[0])


def _elastic(machine: Machine, site: str) -> tuple[Elastic, float, tuple[float, float]] | None:
    """What the elastic joint begins with, its softest spring in N m/rad or N/m, and the ends of its loss in s.

    None where no motor drives the joint or the physics step is too long for any spring.
    """
    if all(machine.joint_of(actuator) != site for actuator in machine.environment.actuators):
        return None
    sizes, model = machine.joints[site], machine.model
    own = float(model.dof_armature[int(model.joint(site).dofadr[0])])
    rotor = own or 0.2 * sizes.inertia  # the motor's share of what the joint moves, where the model has none
    link = max(sizes.inertia - own, 0.1 * sizes.inertia)
    reduced, frequency = rotor * link / (rotor + link), sizes.velocity / sizes.position
    stiffest, softest = reduced / machine.timestep**2, reduced * (_SOFTEST * frequency) ** 2
    if stiffest < _LEAST_RANGE * softest:
        return None
    twist = 0.05 * sizes.force / softest  # of the softest spring's usual one, where windows may start
    start = (min(twist, sizes.position), min(twist * _SOFTEST * frequency, sizes.velocity))
    low, high = (share / frequency for share in _LOSSES)
    return Elastic(stiffest, reduced, start, loss=(low * high) ** 0.5), softest, (low, high)


def base(machine: Machine, site: str) -> tuple[Unknown, ...]:
    """From rigid to a base whose resonance lies at twice the frequency of the motion; its mass and its loss."""
    if (swaying := _swaying(machine)) is None:
        return ()
    _, mass, frequency, softest = swaying
    low, high = (share / frequency for share in _LOSSES)
    names = ("compliance", "compliance_inertia", "compliance_loss")
    spring, inertia, loss = (tuple(f"joint:base_{axis}.{name}" for axis in "xy") for name in names)
    return (
        Unknown("base_compliance", 0.0, 1 / softest, "displacement per force", spring),
        Unknown("base_mass", mass, 30 * mass, "of what moves with the base", inertia, "log"),
        Unknown("base_loss", low, high, "damping over stiffness", loss, "log"),
    )


def base_joints(machine: Machine, site: str) -> Base | None:
    """The edit of a base."""
    if (swaying := _swaying(machine)) is None:
        return None
    root, mass, frequency, softest = swaying
    swing = 0.0  # how far the machine's mass moves, at most
    for joint, sizes in machine.joints.items():
        lever = float(np.sqrt(sizes.inertia / mass)) if machine.is_hinge(joint) else 1.0
        swing = max(swing, lever * sizes.position)
    start = 0.3 * swing * frequency**2 * mass / softest  # of the softest base's usual displacement
    turn = np.empty(9)
    mujoco.mju_quat2Mat(turn, machine.model.body_quat[root])
    axes = tuple(tuple(row) for row in turn.reshape(3, 3)[:2].tolist())  # the world's x and y in the body's frame
    stiff = Elastic(mass / machine.timestep**2, mass, (start, start * _SOFTEST * frequency), inertia=mass)
    return Base(str(machine.model.body(root).name), axes, stiff)


def _swaying(machine: Machine) -> tuple[int, float, float, float] | None:
    """The body that a base carries, its mass, kg, the fastest joint's frequency, rad/s, the softest stiffness, N/m.

    None of a machine with several such bodies, a free one, one without a name, or without joints of its own.
    """
    model, free = machine.model, int(mujoco.mjtJoint.mjJNT_FREE)
    roots = [b for b in range(1, model.nbody) if model.body_parentid[b] == 0 and model.body_jntnum[b] > 0]
    if len(roots) != 1 or int(model.jnt_type[model.body_jntadr[roots[0]]]) == free or not machine.joints:
        return None
    mass = float(model.body_subtreemass[roots[0]])
    frequency = max(sizes.velocity / sizes.position for sizes in machine.joints.values())
    softest = mass * (_SOFTEST * frequency) ** 2
    resolved = mass / machine.timestep**2 >= _LEAST_RANGE * softest
    return (roots[0], mass, frequency, softest) if model.body(roots[0]).name and resolved else None
