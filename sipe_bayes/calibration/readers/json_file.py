"""JSON: a list of records, lists by name, either below a name, or pieces of such: ``q``, ``arm.q``, ``runs[0].q``.

Where all samples lie in one place, columns have no name of it before theirs. Pieces are episodes. ``null`` is masked;
single numbers beside the samples are left out.
"""

from __future__ import annotations

import json
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sipe_bayes.calibration.readers.base import WIDEST, Columns, LogError, check_size, spread_all
from sipe_bayes.core.files import read_text

Found = tuple[str, str, NDArray[np.generic]]
"""Where an array was found, its name there, and itself."""


def read_json_log(path: Path, wanted: Collection[str]) -> Columns:
    """The columns of all lists that the file holds."""
    data = json.loads(read_text(path, "a log of JSON", "write it anew", LogError), parse_int=float)
    found = list(_columns(path, "", data))
    places = {where for where, _, _ in found}
    alone = len(places) == 1 and not places.pop().endswith("]")
    return spread_all((f"{where}.{name}" if where and not alone else name, values) for where, name, values in found)


def _columns(path: Path, where: str, data: Any) -> Iterator[Found]:
    """The arrays within a value."""
    if isinstance(data, dict):
        for key, value in data.items():
            if isinstance(value, dict) or _has_names(value):
                yield from _columns(path, f"{where}.{key}" if where else key, value)
            elif isinstance(value, list):
                yield from _array(where, key, value)
    elif isinstance(data, list) and _are_rows(data):
        yield from _records(path, where, data)
    elif _has_names(data):
        for i, piece in enumerate(data):
            yield from _columns(path, f"{where or 'episodes'}[{i}]", piece)


def _has_names(data: Any) -> bool:
    """Whether a list holds dictionaries, at any depth."""
    while isinstance(data, list) and data:
        data = next((one for one in data if one is not None), None)
    return isinstance(data, dict)


def _are_rows(data: Sequence[Any]) -> bool:
    """Whether a list holds records and no pieces: there are at least as many as any list within has entries."""
    if not all(isinstance(row, dict) for row in data):
        return False
    return len(data) >= max((len(x) for row in data for x in row.values() if isinstance(x, list)), default=0)


def _records(path: Path, where: str, rows: Sequence[dict[str, Any]]) -> Iterator[Found]:
    """The columns of rows; those of a dictionary within have its name before theirs."""
    keys = dict.fromkeys(key for row in rows for key in row)
    check_size(path, 8 * len(keys) * len(rows))
    for key in keys:
        cells = [row.get(key) for row in rows]
        if any(isinstance(cell, dict) for cell in cells):
            inner = [cell if isinstance(cell, dict) else {} for cell in cells]
            yield from ((where, f"{key}.{name}", values) for _, name, values in _records(path, "", inner))
        else:
            yield from _array(where, key, cells)


def _array(where: str, name: str, cells: list[Any]) -> Iterator[Found]:
    """Numbers, words, or lists of equally many numbers; nothing else is a column."""
    width = max((len(cell) for cell in cells if isinstance(cell, list)), default=0)
    if width > WIDEST:
        return
    try:
        yield where, name, np.array([[None] * width if width and x is None else x for x in cells], dtype=np.float64)
    except (TypeError, ValueError):
        if not width:
            yield where, name, np.array([np.nan if cell is None else cell for cell in cells], dtype=object)
