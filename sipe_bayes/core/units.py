"""Units of log columns: a small table of unit words, each with its factor to SI and its dimension.

A dimension is a word such as ``"angle"`` or ``"length"``; it keeps a hinge's position from being given in m.
Radians and dimensionless numbers are different dimensions here, on purpose.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.validation import nearest_name

_TABLE: dict[str, tuple[str, dict[str, float]]] = {
    "time": ("s", {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0}),
    "angle": ("rad", {"rad": 1.0, "mrad": 1e-3, "deg": math.pi / 180, "rev": 2 * math.pi}),
    "angular velocity": (
        "rad/s",
        {"rad/s": 1.0, "deg/s": math.pi / 180, "rev/s": 2 * math.pi, "rpm": 2 * math.pi / 60},
    ),
    "angular acceleration": ("rad/s^2", {"rad/s^2": 1.0, "deg/s^2": math.pi / 180}),
    "length": ("m", {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6}),
    "velocity": ("m/s", {"m/s": 1.0, "cm/s": 1e-2, "mm/s": 1e-3, "km/h": 1 / 3.6}),
    "acceleration": ("m/s^2", {"m/s^2": 1.0, "g0": 9.80665}),
    "torque": ("N m", {"N m": 1.0, "Nm": 1.0, "N*m": 1.0, "mN m": 1e-3, "mNm": 1e-3}),
    "force": ("N", {"N": 1.0, "mN": 1e-3, "kN": 1e3}),
    "mass": ("kg", {"kg": 1.0, "g": 1e-3}),
    "voltage": ("V", {"V": 1.0, "mV": 1e-3}),
    "current": ("A", {"A": 1.0, "mA": 1e-3}),
    "dimensionless": ("1", {"1": 1.0, "%": 1e-2}),
}


@dataclass(frozen=True)
class Unit:
    """One unit word: ``factor`` times a value in it is the value in the SI unit ``si``."""

    word: str
    factor: float
    si: str
    dimension: str


UNITS: dict[str, Unit] = {
    word: Unit(word, factor, si, dimension)
    for dimension, (si, words) in _TABLE.items()
    for word, factor in words.items()
}
DIMENSIONS: tuple[str, ...] = tuple(_TABLE)


def unit_words(dimension: str | None = None) -> list[str]:
    """The legal unit words, of one dimension or of all."""
    return [u.word for u in UNITS.values() if dimension in (None, u.dimension)]


def find_unit(word: str, dimension: str | None = None) -> Unit:
    """The unit of a word.

    Args:
        word: such as ``"deg"``.
        dimension: that it has to be of, if any.

    Raises:
        ValueError: for an unknown word, and for a word of another dimension.
    """
    if dimension is not None and dimension not in _TABLE:
        raise ValueError(f"unknown dimension {dimension!r}; use one of {', '.join(DIMENSIONS)}")
    unit = UNITS.get(" ".join(word.split()))
    if unit is None:
        raise ValueError(_unknown(word, dimension))
    if dimension is not None and unit.dimension != dimension:
        legal = ", ".join(repr(w) for w in unit_words(dimension))
        raise ValueError(f"expected a unit of {dimension}, got {word!r} ({unit.dimension}); use one of {legal}")
    return unit


def _unknown(word: str, dimension: str | None) -> str:
    words = unit_words(dimension)
    same = next((w for w in words if w.lower() == word.lower()), None)
    hint = nearest_name(word, words) or (f"; did you mean {same!r}?" if same else ";")
    return f"expected a unit word, got {word!r}{hint} use one of {', '.join(map(repr, words))}"


def to_si(unit: str) -> tuple[float, str]:
    """Factor to SI and the SI unit's name: ``to_si("deg") == (pi / 180, "rad")``."""
    word = find_unit(unit)
    return word.factor, word.si


def convert(values: ArrayLike, unit: str, dimension: str | None = None) -> FloatArray:
    """Values in SI.

    Args:
        values: in ``unit``, of any shape.
        unit: a unit word.
        dimension: that the unit has to be of.

    Raises:
        ValueError: for a word that is none, or of another dimension.
    """
    factor = find_unit(unit, dimension).factor
    array = np.asarray(values, dtype=np.float64)
    return array if factor == 1.0 else array * factor
