"""HDF5: every dataset of one or two dimensions, called as its path: ``arm/position[0]``.

Links to other files, and datasets whose numbers lie in other files, are not followed.
"""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path
from typing import TYPE_CHECKING

from sipe_bayes.calibration.readers.base import WIDEST, Columns, check_size, spread

if TYPE_CHECKING:
    import h5py


def read_hdf5(path: Path, wanted: Collection[str]) -> Columns:
    """The datasets that hold numbers; of a table with named fields each field is a column, ``log.angle``."""
    import h5py

    datasets: dict[str, h5py.Dataset] = {}

    def note(name: str, item: object) -> None:
        if isinstance(item, h5py.Dataset) and is_column(item):
            datasets[name] = item

    columns: Columns = {}
    with h5py.File(path, "r") as file:
        file.visititems(note)  # each object once, and none through a link
        check_size(path, sum(dataset.nbytes for dataset in datasets.values()))
        for name, dataset in datasets.items():
            for field in dataset.dtype.names or ("",):
                columns.update(spread(f"{name}.{field}" if field else name, dataset[field] if field else dataset[()]))
    return {name: values for name, values in columns.items() if values.dtype.kind in "biuf"}


def is_column(dataset: h5py.Dataset) -> bool:
    """Whether a dataset holds columns of a log: numbers, or fields with names, which are its own."""
    if dataset.shape is None or dataset.is_virtual or dataset.external or dataset.dtype.kind not in "biufV":
        return False
    return dataset.ndim == 1 or (dataset.ndim == 2 and dataset.dtype.kind != "V" and dataset.shape[1] <= WIDEST)
