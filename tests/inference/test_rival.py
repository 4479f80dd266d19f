"""Three traps: a NaN in the log, a start that diverges, a cart of which only gear / mass shows.

Ours returns a usable posterior and says what happened. Where mujoco.sysid can be imported, what it does in the same place
is checked too: it returns the start, dies, and gives an answer that depends on the start. Should a test of its behaviour
fail, the rival has improved, and what the README says of it must change.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import mujoco
import mujoco.rollout
import numpy as np
import pytest
from numpy.typing import NDArray

from sipe_bayes.calibration.problem import prepare
from sipe_bayes.calibration.run import calibrate
from sipe_bayes.diagnostics.result import Calibration, ParameterSummary

FloatArray = NDArray[np.float64]

DT, STEPS = 0.002, 1000
SPRING = 100.0, 0.5  # stiffness, damping of the truth
GEAR, MASS = 2.0, 0.8  # of the truth; only their ratio shows
NOISE = 1e-3  # m

# a model's own value is where mujoco.sysid is started, and what ours takes as the model as given
SPRING_XML = """
<mujoco><option timestep="0.002"/><worldbody><body name="block"><joint name="slide" type="slide" axis="1 0 0"
stiffness="{stiffness}" damping="{damping}"/><geom size="0.05" mass="0.1"/></body></worldbody>
<actuator><motor name="motor" joint="slide"/></actuator><sensor><jointpos name="x" joint="slide"/></sensor></mujoco>
"""
CART_XML = """
<mujoco><option timestep="0.002"/><worldbody><body name="cart"><joint name="slide" type="slide" axis="1 0 0"/>
<geom size="0.05" mass="{mass}"/></body></worldbody>
<actuator><motor name="motor" joint="slide" gear="{gear}"/></actuator>
<sensor><jointpos name="x" joint="slide"/></sensor></mujoco>
"""
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
SPRING_UNKNOWNS = (
    ("stiffness", "joint:slide.stiffness", 10.0, 1e6, "log"),
    ("damping", "joint:slide.damping", 0.05, 5.0, "log"),
)
CART_STARTS = ((0.5, 0.25), (0.5, 3.0), (2.0, 1.0))  # gear, mass


def cart_unknowns(scale: str) -> tuple[tuple[str, str, float, float, str], ...]:
    return ("gear", "actuator:motor.gear", 0.2, 8.0, scale), ("mass", "body:cart.mass", 0.1, 4.0, scale)


def forces(time: FloatArray) -> FloatArray:
    return np.sin(2 * np.pi * 1.3 * time) + 0.6 * np.sin(2 * np.pi * 3.1 * time + 0.4)


@cache
def log(xml: str, seed: int = 0) -> tuple[FloatArray, FloatArray, FloatArray]:
    """time (T+1,), force (T+1,) and position (T+1,) with white noise, from rest."""
    model = mujoco.MjModel.from_xml_string(xml)
    time = np.arange(STEPS + 1) * DT
    force = forces(time)
    state, _ = mujoco.rollout.rollout(model, mujoco.MjData(model), np.zeros(3), force[:-1, None])
    position = np.concatenate([[0.0], state[0, :, 1]])
    return time, force, position + NOISE * np.random.default_rng(seed).standard_normal(STEPS + 1)


def spring_log() -> tuple[FloatArray, FloatArray, FloatArray]:
    return log(SPRING_XML.format(stiffness=SPRING[0], damping=SPRING[1]))


def cart_log() -> tuple[FloatArray, FloatArray, FloatArray]:
    return log(CART_XML.format(gear=GEAR, mass=MASS))


def ours(folder: Path, xml: str, table: tuple[FloatArray, ...], unknowns: tuple[Any, ...]) -> Calibration:
    """What `sipe calibrate` finds, from files."""
    (folder / "model.xml").write_text(xml)
    np.savetxt(
        folder / "log.csv", np.column_stack(table), delimiter=",", header="time,force,x", comments="", fmt="%.17g"
    )
    parameters = "".join(PARAMETER.format(*u) for u in unknowns)
    (folder / "calibrate.toml").write_text(CONFIG.format(parameters=parameters))
    return calibrate(prepare(folder / "calibrate.toml"))


def rival(xml: str, table: tuple[FloatArray, ...], unknowns: tuple[Any, ...]) -> SimpleNamespace:
    """What mujoco.sysid finds: start and value, by parameter. Raises what it raises."""
    from mujoco import sysid

    time, force, position = table
    spec = mujoco.MjSpec.from_string(xml)
    model, params = spec.compile(), sysid.ParameterDict()
    for name, target, low, high, _ in unknowns:
        start, write = _modifier(spec, target)
        params.add(sysid.Parameter(name, start, low, high, modifier=write))
    # sensordata of the state before a step carry the time after it, as mujoco.rollout returns them
    measured = sysid.TimeSeries.from_names(time[1:], position[:-1, None], model)
    state = sysid.create_initial_state(model, np.zeros(1), np.zeros(1), np.zeros(0))
    control = sysid.TimeSeries(time, force[:, None])
    sequence = sysid.ModelSequences("model", spec, "log", state, control, measured)
    residual = sysid.build_residual_fn(models_sequences=[sequence])
    start = params.as_vector()
    found, _ = sysid.optimize(params, residual, verbose=False)
    return SimpleNamespace(start=start, value=found.as_vector())


def _modifier(spec: Any, target: str) -> tuple[float, Any]:
    """A parameter's value in the model and what writes it, for mujoco.sysid."""
    if target == "joint:slide.stiffness":
        return spec.joint("slide").stiffness[0], lambda s, p: s.joint("slide").stiffness.__setitem__(0, p.value[0])
    if target == "joint:slide.damping":
        return spec.joint("slide").damping[0], lambda s, p: s.joint("slide").damping.__setitem__(0, p.value[0])
    if target == "actuator:motor.gear":
        return spec.actuator("motor").gear[0], lambda s, p: s.actuator("motor").gear.__setitem__(0, p.value[0])
    return spec.geoms[0].mass, lambda s, p: setattr(s.geoms[0], "mass", p.value[0])


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
    assert found.logs[0]["missing"]["x"] == 1
    clean = tmp_path / "clean"
    clean.mkdir()
    whole = ours(clean, NAN_XML, spring_log(), SPRING_UNKNOWNS)
    assert not whole.logs[0]["missing"].get("x", 0)
    for name in ("stiffness", "damping"):
        with_nan, without = summary(found, name), summary(whole, name)
        assert abs(with_nan.mean - without.mean) < 0.5 * without.sd


def test_nan_in_the_log_is_named_to_the_reader(tmp_path: Path) -> None:
    found = ours(tmp_path, NAN_XML, nan_log(), SPRING_UNKNOWNS)
    print(found.logs[0]["notes"])
    assert any("x" in note and "1" in note for note in found.logs[0]["notes"]), found.logs[0]["notes"]


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


def test_sysid_answers_differ_from_start_to_start(tmp_path: Path, monkeypatch: Any) -> None:
    pytest.importorskip("mujoco.sysid._src.optimize", reason="mujoco[sysid] is not installed")
    monkeypatch.chdir(tmp_path)
    values = np.array(
        [rival(CART_XML.format(gear=g, mass=m), cart_log(), cart_unknowns("log")).value for g, m in CART_STARTS]
    )
    np.testing.assert_allclose(values[:, 0] / values[:, 1], GEAR / MASS, rtol=0.02)
    gears = values[:, 0]
    print("gear, mass of three starts:", values.round(3).tolist())
    assert gears.max() > 2 * gears.min(), values
