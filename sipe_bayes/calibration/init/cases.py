"""Logs of a draft and the regression of these: the part of it that the model's forces tell something of."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import mujoco
from pydantic import ValidationError

from sipe_bayes.calibration.config_fields import ConfigError, one_line
from sipe_bayes.calibration.config_tables import LogEntry
from sipe_bayes.calibration.init.decisions import GYRO_WORDS, Case
from sipe_bayes.calibration.init.draft import Draft, Reading, Unknown, unit_words
from sipe_bayes.calibration.init.regression import Gyro, Regression
from sipe_bayes.calibration.init.unknowns.candidates import as_parameters, candidates
from sipe_bayes.calibration.logs import load_logs
from sipe_bayes.calibration.machine import Machine, Sizes
from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.smoothing import filled
from sipe_bayes.core.telling import Tell, silent
from sipe_bayes.core.trajectory import Trajectory
from sipe_bayes.core.units import find_unit
from sipe_bayes.envs.channels import Channel
from sipe_bayes.envs.mjcf import MjcfEnvironment

_SAMPLES = 20_000  # of a log that are looked at
_DELAYS = (0, 1, 2, 3, 4, 5, 6, 8, 10, 12, 16)
_LATEST = 0.2  # s, of a delay


@dataclass(frozen=True)
class Source:
    """A log to be looked at: its file, the episode of it, and the part in s."""

    file: Path
    episode: int | None = None
    span: tuple[float, float] | None = None


def tried_part(draft: Draft) -> Draft:
    """The draft with those measurements alone that tell where joints and bodies are."""
    places = {r.match.target for r in draft.measurements}

    def is_tried(target: str) -> bool:
        if target.startswith("sensor:") or target.endswith(("linear_velocity", "angular_velocity", ".force")):
            return False
        return not target.endswith(".velocity") or target.removesuffix("velocity") + "position" not in places

    return replace(draft, measurements=tuple(r for r in draft.measurements if is_tried(r.match.target)))


def rough_unknowns(model: mujoco.MjModel, machine: Machine, readings: Sequence[Reading]) -> list[Unknown]:
    """Unknowns with bounds that the model alone tells."""
    return candidates(model, machine, readings, Sizes.of(model, machine, None, None))


def loaded(draft: Draft, sources: Sequence[Source], folder: Path) -> list[Trajectory]:
    """The logs as the draft reads them."""
    try:
        config = draft.config(folder)
    except ValidationError as error:
        raise ConfigError(f"calibrate.toml: {one_line(error.errors()[0])}") from None
    entries = [
        LogEntry(
            file=s.file,
            name=f"{s.file.stem}-{k}",
            episodes=None if s.episode is None else (s.episode,),
            span=s.span,
        )
        for k, s in enumerate(sources)
    ]
    read = [trajectory for trajectory, _ in load_logs(config, entries)]
    return [log.slice(0, min(len(log), _SAMPLES)) for log in read]


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
        for joint in range(model.body_jntadr[body], model.body_jntadr[body] + model.body_jntnum[body]):
            kind, name = int(model.jnt_type[joint]), model.joint(joint).name
            ball = kind in (int(mujoco.mjtJoint.mjJNT_FREE), int(mujoco.mjtJoint.mjJNT_BALL))
            if kind != int(mujoco.mjtJoint.mjJNT_SLIDE):
                out.add(f"body:{model.body(body).name}.orientation" if ball else f"joint:{name}.position")
        body = int(model.body_parentid[body])
    return out


def case_of(
    draft: Draft,
    model: mujoco.MjModel,
    machine: Machine,
    sources: Sequence[Source],
    folder: Path,
    gyros: Sequence[Reading] = (),
    tell: Tell = silent,
) -> Case:
    """The regression of a draft's logs with its unknowns and gyros, and where its readings are in it."""
    whole = loaded(replace(draft, measurements=(*draft.measurements, *gyros)), sources, folder)
    count = sum(len(m.channels) for m in draft.config(folder).measurements)
    logs = [Trajectory(log.observations[:, :count], log.actions, log.dt, name=log.name) for log in whole]
    config = draft.config(folder)
    channels = [Channel(*channel) for m in config.measurements for channel in m.channels]
    actuators = [c.actuator for c in config.commands]
    unknowns = [u for u in draft.unknowns if not any(t.endswith(".delay") for t in u.targets)]
    environment = MjcfEnvironment.build(str(config.model), as_parameters(model, unknowns), actuators, channels)
    dt = logs[0].dt
    delays = [d for d in _DELAYS if d * dt <= _LATEST and d < len(logs[0]) // 8] if actuators else [0]
    regression = Regression(environment, logs, delays or [0])
    places, at = [], 0
    for m in config.measurements:
        places.append(tuple(range(at, at + len(m.channels))))
        at += len(m.channels)
    regression.gyros = [
        _gyro(model, regression, reading, [log.observations[:, count + 3 * k :][:, :3] for log in whole])
        for k, reading in enumerate(gyros)
    ]
    regression.scales = [_scales_of(reading, machine) for reading in draft.commands]
    one_way = {f"actuator:{a.name}" for a in machine.actuators if a.one_way}
    regression.one_way[:] = [reading.match.target in one_way for reading in draft.commands]
    empty: list[tuple[int, ...]] = [()] * len(actuators)
    commands = (*(None for _ in places), *range(len(actuators)))
    return Case(draft, machine, regression, (*places, *empty), commands, tell=tell)


def _gyro(model: mujoco.MjModel, regression: Regression, reading: Reading, rates: Sequence[FloatArray]) -> Gyro:
    """A gyro's rates, in any of its units where no name says one."""
    site = int(model.sensor(reading.match.target.removeprefix("sensor:")).objid[0])
    named, own = reading.match.label.unit, find_unit(reading.unit).factor
    factors = tuple(find_unit(word).factor / own for word in GYRO_WORDS)
    some = [filled(x[: len(log) + 1]) for x, log in zip(rates, regression.logs, strict=True)]
    return Gyro(site, tuple(some), (1.0,) if named not in ("", *GYRO_WORDS) else factors)


def _scales_of(reading: Reading, machine: Machine) -> tuple[float, ...]:
    """Coefficients that a command may have: one in its own unit; none of a share of something, which has any."""
    unit = find_unit(reading.unit)
    if unit.dimension in ("dimensionless", "current"):
        return ()
    if reading.match.label.unit or reading.factor != 1:
        return (1.0,)
    return tuple(find_unit(word).factor / unit.factor for word in unit_words(reading, machine))
