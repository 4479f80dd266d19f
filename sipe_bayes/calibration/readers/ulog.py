"""PX4's ULog: fields by message, ``vehicle_rates.xyz[0]``; of a second instance ``sensor_gyro[1].x``.

Beside its fields each message has ``time``, its timestamp in seconds since boot, so that the clock needs no word in the
configuration. The format: https://docs.px4.io/main/en/dev_log/ulog_file_format.html
"""

from __future__ import annotations

import contextlib
import io
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from sipe_bayes.calibration.config_fields import nearest
from sipe_bayes.calibration.readers.base import Columns, LogError, check_size

if TYPE_CHECKING:
    from pyulog import ULog

_MOST = 0xFFFF  # bytes of a message


def read_ulog(path: Path, wanted: Collection[str]) -> Columns:
    """The fields of the messages that are wanted."""
    from pyulog import ULog

    check_size(path, path.stat().st_size)
    with contextlib.redirect_stdout(io.StringIO()):  # it prints what it skips
        _check_formats(path, ULog(str(path), parse_header_only=True).message_formats)
    messages = sorted({name.split(".")[0].split("[")[0] for name in wanted})
    with contextlib.redirect_stdout(io.StringIO()):
        log = ULog(str(path), messages or None)
    topics = {data.name for data in log.data_list}
    for name in messages:
        if name not in topics:
            known = nearest(name, topics | set(log.message_formats)) if log.message_formats else "it has no messages"
            raise LogError(f"{path}: no message {name!r} was logged; {known}")
    columns: Columns = {}
    for data in log.data_list:
        name = f"{data.name}[{data.multi_id}]" if data.multi_id else data.name
        columns.update({f"{name}.{field}": np.asarray(values) for field, values in data.data.items()})
        columns[f"{name}.time"] = 1e-6 * np.asarray(data.data["timestamp"], dtype=np.float64)
    return columns


def _check_formats(path: Path, formats: Mapping[str, ULog.MessageFormat]) -> None:
    """Refuse messages in messages that have more fields than a message has bytes, or that hold themselves."""
    counts: dict[str, int] = {}

    def count(name: str, around: tuple[str, ...]) -> int:
        if name in around:
            raise LogError(f"{path}: message {name!r} is defined by itself; record the log again")
        if name not in counts:
            fields = formats[name].fields if name in formats else ()
            counts[name] = sum(max(times, 1) * count(kind, (*around, name)) for kind, times, _ in fields) or 1
        if counts[name] > _MOST:
            raise LogError(
                f"{path}: message {name!r} claims {counts[name]} fields, the most is {_MOST}; record it again"
            )
        return counts[name]

    for name in formats:
        count(name, ())
