"""Logs of a draft and the regression of these: the part of it that the model's forces tell something of.

Columns of what drives apply at their joints, such as the efforts of servos, get their signs and units here. With a
force masses, friction and gains are known in SI; without any they are known relative to each other. A motion need not
be followed for it: commands, positions and velocities of one instant make the force of the model.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import accumulate
from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np
import scipy.optimize
from pydantic import ValidationError
from scipy.ndimage import gaussian_filter1d

from sipe_bayes.calibration.config_fields import ConfigError, one_line
from sipe_bayes.calibration.config_tables import LogEntry
from sipe_bayes.calibration.init.decisions import GYRO_WORDS, Case
from sipe_bayes.calibration.init.draft import Draft, Proposal, Reading, is_tried, unit_words
from sipe_bayes.calibration.init.matching import Match
from sipe_bayes.calibration.init.parameters import as_parameters, candidates
from sipe_bayes.calibration.init.regression import Gyro, Regression
from sipe_bayes.calibration.logs import load_logs
from sipe_bayes.calibration.machine import Machine, Sizes
from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.smoothing import filled
from sipe_bayes.core.telling import Tell, silent
from sipe_bayes.core.trajectory import Trajectory
from sipe_bayes.core.units import find_unit
from sipe_bayes.core.units import unit_words as units_of
from sipe_bayes.envs.channels import Channel
from sipe_bayes.envs.mjcf import MjcfEnvironment

DELAYS = (0, 1, 2, 3, 4, 5, 6, 8, 10, 12, 16)
"""Samples that are tried, up to 0.2 s."""
_FOLLOWS = 0.3  # share of variance from which a column is the force of a drive, whose gains may be off
_UNSURE, _FAR = np.log(1.5), np.log(6.0)  # of the logarithm of how many times the model's force it is
_BOTH_WAYS = 0.1  # of the rows, in which a force that changes its sign has either


class Source(NamedTuple):
    """A log to be looked at: its file, the episode of it, and the part in s."""

    file: Path
    episode: int | None = None
    span: tuple[float, float] | None = None


def tried_part(draft: Draft) -> Draft:
    """The draft with those measurements alone that tell where joints and bodies are."""
    tried = tuple(r for r in draft.measurements if r.match.quaternion or is_tried(draft, r))
    return replace(draft, measurements=tried)


def rough_parameters(model: mujoco.MjModel, machine: Machine, readings: Sequence[Reading]) -> tuple[Proposal, ...]:
    """Parameters with bounds that the model alone tells."""
    return tuple(candidates(model, machine, readings, Sizes.of(model, machine, None, None)))


@dataclass(frozen=True)
class Scene:
    """What drafts are held against.

    Args:
        model: as it is given.
        machine: what of it logs hold.
        sources: the logs that are looked at.
        folder: of the configuration.
        tell: called with how far it is.
    """

    model: mujoco.MjModel
    machine: Machine
    sources: Sequence[Source]
    folder: Path
    tell: Tell = silent

    def load(self, draft: Draft, others: Sequence[Reading]) -> list[Trajectory]:
        """Up to 20,000 samples of each log as the draft reads them, with other measurements behind its own."""
        try:
            config = replace(draft, measurements=(*draft.measurements, *others)).config(self.folder)
        except ValidationError as error:
            raise ConfigError(f"calibrate.toml: {one_line(error.errors()[0])}") from None
        entries = [
            LogEntry(file=file, name=f"{file.stem}-{k}", span=span, episodes=None if episode is None else (episode,))
            for k, (file, episode, span) in enumerate(self.sources)
        ]
        return [log.slice(0, min(len(log), 20_000)) for log, _ in load_logs(config, entries)]

    def case(self, draft: Draft, gyros: Sequence[Reading] = ()) -> Case:
        """The regression of a draft's logs with its parameters and gyros, and where its readings are in it."""
        if not draft.parameters:
            draft = replace(draft, parameters=rough_parameters(self.model, self.machine, draft.readings))
        whole, config = self.load(draft, gyros), draft.config(self.folder)
        ends = list(accumulate(len(m.channels) for m in config.measurements))
        logs = [Trajectory(log.observations[:, : ends[-1]], log.actions, log.dt, name=log.name) for log in whole]
        channels = [Channel(*channel) for m in config.measurements for channel in m.channels]
        actuators = [command.actuator for command in config.commands]
        written = as_parameters(self.model, [p for p in draft.parameters if not p.targets[0].endswith(".delay")])
        environment = MjcfEnvironment.build(str(config.model), written, actuators, channels)
        delays = [d for d in DELAYS if d * logs[0].dt <= 0.2 and d < len(logs[0]) // 8] if actuators else []
        regression = Regression(environment, logs, delays or [0])
        for k, reading in enumerate(gyros):  # in any of its units where no name says one
            site, own = int(self.model.sensor(reading.match.target.removeprefix("sensor:")).objid[0]), reading.unit
            words = GYRO_WORDS if reading.match.label.unit in ("", *GYRO_WORDS) else (own,)
            pairs, first = zip(whole, regression.logs, strict=True), ends[-1] + 3 * k
            rates = tuple(filled(log.observations[: len(used) + 1, first : first + 3]) for log, used in pairs)
            factors = tuple(find_unit(word).factor / find_unit(own).factor for word in words)
            regression.gyros.append(Gyro(site, rates, factors))
        regression.scales = [_scales_of(reading, self.machine) for reading in draft.commands]
        one_way = {f"actuator:{a.name}" for a in self.machine.actuators if a.one_way}
        regression.one_way[:] = [reading.match.target in one_way for reading in draft.commands]
        places = [tuple(range(a, b)) for a, b in zip([0, *ends], ends, strict=False)]
        commands = (*(None for _ in places), *range(len(actuators)))
        readings = (*places, *[()] * len(actuators)), commands
        return Case(draft, self.model, self.machine, regression, *readings, regression.count, tell=self.tell)


def gyros_of(draft: Draft, model: mujoco.MjModel, machine: Machine) -> list[Reading]:
    """The draft's rate gyros that nothing turns but what is measured."""
    known = {reading.match.target for reading in draft.measurements}
    names = [name for name, kind in machine.sensors if kind == "gyro"]
    targets = {f"sensor:{name}" for name in names if _turning(model, name) <= known}
    return [reading for reading in draft.measurements if reading.match.target in targets]


def _turning(model: mujoco.MjModel, sensor: str) -> set[str]:
    """Targets of what turns a sensor's site."""
    body, out = int(model.site_bodyid[model.sensor(sensor).objid[0]]), set[str]()
    while body:
        for joint in np.flatnonzero(model.jnt_bodyid == body):
            if model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_HINGE:
                out.add(f"joint:{model.joint(joint).name}.position")
            elif model.jnt_type[joint] != mujoco.mjtJoint.mjJNT_SLIDE:
                out.add(f"body:{model.body(body).name}.orientation")
        body = int(model.body_parentid[body])
    return out


def _scales_of(reading: Reading, machine: Machine) -> tuple[float, ...]:
    """Coefficients that a command may have: one in its own unit; none of a share of something, which has any."""
    unit = find_unit(reading.unit)
    if unit.dimension in ("dimensionless", "current"):
        return ()
    if reading.match.label.unit or reading.factor != 1:
        return (1.0,)
    return tuple(find_unit(word).factor / unit.factor for word in unit_words(reading, machine))


def with_forces(draft: Draft, matches: Sequence[Match], scene: Scene) -> tuple[Draft, list[str]]:
    """The draft with columns that go as the forces of drives do, and what is to be said of those that do not.

    Commands and positions of the draft are decided; matches are columns with ``joint:NAME.force``.
    """
    hinges = {f"joint:{joint.name}.force" for joint in scene.machine.joints if joint.hinge}
    words = [units_of("torque" if match.target in hinges else "force") for match in matches]
    first, notes = list[Reading](), list[str]()
    for match, own in zip(matches, words, strict=True):
        if match.label.unit in ("", *own):
            first.append(Reading(match, match.label.unit or own[0]))
        else:
            notes.append(f"{match.column!r} is not used: {match.label.unit} is no unit of a force")
    if not first:
        return draft, notes
    regression = scene.case(draft).regression
    motion = regression.given_motion
    place = sum(len(m.channels) for m in draft.config(scene.folder).measurements)
    whole = scene.load(draft, first)
    parts = zip(whole, regression.logs, regression.widths, regression.rows, strict=True)
    raw = [(filled(log.observations[: len(own) + 1, place:]), width, rows) for log, own, width, rows in parts]
    measured = np.concatenate([gaussian_filter1d(values, width, axis=0)[rows] for values, width, rows in raw])
    sizes = len(first) > 1 and not (measured < 0).any()
    readings = []
    for reading, values in zip(first, measured.T, strict=True):
        dof = int(scene.model.joint(reading.joint).dofadr[0])
        force = _add_resistance(motion.asked[:, dof], motion.resisting[:, :, dof].T, values)
        both_ways = min(np.mean(force > 0), np.mean(force < 0)) > _BOTH_WAYS
        if (both_ways or sizes) and not (values < 0).any():
            notes.append(f"{reading.match.column!r} is not used: it never changes its sign")
            continue
        decided = _decide(reading, force, values)
        if decided.fit:
            readings.append(decided)
        else:
            notes.append(f"{reading.match.column!r} is not used: {decided.notes[0]}")
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
    words = [own.word] if reading.match.label.unit else units_of(own.dimension)
    times = {word: ratio * find_unit(word).factor / own.factor for word in words}
    unit = min(words, key=lambda word: abs(np.log(times[word])))
    off = abs(float(np.log(times[unit])))
    note = f"the model's force at {reading.joint} explains {100 * alike**2:.0f} % of its variance"
    if alike**2 < _FOLLOWS:
        return replace(reading, fit=False, notes=(note,))
    note += f"; in {unit} it is {times[unit]:.2g} times as large"
    if off > _FAR:
        return replace(reading, fit=False, notes=(note,))
    reading = replace(reading, unit=unit, sign=1 if alike > 0 else -1)
    if not reading.match.label.unit and off > _UNSURE:
        return replace(reading, doubts=(f"{note}: if it is no force, but a current or a share, leave it out",))
    return replace(reading, notes=(note,))
