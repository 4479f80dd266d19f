"""How far a long command is."""

from __future__ import annotations

import sys
from typing import Any


class Progress:
    """A bar on a terminal; nothing when piped."""

    def __init__(self, quiet: bool = False, unit: str = "rollouts") -> None:
        self._bar: Any = None
        if not quiet and sys.stderr.isatty():
            from rich.console import Console
            from rich.progress import BarColumn, TextColumn, TimeElapsedColumn
            from rich.progress import Progress as Bar

            columns = (TextColumn("{task.description}"), BarColumn(), TextColumn(f"{{task.completed}} {unit}"))
            self._bar = Bar(*columns, TimeElapsedColumn(), console=Console(stderr=True), transient=True)
            self._task = self._bar.add_task("reading", total=None)

    def __enter__(self) -> Progress:
        if self._bar is not None:
            self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def stop(self) -> None:
        """End the bar, if there is one."""
        if self._bar is not None:
            self._bar.stop()
            self._bar = None

    def update(self, what: str, rollouts: int, budget: int) -> None:
        """Say what is being done, and how many rollouts of the budget are used."""
        if self._bar is not None:
            self._bar.update(self._task, description=what, completed=rollouts, total=budget)
