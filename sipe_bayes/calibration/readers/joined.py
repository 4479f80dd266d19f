"""A folder of CSV files that are one log, each with a clock of its own, and ``joint_list.txt`` with a name a line.

So SAGE records servos: ``control.positions[elbow]`` beside ``control.timestamp``. Lists of as many entries as there are
names have these names. The format: https://github.com/isaac-sim2real/sage
"""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path

from sipe_bayes.calibration.readers.base import Columns, LogError
from sipe_bayes.calibration.readers.csv_table import read_csv
from sipe_bayes.core.files import read_text

JOINTS = "joint_list.txt"


def read_joined(path: Path, wanted: Collection[str]) -> Columns:
    """The columns of all files, each behind its file's name."""
    names = [line.strip() for line in _names(path).splitlines() if line.strip()]
    if twice := next((name for name in names if names.count(name) > 1), None):
        raise LogError(f"{path / JOINTS}: {twice!r} stands in it twice; give each joint a name of its own")
    columns: Columns = {}
    for file in sorted(path.glob("*.csv")):
        own = read_csv(file, ())
        for name, values in own.items():
            word, _, number = name.rstrip("]").rpartition("[")
            is_list = name.endswith("]") and number.isdecimal() and f"{word}[{len(names) - 1}]" in own
            labelled = is_list and f"{word}[{len(names)}]" not in own
            columns[f"{file.stem}.{word}[{names[int(number)]}]" if labelled else f"{file.stem}.{name}"] = values
    if not columns:
        raise LogError(f"{path}: no CSV file beside {JOINTS}; name the log's file")
    return columns


def _names(path: Path) -> str:
    return read_text(path / JOINTS, "names of joints, one a line", "write one name a line", LogError)
