"""ROS 2 messages: every type that ROS 2 has, as its own library writes it, and how its numbers are called."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

from sipe_bayes.calibration.readers.base import WIDEST, LogError
from sipe_bayes.calibration.readers.ros_messages import Message
from sipe_bayes.calibration.readers.tables import read_table
from tests.problems.log_files import ROS, START, Messages, command, joint_state, ros_bag

FIELDS = {name: fields for name, (_, fields) in ROS.fielddefs.items()}
KINDS = sorted(name for name in FIELDS if "wstring" not in str(FIELDS[name]))
INTEGERS = {"byte": np.uint8, "octet": np.uint8, "char": np.uint8}


def made(description: tuple[int, Any], chance: np.random.Generator) -> Any:
    """A random value of a field, as rosbags takes it."""
    what, detail = description
    if what == 2:
        return ROS.types[detail](**{name: made(inner, chance) for name, inner in FIELDS[detail]})
    if what in (3, 4):
        (inner, of), count = detail
        count = count if what == 3 else int(chance.integers(0, min(count or 4, 4) + 1))
        if inner == 2 or of[0] == "string":
            return [made((inner, of), chance) for _ in range(count)]
        kind = INTEGERS.get(of[0], np.bool_ if of[0] == "bool" else getattr(np, of[0], None))
        return chance.integers(0, 2, count).astype(kind)
    if detail[0] == "string":
        return "word" * int(chance.integers(0, 3))
    if detail[0].startswith("float"):
        return float(np.float32(chance.normal()))
    return bool(chance.integers(0, 2)) if detail[0] == "bool" else int(chance.integers(0, 100))


def plainly(name: str, value: Any) -> Iterator[tuple[str, float]]:
    """The reference: numbers by their names, one after the other."""
    if hasattr(value, "nanosec"):
        yield name, value.sec + 1e-9 * value.nanosec
    elif hasattr(value, "__msgtype__"):
        labels: list[str] = []
        for field, _ in FIELDS[value.__msgtype__]:
            inner = getattr(value, field)
            word = f"{name}.{field}" if name else field
            if isinstance(inner, list | np.ndarray):
                words = labels if len(set(labels)) == len(labels) == len(inner) else range(len(inner))
                for label, one in zip(words, inner, strict=True):
                    yield from plainly(f"{word}[{label}]", one)
                if len(inner) and isinstance(inner[0], str) and field.endswith(("name", "names")):
                    labels = inner
            else:
                yield from plainly(word, inner)
    elif not isinstance(value, str):
        yield name, float(value)


@pytest.mark.parametrize("kind", KINDS)
def test_every_type_of_ros_2_against_its_own_library(kind: str) -> None:
    for seed in range(4):
        value = made((2, kind), np.random.default_rng(seed))
        numbers = Message(FIELDS, kind, bytes(ROS.serialize_cdr(value, kind))).numbers
        assert numbers == dict(plainly("", value))


def recorded(folder: Path, *messages: tuple[str, Any]) -> Messages:
    """Messages on one topic each, a second apart."""
    return [
        (topic, value.__msgtype__, START + k * 10**9, bytes(ROS.serialize_cdr(value, value.__msgtype__)))
        for k, (topic, value) in enumerate(messages)
    ]


def test_names_of_an_imu_and_of_interfaces(tmp_path: Path) -> None:
    imu = made((2, "sensor_msgs/msg/Imu"), np.random.default_rng(0))
    scan = made((2, "sensor_msgs/msg/LaserScan"), np.random.default_rng(0))
    scan.ranges = np.zeros(WIDEST + 1, np.float32)
    columns = read_table(ros_bag(tmp_path, recorded(tmp_path, ("/imu", imu), ("/arm/scan", scan))))
    assert columns["/imu.angular_velocity.z"].tolist() == [imu.angular_velocity.z]
    assert columns["/imu.orientation.w"].tolist() == [imu.orientation.w]
    assert columns["/arm/scan.range_max"].tolist() == [scan.range_max]
    assert columns["/arm/scan.time"].tolist() == [1.0]
    assert not any(name.startswith("/arm/scan.ranges[") for name in columns)


def test_joints_that_come_in_another_order_keep_their_columns(tmp_path: Path) -> None:
    kind = "sensor_msgs/msg/JointState"
    orders = [(["a", "b"], [1.0, 2.0]), (["b", "a"], [4.0, 3.0]), (["a", "a"], [5.0, 6.0])]
    messages = [(START + k, names, np.array(values)) for k, (names, values) in enumerate(orders)]
    columns = read_table(ros_bag(tmp_path, [("/j", kind, t, joint_state(t, n, v)) for t, n, v in messages]))
    np.testing.assert_array_equal(columns["/j.position[a]"], [1.0, 3.0, np.nan])
    np.testing.assert_array_equal(columns["/j.position[b]"], [2.0, 4.0, np.nan])
    np.testing.assert_array_equal(columns["/j.position[1]"], [np.nan, np.nan, 6.0])


def test_only_topics_that_are_asked_for_are_read(tmp_path: Path) -> None:
    """Another topic may hold what is no message of ours."""
    messages = [
        ("/effort", "std_msgs/msg/Float64MultiArray", START + k, command(np.array([float(k)]))) for k in range(3)
    ]
    messages += [("/camera", "sensor_msgs/msg/Image", START, b"\0\1\0\0 broken")]
    bag = ros_bag(tmp_path, messages)
    assert read_table(bag, ["/effort.data[0]"])["/effort.data[0]"].tolist() == [0, 1, 2]
    with pytest.raises(LogError, match="a message claims"):
        read_table(bag)
    with pytest.raises(
        LogError, match=r"no topic for '/efort.data\[0\]'; did you mean '/effort'\? \(it has /camera \(sen"
    ):
        read_table(bag, ["/efort.data[0]"])


@pytest.mark.parametrize("single", [False, True])
def test_a_chunk_that_unpacks_to_more_than_a_log_is_refused(
    single: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Four megabytes of zeros in a file of three kilobytes, of a topic that nobody asked for."""
    bag = Writer(tmp_path / "bag", version=9, storage_plugin=StoragePlugin.MCAP)
    bag.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
    with bag:
        zeros = bag.add_connection("/zeros", "std_msgs/msg/Float64MultiArray", typestore=ROS)
        effort = bag.add_connection("/effort", "std_msgs/msg/Float64MultiArray", typestore=ROS)
        bag.write(zeros, START, command(np.zeros(500_000)))
        bag.write(effort, START, command(np.ones(1)))
    path = tmp_path / "bag" / "bag.mcap" if single else tmp_path / "bag"
    assert read_table(path, ["/effort.data[0]"])["/effort.data[0]"].tolist() == [1.0]
    monkeypatch.setenv("SIPE_LOG_GIB", str(10**6 / 2**30))
    with pytest.raises(LogError, match=r"claims 0.00373 GiB of columns, the most is 0.00093"):
        read_table(path, ["/effort.data[0]"])


def test_of_many_topics_the_first_are_listed(tmp_path: Path) -> None:
    bag = ros_bag(
        tmp_path, [(f"/t{k:02}", "std_msgs/msg/Float64MultiArray", START, command(np.ones(1))) for k in range(40)]
    )
    with pytest.raises(LogError, match=r"use one of '/t00'.*'/t29' and 10 others \(it has .* and 10 others\)"):
        read_table(bag, ["/zz/none.data[0]"])


@pytest.mark.parametrize("storage", StoragePlugin)
@pytest.mark.parametrize("mode", [CompressionMode.NONE, CompressionMode.MESSAGE, CompressionMode.FILE])
def test_bags_are_unpacked(storage: StoragePlugin, mode: CompressionMode, tmp_path: Path) -> None:
    bag = Writer(tmp_path / "bag", version=8, storage_plugin=storage)
    if mode != CompressionMode.NONE:
        bag.set_compression(mode, CompressionFormat.ZSTD)
    with bag:
        effort = bag.add_connection("/effort", "std_msgs/msg/Float64MultiArray", typestore=ROS)
        for k in range(5):
            bag.write(effort, START + k * 10**7, command(np.array([float(k), -float(k)])))
    columns = read_table(tmp_path / "bag")
    assert columns["/effort.data[1]"].tolist() == [0, -1, -2, -3, -4]
    np.testing.assert_allclose(columns["/effort.time"], np.arange(5) * 0.01)
