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


def stop_in_stage(number: int, calls: int = 1) -> Callable[[str, int, int], None]:
    """A progress function that interrupts a search in its stage of that number, at its call of that number there."""
    seen: dict[str, int] = {}

    def progress(what: str, rollouts: int, budget: int) -> None:
        stage = what.partition(": ")[0]
        seen[stage] = seen.get(stage, 0) + 1
        if len(seen) == number and seen[stage] == calls:
            raise KeyboardInterrupt

    return progress
