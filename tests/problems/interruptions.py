"""Fits that are interrupted."""

from __future__ import annotations

from collections.abc import Callable


def stop_after(steps: int) -> Callable[[str, int, int], None]:
    """A progress function that interrupts a fit at its step of that number."""
    count = 0

    def progress(what: str, rollouts: int, budget: int) -> None:
        nonlocal count
        count += 1
        if count == steps:
            raise KeyboardInterrupt

    return progress
