"""The TOML file of ``sipe calibrate``: its schema, and every check that needs nothing but the file itself.

``load_config`` returns a frozen ``Config`` or raises a ``ConfigError`` of one line that names the key as TOML
writes it, what was expected, what came, and the remedy. Relative paths are relative to the TOML's folder.
What needs the MJCF (does the joint exist, which kind of unit has it) is checked where the model is read.
"""

from __future__ import annotations

import tomllib
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import Field, PrivateAttr, Strict, ValidationError, model_validator

from sipe_bayes.calibration.config_fields import (
    Budget,
    ConfigError,
    EstimatorName,
    Location,
    Table,
    Tolerance,
    Use,
    Window,
    nearest_file,
    one_line,
    problem,
)
from sipe_bayes.calibration.config_tables import (
    Columns,
    Command,
    LogEntry,
    Logs,
    Measurement,
    Noise,
    ParameterEntry,
    PriorSource,
    Resample,
    Search,
    Structure,
)
from sipe_bayes.calibration.readers.many import episodes_of
from sipe_bayes.core.files import read_text, reading
from sipe_bayes.core.units import find_unit
from sipe_bayes.core.validation import MOST
from sipe_bayes.structure.tolerances import GEOMETRY, PHYSICS_STEPS, TIMING


class Config(Table):
    """A whole configuration; ``load_config`` reads one.

    ``window`` is in seconds, or "log" for whole logs; None where the likelihood has no windows.
    """

    model: Location
    """the MJCF file"""
    estimator: EstimatorName = "laplace"
    """the method, see [estimators](estimators.md)"""
    likelihood: Literal["segments", "state_space"] = "segments"
    """`"segments"`: windows of the log; or `"state_space"`: the state is unknown at every sample and process
    noise is inferred (`laplace` and `mcmc`; takes neither `window` nor a `noise.model` other than `"white"`)"""
    window: Window = None
    """length in seconds of the windows that a log is cut into, each with a start of its own; `"log"` for whole
    logs; to be given with `"segments"`"""
    seed: Annotated[int, Strict(), Field(ge=0, le=MOST)] = 0
    """the same seed gives the same posterior"""
    budget: Budget | None = None
    """rollouts of the search: one parameter vector simulated over one log; default the estimator's own. Checks
    afterwards (each log alone, dead ranges, what the model lacks, the prior's simulations, bands) come on top"""
    geometry_tolerance: Tolerance = GEOMETRY
    """sd of where centres of mass lie, as a share of the body's radius of gyration about the joint that turns it, and
    of masses that are not unknown, as a share of them; intervals with what the model lacks allow for it where no log
    tells. 0: exact"""
    timing_tolerance: Tolerance = TIMING
    """sd of when each measurement is taken, as a share of the time from sample to sample: loops read one joint after
    the other. Intervals with what the model lacks allow for it where no log tells. 0: exact"""
    step_tolerance: Tolerance = PHYSICS_STEPS
    """what physics steps change, as a share of all that they do: a machine takes none. Intervals with what the model
    lacks or may lack allow for it. 0: for logs in the model's own steps, of which they are but one more piece"""
    search: Search = Search()
    resample: Resample = Resample()
    columns: Columns = Columns()
    commands: tuple[Command, ...] = ()
    measurements: Annotated[tuple[Measurement, ...], Field(min_length=1)]
    logs: Logs
    parameters: Annotated[tuple[ParameterEntry, ...], Field(min_length=1)]
    noise: Noise = Noise()
    prior: PriorSource | None = None
    structure: Structure = Structure()

    _path: Path = PrivateAttr(default=Path("CONFIG.toml"))

    @property
    def path(self) -> Path:
        """The TOML file this was read from."""
        return self._path

    @property
    def channels(self) -> tuple[str, ...]:
        """Names of the measurements, in the order of a trajectory's observations."""
        return tuple(name for m in self.measurements for _, name in m.channels)

    @property
    def drives(self) -> tuple[Command, ...]:
        """What the columns of a trajectory's actions are: the commands, and supplies of sampled controllers."""
        supplies = {c.fed.actuator: c.fed for c in self.commands if c.fed is not None and c.rate is not None}
        return (*self.commands, *supplies.values())

    @property
    def sources(self) -> tuple[tuple[Measurement, str], ...]:
        """Every measured column of a log, with its measurement."""
        return tuple((m, column) for m in self.measurements for column in m.sources)

    def logs_for(self, use: Use) -> tuple[LogEntry, ...]:
        """The logs that train, or those held out."""
        return tuple(log for log in self.logs if log.use == use)

    def window_of(self, log: LogEntry) -> float | None:
        """Seconds of a window of ``log``; None for the whole log as one."""
        window = self.window if log.window is None else log.window
        return None if window == "log" else window

    @model_validator(mode="after")
    def _check(self) -> Self:
        _check_unique("commands", "actuator", [c.actuator for c in self.commands])
        _check_unique("measurements", "name", self.channels)
        _check_unique("measurements", "target", [m.target for m in self.measurements])
        _check_unique("logs", "name", [log.name for log in self.logs if log.episodes is None])
        _check_unique("parameters", "name", [p.name for p in self.parameters])
        self._check_likelihood()
        self._check_targets()
        if not any(m.fit for m in self.measurements):
            raise problem("expected at least one with fit = true, got none; set one to true", "measurements")
        if not self.logs_for("train"):
            raise problem("expected at least one with use = 'train', got none; mark one", "logs")
        self._check_holdout()
        return self

    def _check_likelihood(self) -> None:
        """Windows and coloured noise are of segments alone; held-out logs are scored by windows either way."""
        if self.likelihood == "segments":
            if self.window is None:
                raise problem(
                    'missing; add it in seconds, such as window = 0.5, or window = "log" for whole logs', "window"
                )
            return
        needless = "given with likelihood = 'state_space', which has no windows; drop it or use likelihood = 'segments'"
        if self.window is not None:
            raise problem(needless, "window")
        for i, log in enumerate(self.logs):
            if log.window is not None and log.use == "train":
                raise problem(needless, "logs", i, "window")
        if "model" in self.noise.model_fields_set and self.noise.model != "white":
            expected = f"expected 'white' with likelihood = 'state_space', got {self.noise.model!r}"
            raise problem(f"{expected}; drop it or use likelihood = 'segments'", "noise", "model")

    def _check_targets(self) -> None:
        owner: dict[str, str] = {}
        for i, parameter in enumerate(self.parameters):
            for target in parameter.targets:
                if target in owner:
                    message = f"{target!r} is already driven by parameter {owner[target]!r}; drop it from one"
                    raise problem(message, "parameters", i, "targets")
                owner[target] = parameter.name

    def _check_holdout(self) -> None:
        """A held-out sample that also trains would be no test."""
        for i, held in enumerate(self.logs):
            for train in self.logs_for("train") if held.use == "holdout" else ():
                if held.file == train.file and held.meets(train):
                    message = f"held out, but samples of it train as log {train.name!r}; give spans or episodes apart"
                    raise problem(message, "logs", i, "use")


_ABOVE = frozenset(Config.model_fields)
"""Keys of the whole file, which TOML takes for a table's where they stand below its header."""


def _check_unique(table: str, key: str, words: Sequence[str]) -> None:
    for i, word in enumerate(words):
        if word in words[:i]:
            message = f"expected different values, got {word!r} also at {table}[{words.index(word)}]; change one"
            raise problem(message, table, i, key)


def check_dimensions(config: Config, dimensions: Mapping[str, str]) -> None:
    """Refuse a unit that is of another kind than what its column stands for.

    Args:
        config: the configuration.
        dimensions: target -> dimension, e.g. {"joint:hinge.position": "angle", "actuator:motor": "torque"}; targets
            that are not in it are not checked.

    Raises:
        ConfigError: for such a unit.
    """
    for table in ("commands", "measurements"):
        for i, entry in enumerate(getattr(config, table)):
            try:
                find_unit(entry.unit, dimensions.get(entry.target))
            except ValueError as error:
                where = f"{config.path}: key `{table}[{i}].unit`"
                raise ConfigError(f"{where}: {entry.target} is no such quantity: {error}") from None


def _episodes(path: Path, config: Config) -> tuple[LogEntry, ...]:
    """The logs, each episode as one of its own."""
    column, logs = config.columns.episode, []
    for i, log in enumerate(config.logs):
        if column is None:
            if log.episodes is not None:
                raise ConfigError(f"{path}: key `logs[{i}].episodes`: needs `columns.episode`; name the column there")
            logs.append(log)
            continue
        numbers = episodes_of(log.file, column, config.columns.names) if log.episodes is None else log.episodes
        own = log.episodes is not None and len(log.episodes) == 1 and log.name != log.file.stem
        names = [log.name if own else f"{log.name}-{n}" for n in numbers]
        logs += [
            log.model_copy(update={"name": name, "episodes": (n,)}) for name, n in zip(names, numbers, strict=True)
        ]
    ((name, count),) = Counter(log.name for log in logs).most_common(1)
    if count > 1:
        raise ConfigError(f"{path}: key `logs`: {count} logs are called {name!r}; give each file a `name`")
    return tuple(logs)


def load_config(path: str | Path) -> Config:
    """Read and check a configuration, a TOML file; raises ConfigError for one that cannot be used."""
    path = Path(path)
    try:
        text = read_text(path, "a configuration", "give a TOML file in UTF-8", ConfigError)
    except FileNotFoundError:
        raise ConfigError(f"{path}: no such file; {nearest_file(path)}") from None
    with reading(path, "a configuration", "correct it", ConfigError):
        try:
            data = tomllib.loads(text)
            config = Config.model_validate(data, context={"folder": path.parent, "above": _ABOVE})
        except tomllib.TOMLDecodeError as error:
            raise ConfigError(f"{path}: not valid TOML: {error}; correct that line") from None
        except ValidationError as error:
            raise ConfigError(f"{path}: {one_line(error.errors()[0])}") from None
    config = config.model_copy(update={"logs": _episodes(path, config)})
    config._path = path
    if not config.model.is_file():
        raise ConfigError(f"{path}: key `model`: no such file, got {str(config.model)!r}; {nearest_file(config.model)}")
    return config
