"""PX4's ULog: fields by message, ``vehicle_rates.xyz[0]``; of a second instance ``sensor_gyro[1].x``.

Beside its fields each message has ``time``, its timestamp in seconds since boot, so that the clock needs no word in the
configuration. The format: https://docs.px4.io/main/en/dev_log/ulog_file_format.html
"""

from __future__ import annotations

import contextlib
import io
from collections.abc import Collection
from pathlib import Path

import numpy as np

from sipe_bayes.calibration.config_fields import nearest
from sipe_bayes.calibration.readers.base import Columns, LogError, check_size


def read_ulog(path: Path, wanted: Collection[str]) -> Columns:
    """The fields of the messages that are wanted."""
    from pyulog import ULog

    check_size(path, path.stat().st_size)
    messages = sorted({name.split(".")[0].split("[")[0] for name in wanted})
    with contextlib.redirect_stdout(io.StringIO()):  # it prints what it skips
        log = ULog(str(path), messages or None)
    there = {data.name for data in log.data_list}
    for name in messages:
        if name not in there:
            known = nearest(name, there | set(log.message_formats)) if log.message_formats else "it has no messages"
            raise LogError(f"{path}: no message {name!r} was logged; {known}")
    columns: Columns = {}
    for data in log.data_list:
        name = f"{data.name}[{data.multi_id}]" if data.multi_id else data.name
        columns.update({f"{name}.{field}": np.asarray(values) for field, values in data.data.items()})
        columns[f"{name}.time"] = 1e-6 * np.asarray(data.data["timestamp"], dtype=np.float64)
    return columns
