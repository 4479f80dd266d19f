"""Options of a method: one frozen dataclass each, whose fields carry unit, reason and limits.

The constructor's arguments and their check, and the checkpoint's fingerprint, come from the fields; so do the options
of `sipe train`::

    @dataclass(frozen=True)
    class SimOptOptions(Options):
        updates: int = option(12, "REPS updates in an iteration", least=1)
        epsilon: float = option(0.5, "bound on the KL of an update", unit="nats", above=0)
"""

from __future__ import annotations

import dataclasses
import inspect
import math
import types
import typing
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from numbers import Integral, Real
from pathlib import Path
from typing import Any, Self, TypeVar

import numpy as np

from sipe_bayes.core.validation import MOST, nearest_name

T = TypeVar("T")


@dataclass(frozen=True)
class Limits:
    """What an option is and may be; see ``option``."""

    why: str
    unit: str = ""
    least: float | None = None
    most: float | None = None
    above: float | None = None
    below: float | None = None
    among: tuple[str, ...] = ()

    def text(self) -> str:
        """The legal range in words."""
        bounds = (("at least", self.least), ("above", self.above), ("at most", self.most), ("below", self.below))
        words = " and ".join(f"{word} {bound:g}" for word, bound in bounds if bound is not None)
        if words == "above 0":
            return "a positive number"
        whole_range = 0 in (self.least, self.above) and 1 in (self.most, self.below)
        return f"a share {words}" if whole_range else words or "a finite number"

    def allows(self, value: float) -> bool:
        """Whether a number lies within."""
        return (
            math.isfinite(value)
            and (self.least is None or value >= self.least)
            and (self.most is None or value <= self.most)
            and (self.above is None or value > self.above)
            and (self.below is None or value < self.below)
        )


def option(
    default: T,
    why: str,
    unit: str = "",
    *,
    least: float | None = None,
    most: float | None = None,
    above: float | None = None,
    below: float | None = None,
    among: Iterable[str] = (),
) -> T:
    """A field of ``Options``.

    Args:
        default: its value where none is given.
        why: what it does, and why it is so.
        unit: of the value.
        least: inclusive lower limit.
        most: inclusive upper limit.
        above: exclusive lower limit.
        below: exclusive upper limit.
        among: the legal texts.
    """
    limits = Limits(why, unit, least, most, above, below, tuple(among))
    field: T = dataclasses.field(default=default, metadata={"limits": limits})
    return field


@dataclass(frozen=True)
class Options:
    """Base of all options; checks every field by its type and limits.

    Raises:
        ValueError: for a value of another type or beyond its limits; the message names the option and the remedy.
    """

    def __post_init__(self) -> None:
        hints = typing.get_type_hints(type(self))
        for field in dataclasses.fields(self):
            limits = field.metadata.get("limits", Limits(""))
            object.__setattr__(
                self, field.name, _checked(field.name, getattr(self, field.name), hints[field.name], limits)
            )

    @classmethod
    def of(cls, given: Mapping[str, object], method: str) -> Self:
        """Options from keyword arguments; raises TypeError for a name that ``method`` does not take."""
        names = [field.name for field in dataclasses.fields(cls)]
        for name in given:
            if name not in names:
                raise TypeError(
                    f"{method}: takes no option {name!r}{nearest_name(name, names)}; it takes {', '.join(names)}"
                )
        make: Callable[..., Self] = cls
        return make(**given)

    @classmethod
    def parameters(cls) -> list[inspect.Parameter]:
        """The fields as keyword arguments of a constructor."""
        kind = inspect.Parameter.KEYWORD_ONLY
        return [inspect.Parameter(f.name, kind, default=f.default, annotation=f.type) for f in dataclasses.fields(cls)]

    def plain(self) -> dict[str, object]:
        """Names and values as JSON has them, for fingerprints and records."""
        return {f.name: _plain(getattr(self, f.name)) for f in dataclasses.fields(self)}


def _plain(value: Any) -> Any:
    if isinstance(value, Options):
        return value.plain()
    if isinstance(value, tuple | list):
        return [_plain(v) for v in value]
    if isinstance(value, np.ndarray):
        return value.tolist()
    return str(value) if isinstance(value, Path) else value


def _checked(name: str, value: Any, hint: Any, limits: Limits) -> Any:
    """The value as the field's type has it."""
    choices = typing.get_args(hint) if isinstance(hint, types.UnionType) else (hint,)
    if value is None and type(None) in choices:
        return None
    kind = next((c for c in choices if c is not type(None)), object)
    if limits.among:
        if not isinstance(value, str) or value not in limits.among:
            hint = nearest_name(str(value), limits.among)
            raise ValueError(f"{name}: expected one of {', '.join(limits.among)}, got {value!r}{hint}")
        return value
    if kind is bool:
        if not isinstance(value, bool):
            raise ValueError(f"{name}: expected True or False, got {value!r}")
    elif kind in (int, float):
        return _number(name, value, kind, limits)
    elif kind is Path and isinstance(value, str):
        return Path(value)
    elif isinstance(kind, type) and issubclass(kind, Options) and not isinstance(value, kind):
        home = kind.__module__.removeprefix("sipe_bayes.")
        raise ValueError(f"{name}: expected {home}.{kind.__name__}(...), got {value!r}")
    elif typing.get_origin(kind) is tuple:
        return _sequence(name, value, typing.get_args(kind), limits)
    return value


def _sequence(name: str, value: Any, kinds: tuple[Any, ...], limits: Limits) -> tuple[Any, ...]:
    """A tuple of as many values as its type says, each as the type and the limits have it."""
    if not isinstance(value, tuple | list):
        raise ValueError(f"{name}: expected a sequence, got {value!r}")
    every = (kinds[0],) * len(value) if kinds[1:] == (...,) else kinds
    if len(every) != len(value):
        raise ValueError(f"{name}: expected {len(every)} values, got {len(value)}")
    return tuple(_checked(name, v, kind, limits) for v, kind in zip(value, every, strict=True))


def _number(name: str, value: Any, kind: type, limits: Limits) -> Any:
    if isinstance(value, Integral) and abs(int(value)) > MOST:
        raise ValueError(f"{name}: expected at most {MOST}, got more; lower it")
    whole = isinstance(value, Integral) or (isinstance(value, Real) and float(value).is_integer())
    if kind is int and (isinstance(value, bool) or not whole):
        least = max(limits.least or 1, 1)
        raise ValueError(f"{name}: expected a whole number, got {value!r}; give one, such as {least:g}")
    if isinstance(value, bool) or not isinstance(value, Real) or not limits.allows(float(value)):
        raise ValueError(f"{name}: expected {limits.text()}, got {value!r}")
    return kind(value)
