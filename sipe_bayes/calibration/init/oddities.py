"""What is odd in logs and in the model beside them, seen before a fit: a sentence with the remedy for each."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import chain, pairwise

import mujoco
import numpy as np

from sipe_bayes.calibration.column_names import Kind, read_name
from sipe_bayes.calibration.init.decisions import Case, scale_of
from sipe_bayes.calibration.init.regression import SERVOS, touches
from sipe_bayes.calibration.init.tables import Opened, leaf
from sipe_bayes.calibration.machine import Drive
from sipe_bayes.core.arrays import FloatArray


def find_oddities(case: Case, opened: Opened) -> list[str]:
    """All that is odd; case: of the readings as they are, opened: the first log's columns."""
    return list(dict.fromkeys(chain.from_iterable(find(case, opened) for find in _ODDITIES)))


def _limits(case: Case, _: Opened) -> Iterator[str]:
    """Joints that the model stops, and the machine does not."""
    for k, joint in case.positions.items():
        values, (low, high) = case.series[:, case.channels[k][0]], joint.reach or (-np.inf, np.inf)
        share, least, most = _beyond(values, low, high, -0.005), values.min(), values.max()
        if share < 0.02:
            continue
        name, turn = case.draft.readings[k].match.column, 180 / np.pi
        text = f"{name!r}: {100 * share:.0f} % of the samples are at or beyond the range of {joint.name}"
        text += f", {low:.3g} to {high:.3g}"
        far = max(low - least, most - high) > high - low
        if joint.hinge and far and low * turn <= least and most <= high * turn:
            yield (
                f"{text} rad: look at the column's unit; or the model's angles are radians that are read as degrees, "
                'which <compiler angle="radian"/> mends'
            )
        else:
            yield f"{text}: widen the range, or look at unit and zero"


def _beyond(values: FloatArray, low: float, high: float, room: float = 0.0) -> float:
    """The share of values (n,) that lie beyond a range that is wider by ``room`` of it at both ends."""
    room = room * (high - low) if np.isfinite(high - low) else 0.0
    return float(np.mean((values < low - room) | (values > high + room)))


def _cut_off(case: Case, _: Opened) -> Iterator[str]:
    """Set-points that a ctrlrange cuts off, and other commands most of which it does."""
    model = case.regression.simulator.model
    for k, command in enumerate(case.commands):
        if command is None or not model.actuator_ctrllimited[index := case.regression.actuators[command]]:
            continue
        low, high = model.actuator_ctrlrange[index].tolist()
        values = np.concatenate([log.actions[:, command] for log in case.regression.logs])
        name, actuator = case.draft.readings[k].match.column, model.actuator(index).name
        if case.drive(k) not in SERVOS:
            share = _beyond(values, low, high, 0.05)
            if share > 0.5:
                yield (
                    f"commands, column {name!r}: {100 * share:.0f} % of it lies outside of the ctrlrange "
                    f"{[low, high]} of actuator:{actuator}, which cuts it off; look at its factor, zero, supply"
                )
        elif (share := _beyond(values, low, high)) > 0.01:
            yield (
                f"{name!r}: {100 * share:.0f} % of the set-points lie beyond the range {low:.3g} to {high:.3g} of "
                f"{actuator}, which cuts them off: widen it, or look at the unit"
            )


def _drive_off(case: Case, _: Opened) -> Iterator[str]:
    """Parts of logs in which a position does not follow its set-point, though it does elsewhere."""
    for k, (place, _times) in case.ties.items():
        for log in case.regression.logs:
            wanted, seen = log.actions[:, case.commands[k]], log.observations[:-1, case.channels[place][0]]
            edges = pairwise(np.linspace(0, len(wanted), 11).astype(int).tolist())
            parts = [slice(a, b) for a, b in edges if (b - a) * log.dt > 0.3]
            away = [float(np.sqrt(np.mean((wanted[p] - seen[p]) ** 2))) for p in parts]
            alike = [
                (part, _alike(wanted[part], seen[part]), far > 3 * np.median(away))
                for part, far in zip(parts, away, strict=True)
                if wanted[part].std() > 0.3 * wanted.std() > 0  # the set-point moves
            ]
            off = [part for part, like, far in alike if far and like < 0.2]
            if off and sum(like > 0.7 for _, like, _ in alike) > 1:
                yield (
                    f"{case.draft.readings[place].match.column!r} is not at its set-point from "
                    f"{off[0].start * log.dt:.3g} to {off[-1].stop * log.dt:.3g} s of {log.name!r}: if the drive was "
                    "off there, cut that part out (`span`)"
                )
                break


def _alike(a: FloatArray, b: FloatArray) -> float:
    """The share of variance."""
    return float(np.corrcoef(a, b)[0, 1]) ** 2 if a.std() * b.std() else 0.0


def _enabled(case: Case, opened: Opened) -> Iterator[str]:
    """Columns of two values that say when the drive is on."""
    used = {column for reading in case.draft.readings for column in reading.match.columns}
    for column, values in opened.columns.items():
        known = np.unique(values[np.isfinite(values)])
        words = {*read_name(leaf(column)).words, *leaf(column).lower().replace("_", " ").split()}
        if column not in used and len(known) == 2 and any(w.startswith(("enab", "torque_en", "power")) for w in words):
            share = 100 * float(np.mean(values == known[0]))
            yield (
                f"{column!r} is {known[0]:g} in {share:.0f} % of the samples: where the drive is off then, cut these "
                "parts out (`span`)"
            )


def _unsigned(case: Case, opened: Opened) -> Iterator[str]:
    """Torques and currents that never change their sign, of joints that move both ways."""
    steps = [np.diff(case.series[:, case.channels[k][0]]) for k in case.positions]
    both = any(min(np.mean(own > 0), np.mean(own < 0)) > 0.02 for own in steps)
    used = {column for reading in case.draft.commands for column in reading.match.columns}
    forces = [c for c in opened.columns if c not in used and read_name(c).kind in (Kind.TORQUE, Kind.CURRENT)]
    sizes = [repr(c) for c in forces if np.nanmin(opened.columns[c]) >= 0 < np.nanmax(opened.columns[c])]
    if both and sizes:
        yield (
            f"{', '.join(sizes)}: without a change of sign while joints move both ways: sizes, and no measurements of "
            "a force, unless a load keeps its side"
        )


def _jumps(case: Case, _: Opened) -> Iterator[str]:
    """Positions that jump from one sample to the next."""
    for k in case.positions:
        for log in case.regression.logs:
            steps, reading = np.abs(np.diff(log.observations[:, case.channels[k][0]])), case.draft.readings[k]
            count = int(np.sum(steps > 12 * (usual := float(np.quantile(steps, 0.99)))))
            if usual and 0 < count < 20:
                yield (
                    f"{reading.match.column!r} jumps {count} time{'s' * (count > 1)}, by up to "
                    f"{steps.max() / abs(scale_of(reading)):.3g}, from one sample to the next: add `wraps = true` if "
                    "an angle comes round, else cut these samples out"
                )
                break


def _steps(case: Case, _: Opened) -> Iterator[str]:
    """Servos that are too stiff for the physics step, or for the rate of the log."""
    model, regression, dt = case.regression.simulator.model, case.regression, case.regression.logs[0].dt
    data, inertia = mujoco.MjData(model), np.zeros((model.nv, model.nv))
    mujoco.mj_forward(model, data)
    mujoco.mj_fullM(model, data, inertia)
    at_joint = model.actuator_trntype[regression.actuators] == int(mujoco.mjtTrn.mjTRN_JOINT)
    servos = at_joint & np.array([drive == Drive.POSITION for drive in regression.drives], bool)
    index, gains = np.array(regression.actuators, int)[servos], case.outcome(case.draft.readings).gains[servos]
    carried = np.diag(inertia)[model.jnt_dofadr[model.actuator_trnid[index, 0]]]
    stiffness = model.actuator_gainprm[index, 0] * model.actuator_gear[index, 0] ** 2
    rates = np.sqrt(np.maximum(stiffness, 0.0) / carried)
    fastest, told = (float(own.max(initial=0.0)) for own in (rates, rates * np.sqrt(np.clip(gains, 0, 1))))
    if fastest * model.opt.timestep > 0.7:  # rad of a servo's own oscillation
        yield (
            f"the physics step of {model.opt.timestep:g} s is too long for the gains of the servos: write "
            f'<option timestep="{0.35 / fastest:.1g}"/>, or look at kp'
        )
    if told * dt > 1.5 * np.pi:
        yield f"the log's {1 / dt:.3g} Hz are slower than the servos: gains are weakly identifiable; log faster"


def _inertias(case: Case, _: Opened) -> Iterator[str]:
    """Inertias that no body of its size and mass has."""
    model = case.regression.simulator.model
    for body in np.flatnonzero(model.body_mass > 0).tolist():
        geoms = np.flatnonzero((model.geom_bodyid == body) & (model.geom_rbound > 0))
        sizes = np.linalg.norm(model.geom_pos[geoms], axis=1) + model.geom_rbound[geoms]
        gyration = float(np.sqrt(model.body_inertia[body].max() / model.body_mass[body]))
        if len(geoms) and gyration > 4 * sizes.max():
            yield (
                f"the inertia of body {model.body(body).name or f'number {body}'} is that of something "
                f"{gyration / sizes.max():.2g} times as large as its geoms: look at its units"
            )


def _contacts(case: Case, _: Opened) -> Iterator[str]:
    """Contacts of what does not move freely, along the log."""
    model = case.regression.simulator.model
    free = (model.jnt_type == int(mujoco.mjtJoint.mjJNT_FREE)).any()
    if not free and case.regression.known.all():
        some = [own[:: 1 + len(own) // 100, 1 : 1 + model.nq] for own in case.regression.states]
        share = float(touches(model, np.concatenate(some)).mean())
        if share > 0.05:
            yield (
                f"the model touches something in {100 * share:.0f} % of the samples: if the machine does not, its "
                "geoms are too large (exclude these contacts), or a unit or a zero is wrong"
            )


_ODDITIES = (_limits, _cut_off, _drive_off, _enabled, _unsigned, _jumps, _steps, _inertias, _contacts)
