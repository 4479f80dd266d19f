"""MATLAB, versions 5 to 7.3: ``q``, ``q[0]``, of structs ``log.q``, of cells and arrays of structs ``log[0].q``.

Counts begin at zero. Objects (timeseries, tables, functions) are not read. Before a file of version 5 to 7 goes to
SciPy, its elements are walked, so that no size that it claims is larger than what it holds. The format: MathWorks,
MAT-File Format, https://www.mathworks.com/help/pdf_doc/matlab/matfile_format.pdf
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Collection, Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sipe_bayes.calibration.readers.base import Columns, LogError, check_size, largest, spread, spread_all

_HEADER = 128  # bytes before the first element
_MATRIX, _COMPRESSED = 14, 15  # types of elements
_CELL, _STRUCT, _OBJECT, _SPARSE, _FUNCTION, _OPAQUE = 1, 2, 3, 5, 16, 17  # classes of matrices
_OBJECTS = (_OBJECT, _FUNCTION, _OPAQUE)
_DEEPEST = 32  # cells in cells
_VISIT = 4096  # bytes that each dataset counts for at least, so that cells which hold one another come to an end


def read_matlab(path: Path, wanted: Collection[str]) -> Columns:
    """The numbers of every variable that is no object."""
    import h5py

    check_size(path, path.stat().st_size)
    columns, objects = (_version_7_3(path), list[str]()) if h5py.is_hdf5(path) else _version_5(path)
    missing = [name for name in wanted if name not in columns]
    if missing and objects:
        raise LogError(
            f"{path}: no column {missing[0]!r}, and MATLAB's objects ({', '.join(objects)}) are not read; save their "
            "numbers, such as `t = object.Time; q = object.Data`"
        )
    return columns


def _version_5(path: Path) -> tuple[Columns, list[str]]:
    from scipy.io import loadmat

    kinds = dict(_variables(path))
    objects = [name for name, kind in kinds.items() if kind in _OBJECTS]
    names = [name for name in kinds if name and name not in objects]
    variables = loadmat(path, variable_names=names, simplify_cells=True) if names else {}
    return spread_all(leaf for name in names for leaf in _leaves(name, variables.get(name), 0)), objects


def _leaves(name: str, value: object, depth: int) -> Iterator[tuple[str, NDArray[np.generic]]]:
    """The arrays of numbers within a variable, by their names."""
    if depth > _DEEPEST:
        raise LogError(f"{name.split('.')[0]!r} is nested more than {_DEEPEST} deep; save its numbers as variables")
    if isinstance(value, dict):
        for field, inner in value.items():
            yield from _leaves(f"{name}.{field}", inner, depth + 1)
    elif isinstance(value, list) or (isinstance(value, np.ndarray) and value.dtype == object and value.ndim == 1):
        rows = all(isinstance(row, dict) and not any(map(_is_many, row.values())) for row in value)
        rows = rows and len({tuple(row) for row in value}) == 1
        for field in value[0] if rows and len(value) else ():
            yield from _leaves(f"{name}.{field}", np.array([row[field] for row in value]), depth)
        for i, inner in enumerate(() if rows else value):
            yield from _leaves(f"{name}[{i}]", inner, depth + 1)
    elif isinstance(value, np.ndarray) and value.dtype.kind in "biuf":
        yield name, value


def _is_many(value: object) -> bool:
    return isinstance(value, dict | list | np.ndarray)


def _variables(path: Path) -> Iterator[tuple[str, int]]:
    """Name and class of each variable; refuses a file whose elements claim more than it holds."""
    data = path.read_bytes()
    order = {b"IM": "<", b"MI": ">"}.get(data[126:128])
    if order is None or data[:4].count(0):
        raise LogError(f"{path}: no MATLAB file of version 5 to 7.3; save it with `save -v7`")
    position, total = _HEADER, 0
    while position + 8 <= len(data):
        kind, size = struct.unpack_from(f"{order}II", data, position)
        body = data[position + 8 : position + 8 + size]
        if len(body) < size:
            raise LogError(f"{path}: ends within a variable; save it anew")
        if kind == _COMPRESSED:
            stream = zlib.decompressobj()
            body = stream.decompress(body, largest())
            total += largest() + 1 if stream.unconsumed_tail else len(body)
            check_size(path, total)
            kind, body = struct.unpack_from(f"{order}I", body)[0], body[8:]
        if kind == _MATRIX:
            yield _check_matrix(path, memoryview(body), order, 0)
        position += 8 + size


def _check_matrix(path: Path, body: memoryview, order: str, depth: int) -> tuple[str, int]:
    """Name and class of a matrix; refuses one that, or one within which, has dimensions beyond its bytes."""
    if depth > _DEEPEST:
        raise LogError(f"{path}: cells and structs are nested more than {_DEEPEST} deep; save the numbers as variables")
    elements = list(_elements(path, body, order))
    if len(elements) < 3:
        return "", 0
    kind = elements[0][1][0] if order == "<" else elements[0][1][3]
    opaque = kind in (_FUNCTION, _OPAQUE)  # which have no dimensions
    lengths = [] if opaque else np.frombuffer(elements[1][1], f"{order}i4").tolist()
    name = bytes(elements[1 if opaque else 2][1]).decode("latin1")
    inside = [part for what, part in elements[3:] if what == _MATRIX]
    count = 1
    for length in lengths:
        count *= length
    least = len(inside) if kind in (_CELL, _STRUCT, _OBJECT) else len(body)
    if kind != _SPARSE and (min(lengths, default=0) < 0 or count > max(least, 1)):
        raise LogError(f"{path}: a variable claims the size {lengths}, more than it holds; save it anew")
    for part in inside:
        _check_matrix(path, part, order, depth + 1)
    return name, kind


def _elements(path: Path, body: memoryview, order: str) -> Iterator[tuple[int, memoryview]]:
    """Type and bytes of each element; small ones have both in eight bytes."""
    position = 0
    while position + 8 <= len(body):
        kind, size = struct.unpack_from(f"{order}II", body, position)
        start = position + 8
        if kind >> 16:
            kind, size, start = kind & 0xFFFF, kind >> 16, position + 4
        if start + size > len(body):
            raise LogError(f"{path}: a variable is cut short; save it anew")
        yield kind, body[start : start + size]
        position = start + size + (-(start + size - position) % 8 if start > position + 4 else 4 - min(size, 4))


def _version_7_3(path: Path) -> Columns:
    """HDF5 as MATLAB writes it: arrays are transposed, cells and arrays of structs are references."""
    import h5py

    columns: Columns = {}
    room = largest()

    def put(name: str, item: object, depth: int) -> None:
        nonlocal room
        if depth > _DEEPEST:
            raise LogError(f"{path}: cells and structs are nested more than {_DEEPEST} deep; save numbers as variables")
        if isinstance(item, h5py.Group):
            for field in item:
                if isinstance(item.get(field, getlink=True), h5py.HardLink) and not field.startswith("#"):
                    put(f"{name}.{field}" if name else field, item[field], depth + 1)
            return
        if not isinstance(item, h5py.Dataset) or item.shape is None or item.is_virtual or item.external:
            return
        room -= item.nbytes + _VISIT
        check_size(path, largest() - room)
        if h5py.check_ref_dtype(item.dtype) is h5py.Reference:
            for i, reference in enumerate(np.ravel(item[()], order="F")):
                group, _, field = name.rpartition(".")
                cell = item.attrs.get("MATLAB_class") == b"cell" or not group
                put(f"{name}[{i}]" if cell else f"{group}[{i}].{field}", item.file[reference], depth + 1)
        elif item.attrs.get("MATLAB_class") != b"char" and item.dtype.kind in "biuf":
            values = np.squeeze(item[()].T)
            columns.update(spread(name, values))

    with h5py.File(path, "r") as file:
        put("", file, 0)
    return columns
