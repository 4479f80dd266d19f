"""A cart on wheels whose height and pitch nothing measures: contact holds them, and windows start on the ground."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from sipe_bayes.core.parameters import Parameter
from sipe_bayes.core.trajectory import Trajectories, Trajectory
from sipe_bayes.envs.internal.resting import loose_joints, resting_joints
from sipe_bayes.envs.mjcf import MjcfEnvironment
from sipe_bayes.inference.laplace import Laplace
from sipe_bayes.likelihood import Segments, estimate_states, unmeasured_joints
from sipe_bayes.likelihood.starts.estimates import contacts_of, start_sd
from sipe_bayes.simulation.contacts import Contacts
from sipe_bayes.simulation.simulator import Simulator

CART = """<mujoco><option timestep="0.002" integrator="implicitfast"/><worldbody>
<geom name="floor" type="plane" size="20 20 .1"/>
<body name="cart" pos="0 0 {height}"><joint name="x" type="slide" axis="1 0 0"/>
 <joint name="z" type="slide" axis="0 0 1"/><joint name="pitch" axis="0 1 0"/>
 <geom type="box" size=".2 .1 .03" mass="3" contype="0" conaffinity="0"/>
 <geom name="rear" type="sphere" size=".05" pos="-.15 0 -.03" mass=".1" friction=".02"/>
 <body name="wheel" pos=".15 0 -.03"><joint name="wheel" axis="0 1 0" damping=".02" armature=".002"/>
  <geom type="cylinder" size=".05 .02" euler="90 0 0" mass=".2"/></body>
 <body name="bob" pos="0 0 .2"><joint name="bob" axis="0 1 0" damping=".01"/>
  <geom type="sphere" size=".02" pos="0 0 -.1" mass=".05" contype="0" conaffinity="0"/></body></body></worldbody>
<actuator><motor name="drive" joint="wheel"/></actuator></mujoco>"""
HOPPER = """<mujoco><option timestep="0.002" integrator="implicitfast"/><worldbody><geom type="plane" size="9 9 .1"/>
<body name="trunk" pos="0 0 .4"><joint name="z" type="slide" axis="0 0 1"/>
 <geom size=".08" mass="1" contype="0" conaffinity="0"/>
 <body name="foot" pos="0 0 -.35"><joint name="leg" type="slide" axis="0 0 1" stiffness="800" damping="8"/>
  <geom size=".05" mass=".1"/></body></body></worldbody>
<actuator><motor name="leg" joint="leg" gear="-1"/></actuator></mujoco>"""
PARAMETERS = [
    Parameter("damping", 0.0, 0.1, targets=("joint:wheel.damping",)),
    Parameter("mass", 2.0, 5.0, targets=("body:cart.mass",)),
]
MEASURED = ["joint:x.position", "joint:wheel.position", "joint:bob.position"]


def cart(height: float = 0.08, measured: list[str] = MEASURED) -> Simulator:
    return Simulator(MjcfEnvironment.build(CART.format(height=height), PARAMETERS, ["drive"], measured), 1)


def recorded(simulator: Simulator, values: list[float], noise: float = 0.0) -> Trajectory:
    """Three seconds at 50 Hz, and the states that they came from."""
    time = 0.02 * np.arange(150)
    actions = (0.4 * np.sin(4 * time) + 0.3 * np.sin(9 * time + 1))[:, None]
    theta = simulator.space.normalise(np.array(values))
    motion = simulator.rollout(theta, actions, simulator.default_state(), dt=0.02)
    seen = motion.observations[0] + noise * np.random.default_rng(0).standard_normal(motion.observations[0].shape)
    assert motion.states is not None
    return Trajectory(seen, actions, 0.02, states=motion.states[0])


def blind(log: Trajectory) -> Trajectory:
    return Trajectory(log.observations, log.actions, log.dt)


def ids(simulator: Simulator, *names: str) -> list[int]:
    return [simulator.model.joint(name).id for name in names]


@pytest.mark.parametrize("height", [0.08, 0.14], ids=["reset on the ground", "reset above it"])
def test_what_rests_on_wheels_is_where_the_simulation_has_it(height: float) -> None:
    """Also of a cart that the model's reset holds in the air, and with masses that are off."""
    simulator = cart(height)
    log = recorded(simulator, [0.02, 4.0])
    assert log.states is not None
    estimated, (z, pitch) = estimate_states(simulator, blind(log)), ids(simulator, "z", "pitch")
    off = np.abs(estimated - log.states)[25:, [1 + z, 1 + pitch]].max(0)  # it has fallen, where it began in the air
    print(off)
    assert (off < [1e-3, 5e-3]).all()
    trajectories = Trajectories.stack([blind(log)])
    assert unmeasured_joints(simulator, trajectories) == []
    sd = start_sd(simulator, trajectories)
    assert (sd[[z, pitch]] < 0.03).all()
    assert (sd[ids(simulator, "x", "wheel", "bob")] >= 0.1).all()


def test_what_swings_free_is_not_held() -> None:
    """A bob that nothing measures rests on nothing; nor does a cart that flies."""
    simulator = cart(measured=MEASURED[:2])
    log = Trajectories.stack([blind(recorded(simulator, [0.02, 3.0]))])
    assert unmeasured_joints(simulator, log) == ids(simulator, "bob")
    text = CART.format(height=1.0).replace('type="plane"', 'type="plane" contype="0" conaffinity="0"')
    flying = mujoco.MjModel.from_xml_string(text)
    assert resting_joints(flying, ids(simulator, "x", "wheel", "bob")) == set()
    assert resting_joints(simulator.model, ids(simulator, "x", "wheel", "bob")) == set(ids(simulator, "z", "pitch"))


def test_what_a_tendon_or_a_parents_drive_moves_is_not_loose() -> None:
    """Whatever the transmission: only the slide is driven by nothing."""
    text = """<mujoco><worldbody><body><joint name="h" axis="0 1 0"/><geom size=".1"/>
    <body pos=".3 0 0"><joint name="k" axis="0 1 0"/><geom size=".1"/></body></body>
    <body pos="2 0 0"><joint name="free" type="slide"/><geom size=".1"/></body></worldbody>
    <tendon><fixed name="t"><joint joint="h" coef="1"/></fixed></tendon>
    <actuator><position tendon="t"/><motor jointinparent="k"/></actuator></mujoco>"""
    model = mujoco.MjModel.from_xml_string(text)
    assert loose_joints(model, range(3)) == [model.joint("free").id]


@pytest.mark.parametrize(("strength", "held"), [(0.0, True), (60.0, False)], ids=["stands", "hops"])
def test_a_machine_that_hops_is_not_held(strength: float, held: bool) -> None:
    """The height of a hopper, whose leg alone is measured: it leaves the ground where the log's commands throw it."""
    leg = Parameter("mass", 0.5, 2.0, targets=("body:trunk.mass",))
    simulator = Simulator(MjcfEnvironment.build(HOPPER, [leg], ["leg"], ["joint:leg.position"]), 1)
    actions = strength * (np.sin(8 * 0.02 * np.arange(150)) > 0)[:, None]
    motion = simulator.rollout(np.array([0.5]), actions, simulator.default_state(), dt=0.02)
    log = Trajectories.stack([Trajectory(motion.observations[0], actions, 0.02)])
    assert (unmeasured_joints(simulator, log) == []) is held


def test_masses_come_back_through_the_wheels() -> None:
    """Windows of a log that tells of neither height nor pitch hold damping and mass."""
    simulator = cart()
    log = recorded(simulator, [0.05, 4.0], noise=2e-4)
    estimator = Laplace(simulator, likelihood=Segments(noise="white"), seed=0)
    posterior = estimator.fit(blind(log))
    truth = simulator.space.normalise(np.array([0.05, 4.0]))
    z = (posterior.mean.numpy() - truth) / posterior.stddev.numpy()
    print(z, posterior.stddev.numpy(), [f.code for f in estimator.findings])
    assert (np.abs(z) < 4).all()
    assert posterior.stddev.numpy()[1] < 0.02
    assert not estimator.findings


ROVER = """<mujoco><option timestep="0.002" integrator="implicitfast"/><worldbody>
<geom name="floor" type="plane" size="20 20 .1"/>
<body name="base" pos="0 0 .05"><joint name="x" type="slide" axis="1 0 0"/><joint name="y" type="slide" axis="0 1 0"/>
 <joint name="z" type="slide" axis="0 0 1"/><joint name="yaw" axis="0 0 1"/><joint name="pitch" axis="0 1 0"/>
 <geom type="box" size=".1 .08 .03" mass="2" contype="0" conaffinity="0"/>
 <geom type="sphere" size=".02" pos="-.09 0 -.03" mass=".05" friction=".01"/>
 <body pos=".04 .1 0"><joint name="left" axis="0 1 0" damping=".005" armature=".001"/>
  <geom type="cylinder" size=".05 .012" euler="90 0 0" mass=".1"/></body>
 <body pos=".04 -.1 0"><joint name="right" axis="0 1 0" damping=".005" armature=".001"/>
  <geom type="cylinder" size=".05 .012" euler="90 0 0" mass=".1"/></body></body></worldbody>
<actuator><velocity name="left" joint="left" kv=".2"/>
 <velocity name="right" joint="right" kv=".2"/></actuator></mujoco>"""


def rover(seed: int = 2) -> tuple[Simulator, Trajectory]:
    """Of two driven wheels and a ball behind, and six seconds at 50 Hz, on which the tyres slip at times."""
    gains = tuple(f"actuator:{side}.{what}" for side in ("left", "right") for what in ("gain", "bias_velocity"))
    parameters = [
        Parameter("kv", 0.2, 5.0, targets=gains, relative=True),
        Parameter("dry", 0.0, 0.1, targets=("joint:left.frictionloss", "joint:right.frictionloss")),
    ]
    measured = [f"joint:{joint}.position" for joint in ("x", "y", "yaw", "left", "right")]
    simulator = Simulator(MjcfEnvironment.build(ROVER, parameters, ["left", "right"], measured), 1)
    time, rng = 0.02 * np.arange(300), np.random.default_rng(seed)
    phase = rng.uniform(0, 6, (2, 2))
    actions = 3 * np.sin(2.1 * time[:, None] + phase[0]) + 3 * np.sin(5.3 * time[:, None] + phase[1])
    theta = simulator.space.normalise(np.array([0.5, 0.03]))
    motion = simulator.rollout(theta, actions, simulator.default_state(), dt=0.02)
    noise = np.array([3e-4, 3e-4, 1e-3, 3e-3, 3e-3]) * rng.standard_normal(motion.observations[0].shape)
    return simulator, Trajectory(motion.observations[0] + noise, actions, 0.02)


def test_wheels_that_slip_make_simulations_jump_and_wheels_that_roll_do_not() -> None:
    """A rover turns on its tyres, a cart rolls straight on: what is asked is whether short differences are luck."""
    logs = [rover(seed) for seed in range(6)]
    for simulator, log in logs:
        assert contacts_of(simulator, [log]) == Contacts(touch=True, change=False, rough=True)
    rolling = cart()
    smooth = contacts_of(rolling, [blind(recorded(rolling, [0.02, 3.0]))])
    assert smooth == Contacts(touch=True, change=False, rough=False)


def test_a_rovers_motors_come_back() -> None:
    simulator, log = rover()
    estimator = Laplace(simulator, restarts=1, candidates=0, seed=0)
    posterior = estimator.fit(log)
    off = np.abs(posterior.mean.numpy() - simulator.space.normalise(np.array([0.5, 0.03])))
    print(off, posterior.stddev.numpy(), [f.code.name for f in estimator.findings], estimator.rollouts)
    assert (off < 0.03).all()  # it began 0.3 off
