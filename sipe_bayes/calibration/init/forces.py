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
from scipy.ndimage import gaussian_filter1d

from sipe_bayes.calibration.init.cases import Source, case_of, loaded
from sipe_bayes.calibration.init.draft import Draft, Reading
from sipe_bayes.calibration.init.matching import Match
from sipe_bayes.calibration.init.regression import turning_of
from sipe_bayes.calibration.machine import Machine
from sipe_bayes.calibration.signals import Likeness
from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.smoothing import filled
from sipe_bayes.core.units import find_unit, unit_words

_FOLLOWS = 0.3  # share of variance from which a column is the force of a drive, whose gains may be off
_UNSURE, _FAR = np.log(1.5), np.log(6.0)  # of the logarithm of how many times the model's force it is
_FEWEST = 20  # rows
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

    Args:
        draft: whose commands and positions are decided.
        matches: columns with ``joint:NAME.force``.
        model: as given.
        machine: what of it logs hold.
        sources: logs.
        folder: of the configuration.
    """
    known = [match for match in matches if match.label.unit in ("", *_words(machine, match))]
    notes = [f"{m.column!r} is not used: {m.label.unit} is no unit of a force" for m in matches if m not in known]
    if not known:
        return draft, notes
    first = tuple(Reading(m, m.label.unit or _words(machine, m)[0]) for m in known)
    whole = replace(draft, measurements=(*draft.measurements, *first))
    regression = case_of(draft, model, machine, sources, folder).regression
    outcome, motion = regression.fit(regression.given), regression.given_motion
    damping = regression.simulator.model.dof_damping
    seen = motion.asked + damping * motion.speed + outcome.friction * turning_of(motion.speed)
    place = sum(len(m.channels) for m in draft.config(folder).measurements)
    logs = [log.slice(0, len(own)) for log, own in zip(loaded(whole, sources, folder), regression.logs, strict=True)]
    measured = np.concatenate(
        [
            gaussian_filter1d(filled(log.observations[:, place:]), width, axis=0)[rows]
            for log, width, rows in zip(logs, regression.widths, regression.rows, strict=True)
        ]
    )
    readings, sizes = [], len(first) > 1 and not (measured < 0).any()
    for k, reading in enumerate(first):
        dof = int(model.joint(_joint(reading)).dofadr[0])
        both_ways = min(np.mean(seen[:, dof] > 0), np.mean(seen[:, dof] < 0)) > _BOTH_WAYS
        if (both_ways or sizes) and not (measured[:, k] < 0).any():
            notes.append(f"{reading.match.column!r} is not used: it never changes its sign")
            continue
        decided = _decided(reading, _likeness(seen[:, dof], measured[:, k]))
        if decided.fit:
            readings.append(decided)
        else:
            notes += [f"{reading.match.column!r} is not used: {note}" for note in decided.notes]
    return replace(draft, measurements=(*draft.measurements, *readings)), notes


def _words(machine: Machine, match: Match) -> list[str]:
    """Units that it may have, the likeliest first."""
    hinge = next(j.hinge for j in machine.joints if match.target == f"joint:{j.name}.force")
    return unit_words(find_unit("N m" if hinge else "N").dimension)


def _decided(reading: Reading, like: Likeness) -> Reading:
    """With the sign and the unit in which it is about as large as the model's force; not fitted where it is in none."""
    dimension, own = find_unit(reading.unit).dimension, find_unit(reading.unit).factor
    words = [reading.unit] if reading.match.label.unit else unit_words(dimension)

    def times(word: str) -> float:
        """How many times the model's it is."""
        return find_unit(word).factor / (abs(like.factor) * own)

    unit = min(words, key=lambda word: abs(float(np.log(times(word)))))
    note = f"the model's force at {_joint(reading)} explains {100 * like.share:.0f} % of its variance"
    off = abs(float(np.log(times(unit))))
    note += f"; in {unit} it is {times(unit):.2g} times as large" if like.share > _FOLLOWS else ""
    if like.share < _FOLLOWS or off > _FAR:
        return replace(reading, fit=False, notes=(note,))
    reading = replace(reading, unit=unit, sign=1 if like.factor > 0 else -1)
    if not reading.match.label.unit and off > _UNSURE:
        return replace(reading, doubts=(f"{note}: if it is no force, but a current or a share, leave it out",))
    return replace(reading, notes=(note,))


def _joint(reading: Reading) -> str:
    return reading.match.target.removeprefix("joint:").removesuffix(".force")


def _likeness(simulated: FloatArray, measured: FloatArray) -> Likeness:
    """How one (n,) goes as the other; the factor is that of their spreads, which noise of either does not shrink."""
    known = np.isfinite(simulated) & np.isfinite(measured)
    if known.sum() < _FEWEST or not np.ptp(simulated[known]) or not np.ptp(measured[known]):
        return Likeness(1.0, 0.0)
    alike = float(np.corrcoef(simulated[known], measured[known])[0, 1])
    return Likeness(float(np.sign(alike) * simulated[known].std() / measured[known].std()), alike**2)
