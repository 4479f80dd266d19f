"""Logs of a draft and the regression of these: the part of it that the model's forces tell something of."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import accumulate
from pathlib import Path

import mujoco
from pydantic import ValidationError

from sipe_bayes.calibration.config_fields import ConfigError, one_line
from sipe_bayes.calibration.config_tables import LogEntry
from sipe_bayes.calibration.init.decisions import GYRO_WORDS, Case
from sipe_bayes.calibration.init.draft import Draft, Proposal, Reading, is_tried, unit_words
from sipe_bayes.calibration.init.parameters import as_parameters, candidates
from sipe_bayes.calibration.init.regression import Gyro, Regression
from sipe_bayes.calibration.logs import load_logs
from sipe_bayes.calibration.machine import Machine, Sizes
from sipe_bayes.core.smoothing import filled
from sipe_bayes.core.telling import Tell, silent
from sipe_bayes.core.trajectory import Trajectory
from sipe_bayes.core.units import find_unit
from sipe_bayes.envs.channels import Channel
from sipe_bayes.envs.mjcf import MjcfEnvironment

DELAYS = (0, 1, 2, 3, 4, 5, 6, 8, 10, 12, 16)
"""Samples that are tried, up to 0.2 s."""


@dataclass(frozen=True)
class Source:
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


def loaded(draft: Draft, sources: Sequence[Source], folder: Path) -> list[Trajectory]:
    """The logs as the draft reads them, up to 20,000 samples of each."""
    try:
        config = draft.config(folder)
    except ValidationError as error:
        raise ConfigError(f"calibrate.toml: {one_line(error.errors()[0])}") from None
    episodes = [None if source.episode is None else (source.episode,) for source in sources]
    entries = [
        LogEntry(file=source.file, name=f"{source.file.stem}-{k}", span=source.span, episodes=own)
        for k, (source, own) in enumerate(zip(sources, episodes, strict=True))
    ]
    return [log.slice(0, min(len(log), 20_000)) for log, _ in load_logs(config, entries)]


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
            kind = mujoco.mjtJoint(int(model.jnt_type[joint]))
            if kind == mujoco.mjtJoint.mjJNT_HINGE:
                out.add(f"joint:{model.joint(joint).name}.position")
            elif kind != mujoco.mjtJoint.mjJNT_SLIDE:
                out.add(f"body:{model.body(body).name}.orientation")
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
    """The regression of a draft's logs with its parameters and gyros, and where its readings are in it."""
    if not draft.parameters:
        draft = replace(draft, parameters=rough_parameters(model, machine, draft.readings))
    whole = loaded(replace(draft, measurements=(*draft.measurements, *gyros)), sources, folder)
    config = draft.config(folder)
    ends = list(accumulate(len(m.channels) for m in config.measurements))
    count = ends[-1]
    logs = [Trajectory(log.observations[:, :count], log.actions, log.dt, name=log.name) for log in whole]
    channels = [Channel(*channel) for m in config.measurements for channel in m.channels]
    actuators = [c.actuator for c in config.commands]
    written = as_parameters(model, [p for p in draft.parameters if not p.targets[0].endswith(".delay")])
    environment = MjcfEnvironment.build(str(config.model), written, actuators, channels)
    delays = [d for d in DELAYS if d * logs[0].dt <= 0.2 and d < len(logs[0]) // 8] if actuators else [0]
    regression = Regression(environment, logs, delays or [0])
    pairs = list(zip(whole, regression.logs, strict=True))
    for k, reading in enumerate(gyros):  # in any of its units where no name says one
        site, own = int(model.sensor(reading.match.target.removeprefix("sensor:")).objid[0]), find_unit(reading.unit)
        factors = tuple(find_unit(word).factor / own.factor for word in GYRO_WORDS)
        factors = factors if reading.match.label.unit in ("", *GYRO_WORDS) else (1.0,)
        cut = [log.observations[: len(own) + 1, count + 3 * k :][:, :3] for log, own in pairs]
        regression.gyros.append(Gyro(site, tuple(filled(rates) for rates in cut), factors))
    regression.scales = [_scales_of(reading, machine) for reading in draft.commands]
    one_way = {f"actuator:{a.name}" for a in machine.actuators if a.one_way}
    regression.one_way[:] = [reading.match.target in one_way for reading in draft.commands]
    places = [tuple(range(a, b)) for a, b in zip([0, *ends], ends, strict=False)]
    commands = (*(None for _ in places), *range(len(actuators)))
    return Case(draft, machine, regression, (*places, *[()] * len(actuators)), commands, tell=tell)


def _scales_of(reading: Reading, machine: Machine) -> tuple[float, ...]:
    """Coefficients that a command may have: one in its own unit; none of a share of something, which has any."""
    unit = find_unit(reading.unit)
    if unit.dimension in ("dimensionless", "current"):
        return ()
    if reading.match.label.unit or reading.factor != 1:
        return (1.0,)
    return tuple(find_unit(word).factor / unit.factor for word in unit_words(reading, machine))
