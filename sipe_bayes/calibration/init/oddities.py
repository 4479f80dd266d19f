"""What is odd in logs and in the model beside them, seen before a fit."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import NamedTuple

import mujoco
import numpy as np

from sipe_bayes.calibration.column_names import Kind, read_name
from sipe_bayes.calibration.init.decisions import Case, scale_of, tied_of
from sipe_bayes.calibration.init.draft import Reading
from sipe_bayes.calibration.init.tables import Opened, leaf
from sipe_bayes.calibration.machine import Drive
from sipe_bayes.core.arrays import BoolArray, FloatArray

_AT_LIMIT, _NEAR = 0.02, 0.005  # share of the samples; of a joint's range, what is at its limit
_BEYOND = 0.01  # of the samples, set-points that a range cuts off
_BLOCKS, _MOVES, _STILL, _FOLLOWED = 10, 0.3, 0.2, 0.7  # parts of a log; of the usual motion; shares of variance
_AWAY, _LEAST = 3.0, 0.3  # times the usual distance from a set-point; s, of a part
_JUMP = 12.0  # times the usual largest step, of a jump
_COARSE, _SLOW = 0.7, 1.5  # rad of a servo's own oscillation in a physics step, and in a sample
_SPREAD = 4.0  # times the size of a body's geoms, beyond which its inertia is no body's
_LIGHT, _HEAVY = 1.0, 30_000.0  # kg/m^3
_TOUCHING = 0.05  # of the samples
_SIGNED = 0.02  # of the samples, of either sign


class Oddity(NamedTuple):
    """A code, and one sentence with the remedy."""

    code: str
    text: str


def oddities(case: Case, opened: Opened) -> list[Oddity]:
    """All that is odd; case: of the readings as they are, opened: the first log's columns."""
    model = case.regression.simulator.model
    found = [
        *_limits(case, model), *_set_points(case, model), *_drive_off(case), *_enabled(case, opened),
        *_unsigned(case, opened), *_jumps(case), *_steps(case, model),
        *_inertias(model), *_contacts(case, model),
    ]  # fmt: skip
    return list(dict.fromkeys(found))


def _positions(case: Case) -> Iterator[tuple[int, Reading, FloatArray]]:
    """Joints' ids with the readings of their positions and all samples of them (n,), SI."""
    model = case.regression.simulator.model
    for reading, channels in zip(case.draft.readings, case.channels, strict=True):
        if channels and reading.match.target.startswith("joint:") and reading.match.target.endswith(".position"):
            joint = model.joint(reading.match.target[6:].rpartition(".")[0]).id
            values = np.concatenate([log.observations[:, channels[0]] for log in case.regression.logs])
            yield joint, reading, values[np.isfinite(values)]


def _limits(case: Case, model: mujoco.MjModel) -> Iterator[Oddity]:
    """Joints that the model stops, and the machine does not."""
    for joint, reading, values in _positions(case):
        if not model.jnt_limited[joint]:
            continue
        low, high = model.jnt_range[joint].tolist()
        room = _NEAR * (high - low)
        share = float(np.mean((values < low + room) | (values > high - room)))
        if share < _AT_LIMIT:
            continue
        name, hinge = model.joint(joint).name, int(model.jnt_type[joint]) == int(mujoco.mjtJoint.mjJNT_HINGE)
        text = f"{reading.match.column!r}: {100 * share:.0f} % of the samples are at or beyond the range of {name}"
        turn = 180 / np.pi
        beyond = max(low - values.min(), values.max() - high) > high - low
        if hinge and beyond and low * turn <= values.min() and values.max() <= high * turn:
            yield Oddity(
                "angle", f"{text}, {low:.3g} to {high:.3g} rad: look at the column's unit; or the model's angles are "
                'radians that are read as degrees, which <compiler angle="radian"/> mends',
            )  # fmt: skip
        else:
            yield Oddity("limit", f"{text}, {low:.3g} to {high:.3g}: widen the range, or look at unit and zero")


def _set_points(case: Case, model: mujoco.MjModel) -> Iterator[Oddity]:
    """Set-points that a ctrlrange cuts off."""
    for k, command in enumerate(case.commands):
        if command is None or case.drive(k) not in (Drive.POSITION, Drive.VELOCITY):
            continue
        index = case.regression.actuators[command]
        if model.actuator_ctrllimited[index]:
            low, high = model.actuator_ctrlrange[index].tolist()
            values = np.concatenate([log.actions[:, command] for log in case.regression.logs])
            share = float(np.mean((values < low) | (values > high)))
            if share > _BEYOND:
                column = case.draft.readings[k].match.column
                yield Oddity(
                    "set-point", f"{column!r}: {100 * share:.0f} % of the set-points lie beyond the range {low:.3g} "
                    f"to {high:.3g} of {model.actuator(index).name}, which cuts them off: widen it, or look at the "
                    "unit",
                )  # fmt: skip


def _drive_off(case: Case) -> Iterator[Oddity]:
    """Parts of logs in which a position does not follow its set-point, though it does elsewhere."""
    for k, (place, _) in tied_of(case).items():
        command, channel = case.commands[k], case.channels[place][0]
        assert command is not None
        for log in case.regression.logs:
            wanted, seen = log.actions[:, command], log.observations[:-1, channel]
            edges = np.linspace(0, len(wanted), _BLOCKS + 1).astype(int)
            parts = [slice(a, b) for a, b in pairwise(edges) if (b - a) * log.dt > _LEAST]
            moves = [wanted[p].std() > _MOVES * wanted.std() > 0 for p in parts]
            alike = [_alike(wanted[p], seen[p]) for p in parts]
            away = [float(np.sqrt(np.mean((wanted[p] - seen[p]) ** 2))) for p in parts]
            far = [x > _AWAY * np.median(away) for x in away]
            off = [p for p, m, a, f in zip(parts, moves, alike, far, strict=True) if m and f and a < _STILL]
            on = [a for m, a in zip(moves, alike, strict=True) if m and a > _FOLLOWED]
            if off and len(on) > 1:
                begin, end = off[0].start * log.dt, off[-1].stop * log.dt
                yield Oddity(
                    "off", f"{case.draft.readings[place].match.column!r} is not at its set-point from {begin:.3g} "
                    f"to {end:.3g} s of {log.name!r}: if the drive was off there, cut that part out (`span`)",
                )  # fmt: skip
                break


def _alike(a: FloatArray, b: FloatArray) -> float:
    spread = float(a.std() * b.std())
    return float(np.mean((a - a.mean()) * (b - b.mean())) / spread) ** 2 if spread else 0.0


def _enabled(case: Case, opened: Opened) -> Iterator[Oddity]:
    """Columns of two values that say when the drive is on."""
    used = {column for reading in case.draft.readings for column in reading.match.columns}
    for column, values in opened.columns.items():
        known = np.unique(values[np.isfinite(values)])
        words = {*read_name(leaf(column)).words, *leaf(column).lower().replace("_", " ").split()}
        if column not in used and len(known) == 2 and any(w.startswith(("enab", "torque_en", "power")) for w in words):
            share = float(np.mean(values == known[0]))
            yield Oddity(
                "enable", f"{column!r} is {known[0]:g} in {100 * share:.0f} % of the samples: where the drive is off "
                "then, cut these parts out (`span`)",
            )  # fmt: skip


def _unsigned(case: Case, opened: Opened) -> Iterator[Oddity]:
    """Torques and currents that never change their sign, of joints that move both ways."""
    both = any(_is_signed(np.diff(values)) for _, _, values in _positions(case))
    used = {column for reading in case.draft.commands for column in reading.match.columns}
    sizes = []
    for column, values in opened.columns.items():
        known = values[np.isfinite(values)]
        if read_name(column).kind in (Kind.TORQUE, Kind.CURRENT) and column not in used and known.min() >= 0:
            sizes += [repr(column)] * bool(known.max() > 0)
    if both and sizes:
        yield Oddity(
            "unsigned", f"{', '.join(sizes)}: without a change of sign while joints move both ways: sizes, and no "
            "measurements of a force, unless a load keeps its side",
        )  # fmt: skip


def _is_signed(values: FloatArray) -> bool:
    return bool(min(np.mean(values > 0), np.mean(values < 0)) > _SIGNED)


def _jumps(case: Case) -> Iterator[Oddity]:
    """Positions that jump from one sample to the next."""
    for _, reading, _ in _positions(case):
        for log, channels in ((log, case.channels[case.draft.readings.index(reading)]) for log in case.regression.logs):
            steps = np.abs(np.diff(log.observations[:, channels[0]]))
            usual = float(np.quantile(steps, 0.99))
            count = int(np.sum(steps > _JUMP * usual)) if usual else 0
            if 0 < count < 20:
                raw = float(steps.max() / abs(scale_of(reading)))
                yield Oddity(
                    "jump", f"{reading.match.column!r} jumps {count} time{'s' * (count > 1)}, by up to {raw:.3g}, from "
                    "one sample to the next: add `wraps = true` if an angle comes round, else cut these samples out",
                )  # fmt: skip
                break


def _steps(case: Case, model: mujoco.MjModel) -> Iterator[Oddity]:
    """Servos that are too stiff for the physics step, or for the rate of the log."""
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    inertia = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, inertia)
    outcome, dt = case.outcome(case.draft.readings), case.regression.logs[0].dt
    fastest, told = 0.0, 0.0
    for gain, index, drive in zip(outcome.gains, case.regression.actuators, case.regression.drives, strict=True):
        joint = int(model.actuator_trnid[index, 0])
        if drive != Drive.POSITION or int(model.actuator_trntype[index]) != int(mujoco.mjtTrn.mjTRN_JOINT):
            continue
        own = float(model.actuator_gainprm[index, 0] * model.actuator_gear[index, 0] ** 2)
        rate = np.sqrt(max(own, 0.0) / inertia[model.jnt_dofadr[joint], model.jnt_dofadr[joint]])
        fastest, told = max(fastest, float(rate)), max(told, float(rate * np.sqrt(np.clip(gain, 0, 1))))
    if fastest * model.opt.timestep > _COARSE:
        step = float(f"{0.5 * _COARSE / fastest:.1g}")
        yield Oddity(
            "step", f"the physics step of {model.opt.timestep:g} s is too long for the gains of the servos: write "
            f'<option timestep="{step:g}"/>, or look at kp',
        )  # fmt: skip
    if told * dt > _SLOW * np.pi:
        yield Oddity("slow", f"the log's {1 / dt:.3g} Hz are slower than the servos: gains are weakly identifiable")


def _inertias(model: mujoco.MjModel) -> Iterator[Oddity]:
    """Inertias that no body of its size and mass has."""
    for body in range(1, model.nbody):
        geoms = [g for g in range(model.ngeom) if int(model.geom_bodyid[g]) == body and model.geom_rbound[g] > 0]
        mass = float(model.body_mass[body])
        if not geoms or not mass:
            continue
        size = max(float(np.linalg.norm(model.geom_pos[g]) + model.geom_rbound[g]) for g in geoms)
        gyration = float(np.sqrt(model.body_inertia[body].max() / mass))
        name = model.body(body).name or f"number {body}"
        if gyration > _SPREAD * size:
            yield Oddity(
                "inertia", f"the inertia of body {name} is that of something {gyration / size:.2g} times as large as "
                "its geoms: look at its units",
            )  # fmt: skip


def _contacts(case: Case, model: mujoco.MjModel) -> Iterator[Oddity]:
    """Contacts of what does not move freely, along the log."""
    if any(int(kind) == int(mujoco.mjtJoint.mjJNT_FREE) for kind in model.jnt_type) or not case.regression.known.all():
        return
    touching = np.concatenate([_pressed(model, own) for own in case.regression.states])
    if touching.mean() > _TOUCHING:
        yield Oddity(
            "contact", f"the model touches something in {100 * touching.mean():.0f} % of the samples: if the machine "
            "does not, its geoms are too large (exclude these contacts), or a unit or a zero is wrong",
        )  # fmt: skip


def _pressed(model: mujoco.MjModel, states: Sequence[FloatArray] | FloatArray) -> BoolArray:
    """Whether bodies touch (n,), in some of a log's states."""
    some = np.asarray(states)[:: 1 + len(states) // 100]
    data, out = mujoco.MjData(model), np.zeros(len(some), bool)
    for k, state in enumerate(some):
        data.qpos[:] = state[1 : 1 + model.nq]
        mujoco.mj_kinematics(model, data)
        mujoco.mj_collision(model, data)
        out[k] = bool(len(data.contact.dist) and data.contact.dist.min() < 0)
    return out
