"""`sipe init` on commands that are the widths of a servo's or a speed controller's pulses."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from sipe_bayes.calibration.init.propose import propose
from sipe_bayes.calibration.init.write import toml_of
from sipe_bayes.calibration.problem import prepare
from sipe_bayes.core.parameters import Parameter
from sipe_bayes.envs.mjcf import MjcfEnvironment
from sipe_bayes.simulation.simulator import Simulator

CART = """<mujoco><option timestep="0.005" integrator="implicitfast"/><worldbody><body name="cart">
  <joint name="rail" type="slide" axis="1 0 0" damping="2"/><geom size=".1" mass="1"/></body></worldbody><actuator>
  <motor name="fan" joint="rail" gear="GEAR" ctrllimited="true" ctrlrange="RANGE"/></actuator></mujoco>"""
DT, STEPS = 0.01, 500


@pytest.mark.parametrize(
    ("limits", "column", "low", "high", "zero", "span"),
    [
        ("0 1", "pwm", 1000, 1900, 1000.0, 1000.0),  # a fan that blows one way
        ("-1 1", "esc_us", 1150, 1850, 1500.0, 500.0),
        ("-1 1", "u", 1300, 1700, 1500.0, 500.0),  # told by the ctrlrange alone
        ("-2000 2000", "u", 900, 2100, 0.0, 1.0),  # a force
    ],
)
def test_pulses_become_shares_of_the_ctrlrange(
    tmp_path: Path, limits: str, column: str, low: int, high: int, zero: float, span: float
) -> None:
    """And the battery beside them does not scale what a ctrlrange of one takes."""
    (tmp_path / "cart.xml").write_text(CART.replace("RANGE", limits).replace("GEAR", f"{6 if span > 1 else 0.01}"))
    damping = Parameter("damping", 0.0, 4.0, targets=("joint:rail.damping",))
    environment = MjcfEnvironment.build(tmp_path / "cart.xml", [damping], ["fan"], ["joint:rail.position"])
    simulator, time, rng = Simulator(environment, 1), DT * np.arange(STEPS), np.random.default_rng(0)
    sway = np.sin(2.1 * time) * np.cos(0.7 * time)
    pulses = np.round((low + high) / 2 + (high - low) / 2 * sway)
    actions = ((pulses - zero) / span)[None, :, None]
    seen = simulator.rollout(np.full((1, 1), 0.5), actions, simulator.default_state()[None], DT).observations[0, :-1, 0]
    columns = {"time": time, "rail_m": seen + 1e-4 * rng.standard_normal(STEPS), column: pulses}
    pd.DataFrame(columns | {"vbat": np.full(STEPS, 16.2)}).to_csv(tmp_path / "log.csv", index=False)
    draft = propose(tmp_path / "cart.xml", [tmp_path / "log.csv"], tmp_path, None)
    (command,) = draft.commands
    print(command)
    assert (command.zero, command.supply, command.sign) == (zero, None, 1)
    assert command.factor == pytest.approx(1 / span)
    assert not any("outside of the ctrlrange" in doubt for doubt in draft.open_doubts), draft.open_doubts
    (tmp_path / "calibrate.toml").write_text(toml_of(draft, "sipe init"))
    held = prepare(tmp_path / "calibrate.toml", 1).train.actions[0, :200, 0]
    np.testing.assert_allclose(held, actions[0, :200, 0], atol=1e-6)
