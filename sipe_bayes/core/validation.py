"""What a user gives, checked in one way: a ValueError of one line names the argument, what was expected, what came."""

from __future__ import annotations

import difflib
import math
import os
from collections.abc import Iterable
from numbers import Integral, Real
from pathlib import Path

MOST_ROLLOUTS = 10**9
"""Of a budget: what takes weeks on any machine."""
MOST = 2**63 - 1
"""Of a whole number: what fits into one of 64 bits."""


def most_threads() -> int:
    """Native threads, or processes: beyond four times the processors they only wait for one another."""
    return 4 * cores()


def whole(name: str, value: object, least: int = 1, unit: str = "", most: int = MOST) -> int:
    """``value`` as a whole number; 1e3 is one, True and "3" are not.

    Args:
        name: of the argument, for the message.
        value: what was given.
        least: that it may be.
        unit: of it, for the message.
        most: that it may be.

    Raises:
        ValueError: for anything else, as all checks here do.
    """
    if isinstance(value, bool) or not isinstance(value, Real):
        raise ValueError(f"{name}: expected a whole number, got {_shown(value)}; give one, such as {max(least, 1)}")
    number = int(value) if isinstance(value, Integral) else float(value)
    if isinstance(number, float) and not number.is_integer():
        raise ValueError(f"{name}: expected a whole number, got {_shown(value)}; give one, such as {max(least, 1)}")
    if number < least:
        counted = unit.removesuffix("s") if least == 1 else unit
        raise ValueError(f"{name}: expected at least {least}{unit and ' '}{counted}, got {value}")
    if number > most:
        raise ValueError(f"{name}: expected at most {most}{unit and ' '}{unit}, got {number:.4g}")
    return int(number)


def at_least(name: str, value: object, least: float) -> float:
    """``value`` as a finite float of at least ``least``."""
    if isinstance(value, bool) or not isinstance(value, Real) or not least <= float(value) < math.inf:
        raise ValueError(f"{name}: expected at least {least:g}, got {_shown(value)}")
    return float(value)


def positive(name: str, value: object) -> float:
    """``value`` as a finite float above zero."""
    if isinstance(value, bool) or not isinstance(value, Real) or not 0 < float(value) < math.inf:
        raise ValueError(f"{name}: expected a positive number, got {_shown(value)}")
    return float(value)


def flag(name: str, value: object) -> bool:
    """``value`` if it is True or False."""
    if not isinstance(value, bool):
        raise ValueError(f"{name}: expected True or False, got {_shown(value)}")
    return value


def one_of(name: str, value: object, known: Iterable[str]) -> str:
    """``value`` if it is one of the ``known`` texts."""
    known = tuple(known)
    if not isinstance(value, str) or value not in known:
        raise ValueError(f"{name}: expected one of {', '.join(known)}, got {_shown(value)}")
    return value


def path(name: str, value: object) -> Path | None:
    """``value`` as a Path; None stays."""
    if value is None:
        return None
    if not isinstance(value, str | os.PathLike) or not str(value):
        raise ValueError(f"{name}: expected a path, got {_shown(value)}")
    return Path(value)


def _shown(value: object) -> str:
    """Short: a number or text as it is, of anything else the type."""
    return repr(value) if isinstance(value, Real | str | None) else f"a {type(value).__name__}"


def cores() -> int:
    """Processors that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def nearest_name(name: str, known: Iterable[str], cutoff: float = 0.6) -> str:
    """``"; did you mean 'NAME'?"`` for the known name that is most alike, empty where none is.

    Args:
        name: what was given.
        known: the legal names.
        cutoff: how alike they have to be, from 0 to 1.
    """
    close = difflib.get_close_matches(name, list(known), 1, cutoff)
    return f"; did you mean {close[0]!r}?" if close else ""
