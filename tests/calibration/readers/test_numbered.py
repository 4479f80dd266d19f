"""Episodes side by side in one file, as numbered groups of HDF5 and cells of MATLAB."""

from pathlib import Path

import h5py
import numpy as np
import pytest
from scipy.io import savemat

from sipe_bayes.calibration.init.propose import propose
from sipe_bayes.calibration.logs import load_logs
from sipe_bayes.calibration.readers.base import LogError
from sipe_bayes.calibration.readers.numbered import numbered
from sipe_bayes.calibration.readers.tables import read_table
from tests.problems.log_files import Written, configured
from tests.problems.log_tables import regular
from tests.problems.made_up_logs import PENDULUM

LENGTHS = {0: 40, 2: 60, 10: 50}


def hdf5(folder: Path) -> Written:
    """Groups whose commands are one sample shorter, and a number that is no signal."""
    with h5py.File(folder / "log.h5", "w") as file:
        for number, rows in LENGTHS.items():
            table, group = regular(rows), file.create_group(f"data/demo_{number}")
            group["t"], group["obs/q"], group["u"] = table["t"], table["q"] + number, table["u"][:-1]
            group["weight"] = np.array([number])
    return Written(folder / "log.h5", star("data/demo_*/t", "data/demo_*/obs/q", "data/demo_*/u"), "data/demo_*")


def matlab(folder: Path) -> Written:
    cells = np.empty(len(LENGTHS), dtype=object)
    cells[:] = [{**regular(rows), "q": regular(rows)["q"] + number} for number, rows in LENGTHS.items()]
    savemat(folder / "log.mat", {"runs": cells, "about": "a pendulum"})
    return Written(folder / "log.mat", star("runs[*].t", "runs[*].q", "runs[*].u"), "runs[*]")


def star(t: str, q: str, u: str) -> dict[str, str]:
    return {"t": t.rpartition("/")[2].rpartition(".")[2], "q": q, "u": u}


@pytest.mark.parametrize(("write", "numbers"), [(hdf5, [0, 2, 10]), (matlab, [0, 1, 2])])
def test_each_is_a_log(write, numbers: list[int], tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    config = configured(write(tmp_path), tmp_path)
    assert [log.episodes for log in config.logs] == [(number,) for number in numbers]
    for (read, _), (number, rows) in zip(load_logs(config, config.logs), LENGTHS.items(), strict=True):
        table = regular(rows)
        np.testing.assert_array_equal(read.observations[:, 0], table["q"] + number)
        np.testing.assert_array_equal(read.actions[:, 0], table["u"][:-1])


def test_a_column_that_is_in_none_is_refused(tmp_path: Path) -> None:
    written = hdf5(tmp_path)
    config = configured(Written(written.path, {**written.names, "q": "data/demo_*/p"}, written.episode), tmp_path)
    with pytest.raises(LogError, match=r"no column 'data/demo_\*/p'.*data/demo_\*/"):
        load_logs(config, config.logs)


def test_joints_in_numbered_groups_are_no_episodes() -> None:
    signal = np.zeros(50)
    assert numbered({"arm/joint_1/q": signal, "arm/joint_2/q": signal}, ["demo"]) is None
    assert (
        numbered({"arm/joint_1/q": signal, "demo_1/joint_1/q": signal, "demo_2/joint_1/q": signal}, ["demo"])
        == "demo_*"
    )
    assert numbered({"a[0].q": signal, "a[1].q": signal[:30]}, ["demo"]) == "a[*]"


@pytest.mark.parametrize("write", [hdf5, matlab])
def test_a_configuration_is_proposed(write, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    written = write(tmp_path)
    (tmp_path / "m.xml").write_text(PENDULUM)
    draft = propose(tmp_path / "m.xml", [written.path], tmp_path)
    assert draft.episode == written.episode
    assert {r.match.column for r in draft.readings} == {written.names["q"], written.names["u"]}
    assert [len(log.episodes) for log in draft.logs] == [2, 1]
    assert all(name in read_table(written.path, [written.names["q"]]) for name in (written.names["q"], written.episode))
