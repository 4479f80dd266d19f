"""Tables of text, separated by comma, semicolon, tab or blanks; the first line that is no remark names the columns.

Cells that hold a list, ``"[0.1, 0.2]"``, are columns of their own, ``q[0]`` and ``q[1]``.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Literal, TextIO

import numpy as np
from numpy.typing import NDArray

from sipe_bayes.calibration.readers.base import Columns, LogError, check_size, frame_columns, spread_all

_LONGEST = 2**17  # characters of a header or a name: what the csv module takes
_DATE = re.compile(r"\d{4}-\d\d-\d\d[T ]\d\d:")
_NAMED = "the file names its columns itself: drop --columns (`columns.names`)"
_REMARKS = 200  # lines above the header that are looked through


def read_csv(path: Path, wanted: Collection[str], given: Sequence[str] = ()) -> Columns:
    """The columns; a comma is the decimal sign where semicolons separate. Those without a header have given names."""
    import pandas as pd

    check_size(path, path.stat().st_size)
    with path.open(encoding="utf-8-sig", newline="") as file:
        above, header, first = _opening(file)
    if len(header) >= _LONGEST - 2:
        raise LogError(f"{path}: the first line is longer than {_LONGEST} characters; is it a table of columns?")
    separator = _separator(header)
    names = [name.strip() for name in _split(header.lstrip("#% "), separator)]
    if given:
        above, first = (above, first) if header.lstrip()[:1] in ("#", "%") else (above - 1, header)
        if not _is_row(first) or _width(first) != len(given):
            shown = f"its first row is {first[:40]!r}"
            remedy = f"it has {_width(first)}: correct --columns (`columns.names`)" if _is_row(first) else _NAMED
            raise LogError(f"{path}: {len(given)} names are given for a table without a header, {shown}; {remedy}")
        separator, names = _separator(first), list(given)
    elif any(_is_number(name) for name in names):
        raise LogError(
            f"{path}: the first line must name the columns, got {header[:40]!r}; add such a line, or --columns t,q,..."
        )
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise LogError(f"{path}: column {twice[0]!r} appears more than once; rename one of them")
    frame = pd.read_csv(
        path,
        sep=separator,
        names=names,
        skiprows=above + 1,
        index_col=False,
        decimal="," if separator == ";" and "," in first and "." not in first else ".",
        skipinitialspace=True,
        encoding="utf-8-sig",
        float_precision=_float_precision(pd.__version__),
    )
    return spread_all((name, _rows(cells)) for name, cells in frame_columns(frame).items())


def _rows(cells: NDArray[np.generic]) -> NDArray[np.generic]:
    """Lists in cells (n,) as an array (n, k), NaN where one is blank; other cells as they are."""
    if cells.dtype.kind == "O" and len(cells) and _DATE.match(str(cells[0])):
        return _seconds(cells)
    if cells.dtype.kind != "O" or not all(cell != cell or str(cell).strip()[:1] in ("[", "(") for cell in cells):
        return cells
    rows = [None if cell != cell else str(cell).strip(" [()]").replace(",", " ").split() for cell in cells]
    width = max((len(row) for row in rows if row is not None), default=0)
    try:
        return np.array([[np.nan] * width if row is None else row for row in rows], dtype=np.float64)
    except ValueError:
        return cells


def _seconds(cells: NDArray[np.generic]) -> NDArray[np.generic]:
    """Dates and times (n,) of ISO 8601 in s since 1970; other text as it is."""
    import pandas as pd

    try:
        times = pd.to_datetime(pd.Series(cells), format="ISO8601", utc=True)
    except ValueError:
        return cells
    return np.asarray((times - pd.Timestamp(0, tz="UTC")) / pd.Timedelta(seconds=1), dtype=np.float64)


def _opening(file: TextIO) -> tuple[int, str, str]:
    """How many lines of remarks stand above the header, the header, and the line after it.

    A remark is an empty line or one that begins with ``#`` or ``%``; where rows follow, the header is the last that has
    as many names as the first row has cells.
    """
    header, first, remarks = file.readline(_LONGEST).rstrip("\r\n"), file.readline(_LONGEST), list[str]()
    for above in range(_REMARKS):
        marked = bool(header.strip()) and header.lstrip()[0] in "#%"
        if marked and _is_row(first):
            return above, next((line for line in [header, *remarks] if _width(line) == _width(first)), header), first
        if not first or not (marked or not header.strip()):
            return above, header, first
        remarks.insert(0, header)
        header, first = first.rstrip("\r\n"), file.readline(_LONGEST)
    return _REMARKS, header, first


def _is_row(line: str) -> bool:
    """Whether a line holds a number and is no remark."""
    plain = line.strip()
    return bool(plain) and plain[0] not in "#%" and any(map(_is_number, _split(plain, _separator(plain))))


def _width(line: str) -> int:
    """How many cells a line has, without the mark of a remark."""
    plain = line.strip().lstrip("#% ")
    return len(_split(plain, _separator(plain)))


def _float_precision(version: str) -> Literal["round_trip"] | None:
    """What makes this pandas read every float exactly; from 3.1 it always does."""
    major, minor = (int(part) for part in version.split(".")[:2])
    return None if (major, minor) >= (3, 1) else "round_trip"


def _separator(header: str) -> str:
    for separator in (",", ";", "\t"):
        if separator in header:
            return separator
    return r"\s+"


def _split(header: str, separator: str) -> list[str]:
    return (
        header.split()
        if separator == r"\s+"
        else next(csv.reader([header], delimiter=separator, skipinitialspace=True))
    )


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return text.strip().lower() not in ("nan", "inf", "infinity")
