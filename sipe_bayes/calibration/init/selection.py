"""Which parameters the logs identify: one linearisation of the forces that they change, and bounds from its fit."""

from __future__ import annotations

import re
from collections.abc import Sequence
from copy import copy
from dataclasses import replace
from typing import NamedTuple

import mujoco
import numpy as np
import scipy.optimize
from scipy.ndimage import gaussian_filter1d

from sipe_bayes.calibration.column_names import pieces_of, read_vocabulary
from sipe_bayes.calibration.init.draft import Proposal, rounded_up
from sipe_bayes.calibration.init.parameters import RESISTANCE, least_of, propose_of_joint
from sipe_bayes.calibration.init.regression import Outcome, Regression, turning_of
from sipe_bayes.calibration.machine import Machine, Sizes
from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.envs.targets import bind

MOST = 30
"""Parameters that are free: what shows and is left out is in all others."""
RELATIVE = "no force is known, so that all forces are relative to it; weigh it and write it into the model"
"""Why a mass is left out."""
SHARED = ("armature", "damping", "frictionloss", "stiffness", "lag", "bias_velocity", "kv", "gain", "kp", "mass")
"""What parts that are alike share first: what logs tell least of."""


class Fit(NamedTuple):
    """Values of parameters that explain most."""

    theta: FloatArray  # (N,) in the cube
    nominal: FloatArray  # (N,) of the model, in the cube
    jacobian: FloatArray  # (R, N) what each parameter changes over its range, in units of the noise


def fit_parameters(regression: Regression, outcome: Outcome, values: dict[str, float]) -> Fit:
    """One Gauss-Newton step of the forces and measured efforts, of logs as the configuration reads them.

    Args:
        regression: whose environment has the parameters.
        outcome: its own, for the delay and the sizes.
        values: SI, where it begins in place of the nominal values, by name.
    """
    space = regression.environment.space
    nominal = np.clip(space.default_theta, 0.0, 1.0)
    told = [p.normalise(values[p.name]) if p.name in values else x for p, x in zip(space, nominal, strict=True)]
    start = np.clip(np.array(told, float), 0.0, 1.0)
    late = regression.delays[int(np.argmin(outcome.behind))] if len(outcome.behind) else 0
    dofs = np.flatnonzero(regression.known & (outcome.size > 0))
    if not len(dofs):
        return Fit(start, nominal, np.zeros((1, len(start))))
    at, efforts = _efforts(regression)

    def left(theta: FloatArray) -> FloatArray:
        lacking, driven = _forces(regression, theta, late)
        return np.concatenate([lacking[:, dofs], driven[:, at] - efforts], axis=1)

    base, steps = left(start), np.where(start > 0.98, -0.02, 0.02)
    slopes = np.stack([(left(start + row) - base) / row.sum() for row in np.diag(steps)], axis=-1)
    size = (outcome.left[:, dofs] * outcome.size[dofs]).std(0)
    size = np.append(size, [_unexplained(base[:, k], slopes[:, k]) for k in range(len(dofs), base.shape[1])]) + 1e-12
    jacobian = (slopes / size[:, None]).reshape(-1, len(start))
    share = np.sqrt(min(1.0, regression.independent(outcome) / len(base)))  # what is left is correlated
    design = np.concatenate([share * jacobian, np.eye(len(start)) / 0.4])  # with a prior of that sd
    wanted = np.concatenate([-share * (base / size).ravel(), np.zeros(len(start))])
    step = scipy.optimize.lsq_linear(design, wanted, (-start - 1e-9, 1 - start + 1e-9), method="bvls").x
    independent = np.sqrt(max(1.0, len(base) * len(dofs) / 400.0))
    return Fit(np.clip(start + step, 0.0, 1.0), nominal, jacobian / independent)


def _efforts(regression: Regression) -> tuple[list[int], FloatArray]:
    """Degrees of freedom (C,) at which the logs measure what actuators apply, and these forces (R, C), smoothed."""
    targets = [re.fullmatch(r"joint:(.+)\.force", channel.target) for channel in regression.environment.measurements]
    columns = [k for k, match in enumerate(targets) if match]
    dofs = [int(regression.simulator.model.joint(match[1]).dofadr[0]) for match in targets if match]
    logs = zip(regression.logs, regression.widths, regression.rows, strict=True)
    smooth = [gaussian_filter1d(log.observations[:, columns], width, axis=0)[rows] for log, width, rows in logs]
    return dofs, np.concatenate(smooth)


def _unexplained(values: FloatArray, slopes: FloatArray) -> float:
    """The spread of what slopes (R, N) leave of values (R,)."""
    return float((values - slopes @ np.linalg.lstsq(slopes, values, rcond=None)[0]).std())


def _forces(regression: Regression, theta: FloatArray, late: int) -> tuple[FloatArray, FloatArray]:
    """Forces (R, V) that the model asks for beyond those of its actuators and its friction, and those of actuators."""
    environment, model = regression.simulator.environment, copy(regression.simulator.model)
    values = environment.space.values(theta)
    environment.write(model, values)
    if environment.needs_constants:
        mujoco.mj_setConst(model, mujoco.MjData(model))
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
    motion, data, bias = regression.given_motion, mujoco.MjData(model), environment.bias(values)
    if bias.any():
        motion = regression.motion(replace(regression.given, zeros=tuple(bias.tolist())))
    (commands,) = regression.commands(regression.given, [late], model)
    nq, nv = model.nq, model.nv
    lacking = model.dof_frictionloss * turning_of(motion.speed)
    driven = np.zeros_like(lacking)
    for k, (row, command) in enumerate(zip(motion.states, commands, strict=True)):
        data.qpos[:], data.qvel[:], data.qacc[:] = row[:nq], row[nq : nq + nv], row[nq + nv : nq + 2 * nv]
        data.ctrl[regression.actuators] = command
        for index, value in zip(regression.actuators, command, strict=True):
            if (adr := int(model.actuator_actadr[index])) >= 0:
                data.act[adr] = value
        mujoco.mj_inverse(model, data)
        mujoco.mj_fwdActuation(model, data)
        driven[k] = data.qfrc_actuator
        lacking[k] += data.qfrc_inverse - driven[k]
    return lacking, driven


def sizes_of(model: mujoco.MjModel, machine: Machine, regression: Regression, outcome: Outcome) -> Sizes:
    """Usual forces, speeds and inertias: of joints by inverse dynamics, of tendons by what moves them."""
    motion = regression.given_motion
    states = np.concatenate([np.zeros((len(motion.states), 1)), motion.states[:, : model.nq + model.nv]], axis=1)
    plain = Sizes.of(model, machine, states, None)
    driven = motion.given[0].sum(axis=-1)
    lost = np.abs(motion.asked) + outcome.damping * np.abs(motion.speed) + outcome.friction
    lost, driven, faster = (np.quantile(np.abs(x), 0.9, axis=0) for x in (lost, driven, motion.resisting[2]))
    force, rotor = np.maximum(np.maximum(lost, driven), 1e-9), driven / np.maximum(faster, 1e-9)  # that drives can move
    at = {joint.name: int(model.joint(joint.name).dofadr[0]) for joint in machine.joints}
    known = {name: dof for name, dof in at.items() if regression.known[dof]}
    moved = {name: max(plain.inertia[name], float(rotor[dof])) for name, dof in known.items()}
    forces = {name: float(force[dof]) for name, dof in known.items()}
    return replace(plain, force=plain.force | forces, inertia=plain.inertia | moved)


def inform_bounds(
    model: mujoco.MjModel, proposals: Sequence[Proposal], regression: Regression, outcome: Outcome
) -> tuple[list[Proposal], dict[str, float]]:
    """The proposals with bounds that hold what the regression says, and these values, SI, by name."""
    values, out = dict[str, float](), []
    rotor = outcome.rotor + model.dof_armature
    resistance = {"damping": outcome.damping, "frictionloss": outcome.friction, "armature": rotor}
    actuators = [model.actuator(index).name for index in regression.actuators]
    for one in proposals:
        owner, _, field = one.targets[0].rpartition(".")
        kind, _, name = owner.partition(":")
        if name in actuators and one.relative and field in ("kp", "gain", "resistance", "motor_constant"):
            gain, error = (float(x[actuators.index(name)]) for x in (outcome.gains, outcome.errors))
            if gain > 3 * error:
                times, own = (1 / gain if field == "resistance" else gain), bind(model, one.targets[0]).value
                values[one.name] = value = times * own
                if own > 0 and not one.low < times < one.high:  # the model's own value at most at an end
                    ends = float(f"{min(value / 10, own):.2g}"), rounded_up(max(value * 10, own))
                    note = f"{one.note}; the logs say about {value:.2g}"
                    expected = float(f"{value:.3g}")
                    one = replace(one, low=ends[0], high=ends[1], relative=False, note=note, expected=expected)
        elif kind == "joint" and field in resistance and not one.relative:
            dof = int(model.joint(name).dofadr[0])
            if regression.known[dof]:
                values[one.name] = value = float(resistance[field][dof])  # what the model lacks is in it, too
                one = replace(one, high=max(one.high, rounded_up(4 * value) if value else 0.0))
        out.append(one)
    return out, values


def choose(
    model: mujoco.MjModel, proposals: Sequence[Proposal], fit: Fit, open_scale: bool
) -> tuple[list[Proposal], FloatArray]:
    """The proposals as ``select_identifiable`` tells them, and their values (N,) in the fit.

    Where more than ``MOST`` show, those of parts that are alike share a parameter, one property after the other until
    few enough are left.
    """
    some = list(proposals)
    for field in SHARED:
        if sum(not p.left_out for p in select_identifiable(some, fit, open_scale, len(some))) <= MOST:
            break
        some, fit = share_parameters(some, fit, alike_parts(model, some, field), field)
    some = select_identifiable(some, fit, open_scale)
    spread = np.sqrt(np.diag(np.linalg.inv(fit.jacobian.T @ fit.jacobian + np.eye(len(fit.theta)) / 0.4**2)))
    least = np.maximum(10 * fit.theta, fit.theta + 5 * spread)[: len(some)]
    rough = Sizes.of(model, Machine.of(model), None, None)
    return [_limited(model, one, float(share), rough) for one, share in zip(some, least, strict=True)], fit.theta


def _limited(model: mujoco.MjModel, one: Proposal, share: float, rough: Sizes) -> Proposal:
    """A resistance up to a share of its bound, at least that of the model alone: slow logs would tell any rotor."""
    fields = [target.rpartition(".") for target in one.targets]
    if one.relative or fields[0][2] not in RESISTANCE:
        return one
    if any(
        owner.removeprefix("joint:") not in rough.force for owner, _, _ in fields
    ):  # a tendon without a lever in the model's own pose
        return one
    alone = [propose_of_joint(model, owner, [RESISTANCE[field]], rough)[0].high for owner, _, field in fields]
    return replace(one, high=min(one.high, max([*alone, rounded_up(share * one.high)])))


def select_identifiable(
    proposals: Sequence[Proposal], fit: Fit, open_scale: bool = False, most: int = MOST
) -> list[Proposal]:
    """The proposals, with the reason where one is better left out: it shows too little, or as another one does.

    One that shows as others do is kept where leaving it at the model's own value would cost more than noise.

    Args:
        proposals: of the fit, those first that are to be kept first.
        fit: with the effects of each.
        open_scale: whether forces and masses are known relative to each other alone: masses are left out then.
        most: of how many no more are free.
    """
    masses = [any(target.endswith(".mass") for target in one.targets) for one in proposals]
    kept, out = list[int](), []
    for k, one in enumerate(proposals):
        relative = open_scale and masses[k] and not all(masses)
        reason = RELATIVE if relative else _hidden(proposals, fit, k, kept)
        if not reason and len(kept) >= most:
            reason = f"{most} are enough to begin with"
        kept += [k] * (not reason)
        out.append(replace(one, left_out=reason))
    return out


def _hidden(proposals: Sequence[Proposal], fit: Fit, k: int, kept: Sequence[int]) -> str:
    """Why proposal ``k`` is not identifiable beside those that are kept; "" where it is."""
    effect = fit.jacobian[:, k]
    size = float(np.linalg.norm(effect))
    if size < 3:  # of the noise
        return "moves too little in these logs"
    if not kept:
        return ""
    basis = fit.jacobian[:, kept]
    weights = np.linalg.lstsq(basis, effect, rcond=None)[0]
    alone = float(np.linalg.norm(effect - basis @ weights))
    costs = alone * abs(float(fit.theta[k] - fit.nominal[k])) > 3 and alone > 0.01 * size  # slopes' accuracy
    if costs or alone >= max(0.05 * size, min(0.15 * size, 15)):
        return ""
    share = np.abs(weights) * np.linalg.norm(basis, axis=0)
    most_alike = [i for i in np.argsort(-share)[:2] if share[i] > 0.3 * size] or [int(np.argmax(share))]
    return f"shows as {' and '.join(proposals[kept[i]].name for i in most_alike)} does in these logs"


def widen_bounds(model: mujoco.MjModel, proposal: Proposal, theta: float) -> Proposal:
    """A proposal whose bounds leave room where the fit pressed against one; no lower ones of contacts."""
    low, high = proposal.low, proposal.high
    if theta < 1e-3 and low > 0 and not proposal.targets[0].startswith("geom:"):
        low = max(low / 3, least_of(model, proposal))
    elif theta < 1e-3 and low < 0:
        low *= 3
    if theta > 1 - 1e-3:
        high *= 3
    if (low, high) == (proposal.low, proposal.high):
        return proposal
    note = f"{proposal.note}; bounds wider, since the logs press against the usual one"
    low = rounded_up(low) if low > 0 else float(f"{low:.2g}")  # never below the least
    return replace(proposal, low=low, high=float(f"{high:.2g}"), note=note)


def find_springs(
    model: mujoco.MjModel, springs: Sequence[Proposal], fit: Fit, states: FloatArray
) -> tuple[list[Proposal], list[str]]:
    """Springs that show clearly, with where they rest, and what is to be said of them.

    Args:
        model: as given.
        springs: the last ones of the fit.
        fit: with the effects of each.
        states: (n, S) of the logs: a spring rests where its joint has been.
    """
    free, remarks = [], []
    for k, spring in enumerate(springs, len(fit.theta) - len(springs)):
        theta, target = float(fit.theta[k]), spring.targets[0]
        if np.linalg.norm(fit.jacobian[:, k]) * theta <= 15 or theta <= 0.03:  # of the noise; of its range
            continue
        joint = model.joint(target.removeprefix("joint:").removesuffix(".stiffness"))
        places = [*states[:, 1 + int(joint.qposadr[0])], float(model.qpos_spring[joint.qposadr[0]])]
        size = 10.0 ** (np.floor(np.log10(max(np.ptp(places), 0.1))) - 1)
        low, high = (float(f"{size * x:.6g}") for x in (np.floor(min(places) / size), 1 + np.floor(max(places) / size)))
        value, rest = spring.low + theta * (spring.high - spring.low), f"joint:{joint.name}.springref"
        about = replace(spring, high=rounded_up(spring.high), note=f"{spring.note}, about {value:.2g}")
        where = "where it rests, between the ends of the motion; one that is preloaded rests beyond"
        free += [widen_bounds(model, about, theta), Proposal(f"{spring.name}_rest", (rest,), low, high, False, where)]
        remarks.append(
            f"a spring of about {value:.2g} in SI seems to act where the model has none: {target!r} and {rest!r} are "
            "asked for; take them out if there is none, and look for what pulls instead"
        )
    return free, remarks


def alike_parts(model: mujoco.MjModel, proposals: Sequence[Proposal], field: str) -> list[list[int]]:
    """The places of proposals, those together that one parameter may stand for; ``field``: of which property.

    Parts are alike where the model gives them and what drives them the same number; where it is none or a mass, if they
    are called alike but for a side as well.
    """
    groups: dict[tuple[object, ...], list[int]] = {}
    for k, one in enumerate(proposals):
        owners, key = {target.rpartition(".")[0] for target in one.targets}, tuple[object, ...]((k,))
        kind, _, name = min(owners).partition(":")
        if len(owners) == 1 and one.targets[0].endswith(f".{field}") and kind in ("joint", "actuator", "body"):
            value, drives = bind(model, one.targets[0]).value, np.zeros(model.nu, bool)
            if kind == "joint":
                on_joint = model.actuator_trntype == int(mujoco.mjtTrn.mjTRN_JOINT)
                drives = on_joint & (model.actuator_trnid[:, 0] == model.joint(name).id)
            stem = _stem(name) if kind == "body" or not value else ()
            key = (kind, one.relative, len(one.targets), value, *model.actuator_gainprm[drives, 0].tolist(), stem)
        groups.setdefault(key, []).append(k)
    return list(groups.values())


def _stem(name: str) -> tuple[str, ...]:
    return tuple(piece for piece in pieces_of(name) if piece not in read_vocabulary().of("side"))


def share_parameters(
    proposals: Sequence[Proposal], fit: Fit, groups: Sequence[Sequence[int]], field: str
) -> tuple[list[Proposal], Fit]:
    """The proposals of each group as one, and a fit with these; what stands behind them in the fit is left out."""
    lows, highs = np.array([(one.low, one.high) for one in proposals]).T
    low = np.array([lows[list(group)].min() for group in groups])
    high = np.array([highs[list(group)].max() for group in groups])
    merged = list[Proposal]()
    for group, least, most in zip(groups, low.tolist(), high.tolist(), strict=True):
        one, some = proposals[group[0]], [proposals[k] for k in group]
        if len(some) > 1:
            owners = ", ".join(p.targets[0].rpartition(".")[0].partition(":")[2] for p in some)
            note = f"{one.note}; one for {owners}, which are alike in the model: a table for each if they differ"
            name = _shared_name(some, field, {p.name for p in (*proposals, *merged)})
            targets = tuple(target for p in some for target in p.targets)
            one = replace(one, name=name, targets=targets, low=least, high=most, note=note)
        merged.append(one)

    def mean_of(theta: FloatArray) -> FloatArray:
        values = lows + (highs - lows) * theta[: len(proposals)]
        return (np.array([values[list(group)].mean() for group in groups]) - low) / (high - low)

    slopes = fit.jacobian[:, : len(proposals)] / (highs - lows)
    jacobian = np.stack([slopes[:, list(group)].sum(axis=1) for group in groups], axis=1) * (high - low)
    return merged, Fit(mean_of(fit.theta), mean_of(fit.nominal), jacobian)


def _shared_name(some: Sequence[Proposal], field: str, taken: set[str]) -> str:
    """What the parts' names have in common, else the sort of them."""
    stems = {_stem(one.name.removesuffix(f"_{field}")) for one in some}
    kind = some[0].targets[0].partition(":")[0]
    word = "_".join(stems.pop()) if len(stems) == 1 else ""
    word = word or {"body": "bodies"}.get(kind, f"{kind}s")
    tries = (f"{word}_{field}", *(f"{word}_{k}_{field}" for k in range(2, len(taken) + 3)))
    return next(name for name in tries if name not in taken)


def delay_of(
    actuators: Sequence[str], outcome: Outcome, count: float, delays: Sequence[int], dt: float
) -> tuple[list[Proposal], str]:
    """The delay as a parameter where one shows, and what is to be said of it; dt in s."""
    if not actuators or len(delays) < 2 or not outcome.behind.any():
        return [], ""
    costs = count * outcome.behind  # nats
    best = delays[int(np.argmin(costs))]
    may = [k for k, cost in enumerate(costs) if cost < 9]
    if best == delays[-1] and costs[0] >= 2:
        why = "which other things than a delay do as well: look at the model and at what drives it; none is asked for"
        return [], f"the later commands arrive the better, up to the {1e3 * dt * best:.3g} ms that were tried, {why}"
    if not best and len(may) == 1:
        return [], "commands arrive at once: a delay would not explain more of the joints' forces"
    if not best or costs[0] < 2:  # one costs little, and one that is left out is in all others
        high = dt * delays[min(may[-1] + 1, len(delays) - 1)]
        note = f"commands may be up to {1e3 * dt * delays[may[-1]]:.3g} ms late: these logs hardly tell"
    else:
        near = slice(i := int(np.argmin(costs)) - 1, i + 3)
        error = 1e3 * dt / np.sqrt(2 * max(float(np.polyfit(delays[near], costs[near], 2)[0]), 1e-9))
        high, late = dt * max(2 * best, best + 3), f"{1e3 * dt * outcome.delay:.3g} ms late (standard error {error:.2g}"
        note = f"commands arrive about {late} ms), {outcome.delay:.2g} samples: {costs[0]:.2g} nats more than with none"
    targets = tuple(f"actuator:{name}.delay" for name in actuators)  # none at all is what the model has
    return [Proposal("delay", targets, 0.0, rounded_up(high), False, note)], note
