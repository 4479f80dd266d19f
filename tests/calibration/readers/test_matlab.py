"""What MATLAB's variables are called, in files of version 5 as SciPy writes them and of 7.3 as MATLAB does."""

from pathlib import Path

import h5py
import numpy as np
import pytest
from scipy.io import savemat
from scipy.sparse import eye

from sipe_bayes.calibration.readers.base import Columns
from sipe_bayes.calibration.readers.tables import read_table

TIME = np.arange(3.0)


def version_5(path: Path) -> Columns:
    joints = np.array([(TIME, "a"), (TIME + 1, "b")], dtype=[("q", object), ("label", object)])
    cell = np.empty((1, 2), dtype=object)
    cell[0, 0], cell[0, 1] = TIME + 2, np.stack([TIME, TIME + 3], -1)
    variables = {
        "row": TIME[None],
        "column": TIME[:, None],
        "matrix": np.stack([TIME, TIME + 4], -1),
        "rate": 100.0,
        "word": "a pendulum",
        "none": np.zeros((0, 0)),
        "flags": TIME > 0,
        "cube": np.zeros((3, 2, 2)),
        "few": eye(3).tocsc(),
        "joints": joints,
        "cell": cell,
        "out": {"signals": {"values": TIME + 5}, "time": TIME},
    }
    savemat(path, variables, long_field_names=True)
    return read_table(path)


def version_7_3(path: Path) -> Columns:
    """Arrays transposed, cells and arrays of structs as references, booleans as bytes."""
    with h5py.File(path, "w", userblock_size=512) as file:

        def put(name: str, values: np.ndarray, kind: str = "double") -> h5py.Dataset:
            dataset = file.create_dataset(name, data=values)
            dataset.attrs["MATLAB_class"] = np.bytes_(kind)
            return dataset

        def references(name: str, targets: list[h5py.Dataset]) -> h5py.Dataset:
            dataset = file.create_dataset(name, (len(targets), 1), dtype=h5py.ref_dtype)
            for i, target in enumerate(targets):
                dataset[i, 0] = target.ref
            return dataset

        put("row", TIME[:, None])
        put("column", TIME[None])
        put("matrix", np.stack([TIME, TIME + 4]))
        put("rate", np.array([[100.0]]))
        put("word", np.frombuffer(b"a pendulum", np.uint8).astype(np.uint16)[:, None], "char")
        put("flags", (TIME > 0)[:, None].astype(np.uint8), "logical")
        references("joints/q", [put("#refs#/a", TIME[None]), put("#refs#/b", TIME[None] + 1)])
        cells = [put("#refs#/c", TIME[None] + 2), put("#refs#/d", np.stack([TIME, TIME + 3]))]
        references("cell", cells).attrs["MATLAB_class"] = np.bytes_("cell")
        put("out/signals/values", TIME[:, None] + 5)
        put("out/time", TIME[:, None])
    return read_table(path)


@pytest.mark.parametrize("read", [version_5, version_7_3])
def test_names(read: object, tmp_path: Path) -> None:
    columns = read(tmp_path / "x.mat")  # type: ignore[operator]
    expected = {
        "row": TIME,
        "column": TIME,
        "matrix[0]": TIME,
        "matrix[1]": TIME + 4,
        "flags": TIME > 0,
        "joints[0].q": TIME,
        "joints[1].q": TIME + 1,
        "cell[0]": TIME + 2,
        "cell[1][0]": TIME,
        "cell[1][1]": TIME + 3,
        "out.signals.values": TIME + 5,
        "out.time": TIME,
    }
    assert set(columns) - {"none"} == set(expected)
    for name, values in expected.items():
        np.testing.assert_array_equal(columns[name], values)


def test_cells_that_hold_one_another_come_to_an_end(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "x.mat", "w", userblock_size=512) as file:
        file["t"] = TIME[None]
        cell = file.create_dataset("cell", (40, 1), dtype=h5py.ref_dtype)
        for i in range(40):
            cell[i, 0] = cell.ref
    with pytest.raises(ValueError, match=r"nested more than 32 deep|claims .* GiB of columns"):
        read_table(tmp_path / "x.mat")
