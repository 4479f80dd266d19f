"""What is odd in a configuration that exists: units, signs, swapped columns, delays, velocities, angles that wrap."""

from __future__ import annotations

import itertools
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from sipe_bayes.calibration.config import Config, load_config
from sipe_bayes.calibration.config_tables import Command, Measurement
from sipe_bayes.calibration.gathered import no_rigid_bodies
from sipe_bayes.calibration.init.columns.match import Match
from sipe_bayes.calibration.init.columns.names import read_name
from sipe_bayes.calibration.init.columns.signals import turn_of
from sipe_bayes.calibration.init.decisions import AGAINST, decide
from sipe_bayes.calibration.init.draft import Draft, LogLine, Reading
from sipe_bayes.calibration.init.fits import delay_of, fit
from sipe_bayes.calibration.init.machine import Machine, Sizes
from sipe_bayes.calibration.init.ranking import fitted_miss
from sipe_bayes.calibration.init.readings import with_velocities
from sipe_bayes.calibration.init.tables import Opened, open_table
from sipe_bayes.calibration.init.trials import Assumption, Trial, followed
from sipe_bayes.calibration.init.unknowns.candidates import springs
from sipe_bayes.calibration.init.windows import (
    FEW,
    MANY,
    Source,
    delays_of,
    loaded,
    rough_unknowns,
    trial_of,
    tried_part,
)
from sipe_bayes.calibration.problem import environment_of
from sipe_bayes.calibration.readers.tables import read_table
from sipe_bayes.core.finding_advice import ADVICE
from sipe_bayes.core.units import find_unit
from sipe_bayes.envs.foreign.load import compile_spec, load_spec
from sipe_bayes.posterior import prior

_LOGS = 3  # that are simulated
_BETTER = np.log(1.5)  # of the logarithm of misses together, from which another reading is named
_ROOM = 0.05  # of a ctrlrange, by which a command may lie beyond it
_ROUNDS = 12  # of the fits with either reading: a model that is far off speaks for wrong units


@dataclass(frozen=True)
class Checked:
    """What was found in a configuration.

    Args:
        odd: one line for each thing that simulations and slopes speak against.
        doubts: one line for each that they can not tell.
    """

    odd: list[str]
    doubts: list[str]


def checked(path: Path) -> Checked:
    """Hold a configuration against its logs.

    Raises:
        ConfigError: for a configuration that can not be used.
        LogError: for a log that can not be used.
        ModelError: for a model that does not compile.
    """
    config = load_config(path)
    environment = environment_of(config, config.logs_for("train"), config.logs_for("holdout"))  # raises as a run
    bodies = no_rigid_bodies(environment, prior(environment.space), 0, prior=True)
    folder = path.parent
    model = compile_spec(load_spec(str(config.model)), str(config.model))
    machine = Machine.of(model)
    train = sorted(config.logs_for("train"), key=lambda log: bool(log.added))[:_LOGS]  # with a load, another machine
    opened = open_table(train[0].file, read_table(train[0].file), config.columns.time.rate)
    draft = _draft_of(config, opened, folder)
    part = tried_part(draft)
    part = replace(part, unknowns=tuple(rough_unknowns(model, machine, draft.readings)))
    sources = [Source(log.file, log.episodes[0] if log.episodes else None, log.span) for log in train]
    logs = loaded(part, sources, folder)
    trial, layout = trial_of(part, model, machine, logs, folder, FEW)
    better = decide(part, machine, trial, layout)
    gain, out = _swapped(part, trial)
    changed = [
        (a, b) for a, b in zip(part.readings, better.readings, strict=True) if (a.unit, a.sign) != (b.unit, b.sign)
    ]
    if changed:
        then = layout.assumption(trial, part, better.readings)
        (now, _), (other, _) = (fitted_miss(trial, assumption, _ROUNDS) for assumption in (trial.given, then))
        named = all(a.sign == b.sign and read_name(a.match.column).unit == a.unit for a, b in changed)
        if now - other > max(gain, AGAINST if named else _BETTER):
            out = _other_readings(changed, np.exp((now - other) / len(part.measurements)))
    if not out:
        beside = springs(model, machine, draft.readings, Sizes.of(model, machine, None, None))
        part = replace(part, unknowns=(*part.unknowns, *beside))
        trial, _ = trial_of(part, model, machine, logs, folder, MANY)
        left = fit(trial, trial.given, delays_of(trial, logs[0].dt), rounds=6)
        late, note = delay_of([c.actuator for c in config.commands], left, logs[0].dt)
        delays = [p for p in config.parameters if any(t.endswith(".delay") for t in p.targets)]
        if late and not delays and not model.actuator_delay.any():
            targets = ", ".join(f"actuator:{command.actuator}.delay" for command in config.commands)
            out.append(f"parameters: {note}; ask for {'one of ' * (len(config.commands) > 1)}{targets}")
        if late and delays and left.best * logs[0].dt > max(p.range[1] for p in delays):
            out.append(f"parameters: {note}, beyond the bounds of {delays[0].name!r}; widen them")
    doubts = [doubt for doubt in better.open_doubts if doubt != draft.clock.doubt]
    out = [f"parameters: {one.text}. {ADVICE[one.code]}" for one in bodies] + out
    return Checked(
        out + _clipped(config, draft, machine, opened) + _slopes(draft, opened) + _turns(draft, opened), doubts
    )


def _draft_of(config: Config, opened: Opened, folder: Path) -> Draft:
    """The configuration as a draft whose columns' names say no units."""

    def reading(entry: Command | Measurement, columns: tuple[str, ...]) -> Reading:
        label = replace(read_name(columns[0]), unit="")
        quaternion = (entry.quaternion or "") if isinstance(entry, Measurement) else ""
        match = Match(columns, entry.target, label, 1.0, quaternion)
        wraps = isinstance(entry, Measurement) and entry.wraps
        feed = entry.supply if isinstance(entry, Command) and entry.rate is None else None
        supply = None if feed is None else (feed.column, feed.unit)
        return Reading(match, entry.unit, entry.sign, entry.factor, entry.zero, wraps=wraps, supply=supply)

    clock = replace(opened.clock, column=config.columns.time.column, unit=config.columns.time.unit)
    return Draft(
        Path(os.path.relpath(config.model, folder)).as_posix(),
        clock,
        config.columns.episode,
        tuple(reading(c, (c.column,)) for c in config.commands),
        tuple(reading(m, m.sources) for m in config.measurements),
        (LogLine(str(config.logs[0].file.resolve())),),
        "log",
    )


def _other_readings(changed: Sequence[tuple[Reading, Reading]], times: float) -> list[str]:
    """Units and signs with which the logs are followed so many times better, whatever the unknowns."""
    out = []
    for now, then in changed:
        where = f"{'commands' if now.commanded else 'measurements'}, column {now.match.column!r}"
        more = f"fits the log: simulated windows miss {times:.2g} times as much with what stands there"
        if now.unit != then.unit:
            named = read_name(now.match.column).unit == now.unit
            but = "; its name says what stands there, so the model may be as far off instead" if named else ""
            out.append(f"{where}: unit {now.unit!r} is odd, {then.unit!r} {more}{but}")
        if now.sign != then.sign:
            out.append(f"{where}: sign {now.sign} is odd, {then.sign} {more}")
    return out


def _swapped(draft: Draft, trial: Trial) -> tuple[float, list[str]]:
    """Two columns of one kind that fit better the other way round, with any signs, and the logarithm of by how much."""
    given, count = trial.given, len(draft.measurements)
    tried: list[tuple[str, Assumption]] = []
    for a, b in itertools.combinations(range(len(draft.readings)), 2):
        one, other = draft.readings[a], draft.readings[b]
        if one.commanded != other.commanded or one.unit != other.unit:
            continue
        if any(len(r.match.columns) > 1 for r in draft.measurements):
            continue
        i, j = (a - count, b - count) if one.commanded else (a, b)
        order = list(given.actuators if one.commanded else given.channels)
        order[i], order[j] = order[j], order[i]
        for signs in itertools.product((1.0, -1.0), repeat=2):
            factors = list(given.driven if one.commanded else given.observed)
            factors[i], factors[j] = signs
            names = f"columns {one.match.column!r} and {other.match.column!r}"
            now = (
                replace(given, actuators=tuple(order), driven=tuple(factors))
                if one.commanded
                else replace(given, channels=tuple(order), observed=tuple(factors))
            )
            tried.append((names, now))
    if not tried:
        return 0.0, []
    misses = followed(trial.misses([given, *(now for _, now in tried)], trial.theta))
    best = int(np.argmin(misses[1:]))
    gain, names = float(misses[0] - misses[1 + best]), tried[best][0]
    if gain < _BETTER:
        return 0.0, []
    times = f"simulated windows miss {np.exp(gain / count):.2g} times as much as the other way round"
    return gain, [f"{names} look swapped: {times}"]


def _clipped(config: Config, draft: Draft, machine: Machine, opened: Opened) -> list[str]:
    """Commands most of which the ctrlrange of their actuator cuts off."""
    limits = {f"actuator:{actuator.name}": actuator.limits for actuator in machine.actuators}
    out = []
    for entry, r in zip(config.commands, draft.commands, strict=True):
        ends, fed = limits.get(r.match.target), (r.supply[0],) if r.supply else ()
        if ends is None or entry.rate is not None or any(name not in opened.columns for name in (r.match.column, *fed)):
            continue
        values = (opened.columns[r.match.column] - r.zero) * r.sign * r.factor * find_unit(r.unit).factor
        if r.supply:
            values = values * opened.columns[r.supply[0]] * find_unit(r.supply[1]).factor
        room = _ROOM * (ends[1] - ends[0])
        share = float(np.mean((values < ends[0] - room) | (values > ends[1] + room)))
        if share > 0.5:
            where = f"commands, column {r.match.column!r}: {100 * share:.0f} % of it lies outside of the ctrlrange"
            out.append(f"{where} {list(ends)} of {r.match.target}, which cuts it off; look at its factor, zero, supply")
    return out


def _slopes(draft: Draft, opened: Opened) -> list[str]:
    """Velocities whose unit or sign the slopes of their positions speak against."""
    known = [r for r in draft.measurements if all(c in opened.columns for c in r.match.columns)]
    out = []
    for now, then in zip(known, with_velocities(known, opened.columns, draft.clock), strict=True):
        where = f"measurements, column {now.match.column!r}"
        if then.doubts:
            out.append(f"{where}: {then.doubts[0]}")
        elif (now.unit, now.sign) != (then.unit, then.sign):
            sign = "-" if then.sign < 0 else ""
            out.append(f"{where}: as the slope of its position it is {sign}{then.unit}, not {now.sign} x {now.unit}")
    return out


def _turns(draft: Draft, opened: Opened) -> list[str]:
    """Angles that come round and are not written on."""
    return [
        f"measurements, column {r.match.column!r}: jumps by {turn:.5g} where the angle comes round; add `wraps = true`"
        for r in draft.measurements
        if len(r.match.columns) == 1 and not r.wraps and r.match.column in opened.columns
        if r.match.target.endswith(".position") and (turn := turn_of(opened.columns[r.match.column]))
    ]
