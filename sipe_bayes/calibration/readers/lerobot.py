"""LeRobot's datasets, versions 2 and 3: ``meta/info.json`` and the Parquet files below ``data``.

All episodes are one table; ``columns.episode = "episode_index"`` tells them apart. Videos are left alone. The format:
https://huggingface.co/docs/lerobot/lerobot-dataset-v3
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from pathlib import Path

from sipe_bayes.calibration.readers.base import Columns, LogError
from sipe_bayes.calibration.readers.parquet_table import parquet_columns
from sipe_bayes.core.files import read_json

INFO = "meta/info.json"


def read_lerobot(path: Path, wanted: Collection[str]) -> Columns:
    """The columns; those of a vector are called as its entries are: ``observation.state[shoulder]``."""
    info = read_json(path / INFO, "the description of a dataset", "write the dataset anew", LogError)
    version = str(info.get("codebase_version"))
    if not version.startswith(("v2", "v3")):
        raise LogError(f"{path}: expected a dataset of version v2 or v3, got {version!r}; convert it with lerobot")
    files = sorted((path / "data").glob("**/*.parquet"))
    if not files:
        raise LogError(f"{path}: no Parquet file below {path.name}/data; fetch the data, not the description alone")
    features = info.get("features")
    labels = {n: _labels(f) for n, f in features.items()} if isinstance(features, dict) else {}
    columns = parquet_columns(path, files, labels)
    rows, frames = max(map(len, columns.values()), default=0), info.get("total_frames", 0)
    if rows != frames:
        raise LogError(f"{path}: {INFO} counts {frames} frames, the Parquet files hold {rows}; fetch the whole dataset")
    return columns


def _labels(feature: object) -> Sequence[str]:
    """Names of a vector's entries: a list, or the one list of a table such as ``{"motors": [...]}``."""
    names = feature.get("names") if isinstance(feature, dict) else None
    if isinstance(names, dict) and len(names) == 1:
        (names,) = names.values()
    return [str(name) for name in names] if isinstance(names, list) else ()
