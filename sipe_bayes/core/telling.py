"""How what takes its time says what it is doing."""

from __future__ import annotations

from collections.abc import Callable

Tell = Callable[[str], object]
"""Called with what is being done."""


def silent(what: str) -> None:
    """A ``Tell`` that says nothing."""
