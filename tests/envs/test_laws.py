"""Laws simulated by the engine as by a plain MuJoCo loop, on three machines; at neutral numbers they are the model."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any
from unittest import mock

import mujoco
import numpy as np
import pytest

from sipe_bayes.calibration.machine import Machine
from sipe_bayes.core.parameters import Parameter
from sipe_bayes.envs.laws.base import Law, LawError
from sipe_bayes.envs.laws.bound import declare, laws_of
from sipe_bayes.envs.laws.registry import LAWS
from sipe_bayes.envs.laws.residual import Residual
from sipe_bayes.envs.mjcf import MjcfEnvironment
from sipe_bayes.envs.target import TargetError
from sipe_bayes.simulation.simulator import Simulator
from tests.problems.machines import MACHINES, Drive, environment

FULL = mujoco.mjtState.mjSTATE_FULLPHYSICS
HORIZON = 40
NUMBERS = {  # bounds of each number of a law: large against the machines' forces
    "load_friction": (0.0, 0.6),
    **dict.fromkeys(("direction_friction", "direction_gain"), (-0.4, 0.4)),
    **dict.fromkeys(("direction_damping", "force_drop"), (-0.2, 0.2)),
    **dict.fromkeys(("stribeck_friction", "presliding_friction", "hysteresis_force"), (0.0, 0.8)),
    **dict.fromkeys(("cogging_sin", "cogging_cos"), (-0.5, 0.5)),
    "stribeck_velocity": (0.05, 2.0),
    "presliding_range": (0.01, 0.2),
    "hysteresis_range": (0.02, 0.5),
    "supply_sag": (0.0, 0.3),
    "cogging_poles": (1.0, 12.0),
    "exponent": (0.7, 1.4),
    "exponent_force": (0.5, 2.0),
    "dead_zone": (0.0, 0.5),
    **dict.fromkeys(Residual.scales, (0.3, 2.0)),
    **{number.attribute: (-0.3, 0.3) for number in Residual.numbers[3:]},
}
CASES = [(name, machine) for name in LAWS for machine in MACHINES]


def lawful(drive: Drive, law: Law) -> MjcfEnvironment:
    """A machine with a law at every joint or actuator, all its numbers unknown."""
    owners = drive.joints if law.kind == "joint" else drive.actuators
    extra = [
        Parameter(f"{owner}.{n.attribute}", *NUMBERS[n.attribute], targets=(f"{law.kind}:{owner}.{n.attribute}",))
        for owner in owners
        for n in law.numbers
    ]
    return environment(drive, extra)


def drawn(simulator: Simulator, batch: int = 5) -> tuple[Any, Any, Any]:
    """Random theta (B, N), actions (B, T, A) and starts (B, S)."""
    rng, model = np.random.default_rng(3), simulator.model
    starts = np.tile(simulator.default_state(), (batch, 1))
    starts[:, 1 : 1 + model.nq + model.nv] += rng.normal(0, 0.7, (batch, model.nq + model.nv))
    starts[:, 1 + model.nq + model.nv :] = rng.uniform(-1, 1, (batch, model.na))
    actions = rng.normal(0, 2, (batch, HORIZON // 4, simulator.environment.num_actions)).repeat(4, axis=1)
    return rng.random((batch, len(simulator.space))), actions, starts


def plain_value(
    name: str, p: Any, q: float, v: float, u: float, torque: float, force: float, total: float, memory: Any
) -> float:
    """The laws as their module states them, one number at a time."""
    if name == "residual":
        place = np.array([q / p[0], v / p[1], u / p[2]])
        features = [np.cos(Residual.frequencies[:, k] @ place + Residual.phases[k]) for k in range(len(p) - 3)]
        return float(np.dot(p[3:], features) * np.sqrt(2 / (len(p) - 3)))
    values: dict[str, Callable[[], float]] = {
        "load_friction": lambda: p[0] * abs(torque),
        "direction_friction": lambda: p[0] * np.sign(v),
        "direction_damping": lambda: -p[0] * abs(v),
        "stribeck": lambda: p[0] * np.exp(-((v / p[1]) ** 2)),
        "cogging": lambda: p[0] * np.sin(p[2] * q) + p[1] * np.cos(p[2] * q),
        "presliding": lambda: -p[0] * memory[0],
        "hysteresis": lambda: -p[0] * sum(memory) / 3,
        "supply_sag": lambda: -force * min(p[0] * total, 1.0),
        "force_drop": lambda: -p[0] * force * abs(force),
        "direction_gain": lambda: p[0] * abs(force),
        "power": lambda: np.sign(force) * p[1] * abs(force / p[1]) ** p[0] - force,
        "dead_zone": lambda: -max(-p[0], min(p[0], force)),
    }
    return float(values[name]())


def plain_memory(name: str, p: Any, memory: Any, shift: float) -> list[float]:
    """What a law remembers after a step."""
    if name == "presliding":
        towards = np.sign(shift)
        return [towards + (memory[0] - towards) * np.exp(-abs(shift) / p[1])] if shift else list(memory)
    return [min(max(s + shift / (p[1] * width), -1.0), 1.0) for s, width in zip(memory, (0.25, 1, 4), strict=True)]


def plain_loop(simulator: Simulator, law: Law, drive: Drive, theta: Any, actions: Any, start: Any) -> Any:
    """States (T+1, S): mj_forward senses, friction and force are written, mj_step goes on."""
    values = dict(zip(simulator.space.names, simulator.space.values(theta), strict=True))
    model = simulator.written(theta)
    data, dry, states = mujoco.MjData(model), model.dof_frictionloss.copy(), [start]
    mujoco.mj_setState(model, data, start, FULL)
    for action in actions:
        data.ctrl[: len(action)], data.qfrc_applied[:], model.dof_frictionloss[:] = action, 0.0, dry
        mujoco.mj_forward(model, data)
        torque = np.empty(model.nv)
        mujoco.mj_rne(model, data, 1, torque)  # what accelerates and carries the links, without the armature
        applied, friction, before = np.zeros(model.nv), dry.copy(), data.qpos.copy()
        total, memories = float(np.abs(data.actuator_force).sum()), data.act.reshape(len(drive.joints), -1).copy()
        for k, (joint, actuator) in enumerate(zip(drive.joints, drive.actuators, strict=True)):
            dof, owner = int(model.joint(joint).dofadr[0]), joint if law.kind == "joint" else actuator
            p = np.array([values[f"{owner}.{number.attribute}"] for number in law.numbers])
            force = float(data.actuator_force[k])
            here = data.qpos[dof], data.qvel[dof], action[k], torque[dof], force, total
            value = plain_value(law.name, p, *here, memories[k])
            if law.friction:
                friction[dof] = max(friction[dof] + value, 0.0)
            else:
                applied[dof] += value * (model.actuator_gear[k, 0] if law.kind == "actuator" else 1.0)
        data.qfrc_applied[:], model.dof_frictionloss[:] = applied, friction
        mujoco.mj_step(model, data)
        for k, joint in enumerate(drive.joints if law.memory else ()):
            dof = int(model.joint(joint).dofadr[0])
            p = np.array([values[f"{joint}.{number.attribute}"] for number in law.numbers])
            memories[k] = plain_memory(law.name, p, memories[k], data.qpos[dof] - before[dof])
        data.act[:] = memories.ravel()
        mujoco.mj_getState(model, data, state := np.empty_like(start), FULL)
        states.append(state)
    return np.array(states)


@pytest.mark.parametrize(("name", "machine"), CASES)
def test_the_engine_simulates_a_law_as_a_plain_loop(name: str, machine: str) -> None:
    drive, law = MACHINES[machine], LAWS[name]
    simulator = Simulator(lawful(drive, law), 2)
    theta, actions, starts = drawn(simulator)
    run = simulator.rollout(theta, actions, starts)
    assert run.valid.all()
    assert run.states is not None
    for row in range(len(theta)):
        expected = plain_loop(simulator, law, drive, theta[row], actions[row], starts[row])
        np.testing.assert_allclose(run.states[row], expected, rtol=1e-12, atol=1e-12)
    plain = Simulator(environment(drive), 1)
    own = starts[:, : plain.default_state().size]
    without = plain.rollout(np.full((1, 1), 0.5), actions, own)
    assert np.abs(run.observations - without.observations).max() > 1e-3, "the law's numbers do something"


@pytest.mark.parametrize(("name", "machine"), CASES)
def test_neutral_numbers_are_the_plain_model_bit_for_bit(name: str, machine: str) -> None:
    drive, law = MACHINES[machine], LAWS[name]
    simulator, plain = Simulator(lawful(drive, law), 1), Simulator(environment(drive), 1)
    theta, actions, starts = drawn(simulator)
    theta[:, 1:] = simulator.space.default_theta[1:]
    run = simulator.rollout(theta, actions, starts)
    own = plain.default_state().size
    expected = plain.rollout(theta[:, :1], actions, starts[:, :own])
    assert run.states is not None
    np.testing.assert_array_equal(run.states[..., :own], expected.states)
    np.testing.assert_array_equal(run.observations, expected.observations)


@pytest.mark.parametrize(("name", "machine"), CASES)
def test_step_by_step_windows_of_one_step_and_whole_rollouts_agree(name: str, machine: str) -> None:
    simulator = Simulator(lawful(MACHINES[machine], LAWS[name]), 2)
    theta, actions, starts = drawn(simulator, 3)
    whole = simulator.rollout(theta, actions, starts)
    assert whole.states is not None
    here = starts
    for t in range(HORIZON):  # all simulations a control step at a time
        one = simulator.rollout(theta, actions[:, t : t + 1], here)
        assert one.states is not None
        here = one.states[:, 1]
        np.testing.assert_array_equal(here, whole.states[:, t + 1])
    for row in range(3):  # windows of one step, all of a simulation at once
        cut = simulator.rollout(theta[row], actions[row][:, None], whole.states[row, :-1])
        np.testing.assert_array_equal(cut.observations[:, 1], whole.observations[row, 1:])
    alone = Simulator(simulator.environment, 1).rollout(theta[1], actions[1], starts[1])
    np.testing.assert_array_equal(alone.observations[0], whole.observations[1])


def test_control_steps_of_several_physics_steps_ask_the_laws_in_each() -> None:
    simulator = Simulator(lawful(MACHINES["double"], LAWS["load_friction"]), 1)
    theta, actions, starts = drawn(simulator, 2)
    dt = simulator.model.opt.timestep
    coarse = simulator.rollout(theta, actions[:, ::4], starts, 4 * dt)
    fine = simulator.rollout(theta, actions, starts, dt)
    np.testing.assert_array_equal(coarse.observations, fine.observations[:, ::4])


def test_forces_that_do_not_hang_on_the_motion_take_few_calls() -> None:
    simulator = Simulator(lawful(MACHINES["slide"], LAWS["dead_zone"]))
    with mock.patch.object(simulator.engine, "_steps", wraps=simulator.engine._steps) as steps:
        simulator.rollout(*drawn(simulator))
    assert steps.call_count == 4, "twice a few steps, twice all"


def test_friction_of_a_law_leaves_the_models_as_they_were() -> None:
    simulator = Simulator(lawful(MACHINES["pendulum"], LAWS["load_friction"]), 1)
    theta, actions, starts = drawn(simulator)
    first = simulator.rollout(theta, actions, starts)
    assert all((slot.model.dof_frictionloss == 0.02).all() for slot in simulator.pool.slots)
    np.testing.assert_array_equal(simulator.rollout(theta, actions, starts).states, first.states)


def test_laws_stand_in_the_model_and_are_declared_once() -> None:
    spec = mujoco.MjSpec.from_string(MACHINES["pendulum"].xml)
    for _ in range(2):
        for law in LAWS.values():
            declare(spec, law.kind, "hinge" if law.kind == "joint" else "motor", law)
    model = spec.compile()
    assert model.nnumeric == len(LAWS) + len([law for law in LAWS.values() if law.memory])
    assert [bound.law.name for bound in laws_of(model)] == list(LAWS)
    loaded = mujoco.MjModel.from_xml_string(spec.to_xml())
    assert [bound.law.name for bound in laws_of(loaded)] == list(LAWS)


THRUSTER = """<mujoco><option gravity="0 0 0"/><worldbody><body><joint name="x" type="slide" axis="1 0 0"/>
  <joint name="turn" type="hinge" axis="0 0 1"/><geom size=".1" mass="2"/>
  <site name="jet" pos="0 .3 0"/></body></worldbody>
  <actuator><motor name="jet" site="jet" gear="{gear} 0 0 0 0 0" forcelimited="false"
  ctrllimited="false"/></actuator></mujoco>"""


DEFAULTS = {
    "none": "",
    "servo": '<position kp="100"/>',
    "weak": '<general gainprm="50" ctrllimited="true" ctrlrange="-.1 .1" forcelimited="true" forcerange="-.2 .2"/>',
    "slow": '<general dyntype="filter" dynprm=".1"/>',
}


@pytest.mark.parametrize("default", DEFAULTS)
@pytest.mark.parametrize(
    ("attribute", "value", "force"),
    [
        ("direction_gain", 0.3, lambda u: u + 0.3 * abs(u)),
        ("exponent", 2.0, lambda u: u * abs(u)),
        ("force_drop", 0.2, lambda u: u - 0.2 * u * abs(u)),
        ("dead_zone", 0.1, lambda u: u - np.clip(u, -0.1, 0.1)),
    ],
)
def test_a_thruster_at_a_site_has_laws_too(
    attribute: str, value: float, force: Callable[[float], float], default: str
) -> None:
    """Through the same transmission, also where its gear is unknown, whatever a model's defaults give to actuators."""
    low = 0.1 if attribute == "exponent" else 0.0
    law, gear = Parameter("p", low, 3.0, targets=(f"actuator:jet.{attribute}",)), 6.0
    unknown = Parameter("gear", 1.0, 10.0, targets=("actuator:jet.gear",))
    measured = ["joint:x.position", "joint:turn.position"]
    xml = THRUSTER.replace("<worldbody>", f"<default>{DEFAULTS[default]}</default><worldbody>")
    simulator = Simulator(MjcfEnvironment.build(xml.format(gear=2), [law, unknown], ["jet"], measured), 1)
    assert [actuator.name for actuator in Machine.of(simulator.model).actuators] == ["jet"]  # of which init asks
    commands = np.random.default_rng(0).uniform(-1, 1, (1, 20, 1))
    theta = simulator.space.normalise(np.array([[value, gear]]))
    run = simulator.rollout(theta, commands, simulator.default_state()[None], 0.01)
    model = mujoco.MjModel.from_xml_string(THRUSTER.format(gear=gear))
    data, seen = mujoco.MjData(model), []
    for command in commands[0, :, 0]:
        data.ctrl[:] = force(float(command))
        for _ in range(round(0.01 / model.opt.timestep)):
            mujoco.mj_step(model, data)
        seen.append(data.qpos.copy())
    np.testing.assert_allclose(run.observations[0, 1:], seen, rtol=1e-9, atol=1e-12)


BALL = """<mujoco><worldbody><body><joint name="ball" type="ball"/><geom size=".1"/></body></worldbody>
  <actuator><motor name="motor" joint="ball" gear="1 0 0"/></actuator></mujoco>"""
NO_SENSOR = MACHINES["pendulum"].xml.replace(
    "</mujoco>", '<custom><numeric name="joint:hinge.load_friction" data=".1"/></custom></mujoco>'
)
NO_JOINT = NO_SENSOR.replace("joint:hinge.", "joint:gone.")
FORGETFUL = NO_SENSOR.replace("load_friction", "presliding").replace('data=".1"', 'data=".1 1"')
TOO_MANY = NO_SENSOR.replace('data=".1"', 'data=".1 .2"')


@pytest.mark.parametrize(
    ("target", "words"),
    [
        ("joint:ball.load_friction", "only hinge and slide joints"),
        ("joint:ball.cogging_sin", "only hinge and slide joints"),
        ("actuator:motor.force_drop", "only hinge and slide joints, and actuators of anything but a ball"),
        ("joint:none.load_friction", "no joint 'none'"),
    ],
)
def test_a_law_where_it_cannot_act_is_refused_in_a_line(target: str, words: str) -> None:
    with pytest.raises(TargetError, match=words) as caught:
        MjcfEnvironment.build(BALL, [Parameter("p", 0.0, 1.0, targets=(target,))], [], [])
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("xml", "words"),
    [
        (NO_SENSOR, "wants a sensor of the same name"),
        (NO_JOINT, "wants a joint 'gone'"),
        (TOO_MANY, "and 1 number"),
        (FORGETFUL, "wants an actuator of the same name with 1 activations"),
    ],
)
def test_a_numeric_that_is_no_law_is_refused_in_a_line(xml: str, words: str) -> None:
    with pytest.raises(LawError, match=words) as caught:
        laws_of(mujoco.MjModel.from_xml_string(xml))
    assert "\n" not in str(caught.value)
