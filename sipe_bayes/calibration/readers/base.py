"""What every log reader gives, and what they share."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    import pandas

Columns = dict[str, NDArray[np.generic]]


class LogError(ValueError):
    """A log that cannot be used; the message is one line with the log, the value and the remedy."""


class LogReader(Protocol):
    """Reads one format.

    A reader gives the columns of a file as it finds them: one-dimensional, of any type, in the file's units; which of
    them are commands, measurements and time, and whether they are fit to be used, is checked by those who ask.
    """

    def __call__(self, path: Path) -> Columns:
        """Read a file.

        Args:
            path: a file that exists and has the reader's suffix.

        Returns:
            The columns by name, each (n,); they may differ in length.

        Raises:
            LogError: the file cannot be used and the reader can say why.
            ValueError: what a library says of a file that it cannot read; ``read_table`` words it.
        """
        ...


def frame_columns(frame: pandas.DataFrame) -> Columns:
    """Columns of a table of pandas by name, dates as seconds from the first one."""
    return {str(name): plain(frame[name].to_numpy()) for name in frame.columns}


def plain(values: NDArray[np.generic]) -> NDArray[np.generic]:
    """Dates as seconds from the first one; everything else as it is."""
    if values.dtype.kind == "M":
        return (values - values[0]) / np.timedelta64(1, "s")
    return np.divide(values, np.timedelta64(1, "s")) if values.dtype.kind == "m" else values
