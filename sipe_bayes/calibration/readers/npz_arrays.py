"""NumPy's npz: a two-dimensional array ``states`` (n, k) becomes ``states:0`` .. ``states:{k-1}``."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from sipe_bayes.calibration.readers.base import Columns, LogError, plain


def read_npz(path: Path) -> Columns:
    """The arrays of one or two dimensions, which may differ in length; nothing is unpickled."""
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
                columns[key] = plain(array)
            elif array.ndim == 2:
                columns.update({f"{key}:{j}": plain(array[:, j]) for j in range(array.shape[1])})
    return columns
