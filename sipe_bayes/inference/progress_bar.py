"""How far a long fit is, as a bar on a terminal and in a notebook."""

from __future__ import annotations

import sys
import warnings
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from types import TracebackType
    from typing import Self


class ProgressBar:
    """A bar by tqdm, on standard error; nothing where that is neither a terminal nor a notebook.

    It is what ``progress`` of ``sipe.get_estimator``, ``sipe.calibrate`` and ``sipe.discover`` takes::

        with sipe.ProgressBar() as progress:
            calibration = sipe.calibrate(problem, progress=progress)

    Args:
        quiet: show nothing anywhere.
        unit: of what is counted.
    """

    def __init__(self, quiet: bool = False, unit: str = "rollouts") -> None:
        self._bar: Any = None
        if not quiet and ("ipykernel" in sys.modules or sys.stderr.isatty()):
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
        """End the bar, if there is one."""
        if self._bar is not None:
            self._bar.close()
            self._bar = None

    def __call__(self, what: str, done: int, total: int) -> None:
        """Say what is being done, and how much of all is done."""
        if self._bar is not None:
            self._bar.set_description(what, refresh=False)
            self._bar.total, self._bar.n = total, min(done, total)
            self._bar.refresh()
