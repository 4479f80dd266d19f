"""Parquet: dates become seconds from the first one."""

from __future__ import annotations

from pathlib import Path

from sipe_bayes.calibration.readers.base import Columns, frame_columns


def read_parquet(path: Path) -> Columns:
    """The columns, without the index that pandas keeps beside them."""
    import pyarrow.parquet

    return frame_columns(pyarrow.parquet.read_table(path).to_pandas(ignore_metadata=True))
