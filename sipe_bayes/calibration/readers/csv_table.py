"""Tables of text, separated by comma, semicolon, tab or blanks; the first line that is no remark names the columns."""

from __future__ import annotations

import csv
from collections.abc import Collection
from pathlib import Path
from typing import Literal, TextIO

from sipe_bayes.calibration.readers.base import Columns, LogError, check_size, frame_columns

_LONGEST = 2**17  # characters of a header or a name: what the csv module takes
_REMARKS = 200  # lines above the header that are looked through


def read_csv(path: Path, wanted: Collection[str]) -> Columns:
    """The columns; a comma is the decimal sign where semicolons separate."""
    import pandas as pd

    check_size(path, path.stat().st_size)
    with path.open(encoding="utf-8-sig", newline="") as file:
        above, header, first = _opening(file)
    if len(header) >= _LONGEST - 2:
        raise LogError(f"{path}: the first line is longer than {_LONGEST} characters; is it a table of columns?")
    separator = _separator(header)
    names = [name.strip() for name in _split(header.lstrip("#% "), separator)]
    if any(_is_number(name) for name in names):
        raise LogError(f"{path}: the first line must name the columns, got {header[:40]!r}; add a header line")
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
    return frame_columns(frame)


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
