"""Readers of logs: each format of the registry is read alike, and a new one needs one line."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from sipe_bayes.calibration.readers.base import Columns, LogError
from sipe_bayes.calibration.tables import READERS, read_table

COLUMNS = {"time": np.array([0.0, 0.1, 0.2]), "angle": np.array([1.0, np.nan, 1 / 3])}
WRITERS = {
    ".csv": lambda path: pd.DataFrame(COLUMNS).to_csv(path, index=False),
    ".parquet": lambda path: pd.DataFrame(COLUMNS).to_parquet(path),
    ".npz": lambda path: np.savez(path, **COLUMNS),
}


@pytest.mark.parametrize("suffix", READERS)
def test_every_format_gives_the_same_columns(suffix: str, tmp_path: Path) -> None:
    """A format of the registry without a writer here fails: a reader comes with a file that it reads."""
    path = tmp_path / f"log{suffix}"
    WRITERS[suffix](path)
    columns = read_table(path)
    assert list(columns) == list(COLUMNS)
    for name, values in COLUMNS.items():
        np.testing.assert_array_equal(columns[name], values)


def test_a_reader_is_added_by_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def read_lines(path: Path) -> Columns:
        return {"value": np.array([float(line) for line in path.read_text().split()])}

    monkeypatch.setitem(READERS, ".txt", read_lines)
    (tmp_path / "log.txt").write_text("1 2.5")
    assert read_table(tmp_path / "log.txt")["value"].tolist() == [1.0, 2.5]
    (tmp_path / "log.txt").write_text("1 two")
    with pytest.raises(LogError, match=r"log.txt: cannot be read as .txt \(could not convert string to float: 'two'"):
        read_table(tmp_path / "log.txt")
    (tmp_path / "log.mat").write_text("")
    with pytest.raises(LogError, match=r"expected a .csv, .parquet, .npz or .txt file, got '.mat'"):
        read_table(tmp_path / "log.mat")
