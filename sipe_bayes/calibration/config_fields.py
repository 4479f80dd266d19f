"""What a key of the TOML file may hold: types with their checks, and errors as one line with key, value and remedy."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    Strict,
    ValidationInfo,
    model_validator,
)
from pydantic_core import ErrorDetails, PydanticCustomError

from sipe_bayes.core.files import LineError, is_file, is_folder
from sipe_bayes.core.units import find_unit
from sipe_bayes.core.validation import MOST_ROLLOUTS, nearest_name
from sipe_bayes.inference.registry import ESTIMATORS
from sipe_bayes.structure.registry import EXTENSIONS

_LISTED = 30  # words in a line
_LEAST = 1e-30  # of a number beside zero, and one over it the most, in SI: squares stay numbers


class ConfigError(LineError):
    """A configuration that cannot be used; the message is one line with key, value and remedy."""


def problem(message: str, *key: str | int) -> PydanticCustomError:
    """An error at ``key`` below the table that is being checked; ``one_line`` says it."""
    return PydanticCustomError("problem", "{message}", {"message": message, "key": key})


def nearest(word: str, legal: Iterable[str]) -> str:
    """The remedy for a word that is not in ``legal``: the nearest one, else all, or the first of many."""
    words = [str(w) for w in legal]
    return nearest_name(word, words).removeprefix("; ") or f"use one of {listed(list(map(repr, words)))}"


def listed(words: Sequence[str]) -> str:
    """Words one after the other, of many the first."""
    others = f" and {len(words) - _LISTED} others" if len(words) > _LISTED else ""
    return ", ".join(words[:_LISTED]) + others


def nearest_file(path: Path) -> str:
    """The remedy for a missing file: the nearest name in its folder."""
    if not is_folder(path.parent):
        return f"the folder {path.parent} does not exist; correct the path"
    names = sorted(entry.name for entry in path.parent.iterdir() if entry.is_file())
    return nearest_name(path.name, names, 0.5).removeprefix("; ") or (
        "correct the path (it is relative to the TOML's folder)"
    )


def _resolved(value: Any, info: ValidationInfo) -> Any:
    if not isinstance(value, str | Path):
        return value
    if not str(value).strip():
        raise problem("expected a path, got an empty string; give the file's name")
    if not str(value).isprintable():
        raise problem(f"expected a path, got {str(value)!r} with characters that cannot be printed; give another")
    path = Path((info.context or {}).get("folder", Path()), value)
    try:
        path.exists()
    except OSError as error:  # too long, or in a folder that is closed
        raise problem(f"expected a path, got {str(value)!r} ({error.strerror}); give another") from None
    return path


def _read_by(read: Callable[[str], str]) -> AfterValidator:
    """The check that ``read`` makes; what it says of a wrong word is the error."""

    def check(word: str) -> str:
        try:
            return read(word)
        except ValueError as error:
            raise problem(str(error)) from None

    return AfterValidator(check)


def _estimator(name: str) -> str:
    if name not in ESTIMATORS:
        raise problem(f"expected one of {', '.join(ESTIMATORS)}, got {name!r}; {nearest(name, ESTIMATORS)}")
    return name


def _extension(name: str) -> str:
    if name not in EXTENSIONS:
        hint = nearest_name(name, EXTENSIONS).removeprefix("; ") or f"known are {', '.join(EXTENSIONS)}"
        raise problem(f"no extension {name!r}; {hint}; one of your own goes into `extra`")
    return name


def _own_extension(word: str, info: ValidationInfo) -> str:
    """``package.module:Class`` as it stands; the path of ``path/to/file.py:Class`` from the TOML's folder."""
    module, _, kind = word.rpartition(":")
    if not (module and kind.isidentifier()):
        raise problem(f"expected 'path/to/file.py:Class' or 'package.module:Class', got {word!r}; name the class")
    if not module.endswith(".py"):
        return word
    path = Path((info.context or {}).get("folder", Path()), module)
    if not is_file(path):
        raise problem(f"no such file, got {path}; {nearest_file(path)}")
    return f"{path}:{kind}"


def _checked_sign(value: Any) -> int:
    if isinstance(value, bool) or value not in (1, -1):
        raise problem(f"expected 1 or -1, got {value!r}; a sign only turns the direction, scaling is `factor`")
    return int(value)


def _window(value: object) -> object:
    if value == "log":
        return value
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0 < value < float("inf"):
        raise problem(f"expected a length in seconds above zero, or 'log', got {value!r}; try 0.5 or 'log'")
    return float(value)


@dataclass(frozen=True)
class MeasurementTarget:
    """What a column measures.

    Args:
        kind: of what it is.
        name: of the joint, body or sensor.
        quantity: of the joint or body; ``reading`` of a sensor.
        index: of the body's or sensor's component, if it has several.
    """

    kind: Literal["joint", "body", "sensor"]
    name: str
    quantity: Literal["position", "velocity", "orientation", "linear_velocity", "angular_velocity", "force", "reading"]
    index: int | None = None


_JOINT = re.compile(r"joint:(?P<name>.+)\.(?P<quantity>position|velocity|force)")
_BODY = re.compile(
    r"body:(?P<name>[^\[\]]+)\.(?P<quantity>position|orientation|linear_velocity|angular_velocity)"
    r"(\[(?P<index>[0-2])\])?"
)
_SENSOR = re.compile(r"sensor:(?P<name>[^\[\]]+)(\[(?P<index>\d+)\])?")


def parse_measurement_target(target: str) -> MeasurementTarget:
    """Read ``joint:NAME.position``, ``body:NAME.orientation``, ``sensor:NAME``, ``sensor:NAME[i]`` and their like.

    Raises:
        ValueError: for anything else.
    """
    for kind, pattern in (("joint", _JOINT), ("body", _BODY), ("sensor", _SENSOR)):
        if match := pattern.fullmatch(target):
            parts: dict[str, Any] = match.groupdict()
            index = parts.get("index")
            return MeasurementTarget(
                kind,  # type: ignore[arg-type]
                parts["name"],
                parts.get("quantity", "reading"),
                None if index is None else int(index),
            )
    raise ValueError(
        f"expected a measurement target, got {target!r}; write 'joint:NAME.position', 'joint:NAME.velocity', "
        "'joint:NAME.force', 'body:NAME.position', 'body:NAME.orientation', 'body:NAME.linear_velocity', "
        "'body:NAME.angular_velocity', "
        "'sensor:NAME' or 'sensor:NAME[0]'"
    )


def _sized(value: float) -> float:
    """A number whose square is one, too."""
    if value and not _LEAST <= abs(value) <= 1 / _LEAST:
        raise problem(
            f"expected a size from {_LEAST:g} to {1 / _LEAST:g}, or zero, got {value:g}; correct it, or its unit"
        )
    return value


def _share(value: float) -> float:
    if not 0 <= value <= 1:
        raise problem(f"expected a share from 0 to 1, got {value:g}; give one such as 0.05, or 0 where it is exact")
    return value


def _target(word: str) -> str:
    parse_measurement_target(word)
    return word


Text = Annotated[str, Field(min_length=1, max_length=500), Strict()]
ExtensionName = Annotated[Text, AfterValidator(_extension)]
OwnExtension = Annotated[Text, AfterValidator(_own_extension)]
Budget = Annotated[int, Strict(), Field(gt=0, le=MOST_ROLLOUTS)]
Use = Literal["train", "holdout"]
Number = Annotated[float, Strict(), Field(allow_inf_nan=False), AfterValidator(_sized)]
Positive = Annotated[float, Strict(), Field(gt=0, allow_inf_nan=False), AfterValidator(_sized)]
Tolerance = Annotated[float, Strict(), AfterValidator(_share)]
"""How far off a number of the model may be, as a share."""
Pair = tuple[Number, Number]
Location = Annotated[Path, BeforeValidator(_resolved)]
UnitWord = Annotated[str, Strict(), _read_by(lambda word: find_unit(word).word)]
TimeWord = Annotated[str, Strict(), _read_by(lambda word: find_unit(word, "time").word)]
VoltageWord = Annotated[str, Strict(), _read_by(lambda word: find_unit(word, "voltage").word)]
Sign = Annotated[int, BeforeValidator(_checked_sign)]
EstimatorName = Annotated[str, Strict(), AfterValidator(_estimator)]
TargetWord = Annotated[str, Strict(), _read_by(_target)]
Window = Annotated[float | Literal["log"] | None, BeforeValidator(lambda v: None if v is None else _window(v))]
"""Seconds, or "log" for whole logs."""


class Table(BaseModel):
    """A TOML table: frozen, without unknown keys. A key's description is the docstring below its field.

    ``also`` are keys that are turned into others, with their descriptions.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, use_attribute_docstrings=True)
    also: ClassVar[dict[str, str]] = {}

    @model_validator(mode="before")
    @classmethod
    def _known_keys(cls, data: Any, info: ValidationInfo) -> Any:
        if not isinstance(data, Mapping):
            return data
        above = (info.context or {}).get("above", ())
        legal = [field.alias or name for name, field in cls.model_fields.items()] + list(cls.also)
        for key in data:
            if key not in legal and key in above:
                raise problem("a key of the whole file, not of a table; put it above the first line with [", str(key))
            if key not in legal:
                raise problem(f"unknown key; {nearest(str(key), legal)}", str(key))
        return data


def log_words(value: object) -> object:
    """``logs = "tosses/*.csv"`` as the table that it stands for."""
    words = [value] if isinstance(value, str) else value
    if isinstance(words, list) and all(isinstance(word, str) for word in words):
        return [{"file": word} for word in words]
    return value


def overlap(a: Pair | None, b: Pair | None) -> bool:
    """Whether two spans in seconds share samples; None is the whole log."""
    return a is None or b is None or (a[0] < b[1] and b[0] < a[1])


def check_ordered(pair: tuple[float, float], key: str, expected: str) -> None:
    """Refuse a pair at ``key`` whose first number is not the smaller one; ``expected`` says what it stands for."""
    low, high = pair
    if low == high:
        raise problem(f"expected {expected} with low < high, got [{low:g}, {high:g}]; widen it", key)
    if low > high:
        raise problem(f"reversed, got [{low:g}, {high:g}]; swap to [{high:g}, {low:g}]", key)


def _key(location: Iterable[Any]) -> str:
    """A key path in TOML's words: logs[0].file."""
    words = ""
    for part in location:
        words += f"[{part}]" if isinstance(part, int) else f".{part}" if words else str(part)
    return words


def one_line(error: ErrorDetails) -> str:
    """What pydantic says of a value, as key, value and remedy."""
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
