"""Logs that cannot be used: one line of error for everything that is wrong."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sipe_bayes.calibration.readers.base import LogError
from sipe_bayes.calibration.readers.tables import read_table
from tests.problems.log_tables import QUIET, load, regular, write


def edited(**columns: Any) -> dict[str, Any]:
    return {**regular(), **columns}


def swapped(i: int, j: int) -> np.ndarray:
    t = regular()["t"]
    t[[i, j]] = t[[j, i]]
    return t


nan50 = np.full(50, np.nan)
half = np.r_[np.full(20, np.nan), np.zeros(30)]
doubled = np.r_[np.arange(25), np.arange(24, 49)] * 0.01

# (columns, words of the configuration, words in the message)
WRONG: list[tuple[dict[str, Any], dict[str, str], str]] = [
    (
        edited(t=swapped(10, 11)),
        {},
        r"'t' must increase strictly, got 0.1 in row 12 after 0.11 in row 11; sort",
    ),
    (edited(t=doubled), {}, "got 0.24 in row 26 after 0.24 in row 25; drop duplicate rows"),
    (edited(t=np.r_[0, np.nan, regular()["t"][2:]]), {}, "no time in row 2; drop"),
    (edited(q=nan50), {}, "measured column 'q' holds no number; drop"),
    (edited(u=nan50), {}, "command column 'u' holds no number"),
    (edited(u=half), {}, "command column 'u' holds no number before 0.2 s, .*start `span` there"),
    (edited(), {"window": "0.6"}, "lasts 0.49 s, shorter than a window of 0.6 s; lower `window`"),
    (edited(), {"log": "span = [3.0, 4.0]"}, r"span \[3.0, 4.0\] holds 0 samples of the 0.49 s; choose"),
    (edited(), {"resample": "rate = 1.0"}, "lasts 0.49 s, shorter than one control step of 1 s"),
    ({"t": [0.0], "q": [0.0], "u": [0.0]}, {}, "expected at least 2 samples, got 1"),
    ({"t": [], "q": [], "u": []}, {}, "holds no samples"),
    ({"time": regular()["t"], "tt": nan50, "q": half, "u": half}, {}, r"no column 't' in log.npz; did you mean 'tt'"),
    (
        {"t": regular()["t"], "u": nan50, "angle": nan50},
        {},
        "no column 'q' in log.npz; use one of 't', 'u', 'angle'",
    ),
    (edited(q=np.zeros(30)), {}, "column 'q' has 30 samples, the time 50"),
    (edited(q=np.array(["x"] * 50)), {}, "column 'q' holds .*'x'.* in row 1, expected numbers"),
    (
        edited(t=np.r_[0:49, 1e6] * 0.01),
        {},
        "50 samples in 10000 s leave a 100 Hz grid empty; choose a `span`",
    ),
]


@pytest.mark.parametrize(("columns", "words", "message"), WRONG, ids=[w[2][:40] for w in WRONG])
def test_wrong_input(tmp_path: Path, columns: dict[str, Any], words: dict[str, str], message: str) -> None:
    with pytest.raises(LogError) as caught:
        load(tmp_path, columns, **words)
    assert re.search(message, str(caught.value)), caught.value
    assert str(caught.value).startswith("log 'log': ")
    assert "\n" not in str(caught.value)


# (file, bytes, words in the message)
WRONG_FILES: list[tuple[str, bytes | None, str]] = [
    ("lag.csv", None, "no such file; did you mean 'log.csv'"),
    ("x.tdms", b"1", "expected a .csv, .* or .ulg file, got '.tdms'; convert it"),
    ("x.mat", b"1", "no MATLAB file of version 5 to 7.3; save it with `save -v7`"),
    ("x.csv", b"", "holds no samples|cannot be read"),
    ("x.csv", b"0.0,1.0\n0.1,2.0\n", "first line must name the columns, got '0.0,1.0'"),
    ("x.csv", b"t,q,q\n0,1,2\n", "column 'q' appears more than once"),
    ("x.csv", b"t,q\n0,1\n1,2,3,4\n", "cannot be read as .csv"),
    ("x.csv", b"\xff\xfet,q", "cannot be read as .csv"),
    ("x.npz", b"no archive", "cannot be read as .npz"),
    ("x.parquet", b"no table", "cannot be read as .parquet"),
]


@pytest.mark.parametrize(("name", "content", "message"), WRONG_FILES)
def test_wrong_files(tmp_path: Path, name: str, content: bytes | None, message: str) -> None:
    write(tmp_path / "log.csv", regular())
    if content is not None:
        (tmp_path / name).write_bytes(content)
    with pytest.raises(LogError, match=message) as caught:
        read_table(tmp_path / name)
    assert "\n" not in str(caught.value)


def test_npz_with_objects_is_refused(tmp_path: Path) -> None:
    np.savez(tmp_path / "log.npz", t=np.arange(3.0), q=np.array([{}, {}, {}], dtype=object))
    with pytest.raises(LogError, match="array 'q' holds Python objects"):
        read_table(tmp_path / "log.npz")


@QUIET
@given(content=st.binary(max_size=80), suffix=st.sampled_from(["csv", "npz", "parquet"]))
def test_any_bytes_give_a_table_or_a_log_error(tmp_path: Path, content: bytes, suffix: str) -> None:
    path = tmp_path / f"x.{suffix}"
    path.write_bytes(content)
    try:
        table = read_table(path)
    except LogError:
        return
    assert table
