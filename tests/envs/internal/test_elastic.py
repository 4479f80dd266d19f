"""Joints that give way, against the same machines written by hand in MJCF."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

from sipe_bayes.core.parameters import Parameter
from sipe_bayes.envs.export import write_identified
from sipe_bayes.envs.internal.elastic import Base, Elastic, Gear, Link
from sipe_bayes.envs.mjcf import Edit, MjcfEnvironment
from sipe_bayes.envs.targets import TargetError
from sipe_bayes.simulation.simulator import Simulator

HEAD = '<mujoco><option timestep="0.004"><flag contact="disable"/></option><worldbody>'
HINGE = '<joint name="hinge" axis="0 1 0" damping="0.05"'
GEARED = f'{HINGE} armature="0.02"/>'
ROD = '<geom type="capsule" fromto="0 0 0 .1 0 -.5" size=".02" mass="1"/></body>'
LIGHT = '<inertial pos="0 0 0" mass="1e-13" diaginertia="1e-13 1e-13 1e-13"/>'
END = '<actuator><position name="motor" joint="hinge" kp="3"/></actuator></mujoco>'
PLAIN = f'{HEAD}<body name="rod">{GEARED}{ROD}</worldbody>{END}'
BY_HAND = {  # twist 0.1 rad/(N m), or 0.002 m/N
    "gear": f"""{HEAD}<body><joint name="rotor" axis="0 1 0" armature="0.02"/>{LIGHT}</body>
        <body name="rod">{HINGE}/>{ROD}</worldbody><tendon><fixed stiffness="10"><joint joint="rotor" coef="1"/>
        <joint joint="hinge" coef="-1"/></fixed></tendon>{END.replace("hinge", "rotor")}""",
    "link": f"""{HEAD}<body>{LIGHT}{GEARED}
        <body name="rod"><joint name="twist" axis="0 1 0" stiffness="10" damping=".1"/>{ROD}</body></worldbody>{END}""",
    "base": f"""{HEAD}<body><joint name="x" type="slide" axis="1 0 0" stiffness="500" damping="5"/>
        <geom size=".1" mass="3"/><body name="rod">{GEARED}{ROD}</body></worldbody>{END}""",
}
SPRING = Elastic(stiffest=2000.0, idle=0.02, start=(0.1, 1.0))
EDITS: dict[str, Edit] = {
    "gear": Gear("hinge", SPRING),
    "link": Link("hinge", Elastic(2000.0, 0.02, (0.1, 1.0), loss=0.01)),
    "base": Base("rod", ((1, 0, 0), (0, 1, 0)), Elastic(10000.0, 1.0, (0.1, 1.0), inertia=3.0, loss=0.01)),
}
AT = {"gear": "joint:hinge.gear", "link": "joint:hinge.link", "base": "joint:base_x"}
COMPLIANCE = {"gear": 0.1, "link": 0.1, "base": 0.002}


def machine(which: str, attribute: str = "compliance", most: float = 1.0) -> Simulator:
    parameter = Parameter("give", 0.0, most, targets=(f"{AT[which]}.{attribute}",))
    channels = ["joint:hinge.position", "joint:hinge.velocity"]
    return Simulator(MjcfEnvironment.build(PLAIN, [parameter], ["motor"], channels, [EDITS[which]]), 1)


def moved(simulator: Simulator, give: float) -> Any:
    """States (T+1, S) under a random command."""
    actions = np.random.default_rng(0).normal(size=(30, 1)).repeat(10, axis=0)
    theta = simulator.space.normalise(np.array([give]))
    run = simulator.rollout(theta, actions, simulator.default_state(), 0.004)
    assert run.valid.all()
    assert run.states is not None
    return run.states[0]


@pytest.mark.parametrize("which", BY_HAND)
def test_it_moves_as_the_machine_written_by_hand(which: str) -> None:
    simulator, model = machine(which), mujoco.MjModel.from_xml_string(BY_HAND[which])
    states, data = moved(simulator, COMPLIANCE[which]), mujoco.MjData(model)
    actions = np.random.default_rng(0).normal(size=(30, 1)).repeat(10, axis=0)
    hinge = int(model.joint("hinge").qposadr[0])
    column = 1 + int(simulator.model.joint("hinge").qposadr[0])
    expected = [0.0]
    for action in actions:
        data.ctrl[:] = action
        mujoco.mj_step(model, data)
        expected.append(data.qpos[hinge])
    np.testing.assert_allclose(states[:, column], expected, rtol=1e-8, atol=1e-8)
    assert np.abs(expected - moved(simulator, 0.0)[:, column]).max() > 0.02, "it gives way"


@pytest.mark.parametrize("which", ["gear", "link"])
def test_a_gap_is_no_wider_than_it_is(which: str) -> None:
    simulator = machine(which, "play")
    column = 1 + int(simulator.model.joint(AT[which].removeprefix("joint:")).qposadr[0])
    twist = np.abs(moved(simulator, 0.2)[:, column])
    assert 0.1 < twist.max() < 0.13, "but for the physics step in which the end is met"


def test_a_spring_is_no_stiffer_than_the_physics_step_resolves() -> None:
    simulator = machine("gear", most=0.001)
    np.testing.assert_array_equal(moved(simulator, 1e-6), moved(simulator, 4e-4))
    assert (moved(simulator, 4e-4) != moved(simulator, 6e-4)).any()


def test_the_armature_is_the_motors_behind_a_gear(tmp_path: Path) -> None:
    parameter = Parameter("rotor", 0.0, 1.0, targets=("joint:hinge.armature",))
    environment = MjcfEnvironment.build(PLAIN, [parameter], ["motor"], ["joint:hinge.position"], [EDITS["gear"]])
    assert environment.space[0].default == 0.02
    model = environment.compile()
    environment.write(model, np.array([0.5]))
    assert model.dof_armature[0] == 0.0
    assert model.tendon_armature == 0.5
    assert write_identified(environment, np.array([0.5]), tmp_path / "identified.xml") == []
    assert mujoco.MjModel.from_xml_path(str(tmp_path / "identified.xml")).tendon_armature == 0.5


@pytest.mark.parametrize(
    ("edits", "words"),
    [
        ((EDITS["gear"], EDITS["gear"]), "take one elastic piece at a joint"),
        ((EDITS["link"], EDITS["link"]), "is not the last one of its body"),
    ],
)
def test_what_a_joint_cannot_have_is_refused_in_a_line(edits: tuple[Edit, ...], words: str) -> None:
    with pytest.raises(ValueError, match=words) as caught:
        MjcfEnvironment.build(PLAIN, [], ["motor"], ["joint:hinge.position"], edits)
    assert "\n" not in str(caught.value)


def test_a_joint_of_the_model_has_no_compliance() -> None:
    parameter = Parameter("give", 0.0, 1.0, targets=("joint:hinge.compliance",))
    with pytest.raises(TargetError, match="does not declare it; an extension brings such a joint"):
        MjcfEnvironment.build(PLAIN, [parameter], ["motor"], ["joint:hinge.position"])
