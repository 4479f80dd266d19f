"""Parquet: dates become seconds from the first one, lists of a constant length columns of their own."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from sipe_bayes.calibration.readers.base import Columns, check_size, frame_columns, spread

if TYPE_CHECKING:
    import pyarrow

_ROWS = 2**16  # read at once, so that a file is refused before it has filled the memory


def read_parquet(path: Path, wanted: Collection[str]) -> Columns:
    """The columns, without the index that pandas keeps beside them."""
    return parquet_columns(path, [path], {})


def parquet_columns(path: Path, files: Sequence[Path], labels: Mapping[str, Sequence[str]]) -> Columns:
    """The columns of several files, one below the other.

    Args:
        path: what a message names.
        files: of equal columns.
        labels: of a column of lists, names of the entries.
    """
    import pyarrow as pa

    tables: list[pyarrow.Table] = []
    for file in files:
        tables.append(_table(path, file, sum(table.nbytes for table in tables)))
    table = pa.concat_tables(tables)
    columns: Columns = {}
    for name in table.column_names:
        column = table.column(name)
        if _is_list(column.type):
            columns.update(_entries(name, column, labels.get(name, ())))
        else:
            columns.update(frame_columns(table.select([name]).to_pandas(ignore_metadata=True)))
    return columns


def _table(path: Path, file: Path, size: int) -> pyarrow.Table:
    """One file without pictures and other columns that hold no numbers; size in bytes of the files before it."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    with _naming(file), pq.ParquetFile(file) as source:
        names = [field.name for field in source.schema_arrow if _is_kept(field.type)]
        batches = []
        for batch in source.iter_batches(_ROWS, columns=names):
            size += batch.nbytes
            check_size(path, size)
            batches.append(batch.select(names))
        return pa.Table.from_batches(batches, pa.schema([source.schema_arrow.field(name) for name in names]))


@contextmanager
def _naming(file: Path) -> Iterator[None]:
    """Says which of several files an error is of."""
    try:
        yield
    except (OSError, ValueError) as error:
        raise type(error)(f"{file.name}: {error}") from None


def _is_kept(kind: pyarrow.DataType) -> bool:
    import pyarrow.types as types

    if _is_list(kind):
        return types.is_primitive(kind.value_type) and not types.is_temporal(kind.value_type)
    return types.is_primitive(kind) or types.is_string(kind) or types.is_large_string(kind) or types.is_dictionary(kind)


def _is_list(kind: pyarrow.DataType) -> bool:
    import pyarrow.types as types

    return types.is_list(kind) or types.is_large_list(kind) or types.is_fixed_size_list(kind)


def _entries(name: str, column: pyarrow.ChunkedArray, labels: Sequence[str]) -> Columns:
    """The columns of a column of lists; none where their lengths differ."""
    import pyarrow.compute as pc

    lengths = pc.unique(pc.list_value_length(column)).to_pylist()
    if len(lengths) != 1 or not lengths[0]:
        return {}
    values = pc.list_flatten(column).to_numpy()
    return spread(name, values.reshape(len(column), lengths[0]), labels)
