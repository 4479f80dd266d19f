"""Which parameters of a model may be free, and between which bounds: a table of kinds, with sizes of the motion."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from itertools import takewhile
from typing import Literal, NamedTuple

import mujoco
import numpy as np

from sipe_bayes.calibration.column_names import Kind as Quantity
from sipe_bayes.calibration.init.draft import Proposal, Reading, rounded_up
from sipe_bayes.calibration.machine import (
    Actuator,
    Drive,
    Joint,
    Machine,
    Sizes,
    bases,
    counts,
    friction_of,
    own_friction,
    top_of,
    touched_by,
)
from sipe_bayes.core.parameters import Parameter
from sipe_bayes.envs.inertia import body_frame_inertia
from sipe_bayes.envs.internal.closed_chains import dependent_joints
from sipe_bayes.envs.sensing import of_sensor
from sipe_bayes.envs.targets import bind

Rule = Literal["factor", "size", "about"]


class Kind(NamedTuple):
    """A kind of parameter: where it applies, its name, its targets, the rule of its bounds, and what it is.

    Bounds are factors of the nominal value; from 0 to ``high`` times a size of the motion, at least to four times the
    nominal value; or the nominal value with ``high`` times a size to either side.
    """

    of: str
    name: str
    fields: str
    rule: Rule
    low: float
    high: float
    what: str


KINDS = (
    Kind("dcmotor", "resistance", "resistance", "factor", 0.5, 2.0, "resistance in Ohm"),
    Kind("dcmotor", "constant", "motor_constant", "factor", 0.5, 2.0, "motor constant in N m/A"),
    Kind("servo", "kp", "kp", "factor", 0.3, 3.0, "position gain"),
    Kind("damped servo", "kv", "kv", "factor", 0.1, 4.0, "velocity gain"),
    Kind("uneven servo", "gain", "gain", "factor", 0.3, 3.0, "gain"),
    Kind("speed servo", "kv", "gain bias_velocity", "factor", 0.2, 5.0, "velocity gain"),
    Kind("voltage", "gain", "gain", "factor", 0.3, 3.0, "force for each unit of the command"),
    Kind("voltage", "back_emf", "bias_velocity", "factor", 0.2, 4.0, "back-EMF"),
    Kind("motor", "gain", "gain", "factor", 0.3, 3.0, "force for each unit of a command that is no force"),
    Kind("filter", "lag", "lag", "factor", 0.2, 5.0, "time constant of its filter in s"),
    Kind("link", "mass", "mass", "factor", 0.5, 2.0, "mass in kg"),
    *(Kind("base", f"inertia_{x}", f"inertia_{x}{x}", "factor", 0.4, 2.5, "moment of inertia") for x in "xyz"),
    *(Kind("base", f"com_{x}", f"com_{x}", "about", 0.0, 0.5, "centre of mass") for x in "xyz"),
    Kind("damped", "damping", "damping", "size", 0.0, 0.5, "viscous friction"),
    Kind("rubbing", "frictionloss", "frictionloss", "size", 0.0, 0.4, "dry friction"),
    Kind("geared", "armature", "armature", "size", 0.0, 0.6, "inertia of rotor and gears"),
    Kind("sprung", "stiffness", "stiffness", "factor", 0.5, 2.0, "spring"),
    Kind("soft", "spring", "stiffness", "size", 0.0, 4.0, "a spring that the model does not have"),
)
RESISTANCE = {"damping": "damped", "frictionloss": "rubbing", "armature": "geared"}
"""Fields of joints and tendons, with where they apply."""
FORCES = ("N m", "mN m", "N", "mN")
SLIPPERY = 0.02
"""The least friction."""


def propose_kinds(
    model: mujoco.MjModel, owner: str, of: Collection[str], sizes: Mapping[str, float] | None = None, more: str = ""
) -> list[Proposal]:
    """The kinds of parameters that apply to an owner, ``joint:NAME``, but for those that it can not have smaller.

    Args:
        model: as given.
        owner: as in targets.
        of: where kinds apply that are asked for.
        sizes: of the motion, by field.
        more: what is said besides.
    """
    out, word = [], word_of(owner.partition(":")[2])
    for kind in (kind for kind in KINDS if kind.of in of):
        fields = kind.fields.split()
        targets, size = tuple(f"{owner}.{field}" for field in fields), (sizes or {}).get(fields[0], 0.0)
        nominal, factor = bind(model, targets[0]).value, kind.rule == "factor"
        low, high = kind.low, kind.high
        if kind.rule == "size":
            low, high = 0.0, rounded_up(max(4 * nominal, kind.high * size, 1e-12))
        elif kind.rule == "about":
            low, high = (float(f"{nominal + x:.4g}") for x in (-kind.high * size, kind.high * size))
        note = f"{kind.what}{more}, {nominal:.4g} in the model"
        one = Proposal(f"{word}_{kind.name}", targets, low, high, factor, note)
        one = replace(one, low=max(low, least_of(model, one))) if factor else one
        out += [one] if not factor or one.low < 1 else []
    return out


def candidates(
    model: mujoco.MjModel, machine: Machine, readings: Sequence[Reading], sizes: Sizes, touching: Sequence[int] = ()
) -> list[Proposal]:
    """Parameters that may be free, those first that show most.

    Args:
        model: as given.
        machine: what of it logs hold.
        readings: measurements and commands.
        sizes: of the motion.
        touching: ids of bodies that touch what stands still in the logs, beside those that move freely.
    """
    joints, passive = _moving(model, machine, readings)
    driven = [(a, r) for a in machine.actuators for r in readings if r.match.target == f"actuator:{a.name}"]
    bodies = [model.body(body).id for body in machine.bodies]
    moved = [int(model.joint(joint.name).bodyid[0]) for joint in (*joints, *passive)]
    masses, attached = _masses(model, moved + bodies * bool(driven))  # what is only thrown moves alike if heavier
    flown = {_thrust_at(model, a) for a, _ in driven} & {*bodies}
    carrying = bases(model) - flown if driven and not attached else ()  # what is attached would stand for their inertia
    gains = [(a, p) for a, r in driven for p in propose_kinds(model, f"actuator:{a.name}", _classes(model, a, r))]
    # a gain of the velocity alone moves a joint as damping does; that of a speed servo is its set-point's, too
    fed_back = [a.joint for a, p in gains if len(p.targets) == 1 and p.targets[0].endswith((".kv", ".bias_velocity"))]
    felt = {r.joint for r in readings if r.match.target.endswith(".force")}  # which tells the two apart
    rotors = {actuator.joint for actuator in machine.actuators}
    of_joints = _of_tendons(model, [a for a, _ in driven], sizes) if joints else []
    for joint in (*(j for j in joints if not j.base), *passive):
        damped, geared = joint not in fed_back or joint.name in felt, joint in joints or joint in rotors
        of = ["rubbing", "sprung", *["damped"] * damped, *["geared"] * geared]
        of_joints += propose_of_joint(model, f"joint:{joint.name}", of, sizes)
    proposed = [
        *_sharing_rotors(model, gains), *masses, *(p for body in flown if not attached for p in _of_base(model, body)),
        *of_joints, *attached, *_zeros(readings), *contacts(model, {*bodies, *touching}),
        *(p for body in carrying for p in _of_base(model, body)),
    ]  # fmt: skip
    return proposed or _masses(model, bodies)[0]


def springs(model: mujoco.MjModel, machine: Machine, readings: Sequence[Reading], sizes: Sizes) -> list[Proposal]:
    """Springs that the model lacks at joints that move: left out of a fit they look like delays."""
    joints, passive = _moving(model, machine, [r for r in readings if r.match.target.endswith(".position")])
    held = {a.joint for a in machine.actuators if a.drive == Drive.POSITION}  # a spring shows as the gain does
    some = [j for j in (*joints, *passive) if not j.base and j not in held and not model.joint(j.name).stiffness[0]]
    return [p for joint in some for p in propose_of_joint(model, f"joint:{joint.name}", ["soft"], sizes, joint.hinge)]


def _moving(model: mujoco.MjModel, machine: Machine, readings: Sequence[Reading]) -> tuple[list[Joint], list[Joint]]:
    """Joints that are measured, and those that nothing measures and closed chains make follow them."""
    measured = {reading.joint for reading in readings if not reading.commanded}
    joints = [joint for joint in machine.joints if joint.name in measured]
    tied = dependent_joints(model, {model.joint(joint.name).id for joint in joints})
    return joints, [j for j in machine.joints if model.joint(j.name).id in tied and not j.base]


def _classes(model: mujoco.MjModel, actuator: Actuator, reading: Reading) -> list[str]:
    """Where kinds of parameters apply to an actuator."""
    index, drive = model.actuator(actuator.name).id, actuator.drive
    gain, (_, at_position, at_speed) = float(model.actuator_gainprm[index, 0]), model.actuator_biasprm[index, :3]
    dcmotor = int(model.actuator_gaintype[index]) == int(mujoco.mjtGain.mjGAIN_DCMOTOR)
    fixed = int(model.actuator_gaintype[index]) == int(mujoco.mjtGain.mjGAIN_FIXED)
    even, in_force = np.isclose(gain, -at_position), reading.match.label.kind == Quantity.TORQUE
    filters = (int(mujoco.mjtDyn.mjDYN_FILTER), int(mujoco.mjtDyn.mjDYN_FILTEREXACT))
    applies = {
        "dcmotor": dcmotor and drive != Drive.POSITION,
        "servo": drive == Drive.POSITION and (dcmotor or even),
        "damped servo": drive == Drive.POSITION and not dcmotor and even and at_speed,
        "uneven servo": drive == Drive.POSITION and not dcmotor and not even,
        "speed servo": drive == Drive.VELOCITY and not dcmotor,
        "voltage": drive == Drive.VOLTAGE and fixed,
        "motor": drive == Drive.FORCE and not in_force and reading.unit not in FORCES,
        "filter": int(model.actuator_dyntype[index]) in filters and model.actuator_dynprm[index, 0] > 0,
    }
    return [name for name, own in applies.items() if own]


def _sharing_rotors(model: mujoco.MjModel, gains: Sequence[tuple[Actuator, Proposal]]) -> list[Proposal]:
    """The gains of rotors that are alike in the model as one: each by itself, they show as a centre of mass does."""
    groups: dict[tuple[int, str], list[Proposal]] = {}
    for actuator, gain in gains:
        body = _thrust_at(model, actuator) if gain.targets[0].endswith(".gain") else 0
        groups.setdefault((body, gain.note if body else gain.name), []).append(gain)
    shared, single = list[Proposal](), list[Proposal]()
    for (body, _), own in groups.items():
        if body and len(own) > 1:
            name = f"rotors_gain_{len(shared)}" if shared else "rotors_gain"
            shared.append(replace(own[0], name=name, targets=tuple(p.targets[0] for p in own)))
        else:
            single += own
    return [*shared, *single]


def _thrust_at(model: mujoco.MjModel, actuator: Actuator) -> int:
    """The id of the body that an actuator at a site pushes; 0 of others."""
    site = int(model.actuator_trnid[model.actuator(actuator.name).id, 0])
    return int(model.body_weldid[model.site_bodyid[site]]) if actuator.thrust else 0


def _masses(model: mujoco.MjModel, bodies: Sequence[int]) -> tuple[list[Proposal], list[Proposal]]:
    """The heaviest of what moves with each body, and what else is attached to it: payloads, tools."""
    heaviest, attached = list[Proposal](), list[Proposal]()
    for moving in dict.fromkeys(int(model.body_weldid[body]) for body in bodies):
        moved = np.flatnonzero((model.body_weldid == moving) & (np.arange(model.nbody) > 0)).tolist()
        names = [model.body(b).name for b in sorted(moved, key=lambda b: -float(model.body_mass[b]))]
        for k, name in enumerate(names):
            if name and model.body(name).mass > 0:
                more = f", attached to {names[0]}" if k else ""
                (attached if k else heaviest).extend(propose_kinds(model, f"body:{name}", ["link"], more=more))
    return heaviest, attached


def _of_base(model: mujoco.MjModel, body: int) -> list[Proposal]:
    """Inertia and centre of mass of what nothing holds."""
    mean = float(np.diag(body_frame_inertia(model, body)).mean())
    size = float(f"{np.sqrt(mean / max(float(model.body_mass[body]), 1e-9)):.1g}")
    return propose_kinds(model, f"body:{model.body(body).name}", ["base"], {f"com_{x}": size for x in "xyz"})


def propose_of_joint(
    model: mujoco.MjModel, owner: str, of: Collection[str], sizes: Sizes, hinge: bool = True
) -> list[Proposal]:
    """What resists the motion of a joint or tendon, up to sizes of the motion; its spring where it has one."""
    key = owner.removeprefix("joint:")
    force, speed, inertia = sizes.force[key], sizes.speed[key], sizes.inertia[key]
    usual = {"damping": force / speed, "frictionloss": force, "armature": inertia}
    usual |= {"stiffness": force if hinge else 10 * force}  # turned by 1 rad, or 0.1 m long
    of = {*of} - ({"sprung"} if not bind(model, f"{owner}.stiffness").value else set())
    return propose_kinds(model, owner, of, usual)


def _of_tendons(model: mujoco.MjModel, driven: Sequence[Actuator], sizes: Sizes) -> list[Proposal]:
    """Of tendons that are pulled what joints have; of others that move what the model gives them.

    What pulls at one joint alone over a fixed tendon is left to that joint, which it can not be told from.
    """
    pulled = {int(model.actuator(a.name).trnid[0]) for a in driven if a.tendon}
    out = []
    for tendon in range(model.ntendon):
        owner, first = f"tendon:{model.tendon(tendon).name}", int(model.tendon_adr[tendon])
        if owner in sizes.inertia and model.tendon(tendon).name:
            by_joints = int(model.wrap_type[first]) == int(mujoco.mjtWrap.mjWRAP_JOINT)
            coupling = tendon in pulled and not (by_joints and int(model.tendon_num[tendon]) == 1)
            of = [w for f, w in RESISTANCE.items() if coupling or getattr(model, f"tendon_{f}")[tendon] > 0]
            out += propose_of_joint(model, owner, [*of, "sprung"], sizes)
    return out


def _zeros(readings: Sequence[Reading]) -> list[Proposal]:
    """What is left of zeros that simulations alone tell, but of those that a servo's set-points have, too."""
    shared = {r.unsure for r in readings if r.commanded}
    return [
        Proposal(
            f"{word_of(r.match.column)}_zero", (f"sensor:{r.match.column}.bias",), -r.unsure, r.unsure, False,
            f"SI, what is left of the zero error of {r.match.column!r}",
        )
        for r in readings if r.unsure and r.unsure not in shared
    ]  # fmt: skip


def as_parameters(model: mujoco.MjModel, proposals: Sequence[Proposal]) -> list[Parameter]:
    """Proposals as parameters of an environment; those that the model can not have are left out."""
    out = []
    for one in proposals:
        value = 0.0 if of_sensor(one.targets[0]) else bind(model, one.targets[0]).value
        own = value if np.isfinite(value) else None
        if one.relative and own:
            out.append(Parameter(one.name, one.low, one.high, targets=one.targets, relative=True))
        elif not one.relative:
            low, high = (one.low, one.high) if own is None else (min(one.low, own), max(one.high, own))
            scale: Literal["linear", "log"] = "linear" if one.expected is None else "log"
            out.append(Parameter(one.name, low, high, scale=scale, targets=one.targets))
    return out


def least_of(model: mujoco.MjModel, proposal: Proposal) -> float:
    """The least that its targets may be, in terms of what bounds are of; factors of negative ones have none."""
    bound = [bind(model, target) for target in proposal.targets if not of_sensor(target)]
    scales = [(t.minimum, t.value if proposal.relative else 1.0) for t in bound]
    return max((1.01 * minimum / scale for minimum, scale in scales if scale > 0), default=-np.inf)


def word_of(name: str) -> str:
    """A name as part of a parameter's."""
    return re.sub(r"\W+", "_", name).strip("_") or "unknown"


def contacts(model: mujoco.MjModel, tops: set[int]) -> list[Proposal]:
    """Friction and bounce of bodies, and of what moves with them, with what stands still.

    Geoms whose friction with it is one number share a parameter: wheels, feet.
    """
    touching = {g: s for g in range(model.ngeom) if top_of(model, g, tops) and (s := touched_by(model, g))}
    groups: dict[tuple[float, ...], list[int]] = {}
    for geom, still in touching.items():
        groups.setdefault(tuple(friction_of(model, geom, s) for s in still), []).append(geom)
    leaning = [{s for g in group for s in touching[g] if counts(model, s, g)} for group in groups.values()]
    out, taken = list[Proposal](), set[int]()
    for k, group in enumerate(groups.values()):
        others = taken.union(*leaning[:k], *leaning[k + 1 :])
        decides = {s for s in leaning[k] - taken if friction_of(model, group[0], s) <= own_friction(model, s)}
        still = sorted(decides | (leaning[k] - others))
        taken |= {*still}
        own = [g for g in group if any(counts(model, g, s) for s in touching[g])]
        least = max((own_friction(model, s) for s in leaning[k] - {*still}), default=SLIPPERY)
        bodies = {int(model.geom_bodyid[g]) for g in group}
        above = [top_of(model, g, tops) for g in group] if bodies & tops or len(groups) == 1 else sorted(bodies)
        name = f"{_stem_of(model, above)}_friction"
        name += f"_{k + 1}" * any(p.name == name for p in out)
        given = [own_friction(model, g) for g in (*own, *still)]
        what = "sliding friction; the other side has a lower priority and does not count"
        if own and still:
            what = "sliding friction of both sides: MuJoCo takes the larger one where their priority is the same"
        elif own and least > SLIPPERY:
            what = f"sliding friction; MuJoCo takes the larger one: no less than the {least:g} of what stands still"
        span = min([least, *given]), max([1.5, 2 * least, *given])  # what the model has lies within
        out += _of_geoms(model, name, "friction", (own, still), span, what)
    if touching:
        every = (sorted(touching), sorted({s for still in touching.values() for s in still}))
        word, step = _stem_of(model, [top_of(model, g, tops) for g in touching]), float(model.opt.timestep)
        times = (rounded_up(2 * step), max(0.05, rounded_up(10 * step)))
        hard, bounce = "of the contact: the shorter the harder", "of the contact: below 1 it bounces"
        out += _of_geoms(model, f"{word}_solref_timeconst", "solref_timeconst", every, times, hard)
        out += _of_geoms(model, f"{word}_solref_dampratio", "solref_dampratio", every, (0.1, 1.5), bounce)
    return out


def nameless(model: mujoco.MjModel, tops: set[int]) -> list[str]:
    """What is to be said of bodies of which no geom that may touch what stands still has a name."""
    named: dict[int, bool] = {}
    for geom in range(model.ngeom):
        if (top := top_of(model, geom, tops)) and touched_by(model, geom):
            named[top] = named.get(top, False) or bool(model.geom(geom).name)
    names = ", ".join(model.body(top).name for top, any_named in named.items() if not any_named)
    return [f"friction of {names} is not asked for: no geom of it that may touch something has a name"] if names else []


def _of_geoms(
    model: mujoco.MjModel, name: str, field: str, geoms: tuple[Sequence[int], Sequence[int]],
    span: tuple[float, float], what: str,
) -> list[Proposal]:  # fmt: skip
    """One number of geoms that move and of those that stand still; nothing where all of one sort have no name.

    That of the largest friction is first: what the model has of the parameter is what its first target has.
    """
    named = [[g for g in part if model.geom(g).name] for part in geoms]
    if any(part and not with_name for part, with_name in zip(geoms, named, strict=True)):
        return []
    missing = sum(map(len, geoms)) - sum(map(len, named))
    what += f"; {missing} geoms are left out that have no name" if missing else ""
    ordered = sorted((g for part in named for g in part), key=lambda g: -own_friction(model, g))
    return [Proposal(name, tuple(f"geom:{model.geom(g).name}.{field}" for g in ordered), *span, False, what)]


def _stem_of(model: mujoco.MjModel, bodies: Sequence[int]) -> str:
    """What the names of bodies begin with, or the first of them."""
    names = [model.body(body).name for body in bodies]
    begin = "".join(letters[0] for letters in takewhile(lambda x: len(set(x)) == 1, zip(*names, strict=False)))
    return word_of((begin.rstrip("_-. 0123456789") if len(set(names)) > 1 else begin) or next(filter(None, names), ""))
