"""A payload of known mass in one log: it is simulated there, and it settles the scale of all forces."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pandas as pd
import pytest

from sipe_bayes.calibration.config_fields import ConfigError
from sipe_bayes.calibration.problem import prepare
from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.parameters import Parameter
from sipe_bayes.envs.added import Added
from sipe_bayes.envs.mjcf import MjcfEnvironment
from sipe_bayes.envs.target import TargetError
from sipe_bayes.simulation.simulator import Simulator

AXIS = """<mujoco><option timestep="0.002" integrator="implicitfast"/><worldbody><body name="cart">
  <joint name="rail" type="slide" axis="1 0 0" damping="{damping}"/><geom size=".1" mass="{cart}"/>
  <body name="load" pos="0 0 .1"><geom type="box" size=".05 .05 .05" mass="{load}"/></body></body></worldbody>
  <actuator><motor name="drive" joint="rail" gear="{gain}"/></actuator></mujoco>"""
TRUTH = {"damping": 3.0, "cart": 2.4, "gain": 0.8}
PARAMETERS = (
    Parameter("cart_mass", 0.5, 8.0, targets=("body:cart.mass",)),
    Parameter("gain", 0.3, 3.0, targets=("actuator:drive.gain",)),
    Parameter("damping", 0.0, 10.0, targets=("joint:rail.damping",)),
)
LOADS = {"empty": 0.0, "loaded": 3.0, "held": 1.5}


def driven(load: float, force: FloatArray) -> FloatArray:
    """Positions (n,) of the true axis at 100 Hz."""
    model = mujoco.MjModel.from_xml_string(AXIS.format(load=1e-6 + load, **TRUTH))
    data, out = mujoco.MjData(model), []
    for u in force:
        out.append(float(data.qpos[0]))
        data.ctrl[:] = u
        mujoco.mj_step(model, data, nstep=5)
    return np.array(out)


def test_it_is_the_model_with_that_mass() -> None:
    """Of a body that a parameter writes, and of one that none does; other logs and no log are without it."""
    text, force = AXIS.format(load=1.0, damping=1.0, cart=2.0, gain=1.0), np.sin(0.1 * np.arange(100))[:, None]
    added = [Added("b", "body:load.mass", 3.0), Added("b", "body:cart.mass", 1.0), Added("c", "body:cart.mass", 0.5)]
    simulator = Simulator(MjcfEnvironment.build(text, PARAMETERS, ["drive"], ["joint:rail.position"], added=added), 1)
    theta = np.full((4, 3), 0.4)
    starts = np.repeat(simulator.default_state()[None], 4, axis=0)
    seen = simulator.rollout(theta, np.stack([force] * 4), starts, 0.01, logs=["a", "b", "c", None]).observations
    assert simulator.checksum() != Simulator(replace(simulator.environment, added=()), 1).checksum()
    cart = float(PARAMETERS[0].value(0.4))
    for run, (own, load) in zip(seen, [(cart, 1.0), (cart + 1, 4.0), (cart + 0.5, 1.0), (cart, 1.0)], strict=True):
        plain = AXIS.format(load=load, damping=1.0, cart=2.0, gain=1.0)
        other = Simulator(MjcfEnvironment.build(plain, PARAMETERS, ["drive"], ["joint:rail.position"]), 1)
        same = np.array([float(PARAMETERS[0].normalise(own)), 0.4, 0.4])
        expected = other.rollout(same, force, other.default_state(), 0.01).observations[0]
        np.testing.assert_allclose(run, expected, rtol=0, atol=1e-9)


def test_an_inertia_that_is_unknown_stays_so_beside_it_and_no_mass_is_negative() -> None:
    text = AXIS.format(load=1.0, damping=1.0, cart=2.0, gain=1.0)
    unknown = [Parameter("inertia", 0.001, 0.1, targets=("body:load.inertia_yy",))]
    for value, physical in ((0.5, True), (-3.0, False)):
        added = [Added("b", "body:load.mass", value)]
        environment = MjcfEnvironment.build(text, unknown, ["drive"], ["joint:rail.position"], added=added)
        model = environment.compile()
        for log in ("a", "b"):
            assert environment.write(model, np.array([0.002]), log) == (physical or log == "a")
            assert np.isclose(model.body("load").inertia, 0.002).any() or not physical


@pytest.mark.parametrize(("target", "words"), [("joint:rail.damping", "only masses"), ("body:cast.mass", "'cast'")])
def test_what_is_no_mass_is_refused(target: str, words: str) -> None:
    text = AXIS.format(load=1.0, damping=1.0, cart=2.0, gain=1.0)
    with pytest.raises(TargetError, match=words):
        MjcfEnvironment.build(text, PARAMETERS, ["drive"], ["joint:rail.position"], added=[Added("a", target, 1.0)])


def configured(folder: Path, known: bool) -> Path:
    """A configuration with three logs, the loads of which it knows or does not."""
    rng, time = np.random.default_rng(0), 0.01 * np.arange(800)
    lines = ['model = "axis.xml"', "window = 0.5"]
    for k, (name, load) in enumerate(LOADS.items()):
        force = np.round(6 * np.sin((2 + 0.3 * k) * time) + 4 * np.sin((5.1 - 0.4 * k) * time), 3)
        position = driven(load, force) + rng.normal(0, 2e-4, len(time))
        pd.DataFrame({"t": time, "x": position, "u": force}).to_csv(folder / f"{name}.csv", index=False)
        more = f'\nadded = {{"body:load.mass" = {load}}}' if known and load else ""
        use = "holdout" if name == "held" else "train"
        lines += [f'[[logs]]\nfile = "{name}.csv"\nuse = "{use}"{more}']
    (folder / "axis.xml").write_text(AXIS.format(load=1e-6, damping=2.0, cart=2.0, gain=1.0))
    lines += [
        '[columns]\ntime = {column = "t", unit = "s"}',
        '[[commands]]\nactuator = "drive"\ncolumn = "u"\nunit = "1"',
    ]
    lines += ['[[measurements]]\ntarget = "joint:rail.position"\ncolumn = "x"\nunit = "m"']
    for one in PARAMETERS:
        bounds = f"[{one.low}, {one.high}]"
        lines += [f'[[parameters]]\nname = "{one.name}"\ntarget = "{one.targets[0]}"\nbounds = {bounds}']
    (folder / "calibrate.toml").write_text("\n".join(lines) + "\n")
    return folder / "calibrate.toml"


def test_a_weighed_load_settles_the_scale_of_forces(tmp_path: Path) -> None:
    import sipe_bayes as sipe

    result = sipe.calibrate(prepare(configured(tmp_path, True), 1))
    values = {p.name: (p.mode, p.sd) for p in result.parameters}
    print(values, [(s.log, s.rmse) for s in result.holdout])
    for name, truth in (("cart_mass", TRUTH["cart"]), ("gain", TRUTH["gain"]), ("damping", TRUTH["damping"])):
        assert abs(values[name][0] - truth) < 4 * values[name][1]
        assert values[name][1] < 0.05 * truth
    assert not result.misfit or not result.misfit.alarm
    unknown = sipe.calibrate(prepare(configured(tmp_path, False), 1))
    print([(p.name, p.sd) for p in unknown.parameters], unknown.holdout[0].rmse)
    assert unknown.misfit is not None
    assert unknown.misfit.alarm
    assert all(p.sd > 0.2 * p.mode for p in unknown.parameters)
    assert result.holdout[0].rmse < 0.6 * unknown.holdout[0].rmse


def test_a_wrong_target_in_a_configuration_is_a_line(tmp_path: Path) -> None:
    file = configured(tmp_path, True)
    file.write_text(file.read_text().replace('"body:load.mass" = 3.0', '"body:lode.mass" = 3.0'))
    with pytest.raises((ConfigError, TargetError), match="lode"):
        prepare(file, 1)
