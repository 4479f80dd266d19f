"""What is odd in a configuration that exists and in its logs, before a fit."""

from __future__ import annotations

import itertools
import os
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from sipe_bayes.calibration.column_names import read_name
from sipe_bayes.calibration.config import Config, load_config
from sipe_bayes.calibration.gathered import no_rigid_bodies
from sipe_bayes.calibration.init.cases import Scene, Source, rough_parameters, tried_part
from sipe_bayes.calibration.init.decisions import DECIDED, Case, Search, decide, search_answers
from sipe_bayes.calibration.init.draft import Draft, LogLine, Reading
from sipe_bayes.calibration.init.matching import Match
from sipe_bayes.calibration.init.oddities import find_oddities
from sipe_bayes.calibration.init.readings import with_velocities
from sipe_bayes.calibration.init.regression import Regression
from sipe_bayes.calibration.init.selection import delay_of
from sipe_bayes.calibration.init.tables import Opened, open_table
from sipe_bayes.calibration.machine import Machine
from sipe_bayes.calibration.problem import environment_of
from sipe_bayes.calibration.readers.tables import read_table
from sipe_bayes.calibration.signals import turn_of
from sipe_bayes.core.finding_advice import ADVICE
from sipe_bayes.core.trajectory import Trajectory
from sipe_bayes.envs.foreign.load import compile_spec, load_spec
from sipe_bayes.posterior import prior

_LOGS = 3  # that are looked at
_BETTER = 2 * DECIDED  # nats, from which another reading is named
_LOST, _PAIRS = 0.3, 60  # of a joint's forces, from which columns may be swapped; pairs that are tried


class Validated(NamedTuple):
    """What was found in a configuration."""

    odd: list[str]  # one line for each thing that the logs speak against
    doubts: list[str]  # one line for each that they can not tell


def validate_config(path: Path) -> Validated:
    """Hold a configuration against its logs.

    Raises:
        ConfigError: for a configuration that can not be used.
        LogError: for a log that can not be used.
        ModelError: for a model that does not compile.
    """
    config = load_config(path)
    environment = environment_of(config, config.logs_for("train"), config.logs_for("holdout"))  # raises as a run
    bodies = no_rigid_bodies(environment, prior(environment.space), 0, prior=True)
    model = compile_spec(load_spec(str(config.model)), str(config.model))
    machine = Machine.of(model)
    train = sorted(config.logs_for("train"), key=lambda log: bool(log.added))[:_LOGS]  # with a load, another machine
    opened = open_table(train[0].file, read_table(train[0].file, (), config.columns.names), config.columns.time.rate)
    draft = _draft_of(config, opened, path.parent)
    part = tried_part(draft)
    part = replace(part, parameters=rough_parameters(model, machine, draft.readings))
    sources = [Source(log.file, log.episodes[0] if log.episodes else None, log.span) for log in train]
    case = Scene(model, machine, sources, path.parent).case(part)
    search = search_answers(case)
    better = decide(search)
    out = [f"parameters: {one.text}. {ADVICE[one.code]}" for one in bodies]
    out += _other_readings(search, part, better)
    out = out or _swapped(case)
    out += find_oddities(case, opened)
    out = out or _delays(config, case)
    out += _slopes(draft, opened) + _turns(draft, opened)
    return Validated(out, [doubt for doubt in better.open_doubts if doubt != draft.clock.doubt])


def _delays(config: Config, case: Case) -> list[str]:
    """Delays that the configuration does not ask for, or not as long as they are."""
    regression = case.regression
    outcome, dt = regression.fit(regression.given), regression.logs[0].dt
    actuators = [command.actuator for command in config.commands]
    late, note = delay_of(actuators, outcome, regression.independent(outcome), regression.delays, dt)
    delays = [p for p in config.parameters if any(t.endswith(".delay") for t in p.targets)]
    if late and not delays and not regression.simulator.model.actuator_delay.any():
        targets = ", ".join(f"actuator:{name}.delay" for name in actuators)
        return [f"parameters: {note}; ask for {'one of ' * (len(actuators) > 1)}{targets}"]
    if late and delays and outcome.delay * dt > max(p.range[1] for p in delays):
        return [f"parameters: {note}, beyond the bounds of {delays[0].name!r}; widen them"]
    return []


def _draft_of(config: Config, opened: Opened, folder: Path) -> Draft:
    """The configuration as a draft whose columns' names say no units."""

    def match(target: str, columns: tuple[str, ...], quaternion: str | None = None) -> Match:
        return Match(columns, target, replace(read_name(columns[0]), unit=""), 1.0, quaternion or "")

    duties = [c.supply if c.rate is None else None for c in config.commands]
    supplies = [None if feed is None else (feed.column, feed.unit) for feed in duties]
    commands = tuple(
        Reading(match(c.target, (c.column,)), c.unit, c.sign, c.factor, c.zero, supply=supply)
        for c, supply in zip(config.commands, supplies, strict=True)
    )
    measurements = tuple(
        Reading(match(m.target, m.sources, m.quaternion), m.unit, m.sign, m.factor, m.zero, wraps=m.wraps)
        for m in config.measurements
    )
    clock = replace(opened.clock, column=config.columns.time.column, unit=config.columns.time.unit)
    logs, names = (LogLine(str(config.logs[0].file.resolve())),), config.columns.names
    model = Path(os.path.relpath(config.model, folder)).as_posix()
    return Draft(model, clock, config.columns.episode, commands, measurements, logs, "log", names=names)


def _swapped(case: Case) -> list[str]:
    """Two columns of commands, or of positions, with which most more is explained the other way round."""
    regression, readings = case.regression, case.draft.readings
    outcome, best = regression.fit(regression.given), _BETTER
    out: list[str] = []
    if outcome.miss[regression.known].max(initial=0.0) < _LOST:
        return []
    for a, b in itertools.islice(itertools.combinations(range(len(readings)), 2), _PAIRS):
        one, other = readings[a], readings[b]
        several = len(one.match.columns + other.match.columns) > 2
        if several or (one.commanded, one.unit) != (other.commanded, other.unit):
            continue
        logs = []
        for log in regression.logs:
            actions, seen = log.actions.copy(), log.observations.copy()
            if one.commanded:
                both = np.array([case.commands[a], case.commands[b]], int)
                actions[:, both] = actions[:, both[::-1]]
            else:
                i, j = case.channels[a][0], case.channels[b][0]
                seen[:, [i, j]] = seen[:, [j, i]]
            logs.append(Trajectory(seen, actions, log.dt))
        there = Regression(regression.environment, logs, regression.delays)
        there.one_way, there.scales, there.springs = regression.one_way, regression.scales, regression.springs
        gain = case.nats(outcome) - case.nats(there.fit(there.given))
        if gain > best:
            names = f"columns {one.match.column!r} and {other.match.column!r}"
            best, out = gain, [f"{names} look swapped: the model explains far more the other way round"]
    return out


def _other_readings(search: Search, part: Draft, better: Draft) -> list[str]:
    """Units and signs with which the model explains far more."""
    both = list(zip(part.readings, better.readings, strict=True))
    pairs = [(a, b) for a, b in both if (a.unit, a.sign) != (b.unit, b.sign)]
    now, then = search.case.outcome(part.readings), search.case.outcome(better.readings)
    gain = search.case.nats(now) - search.case.nats(then)
    if not pairs or (gain < _BETTER and not any(a.commanded and a.sign != b.sign for a, b in both)):
        return []
    times = float((now.miss / then.miss).max())
    out = []
    for one, other in pairs:
        where = f"{'commands' if one.commanded else 'measurements'}, column {one.match.column!r}"
        more = f"fits the log: {times:.2g} times as much of the joints' forces is left with what stands there"
        if one.unit != other.unit:
            named = read_name(one.match.column).unit == one.unit
            but = "; its name says what stands there, so the model may be as far off instead" if named else ""
            out.append(f"{where}: unit {one.unit!r} is odd, {other.unit!r} {more}{but}")
        if one.sign != other.sign:
            out.append(f"{where}: sign {one.sign} is odd, {other.sign} {more}")
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
