"""Firmware in a configuration: what a log's column of commands may be, and what leaving the firmware out costs."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from sipe_bayes.calibration.config import load_config
from sipe_bayes.calibration.config_fields import ConfigError
from sipe_bayes.calibration.problem import method_of, prepare
from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.parameters import Parameter
from sipe_bayes.envs.laws.firmware import Firmware
from sipe_bayes.envs.mjcf import MjcfEnvironment
from sipe_bayes.simulation.simulator import Simulator

PAGE = Path(__file__).parents[2] / "docs" / "firmware.md"
XML = """<mujoco><option timestep="0.001" integrator="implicitfast"/><worldbody><body>
  <joint name="shaft" armature=".004" damping=".03" axis="0 1 0"/>
  <geom type="capsule" fromto="0 0 0 0 0 -.15" size=".01" mass=".15"/></body></worldbody><actuator>
  {actuator}</actuator></mujoco>"""
ACTUATORS = {
    "servo": '<position name="servo" joint="shaft" kp="2" kv=".02" forcerange="-1.2 1.2"/>',
    "torque": '<motor name="torque" joint="shaft"/>',
    "driven": '<dcmotor name="driven" joint="shaft" resistance="2" motorconst=".3"/>',
    "drive": """<dcmotor name="drive" joint="shaft" input="pos" resistance="2" motorconst=".3"
      controller="3 0 .1 0 0 7"/>""",
}
REST = """model = "servo.xml"
window = 0.5
{commands}
[[measurements]]
column = "angle"
target = "joint:shaft.position"
unit = "deg"
[[logs]]
file = "log.csv"
[[parameters]]
name = "damping"
target = "joint:shaft.damping"
bounds = [0.0, 0.2]
"""
GAINS = """[[parameters]]
name = "kp"
target = "actuator:servo.kp"
bounds = [0.5, 10.0]
[[parameters]]
name = "kv"
target = "actuator:servo.kv"
bounds = [0.0, 0.5]
"""
SERVO = '[[commands]]\nactuator = "servo"\ncolumn = "goal"\nunit = "deg"\n'
TRUTH = {"damping": 0.05, "kp": 3.0, "kv": 0.06}
BATTERY, STEPS, DT = 7.4, 600, 0.005


def recorded(folder: Path, seed: int, actuator: str = "servo") -> None:
    """A log at 200 Hz of a servo that samples at 50 Hz, on a battery that falls; the model begins elsewhere."""
    rng = np.random.default_rng(seed)
    damping = Parameter("damping", 0.0, 0.1, targets=("joint:shaft.damping",))
    xml = XML.format(actuator=ACTUATORS["servo"].replace('kp="2" kv=".02"', 'kp="3" kv=".06"'))
    firmware = Firmware("servo", 50.0, "supply")
    sim = Simulator(MjcfEnvironment.build(xml, [damping], ["servo"], ["joint:shaft.position"], [firmware]), 1)
    goal = np.repeat(rng.uniform(-0.8, 0.8, STEPS // 40), 40)
    battery = BATTERY - 0.8 * np.linspace(0, 1, STEPS)
    actions = np.stack([goal, battery / BATTERY], axis=-1)[None]
    angle = sim.rollout(np.full((1, 1), 0.5), actions, sim.default_state()[None], DT).observations[0, :, 0]
    angle = angle + 1e-3 * rng.standard_normal(STEPS + 1)
    columns = [np.degrees(goal), np.full(STEPS, 20.0), battery, np.linspace(-1, 1, STEPS)]
    table = [np.arange(STEPS + 1) * DT, *(np.append(c, c[-1]) for c in columns), np.degrees(angle)]
    header = "time,goal,duty,battery,current,angle"
    np.savetxt(folder / "log.csv", np.stack(table, axis=-1), delimiter=",", header=header, comments="", fmt="%.6f")
    (folder / "servo.xml").write_text(XML.format(actuator=ACTUATORS[actuator]), encoding="utf-8")


def configured(folder: Path, commands: str, unknowns: str = "") -> Path:
    path = folder / "calibrate.toml"
    path.write_text(REST.format(commands=commands) + unknowns, encoding="utf-8")
    return path


BLOCKS = re.findall(r"```toml\n(.*?)```", PAGE.read_text(encoding="utf-8"), flags=re.DOTALL)


@pytest.mark.parametrize("block", BLOCKS, ids=lambda block: re.findall(r'actuator = "(\w+)"', block)[0])
def test_every_configuration_of_the_page_runs(tmp_path: Path, block: str) -> None:
    recorded(tmp_path, 0, next(name for name in ACTUATORS if f'actuator = "{name}"' in block))
    problem = prepare(configured(tmp_path, block), 1)
    simulator, log = problem.simulator, problem.train
    rollout = simulator.rollout(simulator.space.default_theta[None], log.actions, simulator.default_state()[None], DT)
    assert rollout.valid.all()
    assert np.ptp(rollout.observations) > 0.01
    if "driven" in block:
        given = np.loadtxt(tmp_path / "log.csv", delimiter=",", skiprows=1)
        np.testing.assert_allclose(log.actions[0, :, 0], 0.2 * given[:-1, 3], rtol=1e-5)


def sds_off(folder: Path, commands: str) -> FloatArray:
    problem = prepare(configured(folder, commands, GAINS), 1)
    posterior = method_of(problem, None, None, None).fit(problem.train)
    values = posterior.values(2000)
    return np.asarray((values.mean(0) - np.array(list(TRUTH.values()))) / values.std(0))


def test_with_its_firmware_a_servo_is_recovered_and_without_it_is_not(tmp_path: Path) -> None:
    """Three sds of each of three values: a false alarm in 1 of 120 seeds; this one is fixed."""
    recorded(tmp_path, 1)
    supply = f'supply = {{ column = "battery", unit = "V", nominal = {BATTERY} }}\n'
    off, without = sds_off(tmp_path, SERVO + "rate = 50\n" + supply), sds_off(tmp_path, SERVO)
    assert np.abs(off).max() < 3, off
    assert np.abs(without).max() > 6, without


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        (
            "rate = 50\nsupply = { column = 'battery' }",
            r"commands\[0\].supply.nominal.*a controller with `rate` needs it",
        ),
        ("supply = { column = 'battery' }", r"commands\[0\].unit.*got 'deg'; a supply scales a duty"),
        (
            "rate = 50\nsupply = { column = 'battery', unit = 'A', nominal = 7 }",
            "supply.unit.*expected a unit of voltage",
        ),
        ("rate = 0", "commands.*rate.*greater than 0"),
    ],
)
def test_keys_that_do_not_go_together_are_refused(tmp_path: Path, keys: str, words: str) -> None:
    recorded(tmp_path, 0)
    with pytest.raises(ConfigError, match=words):
        load_config(configured(tmp_path, SERVO + keys))
