"""`sipe init` on commands that are the widths of a servo's or a speed controller's pulses."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from sipe_bayes.calibration.init.propose import propose
from sipe_bayes.calibration.init.validate import validate_config
from sipe_bayes.calibration.init.write import toml_of
from sipe_bayes.calibration.problem import prepare
from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.parameters import Parameter
from sipe_bayes.envs.mjcf import MjcfEnvironment
from sipe_bayes.simulation.simulator import Simulator

CART = """<mujoco><option timestep="0.005" integrator="implicitfast"/><worldbody><body name="cart">
  <joint name="rail" type="slide" axis="1 0 0" damping="2"/><geom size=".1" mass="1"/></body></worldbody><actuator>
  <motor name="fan" joint="rail" gear="GEAR" ctrllimited="true" ctrlrange="RANGE"/></actuator></mujoco>"""
DT, STEPS = 0.01, 500
TIME = DT * np.arange(STEPS)
SWAY = np.sin(2.1 * TIME) * np.cos(0.7 * TIME)


def _record(folder: Path, limits: str, gear: float, column: str, pulses: FloatArray, actions: FloatArray) -> None:
    """A cart's model and log, with a battery."""
    (folder / "cart.xml").write_text(CART.replace("RANGE", limits).replace("GEAR", f"{gear}"))
    damping = Parameter("damping", 0.0, 4.0, targets=("joint:rail.damping",))
    environment = MjcfEnvironment.build(folder / "cart.xml", [damping], ["fan"], ["joint:rail.position"])
    simulator, rng = Simulator(environment, 1), np.random.default_rng(0)
    run = simulator.rollout(np.full((1, 1), 0.5), actions[None, :, None], simulator.default_state()[None], DT)
    seen = run.observations[0, :-1, 0] + 1e-4 * rng.standard_normal(STEPS)
    columns = {"time": TIME, "rail_m": seen, column: pulses, "vbat": np.full(STEPS, 16.2)}
    pd.DataFrame(columns).to_csv(folder / "log.csv", index=False)


@pytest.mark.parametrize(
    ("limits", "column", "low", "high", "zero", "span"),
    [
        ("0 1", "pwm", 1000, 1900, 1000.0, 1000.0),  # a fan that blows one way
        ("-1 1", "esc_us", 1150, 1850, 1500.0, 500.0),
        ("-1 1", "u", 1300, 1700, 1500.0, 500.0),  # told by the ctrlrange alone
        ("-2000 2000", "u", 900, 2100, 0.0, 1.0),  # a force
    ],
)  # fmt: skip
def test_pulses_become_shares_of_the_ctrlrange(
    tmp_path: Path, limits: str, column: str, low: int, high: int, zero: float, span: float
) -> None:
    """And the battery beside them does not scale what a ctrlrange of one takes."""
    pulses = np.round((low + high) / 2 + (high - low) / 2 * SWAY)
    actions = (pulses - zero) / span
    _record(tmp_path, limits, 6 if span > 1 else 0.01, column, pulses, actions)
    draft = propose(tmp_path / "cart.xml", [tmp_path / "log.csv"], tmp_path, None)
    (command,) = draft.commands
    assert (command.zero, command.supply, command.sign) == (zero, None, 1)
    assert command.factor == pytest.approx(1 / span)
    assert not any("outside of the ctrlrange" in doubt for doubt in draft.open_doubts), draft.open_doubts
    (tmp_path / "calibrate.toml").write_text(toml_of(draft, "sipe init"))
    held = prepare(tmp_path / "calibrate.toml", 1).train.actions[0, :200, 0]
    np.testing.assert_allclose(held, actions[:200], atol=1e-6)


def test_a_command_that_its_ctrlrange_cuts_off_is_odd(tmp_path: Path) -> None:
    """As a share that is scaled by the battery's volts: the check says so, and of the right one nothing."""
    pulses = np.round(1450 + 450 * SWAY)
    _record(tmp_path, "0 1", 6, "pwm", pulses, (pulses - 1000) / 1000)
    right = toml_of(propose(tmp_path / "cart.xml", [tmp_path / "log.csv"], tmp_path, None), "sipe init")
    for name, text in {"right": right, "wrong": right.replace("zero = 1000.0", "zero = 100.0")}.items():
        (tmp_path / f"{name}.toml").write_text(text)
    assert not any("ctrlrange" in line for line in validate_config(tmp_path / "right.toml").odd)
    odd = validate_config(tmp_path / "wrong.toml").odd
    cut = "% of it lies outside of the ctrlrange [0.0, 1.0] of actuator:fan"
    assert any("column 'pwm'" in line and cut in line for line in odd), odd


def test_a_controller_that_is_not_armed_yet_is_doubted(tmp_path: Path) -> None:
    pulses = np.where(np.arange(STEPS) < 20, 0.0, np.round(1500 + 350 * SWAY))
    _record(tmp_path, "-1 1", 6, "esc_us", pulses, np.where(pulses > 0, (pulses - 1500) / 500, 0.0))
    draft = propose(tmp_path / "cart.xml", [tmp_path / "log.csv"], tmp_path, None)
    assert any("before a controller is armed, which is read as -3" in doubt for doubt in draft.open_doubts)
