"""The TOML file of ``sipe calibrate``: its schema, and every check that needs nothing but the file itself.

``load_config`` returns a frozen ``Config`` or raises a ``ConfigError`` of one line that names the key as TOML
writes it, what was expected, what came, and the remedy. Relative paths are relative to the TOML's folder.
What needs the MJCF (does the joint exist, which kind of unit has it) is checked where the model is read.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Self

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    PrivateAttr,
    Strict,
    ValidationError,
    ValidationInfo,
    model_validator,
)
from pydantic_core import ErrorDetails, PydanticCustomError

from sipe_bayes.core.units import find_unit
from sipe_bayes.inference.registry import ESTIMATORS

Use = Literal["train", "holdout"]


class ConfigError(ValueError):
    """A configuration that cannot be used; the message is one line with key, value and remedy."""


def _problem(message: str, *key: str | int) -> PydanticCustomError:
    """An error at ``key`` below the table that is being checked."""
    return PydanticCustomError("problem", "{message}", {"message": message, "key": key})


def nearest(word: str, legal: Iterable[str]) -> str:
    """The remedy for a word that is not in ``legal``: the nearest one, else all."""
    words = [str(w) for w in legal]
    near = get_close_matches(word, words, n=1)
    return f"did you mean {near[0]!r}?" if near else f"use one of {', '.join(map(repr, words))}"


def _resolved(value: Any, info: ValidationInfo) -> Any:
    if not isinstance(value, str | Path):
        return value
    if not str(value).strip():
        raise _problem("expected a path, got an empty string; give the file's name")
    folder = (info.context or {}).get("folder", Path())
    return Path(folder, value)


def _unit_word(word: str) -> str:
    try:
        return find_unit(word).word
    except ValueError as error:
        raise _problem(str(error)) from None


def _time_word(word: str) -> str:
    try:
        return find_unit(word, "time").word
    except ValueError as error:
        raise _problem(str(error)) from None


def _estimator(name: str) -> str:
    if name not in ESTIMATORS:
        raise _problem(f"expected one of {', '.join(ESTIMATORS)}, got {name!r}; {nearest(name, ESTIMATORS)}")
    return name


def _sign(value: Any) -> Any:
    if isinstance(value, bool) or value not in (1, -1):
        raise _problem(f"expected 1 or -1, got {value!r}; a sign only turns the direction, scaling is `unit`")
    return int(value)


def _window(value: Any) -> Any:
    if value == "log":
        return value
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0 < value < float("inf"):
        raise _problem(f"expected a length in seconds above zero, or 'log', got {value!r}; try 0.5 or 'log'")
    return float(value)


Text = Annotated[str, Field(min_length=1), Strict()]
Number = Annotated[float, Strict(), Field(allow_inf_nan=False)]
Positive = Annotated[float, Strict(), Field(gt=0, allow_inf_nan=False)]
Pair = tuple[Number, Number]
Location = Annotated[Path, BeforeValidator(_resolved)]
UnitWord = Annotated[str, Strict(), AfterValidator(_unit_word)]
TimeWord = Annotated[str, Strict(), AfterValidator(_time_word)]
Sign = Annotated[int, BeforeValidator(_sign)]


class Table(BaseModel):
    """A TOML table: frozen, without unknown keys. ``also`` are keys that are turned into others."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    also: ClassVar[tuple[str, ...]] = ()

    @model_validator(mode="before")
    @classmethod
    def _known_keys(cls, data: Any) -> Any:
        if not isinstance(data, Mapping):
            return data
        legal = [field.alias or name for name, field in cls.model_fields.items()] + list(cls.also)
        for key in data:
            if key not in legal:
                raise _problem(f"unknown key; {nearest(str(key), legal)}", str(key))
        return data


class TimeColumn(Table):
    """The column that holds the clock."""

    column: Text = "time"
    unit: TimeWord = "s"


class Columns(Table):
    """Columns that are neither command nor measurement."""

    time: TimeColumn = TimeColumn()


class Resample(Table):
    """The control grid. rate: Hz, default the log's own. max_gap: s, default five sample periods."""

    rate: Positive | None = None
    max_gap: Positive | None = None


class Command(Table):
    """The column that drives one actuator; ``sign`` * column in ``unit``."""

    actuator: Text
    column: Text
    unit: UnitWord
    sign: Sign = 1

    @property
    def target(self) -> str:
        """``actuator:NAME``."""
        return f"actuator:{self.actuator}"


@dataclass(frozen=True)
class MeasurementTarget:
    """What a column measures. kind joint: ``quantity`` of the joint; kind sensor: component ``index``."""

    kind: Literal["joint", "sensor"]
    name: str
    quantity: Literal["position", "velocity", "reading"]
    index: int | None = None


_JOINT = re.compile(r"joint:(?P<name>.+)\.(?P<quantity>position|velocity)")
_SENSOR = re.compile(r"sensor:(?P<name>[^\[\]]+)(\[(?P<index>\d+)\])?")


def parse_measurement_target(target: str) -> MeasurementTarget:
    """Read ``joint:NAME.position``, ``joint:NAME.velocity``, ``sensor:NAME`` or ``sensor:NAME[i]``.

    Raises ValueError on anything else.
    """
    if match := _JOINT.fullmatch(target):
        quantity: Any = match["quantity"]
        return MeasurementTarget("joint", match["name"], quantity)
    if match := _SENSOR.fullmatch(target):
        index = match["index"]
        return MeasurementTarget("sensor", match["name"], "reading", None if index is None else int(index))
    raise ValueError(
        f"expected a measurement target, got {target!r}; "
        "write 'joint:NAME.position', 'joint:NAME.velocity', 'sensor:NAME' or 'sensor:NAME[0]'"
    )


def _measurement_target(target: str) -> str:
    try:
        parse_measurement_target(target)
    except ValueError as error:
        raise _problem(str(error)) from None
    return target


class Measurement(Table):
    """A column that measures a joint or a sensor; ``sign`` * column in ``unit``.

    fit: False keeps it out of the likelihood, for starting windows and plots only. noise_sd: in SI, if known.
    """

    column: Text
    target: Annotated[str, Strict(), AfterValidator(_measurement_target)]
    unit: UnitWord
    sign: Sign = 1
    fit: Annotated[bool, Strict()] = True
    noise_sd: Positive | None = None
    name: Text = ""

    @model_validator(mode="before")
    @classmethod
    def _default_name(cls, data: Any) -> Any:
        if isinstance(data, dict) and "name" not in data and "column" in data:
            return {**data, "name": data["column"]}
        return data


class LogEntry(Table):
    """One log, or one ``span`` (start, stop) of it in seconds from its first sample; ``window`` overrides the
    configuration's for this log."""

    file: Location
    name: Text = ""
    use: Use = "train"
    span: Pair | None = None
    window: Annotated[float | Literal["log"] | None, BeforeValidator(lambda v: None if v is None else _window(v))] = (
        None
    )

    @model_validator(mode="before")
    @classmethod
    def _default_name(cls, data: Any) -> Any:
        if isinstance(data, dict) and "name" not in data and isinstance(data.get("file"), str | Path):
            return {**data, "name": Path(data["file"]).stem}
        return data

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.span is not None:
            _check_ordered(self.span, "span", "[start, stop] in seconds")
            if self.span[0] < 0:
                raise _problem(f"starts before the log, got {list(self.span)}; count seconds from 0", "span")
        return self


def _check_ordered(pair: tuple[float, float], key: str, expected: str) -> None:
    low, high = pair
    if low == high:
        raise _problem(f"expected {expected} with low < high, got [{low:g}, {high:g}]; widen it", key)
    if low > high:
        raise _problem(f"reversed, got [{low:g}, {high:g}]; swap to [{high:g}, {low:g}]", key)


class NormalPrior(Table):
    """A normal prior truncated to the bounds, in the terms that they are given in: SI, or factors of the model's value."""

    mean: Number
    sd: Positive


class ParameterEntry(Table):
    """One unknown. Give ``bounds`` (SI) or ``factor`` (times the model's own value)."""

    also: ClassVar[tuple[str, ...]] = ("target",)

    name: Text
    targets: Annotated[tuple[Text, ...], Field(min_length=1)]
    bounds: Pair | None = None
    factor: Pair | None = None
    scale: Literal["linear", "log"] = "linear"
    prior: NormalPrior | None = None
    per_log: Annotated[bool, Strict()] = False
    description: str = ""

    @model_validator(mode="before")
    @classmethod
    def _one_target(cls, data: Any) -> Any:
        if not isinstance(data, dict):
            return data
        if ("target" in data) == ("targets" in data):
            came = "both" if "target" in data else "neither"
            raise _problem(f"expected either `target` or `targets`, got {came}; give one of them", "target")
        if "target" not in data:
            return data
        if not isinstance(data["target"], str):
            raise _problem(f"expected one string, got {data['target']!r}; for several use `targets`", "target")
        return {**{k: v for k, v in data.items() if k != "target"}, "targets": [data["target"]]}

    @model_validator(mode="after")
    def _check(self) -> Self:
        self._check_bounds()
        if len(set(self.targets)) < len(self.targets):
            raise _problem(f"names a target twice, got {list(self.targets)}; drop one", "targets")
        if self.prior is not None:
            self._check_prior(self.prior)
        return self

    def _check_bounds(self) -> None:
        if (self.bounds is None) == (self.factor is None):
            came = "neither" if self.bounds is None else "both"
            raise _problem(f"expected either `bounds` or `factor`, got {came}; give one of them", "bounds")
        key = "factor" if self.bounds is None else "bounds"
        pair = self.factor if self.bounds is None else self.bounds
        if pair is None:
            return
        _check_ordered(pair, key, "[low, high]")
        if self.scale == "log" and pair[0] <= 0:
            raise _problem(
                f"a log scale needs bounds above zero, got [{pair[0]:g}, {pair[1]:g}]; "
                "raise the lower one or use scale = 'linear'",
                key,
            )

    def _check_prior(self, prior: NormalPrior) -> None:
        pair = self.factor if self.bounds is None else self.bounds
        if pair is not None and not pair[0] <= prior.mean <= pair[1]:
            low, high = pair
            raise _problem(
                f"expected a mean within the bounds [{low:g}, {high:g}], got {prior.mean:g}; widen them",
                "prior",
                "mean",
            )
        if self.scale == "log" and prior.mean <= 0:
            raise _problem(f"expected a mean above zero on a log scale, got {prior.mean:g}", "prior", "mean")


class Noise(Table):
    """The model of the residuals."""

    model: Literal["ar1", "white", "sandwich"] = "ar1"


class PriorSource(Table):
    """An earlier run's posterior (path without suffix) as the prior; in TOML the key is ``from``."""

    source: Location = Field(alias="from")


class Search(Table):
    """How widely the optimum is looked for: starting points followed, and draws from the prior among which they are chosen."""

    restarts: Annotated[int, Strict(), Field(gt=0)] = 2
    candidates: Annotated[int, Strict(), Field(ge=0)] = 8


class Config(Table):
    """A whole configuration; ``load_config`` reads one. ``window`` in seconds, or "log" for whole logs; None where the likelihood
    has no windows."""

    model: Location
    estimator: Annotated[str, Strict(), AfterValidator(_estimator)] = "laplace"
    likelihood: Literal["segments", "state_space"] = "segments"
    window: Annotated[float | Literal["log"] | None, BeforeValidator(_window)] = None
    seed: Annotated[int, Strict(), Field(ge=0)] = 0
    budget: Annotated[int, Strict(), Field(gt=0)] | None = None
    search: Search = Search()
    resample: Resample = Resample()
    columns: Columns = Columns()
    commands: tuple[Command, ...] = ()
    measurements: Annotated[tuple[Measurement, ...], Field(min_length=1)]
    logs: Annotated[tuple[LogEntry, ...], Field(min_length=1)]
    parameters: Annotated[tuple[ParameterEntry, ...], Field(min_length=1)]
    noise: Noise = Noise()
    prior: PriorSource | None = None

    _path: Path = PrivateAttr(default=Path("CONFIG.toml"))

    @property
    def path(self) -> Path:
        """The TOML file this was read from."""
        return self._path

    @property
    def channels(self) -> tuple[str, ...]:
        """Names of the measurements, in the order of a trajectory's observations."""
        return tuple(m.name for m in self.measurements)

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
        _check_unique("logs", "name", [log.name for log in self.logs])
        _check_unique("parameters", "name", [p.name for p in self.parameters])
        self._check_likelihood()
        self._check_targets()
        if not any(m.fit for m in self.measurements):
            raise _problem("expected at least one with fit = true, got none; set one to true", "measurements")
        if not self.logs_for("train"):
            raise _problem("expected at least one with use = 'train', got none; mark one", "logs")
        self._check_holdout()
        return self

    def _check_likelihood(self) -> None:
        """Windows and coloured noise are of segments alone; held-out logs are scored by windows either way."""
        if self.likelihood == "segments":
            if self.window is None:
                raise _problem("missing; add it", "window")
            return
        needless = "given with likelihood = 'state_space', which has no windows; drop it or use likelihood = 'segments'"
        if self.window is not None:
            raise _problem(needless, "window")
        for i, log in enumerate(self.logs):
            if log.window is not None and log.use == "train":
                raise _problem(needless, "logs", i, "window")
        if "model" in self.noise.model_fields_set and self.noise.model != "white":
            raise _problem(
                f"expected 'white' with likelihood = 'state_space', got {self.noise.model!r}; drop it or use "
                "likelihood = 'segments'",
                "noise",
                "model",
            )

    def _check_targets(self) -> None:
        owner: dict[str, str] = {}
        for i, parameter in enumerate(self.parameters):
            for target in parameter.targets:
                if target in owner:
                    raise _problem(
                        f"{target!r} is already driven by parameter {owner[target]!r}; drop it from one",
                        "parameters",
                        i,
                        "targets",
                    )
                owner[target] = parameter.name

    def _check_holdout(self) -> None:
        """A held-out sample that also trains would be no test."""
        for i, held in enumerate(self.logs):
            for train in self.logs_for("train") if held.use == "holdout" else ():
                if held.file == train.file and overlap(held.span, train.span):
                    raise _problem(
                        f"held out, but its samples also train as log {train.name!r}; give spans apart",
                        "logs",
                        i,
                        "use",
                    )


def overlap(a: Pair | None, b: Pair | None) -> bool:
    """Whether two spans in seconds share samples; None is the whole log."""
    return a is None or b is None or (a[0] < b[1] and b[0] < a[1])


def _check_unique(table: str, key: str, words: Sequence[str]) -> None:
    for i, word in enumerate(words):
        if word in words[:i]:
            raise _problem(
                f"expected different values, got {word!r} also at {table}[{words.index(word)}]; change one",
                table,
                i,
                key,
            )


def check_dimensions(config: Config, dimensions: Mapping[str, str]) -> None:
    """Raise ConfigError where a unit is of another kind than what the column stands for.

    dimensions: target -> dimension, e.g. {"joint:hinge.position": "angle", "actuator:motor": "torque"};
    targets that are not in it are not checked.
    """
    tables: tuple[tuple[str, Sequence[Command | Measurement]], ...] = (
        ("commands", config.commands),
        ("measurements", config.measurements),
    )
    for table, entries in tables:
        for i, entry in enumerate(entries):
            try:
                find_unit(entry.unit, dimensions.get(entry.target))
            except ValueError as error:
                where = f"{config.path}: key `{table}[{i}].unit`"
                raise ConfigError(f"{where}: {entry.target} is no such quantity: {error}") from None


def load_config(path: str | Path) -> Config:
    """Read and check a configuration; raises ConfigError."""
    path = Path(path)
    try:
        data = tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise ConfigError(f"{path}: no such file; {nearest_file(path)}") from None
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: cannot be read ({error}); give a TOML file in UTF-8") from None
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{path}: not valid TOML: {error}; correct that line") from None
    try:
        config = Config.model_validate(data, context={"folder": path.parent})
    except ValidationError as error:
        raise ConfigError(f"{path}: {_one_line(error.errors()[0])}") from None
    config._path = path
    if not config.model.is_file():
        raise ConfigError(f"{path}: key `model`: no such file, got {config.model}; {nearest_file(config.model)}")
    return config


def nearest_file(path: Path) -> str:
    """The remedy for a missing file: the nearest name in its folder."""
    if not path.parent.is_dir():
        return f"the folder {path.parent} does not exist; correct the path"
    names = sorted(entry.name for entry in path.parent.iterdir() if entry.is_file())
    near = get_close_matches(path.name, names, n=1, cutoff=0.5)
    return f"did you mean {near[0]!r}?" if near else "correct the path (it is relative to the TOML's folder)"


def _key(location: Iterable[Any]) -> str:
    """A key path in TOML's words: logs[0].file."""
    words = ""
    for part in location:
        words += f"[{part}]" if isinstance(part, int) else f".{part}" if words else str(part)
    return words


def _one_line(error: ErrorDetails) -> str:
    context = error.get("ctx", {})
    key = _key([*error["loc"], *context.get("key", ())])
    where = f"key `{key}`: " if key else ""
    if error["type"] == "problem":
        return where + str(context["message"])
    if error["type"] == "missing":
        return f"{where}missing; add it"
    message = error["msg"].replace("Input should be", "expected").replace("Input should have", "expected")
    got = error["input"]
    remedy = "correct the value"
    if error["type"] == "literal_error":
        remedy = nearest(str(got), re.findall(r"'([^']*)'", str(context.get("expected", ""))))
    return f"{where}{message}, got {_short(got)}; {remedy}"


def _short(value: Any) -> str:
    text = " ".join(repr(value).split())
    return text if len(text) <= 60 else f"{text[:57]}..."
