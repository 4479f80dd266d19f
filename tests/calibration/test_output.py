"""Whose a folder of results is."""

from __future__ import annotations

from pathlib import Path

import pytest

from sipe_bayes.calibration.output import claimed
from sipe_bayes.core.files import OutputError

RUN = {"seed": 0}


def test_one_run_at_a_time_and_the_same_may_come_back(tmp_path: Path) -> None:
    folder = tmp_path / "out"
    with claimed(folder, RUN, keys=("seed",)):
        (folder / "checkpoint").touch()
        with pytest.raises(OutputError, match="another run is at work in it"), claimed(folder, RUN, keys=("seed",)):
            pass
    with claimed(folder, RUN, keys=("seed",)):
        pass
    with pytest.raises(OutputError, match="differs in seed"), claimed(folder, {"seed": 1}, keys=("seed",)):
        pass


def refused(folder: Path, kept: bool) -> None:
    with claimed(folder, RUN, keys=("seed",)):
        if kept:
            (folder / "checkpoint").touch()
        raise ValueError("refused")


@pytest.mark.parametrize("kept", [False, True])
def test_what_is_refused_before_it_keeps_anything_leaves_no_folder(tmp_path: Path, kept: bool) -> None:
    with pytest.raises(ValueError, match="refused"):
        refused(tmp_path / "out", kept)
    assert (tmp_path / "out").exists() == kept
