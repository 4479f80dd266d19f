"""Logs of every format, each by its own library; by hand MATLAB 7.3 on HDF5, LeRobot on Parquet, ULog before pyulog."""

import json
import shutil
import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import h5py
import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
from pyulog import ULog
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore
from scipy.io import savemat

from sipe_bayes.calibration.config import Config, load_config
from sipe_bayes.calibration.readers.lerobot import INFO
from tests.problems.log_tables import TOML

Table = Mapping[str, np.ndarray]
ROS = get_typestore(Stores.ROS2_HUMBLE)
START = 1_700_000_000_000_000_000  # ns


@dataclass(frozen=True)
class Written:
    """A log with the columns t, q and u, and what they are called in it."""

    path: Path
    names: Mapping[str, str] = field(default_factory=lambda: {"t": "t", "q": "q", "u": "u"})
    episode: str = ""


def configured(written: Written, folder: Path, **words: str) -> Config:
    """The configuration that reads it."""
    words = {"window": "0.001", "resample": "", "measurements": "", "log": "", **words}
    text = TOML.format(file=written.path.relative_to(folder), **words)
    for plain, name in written.names.items():
        text = text.replace(f'column = "{plain}"', f'column = "{name}"')
    if written.episode:
        text = text.replace("[columns]", f'[columns]\nepisode = "{written.episode}"')
    (folder / "m.xml").write_text("<mujoco/>")
    (folder / "run.toml").write_text(text)
    return load_config(folder / "run.toml")


def csv_file(folder: Path, table: Table) -> Written:
    pd.DataFrame(table).to_csv(folder / "log.csv", index=False)
    return Written(folder / "log.csv")


def text_file(folder: Path, table: Table, suffix: str = ".txt", header: str = "") -> Written:
    """Below remarks and an empty line; the header may be one of them."""
    text = pd.DataFrame(table).to_csv(sep="\t", index=False)
    (folder / f"log{suffix}").write_text(f"# bench 3, firmware 1.2\n\n# gains: 3, 4\n{header}{text}")
    return Written(folder / f"log{suffix}")


def parquet_file(folder: Path, table: Table) -> Written:
    pd.DataFrame(table).to_parquet(folder / "log.parquet")
    return Written(folder / "log.parquet")


def npz_file(folder: Path, table: Table) -> Written:
    np.savez_compressed(folder / "log.npz", t=table["t"], states=np.stack([table["q"], table["u"]], -1))
    return Written(folder / "log.npz", {"t": "t", "q": "states[0]", "u": "states[1]"})


def hdf5_file(folder: Path, table: Table, suffix: str = ".h5") -> Written:
    with h5py.File(folder / f"log{suffix}", "w") as file:
        arm = file.create_group("robot/arm")
        arm.create_dataset("t", data=table["t"])
        arm.create_dataset("state", data=np.stack([table["q"], table["u"]], -1), compression="gzip")
        file.create_dataset("camera", data=np.zeros((len(table["t"]), 4, 4, 3), np.uint8))
    return Written(folder / f"log{suffix}", {"t": "t", "q": "robot/arm/state[0]", "u": "robot/arm/state[1]"})


def matlab_file(folder: Path, table: Table) -> Written:
    cell = np.empty(2, dtype=object)
    cell[:] = [{"t": table["t"], "q": table["q"][:, None], "u": table["u"]}, "free text"]
    savemat(folder / "log.mat", {"runs": cell, "about": "a pendulum", "rate": 100.0}, do_compression=True)
    return Written(folder / "log.mat", {"t": "t", "q": "runs[0].q", "u": "runs[0].u"})


def matlab_7_3_file(folder: Path, table: Table) -> Written:
    """As MATLAB writes it: HDF5 behind a header of 512 bytes, arrays transposed, cells as references."""
    path = folder / "log.mat"
    with h5py.File(path, "w", userblock_size=512) as file:
        inside = file.create_group("#refs#/a")
        for name, values in table.items():
            inside.create_dataset(name, data=values[None]).attrs["MATLAB_class"] = np.bytes_("double")
        cell = file.create_dataset("runs", (1, 1), dtype=h5py.ref_dtype)
        cell.attrs["MATLAB_class"] = np.bytes_("cell")
        cell[0, 0] = inside.ref
        file.create_dataset("about", data=np.array([[97], [98]], np.uint16)).attrs["MATLAB_class"] = np.bytes_("char")
    with path.open("r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124) + b"\x00\x02IM")
    return Written(path, {"t": "t", "q": "runs[0].q", "u": "runs[0].u"})


def lerobot_folder(folder: Path, table: Table, version: str = "v2.1", episodes: int = 1) -> Written:
    """Every episode holds the table; in version 3 they share a file."""
    root = folder / "dataset"
    (root / "meta").mkdir(parents=True)
    rows = len(table["t"])
    pieces = []
    for k in range(episodes):
        states = pa.FixedSizeListArray.from_arrays(np.stack([table["q"], np.full(rows, k)], -1).ravel(), 2)
        columns = {
            "observation.state": states if version == "v3.0" else states.cast(pa.list_(pa.float64())),
            "action": pa.array(table["u"][:, None].tolist()),
            "timestamp": table["t"],
            "frame_index": np.arange(rows),
            "episode_index": np.full(rows, k),
            "observation.image": pa.array([{"bytes": b"png", "path": ""}] * rows),
        }
        pieces.append(pa.table(columns))
    files = {"data/chunk-000/file-000.parquet": pa.concat_tables(pieces)}
    if version != "v3.0":
        files = {f"data/chunk-000/episode_{k:06d}.parquet": piece for k, piece in enumerate(pieces)}
    for name, piece in files.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        pq.write_table(piece, root / name)
    features = {
        "observation.state": {"dtype": "float64", "shape": [2], "names": {"motors": ["hinge", "grip.pos"]}},
        "action": {"dtype": "float64", "shape": [1], "names": ["motor"]},
    }
    about = {"codebase_version": version, "fps": 100, "total_frames": rows * episodes, "features": features}
    (root / INFO).write_text(json.dumps(about))
    names = {"t": "timestamp", "q": "observation.state[hinge]", "u": "action[motor]"}
    return Written(root, names, "episode_index")


def joint_state(time: int, names: list[str], position: np.ndarray) -> bytes:
    """A message of joint states in CDR; time in ns."""
    stamp = ROS.types["builtin_interfaces/msg/Time"](sec=time // 10**9, nanosec=time % 10**9)
    header = ROS.types["std_msgs/msg/Header"](stamp=stamp, frame_id="base")
    kind = "sensor_msgs/msg/JointState"
    message = ROS.types[kind](header=header, name=names, position=position, velocity=position * 0, effort=np.zeros(0))
    return bytes(ROS.serialize_cdr(message, kind))


def command(values: np.ndarray) -> bytes:
    """A message of several numbers in CDR."""
    layout = ROS.types["std_msgs/msg/MultiArrayLayout"](dim=[], data_offset=0)
    kind = "std_msgs/msg/Float64MultiArray"
    return bytes(ROS.serialize_cdr(ROS.types[kind](layout=layout, data=values), kind))


Messages = list[tuple[str, str, int, bytes]]
"""Topic, type, ns, bytes."""


def ros_messages(table: Table, delay: int = 0) -> Messages:
    """Joint states that are stamped ``delay`` ns before they are received, and commands."""
    messages: Messages = []
    for t, q, u in zip(table["t"], table["q"], table["u"], strict=True):
        time = START + round(1e9 * t)
        state = joint_state(time - delay, ["grip", "elbow"], np.array([0.5, q]))
        messages.append(("/effort", "std_msgs/msg/Float64MultiArray", time, command(np.array([0.0, u]))))
        messages.append(("/joint_states", "sensor_msgs/msg/JointState", time, state))
    return messages


ROS_NAMES = {"t": "time", "q": "/joint_states.position[elbow]", "u": "/effort.data[1]"}


def ros_bag(folder: Path, messages: Messages, storage: StoragePlugin = StoragePlugin.MCAP) -> Path:
    with Writer(folder / "bag", version=9, storage_plugin=storage) as bag:
        connections = {}
        for topic, kind, time, data in messages:
            if topic not in connections:
                connections[topic] = bag.add_connection(topic, kind, typestore=ROS)
            bag.write(connections[topic], time, data)
    return folder / "bag"


def ros_folder(folder: Path, table: Table) -> Written:
    return Written(ros_bag(folder, ros_messages(table)), ROS_NAMES)


def mcap_file(folder: Path, table: Table) -> Written:
    bag = ros_bag(folder, ros_messages(table))
    shutil.move(bag / "bag.mcap", folder / "log.mcap")
    return Written(folder / "log.mcap", ROS_NAMES)


def sqlite_file(folder: Path, table: Table) -> Written:
    bag = ros_bag(folder, ros_messages(table), StoragePlugin.SQLITE3)
    shutil.move(bag / "bag.db3", folder / "log.db3")
    return Written(folder / "log.db3", ROS_NAMES)


def ulog_file(folder: Path, table: Table) -> Written:
    """PX4's format: a header, definitions of messages, subscriptions, data."""

    def record(kind: str, body: bytes) -> bytes:
        return struct.pack("<HB", len(body), ord(kind)) + body

    parts = [b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 0), record("B", bytes(40))]
    parts.append(record("F", b"joint:uint64_t timestamp;float[1] load;uint8_t[4] _padding0;double[2] angle;"))
    parts.append(record("F", b"motor:uint64_t timestamp;double effort;"))
    parts += [record("A", struct.pack("<BH", 0, i) + name) for i, name in enumerate((b"joint", b"motor"))]
    parts.append(record("A", struct.pack("<BH", 1, 2) + b"motor"))
    for t, q, u in zip(table["t"], table["q"], table["u"], strict=True):
        time = round(1e6 * t) + 5_000_000
        parts.append(record("D", struct.pack("<HQf4xdd", 0, time, 0.25, 0.0, q)))
        parts += [record("D", struct.pack("<HQd", i, time, value)) for i, value in ((1, 0.0), (2, u))]
    (folder / "log.ulg").write_bytes(b"".join(parts))
    if (np.diff(table["t"]) > 0).all():  # pyulog sorts
        ULog(str(folder / "log.ulg")).write_ulog(str(folder / "log.ulg"))
    return Written(folder / "log.ulg", {"t": "time", "q": "joint.angle[1]", "u": "motor[1].effort"})


WRITERS: dict[str, Callable[[Path, Table], Written]] = {
    ".csv": csv_file,
    ".tsv": lambda folder, table: text_file(folder, table, ".tsv", "# "),
    ".txt": text_file,
    ".parquet": parquet_file,
    ".npz": npz_file,
    ".h5": hdf5_file,
    ".hdf5": lambda folder, table: hdf5_file(folder, table, ".hdf5"),
    ".mat": matlab_file,
    INFO: lerobot_folder,
    ".mcap": mcap_file,
    ".db3": sqlite_file,
    "metadata.yaml": ros_folder,
    ".ulg": ulog_file,
}
"""By the key of the registry of readers."""
