"""Parquet: dates become seconds from the first one, lists of a constant length columns of their own."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from sipe_bayes.calibration.readers.base import Columns, check_size, frame_columns, spread

if TYPE_CHECKING:
    import pyarrow


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

    table = pa.concat_tables([_table(path, file) for file in files])
    columns: Columns = {}
    for name in table.column_names:
        column = table.column(name)
        if _is_list(column.type):
            columns.update(_entries(name, column, labels.get(name, ())))
        else:
            columns.update(frame_columns(table.select([name]).to_pandas(ignore_metadata=True)))
    return columns


def _table(path: Path, file: Path) -> pyarrow.Table:
    """One file without pictures and other columns that hold no numbers."""
    import pyarrow.parquet as pq

    with pq.ParquetFile(file) as source:
        names = [field.name for field in source.schema_arrow if _is_kept(field.type)]
        about = source.metadata
        groups = (about.row_group(i) for i in range(about.num_row_groups))
        chunks = (group.column(j) for group in groups for j in range(about.num_columns))
        check_size(
            path, sum(8 * chunk.num_values for chunk in chunks if chunk.path_in_schema.split(".list")[0] in names)
        )
        return source.read(columns=names).select(names)


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
