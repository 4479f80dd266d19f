"""Numbers and names as words of a report."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence

from sipe_bayes.core.thresholds import THRESHOLDS
from sipe_bayes.core.units import UNITS
from sipe_bayes.diagnostics.records import ChannelNoise

_PER = {"command": "unit of command", "position": "rad or m", "velocity": "rad/s or m/s"}  # of an actuator's numbers
_RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
_LAST_WORD = re.compile(r"^(.*\w)[\s_.\-]*[\s_.\-\[(]([^\s_\[\]()]+)[\])]?$")


def significant(value: float, sd: float, scale: float | None = None) -> str:
    """A value to the second significant digit of its sd: 0.69751 with 0.0030 is "0.6975".

    Args:
        value: the number.
        sd: its uncertainty; without one, four significant digits.
        scale: the largest of several numbers that stand together, so that all of them are written alike, either
            plainly or, below 0.001 and from a million on, with a power of ten.
    """
    if not math.isfinite(value):
        return "–"
    if not (math.isfinite(sd) and sd > 0):
        return f"{value:.4g}"
    last = math.floor(math.log10(float(f"{sd:.1e}"))) - 1
    size = max(abs(value), abs(scale or 0.0), sd)
    exponent = math.floor(math.log10(size))
    if -4 < exponent < 6:
        return f"{round(value, -last) + 0.0:.{max(-last, 0)}f}"
    return f"{round(value / 10.0**exponent, exponent - last) + 0.0:.{max(exponent - last, 0)}f}e{exponent}"


def number(value: float | None, digits: int = 3) -> str:
    """``value`` to some significant digits, as short as it goes; a dash when it is missing or not finite."""
    if value is None or not math.isfinite(float(value)):
        return "–"
    rounded = float(f"{float(value):.{digits - 1}e}")
    text = f"{rounded:.0f}" if 10 ** (digits - 1) <= abs(rounded) < 1e6 else f"{rounded:.{digits}g}"
    return re.sub(r"e([+-])0*", r"e\1", text).replace("e+", "e")


def error_text(value: float) -> str:
    """An error to three significant digits, zeros included."""
    return f"{value:#.3g}".rstrip(".") if 1e-4 <= abs(value) < 1000 else number(value)


def times(ratio: float) -> str:
    """An error ratio (model as given over calibrated) in words; 0 where simulations of the calibrated one diverge."""
    if not math.isfinite(ratio):
        return "–"
    if not ratio:
        return "it diverges"
    if 1 / THRESHOLDS.alike < ratio < THRESHOLDS.alike:
        return "about the same"
    factor, word = (ratio, "smaller") if ratio > 1 else (1 / ratio, "larger")
    return f"{factor:.1f} times {word}" if factor < 9.95 else f"{number(factor, 2)} times {word}"


def correlation_time(noise: ChannelNoise) -> str:
    """How long noise remembers, in words; where it is at its limit, that it is."""
    if not noise.tau:
        return "white"
    text = f"{number(noise.tau)} s"
    return f"{text} or more (as long as the logs)" if noise.tau_at_limit else text


def listed(names: Sequence[str]) -> str:
    """The names as words of a sentence: "a, b and c"."""
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}" if names else ""


def unit_text(unit: str) -> str:
    """``unit`` for the eye: "kg m^2" with a raised 2, nothing for the unit "1", of an actuator what it may be."""
    of, per, by = unit.partition("/")
    if of == "force" or by == "command":
        top = "N or N m" if of == "force" else of
        return f"{top} per {_PER.get(by, by)}" if per else top
    return "" if unit == "1" else re.sub(r"\^(-?\d+)", lambda power: power[1].translate(_RAISED), unit)


def with_unit(name: str, unit: str, separator: str = " ") -> str:
    """``name [unit]``, the name alone where there is no unit: ``with_unit("pan_deg", "rad") == "pan [rad]"``.

    Args:
        name: of a quantity; another unit of the same dimension at its end, as of a log's column, is left out.
        unit: its unit; empty for none.
        separator: what stands before the bracket.
    """
    last = _LAST_WORD.match(name)
    if last and last[2] != unit and last[2] in UNITS and unit in UNITS:
        name = last[1] if UNITS[last[2]].dimension == UNITS[unit].dimension else name
    text = unit_text(unit)
    return f"{name}{separator}[{text}]" if text else name


def shortened(text: str, length: int) -> str:
    """``text``, its middle left out when it is longer than ``length``."""
    if len(text) <= length:
        return text
    half = (length - 1) // 2
    return f"{text[:half]}…{text[-half:]}"
