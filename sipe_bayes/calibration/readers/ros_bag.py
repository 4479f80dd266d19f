"""ROS 2 bags and MCAP: numbers by topic and field, ``/joint_states.position[elbow]``, ``/effort.data[0]``.

Beside its fields each topic has two clocks in seconds from the first message that is read: ``time``, when the recorder
got the message, and ``stamp``, its header's stamp, or ``time`` where no message of the topic has one.
"""

from __future__ import annotations

from array import array
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from sipe_bayes.calibration.config_fields import listed, nearest
from sipe_bayes.calibration.readers.base import Columns, LogError, check_size
from sipe_bayes.calibration.readers.ros_messages import Fields, Message

if TYPE_CHECKING:
    from rosbags.interfaces import Connection


def read_bag(path: Path, wanted: Collection[str]) -> Columns:
    """The numbers of the topics that are wanted."""
    from rosbags.rosbag2 import Reader

    _check_databases(path)
    topics: dict[str, _Topic] = {}
    with Reader(path) as bag:
        for storage in getattr(bag.storage, "storages", [bag.storage]):
            for chunk in getattr(storage, "chunks", ()):  # of MCAP, each unpacked as a whole
                check_size(path, chunk.uncompressed_size)
        connections = list(_connections(path, bag.connections, wanted))
        if not connections:
            raise LogError(f"{path}: holds no messages; record the log again or drop it")
        types = {one.msgtype: _types(one) for one in connections}
        for connection, received, data in bag.messages(connections):
            message = Message(types[connection.msgtype], connection.msgtype, data)
            topics.setdefault(connection.topic, _Topic()).add(received, message)
            check_size(path, sum(topic.size for topic in topics.values()))
    first = min((topic.received[0] for topic in topics.values()), default=0)
    columns: Columns = {}
    for name, topic in topics.items():
        columns.update({f"{name}.{field}": values for field, values in topic.columns(first).items()})
    return columns


def _connections(path: Path, all_of_them: Collection[Connection], wanted: Collection[str]) -> Iterator[Connection]:
    """Those of the wanted columns' topics."""
    kinds = {one.topic: one.msgtype for one in all_of_them}
    for name in wanted:
        if not any(name.startswith(f"{topic}.") for topic in kinds):
            topics = listed([f"{topic} ({kind})" for topic, kind in sorted(kinds.items())]) or "no topics"
            raise LogError(f"{path}: no topic for {name!r}; {nearest(name.split('.')[0], kinds)} (it has {topics})")
    for one in all_of_them:
        if not wanted or any(name.startswith(f"{one.topic}.") for name in wanted):
            yield one


def _check_databases(path: Path) -> None:
    """Refuse a database in which a name stands for a computation: a recording has tables of its own, no views."""
    import apsw

    for file in [path] if path.is_file() else sorted(path.glob("*.db3")):
        if file.suffix != ".db3":
            continue
        database = apsw.Connection(str(file), flags=apsw.SQLITE_OPEN_READONLY)
        for kind, name, text in database.execute("SELECT type, name, sql FROM sqlite_master"):
            if kind not in ("table", "index") or "virtual" in str(text).lower():
                raise LogError(f"{file}: {name!r} is no plain table, which a recording does not have; record it again")


def _types(connection: Connection) -> Mapping[str, Fields]:
    """Fields of every type in a connection's messages: as the bag defines them, else as ROS 2 does."""
    from rosbags.interfaces import MessageDefinitionFormat
    from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore

    definition = connection.msgdef
    if definition.format == MessageDefinitionFormat.MSG:
        definitions = get_types_from_msg(definition.data, connection.msgtype)
    elif definition.format == MessageDefinitionFormat.IDL:
        definitions = get_types_from_idl(definition.data)
    else:
        definitions = get_typestore(Stores.LATEST).fielddefs
    return {name: fields for name, (_, fields) in definitions.items()}


class _Topic:
    """Messages of a topic as columns: NaN where a message lacks a field."""

    def __init__(self) -> None:
        self.received, self.stamps = array("q"), array("q")
        self.numbers: dict[str, array[float]] = {}

    @property
    def size(self) -> int:
        """Bytes of the columns."""
        return 8 * len(self.received) * (len(self.numbers) + 2)

    def add(self, received: int, message: Message) -> None:
        """A message; received in ns."""
        row = len(self.received)
        self.received.append(received)
        self.stamps.append(message.stamp)
        for name, value in message.numbers.items():
            column = self.numbers.setdefault(name, array("d"))
            column.extend([np.nan] * (row - len(column)))
            column.append(value)

    def columns(self, first: int) -> Columns:
        """Each (n,), times from ``first`` in ns."""
        rows = len(self.received)
        stamps = self.stamps if any(self.stamps) else self.received
        columns: Columns = {"time": _seconds(self.received, first), "stamp": _seconds(stamps, first)}
        for name, column in self.numbers.items():
            columns[name] = np.append(np.array(column), np.full(rows - len(column), np.nan))
        return columns


def _seconds(times: array[int], first: int) -> np.ndarray:
    return (np.array(times) - first) / 1e9
