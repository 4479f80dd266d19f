"""The tables of the TOML file of ``sipe calibrate``, each with the checks that need nothing but itself."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Self

from pydantic import AfterValidator, BeforeValidator, Field, Strict, ValidationInfo, model_validator

from sipe_bayes.calibration.config_fields import (
    Budget,
    ExtensionName,
    Location,
    Number,
    OwnExtension,
    Pair,
    Positive,
    Sign,
    Table,
    TargetWord,
    Text,
    TimeWord,
    Tolerance,
    UnitWord,
    Use,
    VoltageWord,
    Window,
    check_ordered,
    log_words,
    overlap,
    parse_measurement_target,
    problem,
)
from sipe_bayes.calibration.readers.many import matching, names_of
from sipe_bayes.core.units import find_unit
from sipe_bayes.structure.tolerances import COMMANDS


class TimeColumn(Table):
    """The column that holds the clock."""

    column: Text = "time"
    """column with the clock"""
    unit: TimeWord = "s"
    """its unit; to be named where rows are a quarter of a second apart or more"""
    rate: Positive | None = None
    """Hz, of logs without a clock: rows come evenly"""


class Columns(Table):
    """Columns that are neither command nor measurement."""

    time: TimeColumn = TimeColumn()
    names: tuple[Text, ...] = ()
    """what the columns of a CSV without a header are called, in their order"""
    episode: Text | None = None
    """column that numbers the episodes of a file, each of which is then a log of its own; `"data/demo_*"` for numbered
    groups of HDF5, `"runs[*]"` for cells of MATLAB"""


class Resample(Table):
    """The control grid."""

    rate: Positive | None = None
    """Hz of the control grid; default the log's own rate"""
    max_gap: Positive | None = None
    """seconds; wider holes are masked; default five sample periods"""


class Supply(Table):
    """The voltage that a motor's driver is fed with."""

    column: Text
    """column with the voltage that the driver is fed with; a duty times it is what the motor gets"""
    unit: VoltageWord = "V"
    """its unit"""
    nominal: Positive | None = None
    """V at which the controller of the model is as strong as the MJCF says; with `rate`"""


class Command(Table):
    """A column that drives an actuator; ``sign`` * ``factor`` * (column - ``zero``) in ``unit``, times its supply."""

    actuator: Text
    """name of the driven actuator in the MJCF; a `[[commands]]` for each"""
    column: Text
    """the log's column that drives it; under position control the set-point"""
    unit: UnitWord
    """unit of that column"""
    sign: Sign = 1
    """1 or -1"""
    factor: Positive = 1.0
    """what the column is multiplied by beside its unit"""
    zero: Number = 0.0
    """what the column says where the model's command is 0; taken off before all else"""
    tolerance: Tolerance = COMMANDS
    """sd of what a motor or position servo delivers, as a share of what the column says: a motor constant is known to
    about a tenth, and masses are off by as much. The intervals with what the model lacks allow for it. 0: exact"""
    rate: Positive | None = None
    """Hz at which [firmware](../firmware.md) evaluates the controller, and holds its output between; default always"""
    supply: Supply | None = None
    """`{ column = "battery" }`: its voltage scales a duty, or with `rate` and `nominal` what the controller puts out"""

    @property
    def target(self) -> str:
        """``actuator:NAME``."""
        return f"actuator:{self.actuator}"

    @property
    def fed(self) -> Command | None:
        """The supply as a column that drives a control of its own: V of a duty, share of nominal of a controller."""
        if self.supply is None:
            return None
        nominal, column = self.supply.nominal or 1.0, self.supply.column
        name = f"supply:{column}/{nominal:g}"
        return Command(actuator=name, column=column, unit=self.supply.unit, factor=1 / nominal)

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.supply is None:
            return self
        if (self.rate is None) != (self.supply.nominal is None):
            raise problem("a controller with `rate` needs it, a duty needs neither; give both", "supply.nominal")
        if self.rate is None and find_unit(self.unit).dimension != "dimensionless":
            raise problem(f"got {self.unit!r}; a supply scales a duty, '1' or '%', or a controller with `rate`", "unit")
        return self


class Measurement(Table):
    """A column that measures a joint, body or sensor; ``sign`` * ``factor`` * (column - ``zero``) in ``unit``.

    A vector has three ``columns``; an orientation four, and three channels, its rotation vector (rad).
    """

    column: Text | None = None
    """the log's column; a `[[measurements]]` for each measured quantity"""
    columns: tuple[Text, ...] = ()
    """in place of `column`: three of a vector, four of a quaternion"""
    quaternion: Literal["wxyz", "xyzw"] | None = None
    """`"wxyz"` or `"xyzw"`: their order; signs are aligned, residuals are rotation vectors (rad)"""
    target: TargetWord
    """`"joint:NAME.position"`, `"joint:NAME.velocity"`, `"joint:NAME.force"` (what actuators apply there, such as the
    effort of a servo), `"body:NAME.position"`, `.orientation`, `.linear_velocity`, `.angular_velocity` (of a body's
    frame in the world's axes), `"sensor:NAME"` or `"sensor:NAME[0]"` of the MJCF, as of a `tendonpos`"""
    unit: UnitWord
    """unit of that column; its kind is checked against the model"""
    sign: Sign = 1
    """1 or -1"""
    factor: Positive = 1.0
    """what the column is multiplied by beside its unit"""
    zero: Number = 0.0
    """what the column reads where the model has 0, as a height above the floor does; taken off before all else"""
    wraps: Annotated[bool, Strict()] = False
    """`true`: the angle comes round, and jumps by a turn are taken out"""
    fit: Annotated[bool, Strict()] = True
    """`false`: not fitted; it only tells where simulations start, and is drawn"""
    noise_sd: Positive | None = None
    """standard deviation of the noise in SI, where known; default estimated"""
    name: Text = ""
    """default the column's name"""

    @model_validator(mode="before")
    @classmethod
    def _default_name(cls, data: Any) -> Any:
        if not isinstance(data, dict):
            return data
        target = str(data.get("target", "")).partition(":")[2]
        unit = {"unit": "1"} if "quaternion" in data or target.endswith(".orientation") else {}
        name = {"name": data.get("column", target)} if "column" in data or target else {}
        return {**unit, **name, **data}

    @property
    def sources(self) -> tuple[str, ...]:
        """The log's columns."""
        return self.columns or (self.column or "",)

    @property
    def channels(self) -> tuple[tuple[str, str], ...]:
        """(target, name) of each channel."""
        if not self.columns:
            return ((self.target, self.name),)
        part = f"{self.target}.rotation" if self.quaternion and self.target.startswith("sensor:") else self.target
        return tuple((f"{part}[{i}]", f"{self.name}_{axis}") for i, axis in enumerate("xyz"))

    @model_validator(mode="after")
    def _check(self) -> Self:
        target = parse_measurement_target(self.target)
        if (self.column is None) != bool(self.columns):
            came = "both" if self.columns else "neither"
            raise problem(f"expected either `column` or `columns`, got {came}; give one of them", "column")
        whole = target.kind != "joint" and target.index is None
        turns = target.quantity == "orientation" or (target.kind == "sensor" and self.quaternion is not None)
        if turns and self.quaternion is None:
            expected = "an orientation is four columns of a quaternion; name their order"
            raise problem(f"{expected}, quaternion = 'wxyz' or 'xyzw'", "quaternion")
        if self.quaternion and not (turns and whole):
            raise problem(f"{self.target} is no orientation; drop it", "quaternion")
        size = 4 if turns else 3 if target.kind == "body" and whole else 0
        if size and len(self.columns) != size:
            message = f"{self.target} is {size} columns, got {list(self.sources)}; give `columns` in order"
            raise problem(message, "columns")
        if self.columns and not (whole and len(self.columns) in (3, 4 * turns)):
            message = f"{self.target} is one column, or a sensor's three, got {list(self.columns)}; use `column`"
            raise problem(message, "columns")
        if self.wraps and (find_unit(self.unit).dimension != "angle" or self.columns):
            raise problem(f"only one angle comes round, got {self.unit!r} and {list(self.sources)}; drop it", "wraps")
        if self.columns and self.zero:
            raise problem("a vector has none; move the frame in the MJCF instead", "zero")
        if turns and (self.sign, self.factor) != (1, 1.0):
            raise problem("a quaternion has none; turn the frame in the MJCF instead", "sign")
        return self


class LogEntry(Table):
    """One log, or one ``span`` (start, stop) of it in seconds from its first sample; or all that a pattern names.

    A ``file`` with ``*`` is all files that match, and where ``columns.episode`` is given, each episode is a log; of
    those in ``episodes``, else of all. ``window`` overrides the configuration's for this log.
    """

    file: Location
    """a file or folder of one of the [formats](logs.md), or a pattern such as `"tosses/*.csv"` for all that
    match; a `[[logs]]` for each log or part of one. `logs = "tosses/*.csv"` is short for one such table"""
    name: Text = ""
    """default the file's name without suffix; logs of one table are numbered"""
    use: Use = "train"
    """`"train"` or `"holdout"`"""
    episodes: Annotated[tuple[Annotated[int, Strict()], ...], Field(min_length=1)] | None = None
    """numbers of those episodes that are meant; default all"""
    span: Pair | None = None
    """`[start, stop]` in seconds from the first sample; default all"""
    window: Window = None
    """overrides `window` for this log; with `"state_space"`, over what a held-out log is scored (default 0.5 s)"""
    added: dict[Text, Positive] = Field(default_factory=dict)
    """kg that this log, to train on or held out, has more than the model: `{"body:load.mass" = 3.0}` of a known load"""

    @model_validator(mode="before")
    @classmethod
    def _default_name(cls, data: Any) -> Any:
        if isinstance(data, dict) and "name" not in data and isinstance(data.get("file"), str | Path):
            return {**data, "name": Path(data["file"]).stem}
        return data

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.span is not None:
            check_ordered(self.span, "span", "[start, stop] in seconds")
            if self.span[0] < 0:
                raise problem(f"starts before the log, got {list(self.span)}; count seconds from 0", "span")
        if self.episodes is not None and len(set(self.episodes)) < len(self.episodes):
            raise problem(f"names an episode twice, got {list(self.episodes)}; drop one", "episodes")
        return self

    def meets(self, other: LogEntry) -> bool:
        """Whether two parts of one file share samples."""
        apart = self.episodes is not None and other.episodes is not None and not {*self.episodes} & {*other.episodes}
        return not apart and overlap(self.span, other.span)


def _matched(logs: tuple[LogEntry, ...], info: ValidationInfo) -> tuple[LogEntry, ...]:
    """Each log whose file is a pattern as the files that match it."""
    entries: list[LogEntry] = []
    for i, log in enumerate(logs):
        files = matching(log.file, (info.context or {}).get("folder", Path()))
        if not files:
            raise problem(f"no file matches {log.file}; correct the pattern", i, "file")
        names = names_of(files) if log.name == log.file.stem else [f"{log.name}-{k}" for k in range(len(files))]
        names = [log.name] if files == [log.file] else names
        entries += [log.model_copy(update={"file": f, "name": name}) for f, name in zip(files, names, strict=True)]
    return tuple(entries)


Logs = Annotated[tuple[LogEntry, ...], Field(min_length=1), BeforeValidator(log_words), AfterValidator(_matched)]


class NormalPrior(Table):
    """A normal prior truncated to the bounds, in their terms: SI, or factors of the model's value."""

    mean: Number
    """normal prior within the bounds: its mean, in SI, or beside `factor` in factors; default uniform on the scale"""
    sd: Positive
    """its standard deviation"""


class ParameterEntry(Table):
    """One unknown. Give ``bounds`` (SI) or ``factor`` (times the model's own value)."""

    also: ClassVar[dict[str, str]] = {"target": "what it changes, see [targets](targets.md)"}

    name: Text
    """of the unknown; a `[[parameters]]` for each"""
    targets: Annotated[tuple[Text, ...], Field(min_length=1)]
    """several of them in place of `target`: all get its value, or with `factor` keep their proportions"""
    bounds: Pair | None = None
    """`[low, high]` in SI"""
    factor: Pair | None = None
    """`[low, high]` times the model's own value, in place of `bounds`"""
    scale: Literal["linear", "log"] = "linear"
    """`"linear"` or `"log"`"""
    prior: NormalPrior | None = None
    per_log: Annotated[bool, Strict()] = False
    """a value of its own in every training log, as for zero errors, and their mean in a held-out one"""
    description: str = ""
    """free text"""

    @model_validator(mode="before")
    @classmethod
    def _one_target(cls, data: Any) -> Any:
        if not isinstance(data, dict):
            return data
        if ("target" in data) == ("targets" in data):
            came = "both" if "target" in data else "neither"
            raise problem(f"expected either `target` or `targets`, got {came}; give one of them", "target")
        if "target" not in data:
            return data
        if not isinstance(data["target"], str):
            raise problem(f"expected one string, got {data['target']!r}; for several use `targets`", "target")
        return {**{k: v for k, v in data.items() if k != "target"}, "targets": [data["target"]]}

    @property
    def range(self) -> Pair:
        """The bounds, or the factors of the model's value."""
        return self.bounds or self.factor or (0.0, 1.0)

    @model_validator(mode="after")
    def _check(self) -> Self:
        self._check_bounds()
        if len(set(self.targets)) < len(self.targets):
            raise problem(f"names a target twice, got {list(self.targets)}; drop one", "targets")
        if self.prior is not None:
            self._check_prior(self.prior)
        return self

    def _check_bounds(self) -> None:
        if (self.bounds is None) == (self.factor is None):
            came = "neither" if self.bounds is None else "both"
            raise problem(f"expected either `bounds` or `factor`, got {came}; give one of them", "bounds")
        key = "factor" if self.bounds is None else "bounds"
        low, high = self.range
        check_ordered(self.range, key, "[low, high]")
        if self.scale == "log" and low <= 0:
            expected = f"a log scale needs bounds above zero, got [{low:g}, {high:g}]"
            raise problem(f"{expected}; raise the lower one or use scale = 'linear'", key)

    def _check_prior(self, prior: NormalPrior) -> None:
        low, high = self.range
        if not low <= prior.mean <= high:
            expected = f"expected a mean within the bounds [{low:g}, {high:g}]"
            raise problem(f"{expected}, got {prior.mean:g}; widen them", "prior", "mean")
        if self.scale == "log" and prior.mean <= 0:
            raise problem(f"expected a mean above zero on a log scale, got {prior.mean:g}", "prior", "mean")


class Noise(Table):
    """The model of the residuals."""

    model: Literal["ar1", "white", "sandwich"] = "ar1"
    """residuals: `"ar1"` (first-order autoregressive), `"white"`, or `"sandwich"`: plain least squares with the
    width that autoregressive residuals imply (`laplace` only; for models that are wrong at low frequencies)"""


class PriorSource(Table):
    """An earlier run's posterior (path without suffix) as the prior; in TOML the key is ``from``."""

    source: Location = Field(alias="from")
    """path without suffix of an earlier run's posterior, the prior of the parameters that it knows by name"""


class Search(Table):
    """How widely the optimum is looked for."""

    restarts: Annotated[int, Strict(), Field(gt=0, le=10_000)] = 2
    """of `laplace` and `mcmc`: starting points at most; more than one where the fit is poor; with 1 `laplace` looks for
    no other optimum where it is good"""
    candidates: Annotated[int, Strict(), Field(ge=0, le=1_000_000)] = 8
    """how many points are simulated to choose them from, besides the model as given. They are drawn from the
    prior; from 40 on, the later ones around the best so far"""
    start: dict[str, Number] | None = None
    """of `laplace`: values by parameter, in SI, where the search begins instead, as `sipe discover` writes them"""


class Structure(Table):
    """What ``sipe discover`` may put into the model."""

    only: tuple[ExtensionName, ...] | None = None
    """of `sipe discover`: names of the [extensions](extensions.md) that it may try; default all"""
    without: tuple[ExtensionName, ...] = ()
    """names that it leaves out"""
    extra: tuple[OwnExtension, ...] = ()
    """extensions of your own beside them: `"path/to/file.py:Class"` or `"package.module:Class"`"""
    sites: Annotated[tuple[Text, ...], Field(min_length=1)] | None = None
    """joints, actuators, bodies and channels where extensions may be placed; default all"""
    budget: Budget | None = None
    """rollouts of all its fits; default 30,000"""
    weight: Annotated[float, Strict(), Field(gt=0, le=1)] = 1.0
    """stacking weight of this structure among those that the logs do not tell apart, as `sipe discover` writes it"""

    @model_validator(mode="after")
    def _check(self) -> Self:
        left = [name for name in self.only or () if name not in self.without]
        if self.only is not None and not (left or self.extra):
            raise problem("expected at least one name beside `without`, got none; add one or drop the key", "only")
        return self
