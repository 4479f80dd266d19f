"""Three traps: a NaN in the log, a start that diverges, a cart of which only gear / mass shows.

Ours returns a usable posterior and says what happened. Where mujoco.sysid can be imported, what it does in the same
place is checked too: it returns the start, or dies. (That its answer depends on the start is a printed figure:
`bench.py rival`.) Should a test of its behaviour fail, the rival has improved, and what README and
docs/results/measured.md say of it must change.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sipe_bayes.calibration.problem import prepare
from sipe_bayes.calibration.run import calibrate
from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.diagnostics.result import Calibration, ParameterSummary
from tests.problems.sysid import (
    CART_STARTS,
    CART_XML,
    GEAR,
    MASS,
    SPRING,
    SPRING_UNKNOWNS,
    SPRING_XML,
    cart_log,
    cart_unknowns,
    rival,
    spring_log,
)

CONFIG = """
model = "model.xml"
window = 0.5
[columns]
time = {{ column = "time", unit = "s" }}
[[commands]]
actuator = "motor"
column = "force"
unit = "N"
[[measurements]]
name = "x"
column = "x"
target = "joint:slide.position"
unit = "m"
[[logs]]
file = "log.csv"
use = "train"
{parameters}
[noise]
model = "white"
"""
PARAMETER = """
[[parameters]]
name = "{0}"
target = "{1}"
bounds = [{2}, {3}]
scale = "{4}"
"""


def ours(folder: Path, xml: str, table: tuple[FloatArray, ...], unknowns: tuple[Any, ...]) -> Calibration:
    """What `sipe calibrate` finds, from files."""
    (folder / "model.xml").write_text(xml)
    np.savetxt(
        folder / "log.csv", np.column_stack(table), delimiter=",", header="time,force,x", comments="", fmt="%.17g"
    )
    parameters = "".join(PARAMETER.format(*u) for u in unknowns)
    (folder / "calibrate.toml").write_text(CONFIG.format(parameters=parameters))
    return calibrate(prepare(folder / "calibrate.toml"))


def summary(found: Calibration, name: str) -> ParameterSummary:
    return next(p for p in found.parameters if p.name == name)


def assert_near(found: Calibration, name: str, truth: float) -> None:
    """Within five sds of the truth (false alarms 6e-7), and well determined."""
    p = summary(found, name)
    assert abs(p.mean - truth) < 5 * p.sd, f"{name}: {p.mean} ± {p.sd}, truth {truth}"
    assert p.contraction > 0.8, f"{name}: contraction {p.contraction}"


def nan_log() -> tuple[FloatArray, ...]:
    time, force, position = spring_log()
    broken = position.copy()
    broken[400] = np.nan
    return time, force, broken


NAN_XML = SPRING_XML.format(stiffness=300.0, damping=0.2)
DIVERGING_XML = SPRING_XML.format(stiffness=8e5, damping=0.5)


def test_nan_in_the_log_costs_one_sample(tmp_path: Path) -> None:
    found = ours(tmp_path, NAN_XML, nan_log(), SPRING_UNKNOWNS)
    assert_near(found, "stiffness", SPRING[0])
    assert_near(found, "damping", SPRING[1])
    assert found.logs[0].missing["x"] == 1
    clean = tmp_path / "clean"
    clean.mkdir()
    whole = ours(clean, NAN_XML, spring_log(), SPRING_UNKNOWNS)
    assert not whole.logs[0].missing.get("x", 0)
    for name in ("stiffness", "damping"):
        with_nan, without = summary(found, name), summary(whole, name)
        assert abs(with_nan.mean - without.mean) < 0.5 * without.sd


def test_nan_in_the_log_is_named_to_the_reader(tmp_path: Path) -> None:
    found = ours(tmp_path, NAN_XML, nan_log(), SPRING_UNKNOWNS)
    print(found.logs[0].notes)
    assert any("x" in note and "1" in note for note in found.logs[0].notes), found.logs[0].notes


def test_start_that_diverges_is_left_and_named(tmp_path: Path) -> None:
    found = ours(tmp_path, DIVERGING_XML, spring_log(), SPRING_UNKNOWNS)
    assert_near(found, "stiffness", SPRING[0])
    assert_near(found, "damping", SPRING[1])
    assert any("model as given diverges" in w for w in found.warnings), found.warnings


@pytest.mark.parametrize("scale", ["log", "linear"])
def test_cart_gives_one_answer_and_names_the_ridge(tmp_path: Path, scale: str) -> None:
    found = []
    for k, (gear, mass) in enumerate(CART_STARTS):
        folder = tmp_path / str(k)
        folder.mkdir()
        found.append(ours(folder, CART_XML.format(gear=gear, mass=mass), cart_log(), cart_unknowns(scale)))
    spreads = []
    for one in found:
        draws = one.posterior.values(4000)
        ratio = draws[:, 0] / draws[:, 1]
        print(f"gear / mass {ratio.mean():.4f} ± {ratio.std():.4f}, truth {GEAR / MASS}; {one.warnings}")
        assert abs(ratio.mean() / (GEAR / MASS) - 1) < 0.03
        assert ratio.std() < 0.03 * ratio.mean()
        for name in ("gear", "mass"):
            assert summary(one, name).contraction < 0.5
        assert [set(r.parameters) for r in one.ridges] == [{"gear", "mass"}]
        words = " ".join(one.warnings)
        assert "gear and mass alone are not" in words, one.warnings
        assert scale == "linear" or "gear / mass = " in words or "mass / gear = " in words, one.warnings
        spreads.append(np.quantile(draws, [0.05, 0.25, 0.5, 0.75, 0.95], axis=0))
    first = spreads[0]
    for other in spreads[1:]:  # 4000 draws: a quantile's standard error is at most 2.5 % of the spread
        np.testing.assert_array_less(np.abs(other - first), 0.12 * (first[-1] - first[0]) * np.ones((5, 1)))


def test_sysid_returns_the_start_when_the_log_holds_a_nan(tmp_path: Path, monkeypatch: Any) -> None:
    pytest.importorskip("mujoco.sysid._src.optimize", reason="mujoco[sysid] is not installed")
    monkeypatch.chdir(tmp_path)
    found = rival(NAN_XML, nan_log(), SPRING_UNKNOWNS)
    np.testing.assert_array_equal(found.value, found.start)
    whole = rival(NAN_XML, spring_log(), SPRING_UNKNOWNS)  # the NaN is to blame, not the set-up
    np.testing.assert_allclose(whole.value, SPRING, rtol=0.1)


def test_sysid_dies_when_the_start_diverges(tmp_path: Path, monkeypatch: Any) -> None:
    pytest.importorskip("mujoco.sysid._src.optimize", reason="mujoco[sysid] is not installed")
    monkeypatch.chdir(tmp_path)  # MuJoCo writes MUJOCO_LOG.TXT
    with pytest.raises(ValueError, match="times must be strictly increasing"):
        rival(DIVERGING_XML, spring_log(), SPRING_UNKNOWNS)
