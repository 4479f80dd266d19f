"""What may be unknown about a simulator: named parameters with units and bounds.

Everywhere in the library ``theta`` (B, N) is normalised to the unit cube and ``values`` (B, N) are the same
numbers in physical units. A parameter on a linear scale maps affinely, one on a log scale geometrically.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from numbers import Real
from typing import Literal, TypedDict, cast, overload

import numpy as np
from numpy.typing import ArrayLike

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.html import html_table

Scale = Literal["linear", "log"]


class Plain(TypedDict, total=False):
    """A Parameter as JSON has it."""

    name: str
    low: float
    high: float
    default: float | None
    unit: str
    scale: Scale
    targets: list[str]
    relative: bool
    log: str | None
    prior_mean: float | None
    prior_sd: float | None
    description: str


@dataclass(frozen=True)
class Parameter:
    """One unknown of a simulator.

    Args:
        name: unique within its space.
        low: lower bound in ``unit``.
        high: upper bound in ``unit``.
        default: the model's own value, if it has one within the bounds.
        unit: of bounds, default and prior.
        scale: how theta in [0, 1] maps to the value.
        targets: what the value is written to, in the words of the environment.
        relative: until the environment has filled in the model's own value, the bounds are factors of it; several
            targets then keep their proportions.
        log: set when the value holds for that log alone (a nuisance parameter).
        prior_mean: of a normal prior in ``unit``, truncated to the bounds; without it the prior is uniform in theta.
        prior_sd: of that prior. On a log scale it is one of the logarithm, with relative sd ``prior_sd / prior_mean``.
        description: for people.
    """

    name: str
    low: float = 0.0
    high: float = 1.0
    default: float | None = None
    unit: str = ""
    scale: Scale = "linear"
    targets: tuple[str, ...] = ()
    relative: bool = False
    log: str | None = None
    prior_mean: float | None = None
    prior_sd: float | None = None
    description: str = ""

    def __post_init__(self) -> None:
        where = f"parameter {self.name!r}"
        if not isinstance(self.name, str) or not self.name:
            raise ValueError(f"parameter name: expected a non-empty string, got {self.name!r}")
        for field in ("low", "high", "default", "prior_mean", "prior_sd"):
            given = getattr(self, field)
            optional = field in ("default", "prior_mean", "prior_sd")
            if isinstance(given, bool) or not (isinstance(given, Real) or (given is None and optional)):
                raise ValueError(f"{where}: expected a number as {field}, got {given!r}")
        if not (math.isfinite(self.low) and math.isfinite(self.high)):
            raise ValueError(f"{where}: bounds must be finite, got [{self.low}, {self.high}]")
        if self.low >= self.high:
            raise ValueError(
                f"{where}: bounds are reversed or empty, got [{self.low:g}, {self.high:g}]; "
                "give [low, high] with low < high"
            )
        if self.scale not in ("linear", "log"):
            raise ValueError(f"{where}: scale must be 'linear' or 'log', got {self.scale!r}")
        if self.scale == "log" and self.low <= 0:
            raise ValueError(
                f"{where}: a log scale needs bounds above zero, got low = {self.low:g}; "
                "raise it or use scale = 'linear'"
            )
        if self.default is not None and not self.low <= self.default <= self.high:
            raise ValueError(
                f"{where}: the default {self.default:g} {self.unit} lies outside the bounds "
                f"[{self.low:g}, {self.high:g}]; widen the bounds to include it"
            )
        if (self.prior_mean is None) != (self.prior_sd is None):
            raise ValueError(f"{where}: a normal prior needs both mean and sd")
        if self.prior_sd is not None and not self.prior_sd > 0:
            raise ValueError(f"{where}: prior sd must be positive, got {self.prior_sd}")
        if self.scale == "log" and self.prior_mean is not None and self.prior_mean <= 0:
            raise ValueError(f"{where}: prior mean must be positive on a log scale, got {self.prior_mean}")

    @overload
    def normalise(self, value: float) -> float: ...

    @overload
    def normalise(self, value: FloatArray) -> FloatArray: ...

    def normalise(self, value: float | FloatArray) -> float | FloatArray:
        """Theta of a value in ``unit`` (scalar or array)."""
        if self.scale == "log":
            scaled: FloatArray = np.log(np.asarray(value) / self.low) / math.log(self.high / self.low)
            return scaled
        return (np.asarray(value) - self.low) / (self.high - self.low)

    @overload
    def value(self, theta: float) -> float: ...

    @overload
    def value(self, theta: FloatArray) -> FloatArray: ...

    def value(self, theta: float | FloatArray) -> float | FloatArray:
        """The value in ``unit`` of theta (scalar or array)."""
        if self.scale == "log":
            return self.low * np.exp(np.asarray(theta) * math.log(self.high / self.low))
        return self.low + np.asarray(theta) * (self.high - self.low)

    @property
    def theta_prior(self) -> tuple[float, float]:
        """Mean and sd of the normal prior in theta; (0.5, inf) when the prior is uniform."""
        if self.prior_mean is None or self.prior_sd is None:
            return 0.5, math.inf
        mean = float(self.normalise(self.prior_mean))
        if self.scale == "log":
            return mean, self.prior_sd / self.prior_mean / math.log(self.high / self.low)
        return mean, self.prior_sd / (self.high - self.low)


class ParameterSpace(Sequence[Parameter]):
    """An ordered set of parameters; immutable. ``theta`` (..., N) <-> ``values`` (..., N)."""

    def __init__(self, parameters: Iterable[Parameter]) -> None:
        given = (
            None if isinstance(parameters, str | Mapping) or not isinstance(parameters, Iterable) else tuple(parameters)
        )
        if given is None or not all(isinstance(p, Parameter) for p in given):
            what = f"a {type(parameters).__name__}" + (" of other things" if given is not None else "")
            raise ValueError(
                f"parameters: expected a list of Parameters, got {what}; make ParameterSpace([Parameter(name, low, "
                "high), ...])"
            )
        self._parameters = given
        names = [p.name for p in self._parameters]
        if not names:
            raise ValueError("parameters: expected at least one, got none")
        twice = sorted({n for n in names if names.count(n) > 1})
        if twice:
            raise ValueError(f"parameters: the names must differ, but {twice} appear more than once")

    @overload
    def __getitem__(self, key: int) -> Parameter: ...

    @overload
    def __getitem__(self, key: slice) -> tuple[Parameter, ...]: ...

    def __getitem__(self, key: int | slice) -> Parameter | tuple[Parameter, ...]:
        return self._parameters[key]

    def __len__(self) -> int:
        return len(self._parameters)

    def __iter__(self) -> Iterator[Parameter]:
        return iter(self._parameters)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, ParameterSpace) and self._parameters == other._parameters

    def __hash__(self) -> int:
        return hash(self._parameters)

    def __repr__(self) -> str:
        return f"ParameterSpace({', '.join(self.names)})"

    def _repr_html_(self) -> str:
        rows = [(p.name, f"{p.low:g} to {p.high:g}", p.unit, p.scale, ", ".join(p.targets)) for p in self]
        return html_table("ParameterSpace", ("parameter", "bounds", "unit", "scale", "writes"), rows)

    @property
    def names(self) -> tuple[str, ...]:
        """Of the parameters, in order."""
        return tuple(p.name for p in self._parameters)

    @property
    def units(self) -> tuple[str, ...]:
        """Of the parameters, in order."""
        return tuple(p.unit for p in self._parameters)

    def index(self, name: str, *_: object) -> int:
        """Position of the parameter called ``name``."""
        try:
            return self.names.index(name)
        except ValueError:
            raise KeyError(f"no parameter {name!r}; this space has {list(self.names)}") from None

    def subset(self, names: Iterable[str]) -> ParameterSpace:
        """The space of some parameters, in the order given."""
        return ParameterSpace(self._parameters[self.index(n)] for n in names)

    def values(self, theta: ArrayLike) -> FloatArray:
        """Physical values (..., N) of theta (..., N)."""
        checked = self.check_shape(theta)
        return np.stack([p.value(checked[..., j]) for j, p in enumerate(self._parameters)], -1)

    def normalise(self, values: ArrayLike) -> FloatArray:
        """Theta (..., N) of physical values (..., N)."""
        checked = self.check_shape(values)
        return np.stack([p.normalise(checked[..., j]) for j, p in enumerate(self._parameters)], -1)

    @property
    def default_theta(self) -> FloatArray:
        """Theta (N,) of the model's own values; 0.5 where a parameter has none."""
        return np.array([0.5 if p.default is None else float(p.normalise(p.default)) for p in self._parameters])

    @property
    def expected_theta(self) -> FloatArray:
        """Theta (N,) of the means of normal priors, and of the model's own values where a prior is none."""
        means = [p.default if p.prior_mean is None else p.prior_mean for p in self._parameters]
        return np.array([0.5 if x is None else float(p.normalise(x)) for p, x in zip(self, means, strict=True)])

    def check_shape(self, array: ArrayLike) -> FloatArray:
        """``array`` as float64 (..., N); raises ValueError when it is not numbers or its last axis is not N."""
        try:
            checked = np.asarray(array, dtype=np.float64)
        except (TypeError, ValueError):
            raise ValueError(
                f"expected numbers, {len(self)} parameters on the last axis, got a {type(array).__name__}"
            ) from None
        if checked.ndim == 0 or checked.shape[-1] != len(self):
            raise ValueError(f"expected {len(self)} parameters on the last axis, got shape {checked.shape}")
        return checked

    def difference(self, other: ParameterSpace) -> str:
        """In words what makes a theta of this space another one of ``other``, empty where nothing does."""
        if self.names != other.names:
            return f"is over {', '.join(self.names)}, and over {', '.join(other.names)}"
        for mine, theirs in zip(self, other, strict=True):
            if (mine.low, mine.high, mine.scale) != (theirs.low, theirs.high, theirs.scale):
                ours, others = (f"from {p.low:g} to {p.high:g} ({p.scale})" for p in (mine, theirs))
                return f"has {mine.name} {ours}, and {others}"
        return ""

    def to_dict(self) -> list[Plain]:
        """Plain data, for JSON."""
        return [cast(Plain, {**p.__dict__, "targets": list(p.targets)}) for p in self._parameters]

    @classmethod
    def from_dict(cls, items: Iterable[Plain]) -> ParameterSpace:
        """What ``to_dict`` made; raises TypeError for anything else."""
        given: list[dict[str, object]] = [{**item, "targets": tuple(item.get("targets", ()))} for item in items]
        make: Callable[..., Parameter] = Parameter
        return cls(make(**item) for item in given)
