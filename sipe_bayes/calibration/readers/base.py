"""What every log reader gives, and what they share."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import NDArray

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.files import LOG_GIB, LineError, limit

if TYPE_CHECKING:
    import pandas

Columns = dict[str, NDArray[np.generic]]

WIDEST = 512
"""Columns of one array: a wider one is a picture or a map, which is no column of a log."""


class LogError(LineError):
    """A log that cannot be used; the message is one line with the log, the value and the remedy."""


class LogReader(Protocol):
    """Reads one format.

    A reader gives the columns of a file as it finds them: one-dimensional, of any type, in the file's units; which of
    them are commands, measurements and time, and whether they are fit to be used, is checked by those who ask. An array
    ``q`` of two dimensions, (n, k), has the columns ``q[0]`` to ``q[k-1]``, or ``q[NAME]`` where the file names them.
    It runs nothing that the file holds, and asks ``check_size`` before it believes a header.
    """

    def __call__(self, path: Path, wanted: Collection[str]) -> Columns:
        """Read a file.

        Args:
            path: a file or folder that exists and is of the reader's format.
            wanted: columns that will be asked for, none for all. What has nothing to do with them may be left out.

        Returns:
            The columns by name, each (n,); they may differ in length.

        Raises:
            LogError: the file cannot be used and the reader can say why.
            Exception: what a library says of a file that it cannot read; ``read_table`` words it.
        """
        ...


@dataclass(frozen=True)
class Format:
    """A format of logs.

    Args:
        read: its reader.
        columns: what its columns are called, for the reference.
        extra: the extra of this package that brings the library it needs; none where the package itself does.
        remedy: what to do about a file that is broken.
    """

    read: LogReader
    columns: str
    extra: str = ""
    remedy: str = "write it anew"


def largest() -> int:
    """Bytes of a log's columns together: a header that claims more is not believed, and nothing is allocated for it."""
    return int(limit(LOG_GIB) * 2**30)


def check_size(path: Path, size: int) -> None:
    """Refuse a file whose columns would be larger than ``largest``; size in bytes, as it claims them."""
    if size > largest():
        claims = f"claims {size / 2**30:.3g} GiB of columns, the most is {limit(LOG_GIB):g}"
        raise LogError(f"{path}: {claims}; cut it into shorter logs, leave out what is not needed, or set {LOG_GIB}")


def spread(name: str, values: NDArray[np.generic], labels: Sequence[str] = ()) -> Columns:
    """The columns of an array.

    Args:
        name: of the array.
        values: (n,) or (n, k); of any other shape, or with k above ``WIDEST``, it has none.
        labels: k names, all different; otherwise the columns are numbered.
    """
    if values.ndim == 1:
        return {name: plain(values)}
    if values.ndim != 2 or values.shape[1] > WIDEST:
        return {}
    width = values.shape[1]
    words = labels if len(set(labels)) == len(labels) == width else range(width)
    return {f"{name}[{word}]": plain(values[:, j]) for j, word in enumerate(words)}


def spread_all(arrays: Iterable[tuple[str, NDArray[np.generic]]]) -> Columns:
    """The columns of several arrays by their names."""
    return {word: column for name, values in arrays for word, column in spread(name, values).items()}


def frame_columns(frame: pandas.DataFrame) -> Columns:
    """Columns of a table of pandas by name, dates as seconds from the first one."""
    return {str(name): plain(frame[name].to_numpy()) for name in frame.columns}


def plain(values: NDArray[np.generic]) -> NDArray[np.generic]:
    """Dates as seconds from the first one; everything else as it is."""
    if values.dtype.kind == "M":
        values = np.subtract(values, values[:1])
    return np.divide(values, np.timedelta64(1, "s")) if values.dtype.kind == "m" else values


def read_numbers(values: NDArray[np.generic]) -> tuple[FloatArray, int] | None:
    """A column (n,) as numbers, NaN where a cell is text, and how many cells are; None for a column without numbers.

    Text in more than a tenth of the cells is for the caller to refuse: ``is_text``.
    """
    if values.dtype.kind not in "OSU":
        return (values.astype(np.float64), 0) if values.dtype.kind in "biuf" else None
    cells = [_number_in(cell) for cell in values]
    lost = cells.count(None)
    numbers = np.array([np.nan if cell is None else cell for cell in cells], dtype=np.float64)
    return None if lost and not np.isfinite(numbers).any() else (numbers, lost)


def is_text(lost: int, cells: int) -> bool:
    """Whether so much of a column is text that these are no cells that a sensor has missed."""
    return 10 * lost > cells


def _number_in(cell: object) -> float | None:
    """NaN for a blank cell, None for one that is no number."""
    if cell is None or str(cell).strip() == "":
        return np.nan
    try:
        return None if isinstance(cell, complex | np.complexfloating) else float(cell)  # type: ignore[arg-type]
    except (TypeError, ValueError, OverflowError):
        return None
