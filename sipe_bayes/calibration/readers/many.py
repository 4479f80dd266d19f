"""Many logs by one word: files that match a pattern, episodes that a column numbers; and the clock of a column."""

from __future__ import annotations

import glob
import hashlib
import re
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from sipe_bayes.calibration.config_fields import nearest
from sipe_bayes.calibration.readers.base import Columns, LogError
from sipe_bayes.calibration.readers.tables import READERS, read_table
from sipe_bayes.core.arrays import IntArray

_ABOUT = (".json", ".yaml")  # beside the logs of a folder, what tells about them


def matching(path: Path, folder: Path) -> list[Path]:
    """The files that a pattern with ``*``, ``?`` or ``[...]`` matches, numbers in their order.

    Args:
        path: the pattern; without one, or where there is such a file, only that.
        folder: whose own characters are no pattern.
    """
    if not glob.has_magic(str(path)) or path.exists():
        return [path]
    within = path.relative_to(folder) if path.is_relative_to(folder) else path
    files = map(Path, glob.glob(str(Path(glob.escape(str(folder)), within)), recursive=True))
    return sorted(files, key=lambda one: [int(w) if w.isdigit() else w for w in re.split(r"(\d+)", str(one))])


def names_of(paths: list[Path]) -> list[str]:
    """A name for each file: without its suffix, and with its folders where that alone is not different."""
    stems = [path.stem for path in paths]
    if len(set(stems)) == len(stems):
        return stems
    parts = [path.with_suffix("").parts for path in paths]
    same = next(i for i in range(len(parts[0])) if len({part[i : i + 1] for part in parts}) > 1)
    return ["-".join(part[same:]) for part in parts]


def episodes_of(path: Path, column: str, names: Sequence[str] = ()) -> list[int]:
    """The numbers of the episodes in a file, in the order in which they begin; raises LogError where it has none."""
    numbers = episode_numbers(path, read_table(path, [column], names), column)
    distinct = np.unique(numbers, return_index=True)
    episodes = [int(number) for number in distinct[0][np.argsort(distinct[1])]]
    if 2 * len(episodes) > len(numbers):
        raise LogError(
            f"{path}: column {column!r} has {len(episodes)} numbers in {len(numbers)} rows, which are no episodes; "
            "name another one in `columns.episode`"
        )
    return episodes


def episode(table: Columns, numbers: IntArray, number: int) -> Columns:
    """The rows of one episode; columns of another length than its numbers (n,) are left as they are."""
    members = np.flatnonzero(numbers == number)
    if not members.size:
        raise LogError(f"no episode {number}; they go from {numbers.min()} to {numbers.max()}")
    first, last = int(members[0]), int(members[-1]) + 1
    rows = slice(first, last) if last - first == members.size else members  # no copies where they stand together
    return {name: values[rows] if len(values) == len(numbers) else values for name, values in table.items()}


def episode_numbers(path: Path, table: Columns, column: str) -> IntArray:
    """The number of the episode that each row (n,) is of; raises LogError where a column holds none."""
    if column not in table:
        raise LogError(f"{path}: key `columns.episode`: no column {column!r}; {nearest(column, table)}")
    try:
        values = np.asarray(table[column], dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        values = np.array([np.nan])
    if not (np.abs(values) < 2**53).all() or (values != np.round(values)).any():
        raise LogError(f"{path}: column {column!r} is to number the episodes; expected whole numbers in every row")
    return values.astype(np.int64)


def clock_of(table: Columns, column: str, clock: str) -> str:
    """The clock of a column: the one of its own topic, struct or folder, else of the nearest one around it.

    Args:
        table: with the columns.
        column: for example ``/joint_states.position[elbow]``.
        clock: what the clock is called there, for example ``time``.
    """
    depth, ends = 0, []
    for i, letter in enumerate(column):
        depth += (letter == "[") - (letter == "]")
        if letter in "./" and depth == 0:
            ends.append(i + 1)
    around = (f"{column[:end]}{clock}" for end in reversed(ends))
    return next((name for name in around if name in table), clock)


def with_clock(table: Columns, clock: str, rate: float | None) -> Columns:
    """The table with a clock for rows that come at ``rate`` Hz; as it is without one.

    Raises:
        LogError: where it has such a column already.
    """
    if rate is None:
        return table
    if clock in table:
        raise LogError(f"`columns.time.rate` is for logs without a clock, but there is a column {clock!r}; drop it")
    rows = max((len(values) for values in table.values()), default=0)
    return {**table, clock: np.arange(rows) / rate}


def digest(path: Path) -> str:
    """SHA-256 of a file; of a folder, of the names and contents of its logs and of what tells about them."""
    if path.is_file():
        return _sha256(path)
    kept = (file for file in sorted(path.rglob("*")) if file.suffix in (*READERS, *_ABOUT) and file.is_file())
    return combined(word for file in kept for word in (file.relative_to(path).as_posix(), _sha256(file)))


def combined(words: Iterable[str]) -> str:
    """SHA-256 of several words."""
    return hashlib.sha256("\n".join(words).encode()).hexdigest()


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
