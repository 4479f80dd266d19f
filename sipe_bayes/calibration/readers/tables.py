"""Tables of a log: the columns of a file by name, whatever its format."""

from __future__ import annotations

import warnings
from collections.abc import Collection, Iterable, Sequence
from pathlib import Path

from sipe_bayes.calibration.config_fields import nearest_file
from sipe_bayes.calibration.readers.base import Columns, Format, LogError
from sipe_bayes.calibration.readers.csv_table import read_csv
from sipe_bayes.calibration.readers.hdf5_file import read_hdf5
from sipe_bayes.calibration.readers.joined import JOINTS, read_joined
from sipe_bayes.calibration.readers.json_file import read_json_log
from sipe_bayes.calibration.readers.lerobot import INFO, read_lerobot
from sipe_bayes.calibration.readers.matlab import read_matlab
from sipe_bayes.calibration.readers.npz_arrays import read_npz
from sipe_bayes.calibration.readers.numbered import gathered, starred
from sipe_bayes.calibration.readers.parquet_table import read_parquet
from sipe_bayes.calibration.readers.ros_bag import read_bag
from sipe_bayes.calibration.readers.ulog import read_ulog
from sipe_bayes.core.files import is_file, is_folder, reading

_TEXT = Format(read_csv, "as the first line says, or the last of those with `#` or `%` above the rows")
_HDF5 = Format(read_hdf5, "the path of the dataset: `robot/arm/state[0]`")
_BAG = Format(
    read_bag,
    "ROS 2 bag: `/joint_states.position[elbow]`, `/effort.data[0]`, `/imu.angular_velocity.z`",
    "ros",
    "mend it with `mcap recover` or `ros2 bag reindex`, or record it again",
)

READERS: dict[str, Format] = {
    ".csv": _TEXT,
    ".tsv": _TEXT,
    ".txt": _TEXT,
    ".parquet": Format(read_parquet, "as there; entries of lists `state[0]`"),
    ".npz": Format(read_npz, "as its array; of two dimensions, where rows are samples, `states[0]` and so on"),
    ".json": Format(read_json_log, "as in its rows, behind what they are below: `position`, `log.q`, `episodes[0].q`"),
    ".h5": _HDF5,
    ".hdf5": _HDF5,
    ".mat": Format(
        read_matlab,
        "`q[0]`, in a struct `log.q`, in a cell or an array of structs `runs[0].q`; versions 5 to 7.3, no objects",
    ),
    INFO: Format(
        read_lerobot, "LeRobot, v2 and v3: `observation.state[shoulder]`; time `timestamp`, episodes `episode_index`"
    ),
    JOINTS: Format(
        read_joined, "of CSV files in one folder, whose lists have the names of joints: `control.positions[elbow]`"
    ),
    ".mcap": _BAG,
    ".db3": _BAG,
    "metadata.yaml": _BAG,
    ".ulg": Format(read_ulog, "PX4: `vehicle_angular_velocity.xyz[0]`; of a second instance `sensor_gyro[1].x`", "px4"),
}
"""The one list of formats: by the suffix of a file, or by the file that tells what a folder is."""


def read_table(path: str | Path, wanted: Collection[str] = (), names: Sequence[str] = ()) -> Columns:
    """The columns of a log's file by name.

    Args:
        path: a file with a suffix of ``READERS``, or a folder with one of its files.
        wanted: columns that will be asked for; none for all. With ``*``, those of numbered episodes together.
        names: of the columns of a table of text without a header; none for one that has them.

    Returns:
        The columns, each (n,); they may differ in length.

    Raises:
        LogError: there is no such file, no reader for it, or nothing in it that can be read.
    """
    path = Path(path)
    kind = _kind(path)
    if names and READERS[kind] is not _TEXT:
        raise LogError(f"{path}: `columns.names` is for a CSV without a header; drop it")
    try:
        with warnings.catch_warnings(), reading(path, kind, READERS[kind].remedy, LogError):
            warnings.simplefilter("ignore")
            columns = read_csv(path, wanted, names) if names else READERS[kind].read(path, wanted)
    except ModuleNotFoundError as error:
        needs = f"needs the package {error.name}, which is not installed"
        raise LogError(f"{path}: {needs}: pip install 'sipe-bayes[{READERS[kind].extra}]'") from None
    if not columns or not max(len(values) for values in columns.values()):
        raise LogError(f"{path}: holds no samples; record the log again or drop it")
    for prefix in starred(wanted):
        columns |= gathered(columns, prefix)
    return columns


def _kind(path: Path) -> str:
    """The key of ``READERS`` for a path."""
    if is_folder(path):
        folders = [kind for kind in READERS if not kind.startswith(".")]
        inner = next((kind for kind in folders if (path / kind).is_file()), None)
        if inner is None:
            raise LogError(f"{path}: a folder without {_one_of(folders)}; name the log's file")
        return inner
    if not is_file(path):
        raise LogError(f"{path}: no such file; {nearest_file(path)}")
    if path.suffix.lower() in (".pt", ".pth", ".pkl", ".pickle"):
        export = "`numpy.savez('log.npz', **{name: numpy.asarray(x) for name, x in data.items()})`"
        raise LogError(f"{path}: is a pickle, which could run anything and is not loaded; where it was made: {export}")
    if path.suffix.lower() not in READERS:
        suffixes = _one_of(kind for kind in READERS if kind.startswith("."))
        raise LogError(f"{path}: expected a {suffixes} file, got {path.suffix!r}; convert it")
    if not path.stat().st_size:
        raise LogError(f"{path}: holds no samples, the file is empty; record the log again or drop it")
    return path.suffix.lower()


def _one_of(words: Iterable[str]) -> str:
    *others, last = words
    return f"{', '.join(others)} or {last}" if others else last
