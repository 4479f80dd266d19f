"""Readers of logs: each format of the registry is read alike, and a new one needs one line."""

import sys
from collections.abc import Callable, Collection
from pathlib import Path

import numpy as np
import pytest

from sipe_bayes.calibration.logs import load_log
from sipe_bayes.calibration.readers.base import Columns, Format, LogError
from sipe_bayes.calibration.readers.tables import READERS, read_table
from tests.calibration.readers.files import OTHERS
from tests.problems.log_files import WRITERS, Table, Written, configured, csv_file, lerobot_folder, matlab_7_3_file
from tests.problems.log_tables import regular

ALL = {
    **{kind: {**WRITERS, **OTHERS}.get(kind) for kind in READERS},
    "MATLAB 7.3": matlab_7_3_file,
    "LeRobot 3": lambda folder, table: lerobot_folder(folder, table, "v3.0"),
}


@pytest.mark.parametrize("kind", ALL)
def test_every_format_gives_the_trajectory_of_the_csv(kind: str, tmp_path: Path) -> None:
    """A format of the registry without a writer fails: a reader comes with a file that it reads."""
    write: Callable[[Path, Table], Written] | None = ALL[kind]
    assert write is not None, f"{kind}: no writer in tests/problems/log_files.py or files.py"
    table = regular(80)
    table["q"][7] = 1 / 3
    plain = configured(csv_file(tmp_path, table), tmp_path)
    expected, _ = load_log(plain, plain.logs[0])
    config = configured(write(tmp_path, table), tmp_path)
    found, report = load_log(config, config.logs[0])
    np.testing.assert_array_equal(found.observations, expected.observations)
    np.testing.assert_array_equal(found.actions, expected.actions)
    assert found.dt == pytest.approx(expected.dt, rel=1e-12)
    assert not report.resampled
    assert len(report.notes) == 1, report.notes
    assert len(report.sha256) == 64


@pytest.mark.parametrize("kind", WRITERS)
def test_all_columns_where_none_is_named(kind: str, tmp_path: Path) -> None:
    written = WRITERS[kind](tmp_path, regular(20))
    columns = read_table(written.path)
    assert {written.names["q"], written.names["u"]} <= set(columns)
    assert all(values.ndim == 1 for values in columns.values())


def test_a_reader_is_added_by_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def read_lines(path: Path, wanted: Collection[str]) -> Columns:
        return {"value": np.array([float(line) for line in path.read_text().split()])}

    monkeypatch.setitem(READERS, ".lines", Format(read_lines, "`value`"))
    (tmp_path / "log.lines").write_text("1 2.5")
    assert read_table(tmp_path / "log.lines")["value"].tolist() == [1.0, 2.5]
    (tmp_path / "log.lines").write_text("1 two")
    message = r"log.lines: cannot be read as .lines \(could not convert string to float: 'two'"
    with pytest.raises(LogError, match=message):
        read_table(tmp_path / "log.lines")
    (tmp_path / "log.tdms").write_text("")
    with pytest.raises(LogError, match=r"expected a .csv, .*, .ulg or .lines file, got '.tdms'"):
        read_table(tmp_path / "log.tdms")


@pytest.mark.parametrize(("kind", "package", "extra"), [(".mcap", "rosbags", "ros"), (".ulg", "pyulog", "px4")])
def test_a_missing_package_is_named_with_its_command(
    kind: str, package: str, extra: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    written = WRITERS[kind](tmp_path, regular(20))
    for name in [name for name in sys.modules if name.split(".")[0] == package]:
        monkeypatch.setitem(sys.modules, name, None)
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(LogError, match=rf"needs the package {package}\S*, .*: pip install 'sipe-bayes\[{extra}\]'$"):
        read_table(written.path)


def test_a_folder_that_is_no_log(tmp_path: Path) -> None:
    with pytest.raises(
        LogError, match=r"a folder without meta/info.json, joint_list.txt or metadata.yaml; name the log's file"
    ):
        read_table(tmp_path)


@pytest.mark.parametrize(
    ("text", "columns"),
    [
        ("# label,time,q\nrun1,0,1\nrun1,1,2\n", ["label", "time", "q"]),
        ("# q,time\n,0\n1,1\n", ["q", "time"]),
        ("# made by a logger\n# time,q\n# rad\n0,1\n1,2\n", ["time", "q"]),
        ("% remark\n\ntime q\n0 1\n1 2\n", ["time", "q"]),
        ("time,q\n0,1\n1,2\n", ["time", "q"]),
    ],
)
def test_remarks_above_a_table_are_no_header(text: str, columns: list[str], tmp_path: Path) -> None:
    (tmp_path / "log.csv").write_text(text)
    assert [name for name in read_table(tmp_path / "log.csv") if len(name) < 20] == columns
