"""Controllers that firmware samples: against MuJoCo's own at the physics rate, and against a loop written out."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.parameters import Parameter
from sipe_bayes.envs.laws.firmware import Firmware
from sipe_bayes.envs.mjcf import MjcfEnvironment
from sipe_bayes.envs.target import TargetError
from sipe_bayes.simulation.simulator import Simulator

XML = """<mujoco><option timestep="0.001" integrator="Euler"><flag eulerdamp="disable"/></option><worldbody>
  <body><joint name="j" armature=".005" damping=".02" axis="0 1 0"/><geom size=".02" pos="0 0 -.1" mass=".1"/></body>
  <body pos="1 0 0"><joint name="ball" type="ball"/><geom size=".1"/></body>
  </worldbody><actuator>{}</actuator></mujoco>"""
POSITION = '<position name="a" joint="j" kp="2" kv=".05" gear="2" forcerange="-1 1" ctrlrange="-.9 .9"/>'
CONTROLLERS = {  # and what an integral or a filter summed once a step may be off by, of about 1 rad
    "position": (POSITION, 0.0),
    "velocity": ('<velocity name="a" joint="j" kv=".3"/>', 0.0),
    "filtered": ('<position name="a" joint="j" kp="2" kv=".05" timeconst=".1"/>', 0.02),
    "pid": ('<pid name="a" joint="j" input="pos" kp="2" kv=".05"/>', 0.0),
    "integral": ('<pid name="a" joint="j" input="pos" kp="2" kv=".05" ki="8" imax=".1" slewmax="4"/>', 0.02),
    "motor": (
        '<dcmotor name="a" joint="j" resistance="2" motorconst=".3" input="pos" controller="2 0 .05 0 0 6"/>',
        0.0,
    ),
    "speed": ('<dcmotor name="a" joint="j" resistance="2" motorconst=".3" input="vel" controller="0 0 .2 0 0 6"/>', 0),
    "all": (
        '<dcmotor name="a" joint="j" resistance="2" motorconst=".3" input="pos" controller="2 6 .05 3 .1 6"'
        ' saturation=".5 0 0" inductance="0 .01"/>',
        0.02,
    ),
    "late": ('<position name="a" joint="j" kp="2" kv=".05" delay=".0125" nsample="40" interp="linear"/>', 0.0),
}
DT = 0.005


def simulator(actuator: str, *firmware: Firmware) -> Simulator:
    damping = Parameter("damping", 0.0, 0.04, targets=("joint:j.damping",))
    return Simulator(MjcfEnvironment.build(XML.format(actuator), [damping], ["a"], ["joint:j.position"], firmware), 1)


def set_points(steps: int) -> FloatArray:
    return np.repeat(np.random.default_rng(0).uniform(-1, 1, (1, steps // 10, 1)), 10, axis=1)


def positions(sim: Simulator, actions: FloatArray, start: FloatArray | None = None) -> FloatArray:
    begin = sim.default_state()[None] if start is None else start
    if start is None:
        sim.environment.history(sim.model, begin, [np.zeros((1, actions.shape[2]))], np.array([0.001]))  # type: ignore[attr-defined]
    rollout = sim.rollout(np.full((1, 1), 0.5), actions, begin, DT)
    assert rollout.valid.all()
    return rollout.observations[..., 0]


@pytest.mark.parametrize("kind", CONTROLLERS)
def test_at_the_physics_rate_it_is_mujocos_own_controller(kind: str) -> None:
    actuator, tolerance = CONTROLLERS[kind]
    native = positions(simulator(actuator), set_points(120))
    fast = positions(simulator(actuator, Firmware("a", 1000.0)), set_points(120))
    slow = positions(simulator(actuator, Firmware("a", 50.0)), set_points(120))
    np.testing.assert_allclose(fast, native, atol=tolerance + 1e-9)
    assert np.abs(slow - native).max() > max(2 * tolerance, 0.005)


def written_out(actions: FloatArray) -> FloatArray:
    """The servo of ``POSITION`` at 50 Hz, its supply the second action, as one would write it."""
    model = mujoco.MjModel.from_xml_string(XML.format('<motor name="a" joint="j" gear="2"/>'))
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_WARMSTART
    data, force, out = mujoco.MjData(model), 0.0, [0.0]
    for k, (goal, share) in enumerate(actions):
        for step in range(5):
            if (5 * k + step) % 20 == 0:
                goal_now = np.clip(goal, -0.9, 0.9)
                force = np.clip(2 * (goal_now - 2 * data.qpos[0]) - 0.05 * 2 * data.qvel[0], -1, 1)
            data.ctrl[0] = force * share
            mujoco.mj_step(model, data)
        out.append(float(data.qpos[0]))
    return np.array(out)


def test_a_servo_at_50_hz_with_a_supply_is_the_loop_written_out() -> None:
    sim = simulator(POSITION, Firmware("a", 50.0, "supply"))
    shares = np.random.default_rng(1).uniform(0.6, 1.1, (1, 120, 1))
    actions = np.concatenate([set_points(120), shares], axis=-1)
    np.testing.assert_allclose(positions(sim, actions)[0], written_out(actions[0]), atol=1e-9)


@pytest.mark.parametrize("kind", ["position", "all", "late"])
def test_cut_at_ticks_and_batched_it_goes_on_bit_for_bit(kind: str) -> None:
    sim, actions = simulator(CONTROLLERS[kind][0], Firmware("a", 50.0)), set_points(40)
    start = sim.default_state()[None]
    sim.environment.history(sim.model, start, [np.zeros((1, 1))], np.array([0.001]))  # type: ignore[attr-defined]
    whole = sim.rollout(np.full((1, 1), 0.5), actions, start, DT)
    assert whole.states is not None
    again = sim.rollout(np.full((1, 1), 0.5), actions[:, 16:], whole.states[:, 16], DT)
    np.testing.assert_array_equal(again.observations, whole.observations[:, 16:])
    both = sim.rollout(
        np.full((2, 1), 0.5), np.stack([actions[0, :20], actions[0, 16:36]]), whole.states[0, [0, 16]], DT
    )
    np.testing.assert_allclose(both.observations[1], whole.observations[0, 16:37], atol=1e-12)


def test_between_two_ticks_the_output_is_that_of_the_last_one() -> None:
    sim, actions = simulator(POSITION, Firmware("a", 50.0)), np.full((1, 40, 1), 0.3)
    whole = sim.rollout(np.full((1, 1), 0.5), actions, sim.default_state()[None], DT)
    assert whole.states is not None
    again = sim.rollout(np.full((1, 1), 0.5), actions[:, 6:], whole.states[:, 6], DT).observations
    unlike = sim.rollout(
        np.full((1, 1), 0.5), actions[:, 6:], whole.states[:, 6] * (np.arange(whole.states.shape[2]) > 0), DT
    ).observations
    off, restarted = (np.abs(x - whole.observations[:, 6:]).max() for x in (again, unlike))
    assert off < restarted / 4, f"{off:.4f}, with the clock begun anew {restarted:.4f}"


@pytest.mark.parametrize(
    ("actuator", "firmware", "words"),
    [
        ('<motor name="a" joint="j"/>', Firmware("a", 50.0), "'a': `rate` is for a controller with one set-point"),
        ('<motor name="a" joint="j"/>', Firmware("b", 50.0), "no such actuator"),
        ('<dcmotor name="a" joint="j" resistance="2" motorconst=".3"/>', Firmware("a", 50.0), "one set-point"),
        ('<position name="a" joint="ball" kp="2"/>', Firmware("a", 50.0), "of one hinge or slide joint"),
        ('<intvelocity name="a" joint="j" kp="2" actrange="-1 1"/>', Firmware("a", 50.0), "without dynamics"),
    ],
)
def test_what_can_not_be_sampled_is_refused(actuator: str, firmware: Firmware, words: str) -> None:
    with pytest.raises(TargetError, match=words):
        simulator(actuator, firmware)
