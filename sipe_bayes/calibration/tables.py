"""Tables of a log: the columns of a file by name, whatever its format."""

from __future__ import annotations

import zipfile
from pathlib import Path

from sipe_bayes.calibration.config_fields import nearest_file
from sipe_bayes.calibration.readers.base import Columns, LogError, LogReader
from sipe_bayes.calibration.readers.csv_table import read_csv
from sipe_bayes.calibration.readers.npz_arrays import read_npz
from sipe_bayes.calibration.readers.parquet_table import read_parquet

READERS: dict[str, LogReader] = {".csv": read_csv, ".parquet": read_parquet, ".npz": read_npz}
"""The one list of formats, by the suffix of a file."""


def read_table(path: str | Path) -> Columns:
    """The columns of a log's file by name.

    Args:
        path: a file with a suffix of ``READERS``.

    Returns:
        The columns, each (n,); those of an npz may differ in length.

    Raises:
        LogError: there is no such file, no reader for it, or nothing in it that can be read.
    """
    path = Path(path)
    if not path.is_file():
        raise LogError(f"{path}: no such file; {nearest_file(path)}")
    reader = READERS.get(path.suffix.lower())
    if reader is None:
        *others, last = READERS
        raise LogError(f"{path}: expected a {', '.join(others)} or {last} file, got {path.suffix!r}; convert it")
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
