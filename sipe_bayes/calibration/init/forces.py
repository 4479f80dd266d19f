"""Columns of what drives apply at their joints, such as the efforts of servos: their signs and units.

With a force a machine's masses, friction and gains are known in SI; without any they are known relative to each other.
A motion need not be followed for it: commands, positions and velocities of one instant make the force of the model.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import scipy.optimize
from scipy.ndimage import gaussian_filter1d

from sipe_bayes.calibration.init.cases import Source, case_of, loaded
from sipe_bayes.calibration.init.draft import Draft, Reading
from sipe_bayes.calibration.init.matching import Match
from sipe_bayes.calibration.machine import Machine
from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.smoothing import filled
from sipe_bayes.core.units import find_unit, unit_words

_FOLLOWS = 0.3  # share of variance from which a column is the force of a drive, whose gains may be off
_UNSURE, _FAR = np.log(1.5), np.log(6.0)  # of the logarithm of how many times the model's force it is
_BOTH_WAYS = 0.1  # of the rows, in which a force that changes its sign has either


def with_forces(
    draft: Draft,
    matches: Sequence[Match],
    model: mujoco.MjModel,
    machine: Machine,
    sources: Sequence[Source],
    folder: Path,
) -> tuple[Draft, list[str]]:
    """The draft with columns that go as the forces of drives do, and what is to be said of those that do not.

    Commands and positions of the draft are decided; matches are columns with ``joint:NAME.force``.
    """
    hinges = {f"joint:{joint.name}.force" for joint in machine.joints if joint.hinge}
    words = [unit_words("torque" if match.target in hinges else "force") for match in matches]
    known = [(m, m.label.unit or own[0]) for m, own in zip(matches, words, strict=True) if m.label.unit in ("", *own)]
    first = tuple(Reading(match, unit) for match, unit in known)
    others = [m for m, own in zip(matches, words, strict=True) if m.label.unit not in ("", *own)]
    notes = [f"{m.column!r} is not used: {m.label.unit} is no unit of a force" for m in others]
    if not known:
        return draft, notes
    regression = case_of(draft, model, machine, sources, folder).regression
    motion = regression.given_motion
    place = sum(len(m.channels) for m in draft.config(folder).measurements)
    whole = loaded(replace(draft, measurements=(*draft.measurements, *first)), sources, folder)
    parts = zip(whole, regression.logs, regression.widths, regression.rows, strict=True)
    raw = [(filled(log.observations[: len(own) + 1, place:]), width, rows) for log, own, width, rows in parts]
    measured = np.concatenate([gaussian_filter1d(values, width, axis=0)[rows] for values, width, rows in raw])
    sizes = len(first) > 1 and not (measured < 0).any()
    readings = []
    for reading, values in zip(first, measured.T, strict=True):
        dof = int(model.joint(_find_joint(reading)).dofadr[0])
        force = _add_resistance(motion.asked[:, dof], motion.resisting[:, :, dof].T, values)
        both_ways = min(np.mean(force > 0), np.mean(force < 0)) > _BOTH_WAYS
        if (both_ways or sizes) and not (values < 0).any():
            notes.append(f"{reading.match.column!r} is not used: it never changes its sign")
            continue
        decided = _decide(reading, force, values)
        readings += [decided] if decided.fit else []
        notes += [] if decided.fit else [f"{reading.match.column!r} is not used: {note}" for note in decided.notes]
    return replace(draft, measurements=(*draft.measurements, *readings)), notes


def _add_resistance(asked: FloatArray, resisting: FloatArray, measured: FloatArray) -> FloatArray:
    """The force (n,) of a drive: what the model asks for (n,), and what resists it (n, 3) as the measured one says.

    That is viscous and dry friction and the inertia of a rotor, of which the model may have other ones or none.
    """
    known = np.isfinite(measured)
    design = np.column_stack([measured, np.ones(len(measured)), -resisting])[known]
    scale = np.sqrt((design**2).mean(axis=0)) + 1e-12
    least = np.array([-np.inf, -np.inf, 0.0, 0.0, 0.0])
    found = scipy.optimize.lsq_linear(design / scale, asked[known], (least, np.inf)).x / scale
    return np.asarray(asked + resisting @ found[2:])


def _decide(reading: Reading, force: FloatArray, measured: FloatArray) -> Reading:
    """With the sign and the unit in which it is about as large as the model's force; not fitted where it is in none.

    The factor is that of the spreads of both (n,), which noise of either does not shrink.
    """
    known = np.isfinite(force) & np.isfinite(measured)
    force, measured = force[known], measured[known]
    moves = known.sum() >= 20 and np.ptp(force) and np.ptp(measured)
    alike = float(np.corrcoef(force, measured)[0, 1]) if moves else 0.0
    own = find_unit(reading.unit)
    ratio = float(measured.std() / force.std()) if moves else 1.0
    words = [own.word] if reading.match.label.unit else unit_words(own.dimension)
    times = {word: ratio * find_unit(word).factor / own.factor for word in words}
    unit = min(words, key=lambda word: abs(np.log(times[word])))
    off, joint = abs(float(np.log(times[unit]))), _find_joint(reading)
    note = f"the model's force at {joint} explains {100 * alike**2:.0f} % of its variance"
    if alike**2 < _FOLLOWS:
        return replace(reading, fit=False, notes=(note,))
    note += f"; in {unit} it is {times[unit]:.2g} times as large"
    if off > _FAR:
        return replace(reading, fit=False, notes=(note,))
    reading = replace(reading, unit=unit, sign=1 if alike > 0 else -1)
    if not reading.match.label.unit and off > _UNSURE:
        return replace(reading, doubts=(f"{note}: if it is no force, but a current or a share, leave it out",))
    return replace(reading, notes=(note,))


def _find_joint(reading: Reading) -> str:
    return reading.match.target.removeprefix("joint:").removesuffix(".force")
