"""Fixtures that tests of several rooms use."""

from __future__ import annotations

import gc
import os
from pathlib import Path

import pytest

gc.set_threshold(20_000, 10, 10)  # so that looking for cycles of garbage takes no sixth of the suite's time
os.environ["MUJOCO_GL"] = "disabled"  # nothing is rendered but where a test asks for it
os.environ["SIPE_TRUST_MODELS"] = "1"  # a process for each model takes half a second; its own tests unset it


@pytest.fixture
def unreported(monkeypatch: pytest.MonkeyPatch) -> None:
    """Calibrations of this process write no report, which takes longer than a small fit and has tests of its own."""
    monkeypatch.setattr("sipe_bayes.calibration.output.write_report", lambda *_: None)


@pytest.fixture
def config(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The file of a cart's calibration, in the working directory; estimators half and twice as wide are registered."""
    from sipe_bayes.inference.registry import ESTIMATORS
    from tests.problems.carts import write_configuration

    for name in ("half", "twice"):
        monkeypatch.setitem(ESTIMATORS, name, ("tests.problems.planted", name.capitalize()))
    monkeypatch.chdir(tmp_path)
    return write_configuration(tmp_path)
