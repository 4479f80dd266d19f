"""The windows of a draft: the part of it that simulations tell something of, its logs and the trial of these."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import mujoco
from pydantic import ValidationError

from sipe_bayes.calibration.config_fields import ConfigError, one_line
from sipe_bayes.calibration.config_tables import LogEntry
from sipe_bayes.calibration.init.draft import Draft, Reading, Unknown
from sipe_bayes.calibration.init.machine import Drive, Machine, Sizes
from sipe_bayes.calibration.init.ranking import Layout
from sipe_bayes.calibration.init.trials import Trial
from sipe_bayes.calibration.init.unknowns.candidates import as_parameters, candidates
from sipe_bayes.calibration.logs import load_logs
from sipe_bayes.core.trajectory import Trajectory
from sipe_bayes.envs.channels import Channel
from sipe_bayes.envs.mjcf import MjcfEnvironment

FEW, SOME, MANY = 12, 30, 60
"""Windows: for what is clear at once, for zeros, and for delays and unknowns."""
_SAMPLES = 20_000  # of a log that are looked at
_DELAYS = (0, 1, 2, 3, 4, 6, 8, 12, 16)
_LATEST = 0.2  # s, of a delay


@dataclass(frozen=True)
class Source:
    """A log to be looked at: its file, the episode of it, and the part in s."""

    file: Path
    episode: int | None = None
    span: tuple[float, float] | None = None


def tried_part(draft: Draft) -> Draft:
    """The draft with those measurements alone that windows start from and are compared with."""
    places = {r.match.target for r in draft.measurements}

    def is_tried(target: str) -> bool:
        if target.startswith("sensor:") or target.endswith(("linear_velocity", "angular_velocity")):
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


def share_of(machine: Machine) -> float:
    """How long windows of trials are: short where errors grow, longer where a controller takes them back."""
    held = [a.drive in (Drive.POSITION, Drive.VELOCITY) for a in machine.actuators]
    return 0.4 if held and all(held) else 0.1


def trial_of(
    draft: Draft, model: mujoco.MjModel, machine: Machine, logs: Sequence[Trajectory], folder: Path, windows: int
) -> tuple[Trial, Layout]:
    """The trial of a draft's logs, whose unknowns a fit may move, and where its readings are in it."""
    config = draft.config(folder)
    channels = [Channel(*channel) for m in config.measurements for channel in m.channels]
    actuators = [c.actuator for c in config.commands]
    parameters = as_parameters(model, draft.unknowns)
    environment = MjcfEnvironment.build(str(config.model), parameters, actuators, channels)
    trial = Trial(environment, logs, windows, share_of(machine))
    places, at = [], 0
    for m in config.measurements:
        places.append(tuple(range(at, at + len(m.channels))))
        at += len(m.channels)
    empty: list[tuple[int, ...]] = [()] * len(actuators)
    return trial, Layout((*places, *empty), (*(None for _ in places), *range(len(actuators))))


def delays_of(trial: Trial, dt: float) -> list[int]:
    """Delays in control steps that may be; dt in s."""
    if not trial.given.driven:
        return [0]
    return [d for d in _DELAYS if d * dt <= _LATEST and d < trial.length]
