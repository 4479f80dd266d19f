"""Episodes that a file holds side by side, in numbered groups or cells: ``data/demo_0/q``, ``runs[0].q``.

With ``*`` in place of the number, ``data/demo_*/q`` and ``runs[*].q`` are the columns of all of them one below the
other, and ``data/demo_*`` and ``runs[*]`` number the episodes. Within an episode a column may be one sample shorter
than the longest, as commands beside states are; what is shorter still is no signal and is left out.
"""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Iterable, Mapping

import numpy as np
from numpy.typing import NDArray

from sipe_bayes.calibration.readers.base import Columns

_UPTO = re.compile(r"[^*]*\*\]?")
_NUMBER = re.compile(r"(\d+)(\]?)(?=[./\[])")  # of a group or cell with something below it
_FEWEST = 20  # samples of a signal


def starred(names: Iterable[str]) -> list[str]:
    """What numbers the episodes of columns with ``*`` in their names."""
    return sorted({match[0] for name in names if (match := _UPTO.match(name))})


def gathered(columns: Mapping[str, NDArray[np.generic]], prefix: str) -> Columns:
    """Columns of all episodes one below the other, and the one that numbers them, called ``prefix``.

    Args:
        columns: of the file.
        prefix: with ``*`` for the number, as ``starred`` gives it.
    """
    before, after = prefix.split("*")
    pattern = re.compile(f"{re.escape(before)}(\\d+){re.escape(after)}(?=[./\\[])")
    episodes: dict[int, Columns] = defaultdict(dict)
    for name, values in columns.items():
        if match := pattern.match(name):
            episodes[int(match[1])][name[match.end() :]] = values
    pieces: dict[str, list[NDArray[np.generic]]] = defaultdict(list)
    numbers = []
    for number, own in sorted(episodes.items()):
        rows = max(map(len, own.values()))
        signals = {name: values for name, values in own.items() if rows - len(values) <= 1}
        numbers.append(np.full(rows, number))
        for name in {*signals, *pieces}:
            values = signals.get(name, np.full(rows, np.nan))
            before_it = sum(map(len, numbers[:-1])) - sum(map(len, pieces[name]))
            pieces[name] += [np.full(before_it, np.nan)] * bool(before_it)
            pieces[name].append(values if len(values) == rows else np.append(values.astype(np.float64), np.nan))
    out: Columns = {f"{prefix}{name}": np.concatenate(parts) for name, parts in pieces.items()}
    return out | {prefix: np.concatenate(numbers)} if numbers else out


def numbered(columns: Mapping[str, NDArray[np.generic]], words: Iterable[str]) -> str | None:
    """What numbers a file's episodes, where it holds some; joints in numbered groups are none.

    Args:
        columns: of the file.
        words: that the names of episodes have; without one of them, groups of different lengths are episodes.
    """
    families: dict[str, dict[int, set[int]]] = defaultdict(lambda: defaultdict(set))
    for name, values in columns.items():
        for match in _NUMBER.finditer(name):
            if len(values) >= _FEWEST:
                families[f"{name[: match.start()]}*{match[2]}"][int(match[1])].add(len(values))
    for prefix, members in sorted(families.items(), key=lambda item: len(item[0])):
        lengths = {max(own) for own in members.values()}
        spoken = any(word in prefix.lower() for word in words)
        if len(members) > 1 and (spoken or len(lengths) > 1):
            return prefix
    return None
