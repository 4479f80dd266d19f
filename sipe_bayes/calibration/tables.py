"""Tables of a log: the columns of a CSV, Parquet or npz file by name."""

from __future__ import annotations

import csv
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sipe_bayes.calibration.config_fields import nearest_file

Columns = dict[str, NDArray[Any]]


class LogError(ValueError):
    """A log that cannot be used; the message is one line with the log, the value and the remedy."""


def read_table(path: str | Path) -> Columns:
    """The columns of a CSV, Parquet or npz file by name; raises LogError.

    CSV may be separated by comma, semicolon, tab or blanks; its first line names the columns. Parquet's dates
    become seconds from the first one. A two-dimensional npz array ``states`` (n, k) becomes ``states:0`` ..
    ``states:{k-1}``; npz columns may differ in length.
    """
    path = Path(path)
    if not path.is_file():
        raise LogError(f"{path}: no such file; {nearest_file(path)}")
    readers = {".csv": _read_csv, ".parquet": _read_parquet, ".npz": _read_npz}
    reader = readers.get(path.suffix.lower())
    if reader is None:
        raise LogError(f"{path}: expected a .csv, .parquet or .npz file, got {path.suffix!r}; convert it")
    try:
        columns = reader(path)
    except LogError:
        raise
    except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
        reason = " ".join(str(error).split())
        raise LogError(f"{path}: cannot be read as {path.suffix} ({reason}); write it anew") from None
    if not columns or not max(len(values) for values in columns.values()):
        raise LogError(f"{path}: holds no samples; record the log again or drop it")
    return columns


def _read_csv(path: Path) -> Columns:
    import pandas as pd

    with path.open(encoding="utf-8-sig", newline="") as file:
        header, first = file.readline().rstrip("\r\n"), file.readline()
    separator = _separator(header)
    names = [name.strip() for name in _split(header.lstrip("# "), separator)]
    if any(_is_number(name) for name in names):
        raise LogError(f"{path}: the first line must name the columns, got {header[:40]!r}; add a header line")
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise LogError(f"{path}: column {twice[0]!r} appears more than once; rename one of them")
    frame = pd.read_csv(
        path,
        sep=separator,
        names=names,
        skiprows=1,
        index_col=False,
        decimal="," if separator == ";" and "," in first and "." not in first else ".",
        skipinitialspace=True,
        encoding="utf-8-sig",
        **_exact_floats(pd.__version__),
    )
    return _frame_columns(frame)


def _exact_floats(version: str) -> dict[str, Any]:
    """What makes this pandas read every float exactly; from 3.1 it always does."""
    major, minor = (int(part) for part in version.split(".")[:2])
    return {} if (major, minor) >= (3, 1) else {"float_precision": "round_trip"}


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


def _read_parquet(path: Path) -> Columns:
    import pyarrow.parquet

    return _frame_columns(pyarrow.parquet.read_table(path).to_pandas(ignore_metadata=True))


def _frame_columns(frame: Any) -> Columns:
    return {str(name): _plain(frame[name].to_numpy()) for name in frame.columns}


def _plain(values: NDArray[Any]) -> NDArray[Any]:
    """Dates as seconds from the first one; everything else as it is."""
    if values.dtype.kind == "M":
        return (values - values[0]) / np.timedelta64(1, "s")
    return values / np.timedelta64(1, "s") if values.dtype.kind == "m" else values


def _read_npz(path: Path) -> Columns:
    columns: Columns = {}
    with np.load(path, allow_pickle=False) as data:
        for key in data.files:
            try:
                array = data[key]
            except ValueError:
                raise LogError(
                    f"{path}: array {key!r} holds Python objects, which are not read; save it as numbers"
                ) from None
            if array.ndim == 1:
                columns[key] = _plain(array)
            elif array.ndim == 2:
                columns.update({f"{key}:{j}": _plain(array[:, j]) for j in range(array.shape[1])})
    return columns
