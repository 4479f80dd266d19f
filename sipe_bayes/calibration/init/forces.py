"""Columns of what drives apply at their joints, such as the efforts of servos: their signs and units.

With a force a machine's masses, friction and gains are known in SI; without any they are known relative to each other.
No simulation is needed for it: commands, positions and velocities of one instant make the force of the model.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np

from sipe_bayes.calibration.init.columns.match import Match
from sipe_bayes.calibration.init.columns.signals import Likeness
from sipe_bayes.calibration.init.draft import Draft, Reading
from sipe_bayes.calibration.init.machine import Machine
from sipe_bayes.calibration.init.windows import FEW, Source, loaded, trial_of
from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.trajectory import Trajectory
from sipe_bayes.core.units import find_unit, unit_words
from sipe_bayes.likelihood.starts import estimate_states
from sipe_bayes.simulation.simulator import Simulator

_FOLLOWS = 0.3  # share of variance from which a column is the force of a drive, whose gains may be off
_NEAR = np.log(4.0)  # of the logarithm of how many times it is as large as the model's, for the same reason
_SAMPLES, _FEWEST = 400, 20  # of each log, and of all
_LATE = (0, 1, 2, 4, 8)  # samples, of the commands


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
    if not matches:
        return draft, []
    first = tuple(_first(machine, match) for match in matches)
    whole = replace(draft, measurements=(*draft.measurements, *first))
    trial, layout = trial_of(whole, model, machine, loaded(whole, sources, folder), folder, FEW)
    seen = [np.concatenate([_applied(trial.simulator, trial.theta, log, d) for log in trial.logs]) for d in _LATE]
    measured = np.concatenate([_spread(log.observations[:-1]) for log in trial.logs])
    readings, notes = [], []
    for k, reading in enumerate(first, len(draft.measurements)):
        (channel,) = layout.channels[k]
        like = max((_likeness(one[:, channel], measured[:, channel]) for one in seen), key=lambda one: one.share)
        joint, column = reading.match.target.removeprefix("joint:").removesuffix(".force"), reading.match.column
        decided = _decided(reading, like)
        share = f"the model's force there explains {100 * like.share:.0f} % of its variance"
        if decided is None:
            size = (
                f"; in {reading.unit} it is {abs(1 / like.factor):.2g} times as large" if like.share > _FOLLOWS else ""
            )
            notes.append(f"{column!r} is not used as the force at {joint}: {share}{size}")
        else:
            note = f"what drives {joint}: {share}"
            readings.append(replace(decided, notes=(*reading.notes, note)))
    return replace(draft, measurements=(*draft.measurements, *readings)), notes


def _first(machine: Machine, match: Match) -> Reading:
    joint = next(j for j in machine.joints if match.target == f"joint:{j.name}.force")
    default = "N m" if joint.hinge else "N"
    named = match.label.unit
    return Reading(match, named if named in unit_words(find_unit(default).dimension) else default)


def _decided(reading: Reading, like: Likeness) -> Reading | None:
    """With the sign and the unit in which it is about as large as the model's; None where it is in none."""
    words = [reading.unit] if reading.match.label.unit else unit_words(find_unit(reading.unit).dimension)
    own = find_unit(reading.unit).factor

    def off(word: str) -> float:
        return abs(float(np.log(abs(like.factor) * own / find_unit(word).factor)))

    unit = min(words, key=off)
    if like.share < _FOLLOWS or off(unit) > _NEAR:
        return None
    return replace(reading, unit=unit, sign=1 if like.factor > 0 else -1)


def _likeness(simulated: FloatArray, measured: FloatArray) -> Likeness:
    """How one (n,) goes as the other; the factor is that of their spreads, which noise of either does not shrink."""
    known = np.isfinite(simulated) & np.isfinite(measured)
    if known.sum() < _FEWEST or not np.ptp(simulated[known]) or not np.ptp(measured[known]):
        return Likeness(1.0, 0.0)
    alike = float(np.corrcoef(simulated[known], measured[known])[0, 1])
    return Likeness(float(np.sign(alike) * simulated[known].std() / measured[known].std()), alike**2)


def _applied(simulator: Simulator, theta: FloatArray, log: Trajectory, late: int) -> FloatArray:
    """The channels (n, C) of the model in the states of a log, with commands that arrive some samples late."""
    states = _spread(estimate_states(simulator, log)[:-1])
    actions = _spread(np.concatenate([np.repeat(log.actions[:1], late, axis=0), log.actions])[: len(log)])
    return simulator.rollout(theta, actions[:, None], states, log.dt, allow_outside=True).observations[:, 0]


def _spread(rows: FloatArray) -> FloatArray:
    """Some of a log's rows (n, ...), evenly."""
    return rows[:: 1 + len(rows) // _SAMPLES]
