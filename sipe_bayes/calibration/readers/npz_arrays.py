"""NumPy's npz: arrays of numbers, each checked against what its member holds before it is read."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path

from sipe_bayes.calibration.readers.base import Columns, spread_all
from sipe_bayes.core.files import read_arrays


def read_npz(path: Path, wanted: Collection[str]) -> Columns:
    """The arrays of one or two dimensions, which may differ in length; nothing is unpickled."""
    return spread_all(read_arrays(path).items())
