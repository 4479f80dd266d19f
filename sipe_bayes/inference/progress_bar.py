"""How far a long fit is: a bar on a terminal and in a notebook, lines elsewhere."""

from __future__ import annotations

import sys
import threading
import time
import warnings
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from types import TracebackType
    from typing import Self

_CHECKED = 1.0  # s, after which it is looked whether a line is due
_SECONDS = 15.0  # between two lines, and before the first: what is done sooner says nothing


class ProgressBar:
    """A bar by tqdm on standard error; where that is neither a terminal nor a notebook, a line every 15 s.

    Lines come while nothing is reported too, so that long work is not taken for one that hangs.

    It is what ``progress`` of ``sipe.get_estimator``, ``sipe.calibrate`` and ``sipe.discover`` takes::

        with sipe.ProgressBar() as progress:
            calibration = sipe.calibrate(problem, progress=progress)

    Args:
        quiet: show nothing anywhere.
        unit: of what is counted.
        counted: whether lines tell how much is done and how long the rest takes; not where what is being done says so.
    """

    def __init__(self, quiet: bool = False, unit: str = "rollouts", counted: bool = True) -> None:
        self._bar: Any = None
        self._unit, self._counted = unit, counted
        self._began = self._last = time.monotonic()
        self._first = self._before = 0  # what was done when this count began, and last
        self._since: float | None = None  # when it began
        seen = "ipykernel" in sys.modules or sys.stderr.isatty()
        self._lines = not quiet and not seen
        self._latest: tuple[str, int, int] | None = None
        self._lock, self._over = threading.Lock(), threading.Event()
        self._beat: threading.Thread | None = None
        if not quiet and seen:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # a notebook without ipywidgets gets a bar of letters
                from tqdm.auto import tqdm

                self._bar = tqdm(desc="reading", unit=f" {unit}", leave=False, dynamic_ncols=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()

    def stop(self) -> None:
        """End the bar or the lines, if there are any."""
        self._over.set()
        if self._beat is not None:
            self._beat.join(_SECONDS)
            self._beat = None
        if self._bar is not None:
            self._bar.close()
            self._bar = None

    def __call__(self, what: str, done: int, total: int) -> None:
        """Say what is being done, and how much of all is done.

        Args:
            what: is being done.
            done: of the total.
            total: what is done and what is still expected.
        """
        if self._bar is not None:
            self._bar.set_description(what, refresh=False)
            self._bar.total, self._bar.n = total, min(done, total)
            self._bar.refresh()
        elif self._lines:
            self._latest = what, done, total
            if self._beat is None and not self._over.is_set():
                self._beat = threading.Thread(target=self._go_on, daemon=True)
                self._beat.start()
            self._print(what, done, total)

    def _go_on(self) -> None:
        """Say again what is being done, until the end."""
        while not self._over.wait(_CHECKED):
            assert self._latest is not None
            self._print(*self._latest)

    def _print(self, what: str, done: int, total: int) -> None:
        """Print a line where one is due."""
        with self._lock:
            now = time.monotonic()
            if self._since is None or done < self._before:  # another count
                self._first, self._since = done, now
            self._before = done
            if now - self._last >= _SECONDS:
                self._last = now
                print(self._line(what, done, total), file=sys.stderr, flush=True)

    def _line(self, what: str, done: int, total: int) -> str:
        """The time until now, what is being done, how much, and how long the rest takes at the speed until now."""
        line = f"{self._last - self._began:.0f} s: {what}"
        if done >= total or not self._counted:
            return line
        line += f"; {done} of about {total} {self._unit}"
        own = done - self._first  # not what an earlier run did
        if not own:
            return line
        return f"{line}, about {_spoken((self._last - (self._since or 0.0)) * (total - done) / own)} left"


def _spoken(seconds: float) -> str:
    """A duration in words."""
    return f"{seconds:.0f} s" if seconds < 100 else f"{seconds / 60:.0f} min"
