"""NumPy's npz: arrays of numbers, each checked against what its member holds before it is read."""

from __future__ import annotations

import zipfile
from collections.abc import Collection
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sipe_bayes.calibration.readers.base import Columns, LogError, check_size, plain, spread

_PLAIN = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)  # what NumPy writes
_HEADERS = {
    (1, 0): np.lib.format.read_array_header_1_0,
    (2, 0): np.lib.format.read_array_header_2_0,
}


def read_npz(path: Path, wanted: Collection[str]) -> Columns:
    """The arrays of one or two dimensions, which may differ in length; nothing is unpickled."""
    columns: Columns = {}
    with zipfile.ZipFile(path) as archive:
        members = [member for member in archive.infolist() if member.filename.endswith(".npy")]
        check_size(path, sum(member.file_size for member in members))
        for member in members:
            name = member.filename.removesuffix(".npy")
            columns.update(spread(name, _array(path, archive, member, name)))
    return columns


def _array(path: Path, archive: zipfile.ZipFile, member: zipfile.ZipInfo, name: str) -> NDArray[np.generic]:
    where = f"{path}: array {name!r}"
    if member.flag_bits & 1:
        raise LogError(f"{where} is encrypted; save it without a password")
    if member.compress_type not in _PLAIN:
        raise LogError(f"{where} is compressed in a way that npz has not; save it with numpy.savez_compressed")
    with archive.open(member) as file:
        header = _HEADERS.get(np.lib.format.read_magic(file))
        if header is None:
            raise LogError(f"{where} has field names beyond ASCII; save each field as an array of its own")
        shape, by_columns, dtype = header(file)
        if dtype.hasobject:
            raise LogError(f"{where} holds Python objects, which are not read; save it as numbers")
        count = 1
        for length in shape:
            count *= length
        size = count * dtype.itemsize
        if min(shape, default=0) < 0 or size > member.file_size:
            raise LogError(f"{where} claims the shape {shape}, more than its {member.file_size} bytes; save it anew")
        data = file.read(size)
    if len(data) < size:
        raise LogError(f"{where} ends after {len(data)} of {size} bytes; save it anew")
    if not size:
        return plain(np.zeros(shape, dtype))
    return np.frombuffer(data, dtype).reshape(shape, order="F" if by_columns else "C")
