"""A four-bar linkage of which the crank alone is measured: windows start with the loop closed."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from sipe_bayes.calibration.gathered import unmeasured_starts
from sipe_bayes.core.findings import Severity
from sipe_bayes.core.parameters import Parameter
from sipe_bayes.core.trajectory import Trajectories, Trajectory
from sipe_bayes.envs.internal.closed_chains import close, dependent_joints
from sipe_bayes.envs.mjcf import MjcfEnvironment
from sipe_bayes.inference.laplace import Laplace
from sipe_bayes.likelihood import Segments, estimate_states, unmeasured_joints
from sipe_bayes.likelihood.starts.estimates import start_sd
from sipe_bayes.simulation.simulator import Simulator

LINKAGE = """<mujoco><option timestep="0.001" integrator="implicitfast"/><worldbody>
<body name="crank"><joint name="crank" axis="0 1 0" damping=".01"/>
 <geom type="capsule" fromto="0 0 0 .1 0 0" size=".012" mass=".3" contype="0" conaffinity="0"/>
 <body name="coupler" pos=".1 0 0"><joint name="elbow" axis="0 1 0"/>
  <geom type="capsule" fromto="0 0 0 .25 0 .15" size=".01" mass=".2" contype="0" conaffinity="0"/></body></body>
<body name="rocker" pos=".35 0 -.05"><joint name="rocker" axis="0 1 0"/>
 <geom type="capsule" fromto="0 0 0 0 0 .2" size=".012" mass=".4" contype="0" conaffinity="0"/></body>
<body name="hand" mocap="true" pos=".35 0 -.05"><body name="finger"/></body></worldbody><equality>{equality}</equality>
<actuator><motor name="motor" joint="crank" gear=".1"/></actuator></mujoco>"""
LOOP = '<connect body1="coupler" body2="rocker" anchor=".25 0 .15"/>'
DAMPING = Parameter("damping", 0.0, 0.05, targets=("joint:crank.damping",))
MASS = Parameter("rocker_mass", 0.2, 0.8, targets=("body:rocker.mass",))


def linkage(measured: str = "crank") -> Simulator:
    """Its crank is driven round and round, and measured where nothing else is said."""
    text = LINKAGE.format(equality=LOOP)
    return Simulator(MjcfEnvironment.build(text, [DAMPING, MASS], ["motor"], [f"joint:{measured}.position"]), 1)


def recorded(simulator: Simulator, values: list[float], noise: float = 0.0) -> Trajectory:
    """Three seconds at 100 Hz, and the states that they came from."""
    time = 0.01 * np.arange(300)
    actions = (3 * np.sin(4 * time) + 2 * np.sin(9 * time + 1))[:, None]
    theta = simulator.space.normalise(np.array(values))
    motion = simulator.rollout(theta, actions, simulator.default_state(), dt=0.01)
    seen = motion.observations[0]
    seen = seen + noise * np.random.default_rng(0).standard_normal(seen.shape)
    assert motion.states is not None
    return Trajectory(seen, actions, 0.01, states=motion.states[0])


def test_joints_of_the_loop_are_where_the_simulation_has_them() -> None:
    """Within what the loop gives way under its load, and what smoothing leaves of the crank's speed."""
    simulator = linkage()
    log = recorded(simulator, [0.01, 0.4])
    assert log.states is not None
    blind = Trajectory(log.observations, log.actions, log.dt)
    estimated = estimate_states(simulator, blind, raw=True)
    off = np.abs(estimated - log.states)[3:-3, 1:7].max(axis=0)
    print(off, np.abs(log.states[:, 1:7]).max(axis=0))
    assert np.ptp(log.states[:, 3]) > 0.5
    assert (off[:3] < 0.01).all()
    assert (off[3:] < 0.15 * np.abs(log.states[:, 4:7]).max(axis=0)).all()
    assert not unmeasured_joints(simulator, Trajectories.stack([blind]))


def test_a_fit_from_the_crank_alone() -> None:
    """Both values lie within three sds of the truth (false alarm 1 in 200), and closely.

    From starts with the loop open sds are 100 times as large.
    """
    simulator = linkage()
    log = recorded(simulator, [0.012, 0.45], noise=1e-3)
    posterior = Laplace(simulator, likelihood=Segments(0.5), seed=0).fit(
        Trajectory(log.observations, log.actions, 0.01)
    )
    truth = simulator.space.normalise(np.array([0.012, 0.45]))
    print((posterior.mean.numpy() - truth) / posterior.stddev.numpy(), posterior.stddev)
    assert (np.abs(posterior.mean.numpy() - truth) < 3 * posterior.stddev.numpy()).all()
    assert (posterior.stddev.numpy() < 0.002).all()


def test_beyond_a_dead_centre_nothing_follows() -> None:
    """The rocker turns back where the crank goes on: two places of the crank then, and a fit from one is not trusted.

    Followed from sample to sample the crank turned back as well: 5 and 8 sds off, without a finding.
    """
    simulator = linkage("rocker")
    log = recorded(simulator, [0.012, 0.45], noise=1e-3)
    logs = Trajectories.stack([Trajectory(log.observations, log.actions, log.dt)])
    short = Trajectories.stack([Trajectory(log.observations[:18], log.actions[:17], log.dt)])
    assert unmeasured_joints(simulator, logs) == [0, 1]
    assert not unmeasured_joints(simulator, short)  # before the first dead centre
    assert (start_sd(simulator, logs)[:2] > 2 * start_sd(simulator, short)[:2]).all()
    named = [
        item for item in unmeasured_starts(simulator, logs, Segments(0.5), False) if item.severity is Severity.BLOCKING
    ]
    assert {item.text.split()[1] for item in named} == {"crank", "elbow"}
    assert not unmeasured_starts(simulator, short, Segments(0.5), False)


SPATIAL = """<mujoco><worldbody>
<body name="crank"><joint name="crank" axis="0 0 1"/><geom size=".01" pos=".1 0 0"/>
 <body name="rod" pos=".1 0 0"><joint name="rod" type="ball"/><geom size=".01" pos=".3 0 0"/></body></body>
<body name="slider" pos=".4 0 0"><joint name="slider" type="slide" axis="1 0 0"/><geom size=".02"/></body>
</worldbody><equality><connect body1="rod" body2="slider" anchor=".3 0 0"/></equality></mujoco>"""


def test_a_rod_on_balls_carries_a_slider() -> None:
    """Its turn about itself nothing tells; the slider follows all the same."""
    model = mujoco.MjModel.from_xml_string(SPATIAL)
    assert dependent_joints(model, {0}) == [2]
    angle = np.linspace(0.3, 1.2, 30)
    states = np.zeros((30, 1 + model.nq + model.nv))
    states[:, 1 : 1 + model.nq] = model.qpos0
    states[:, 1], states[:, 1 + model.nq] = angle, 1.0
    reset = states[0].copy()
    reset[1 : 1 + model.nq], reset[1 + model.nq :] = model.qpos0, 0
    assert close(model, states, reset, {0}) == [2]
    exact = 0.1 * np.cos(angle) + np.sqrt(0.3**2 - (0.1 * np.sin(angle)) ** 2) - 0.4
    assert np.allclose(states[:, model.nq], exact, atol=1e-6)
    speed = -0.1 * np.sin(angle) - 0.01 * np.sin(angle) * np.cos(angle) / np.sqrt(0.09 - 0.01 * np.sin(angle) ** 2)
    assert np.allclose(states[:, -1], speed, atol=1e-6)


SLIDER = """<mujoco><worldbody><body name="crank"><joint name="crank" axis="0 1 0"/><geom size=".01" pos="0 0 .1"/>
 <body name="rod" pos="0 0 .1"><joint name="rod" axis="0 1 0"/><geom size=".01" pos=".1 0 0"/></body></body>
<body name="slider"><joint name="slider" type="slide" axis="1 0 0"/><geom size=".02"/></body></worldbody>
<equality><connect body1="rod" body2="slider" anchor="{x} 0 -.1"/></equality></mujoco>"""


@pytest.mark.parametrize("degrees", [60, 20, 10])
def test_the_way_from_the_reset_is_no_dead_centre(degrees: float) -> None:
    """A slider is measured, and begins far from where the model has it: the crank follows, to 1e-6 rad.

    By steps of 5 cm of the slider its opening fell so fast that the next was taken for none.
    """
    crank, rod = 0.1, 0.3
    model = mujoco.MjModel.from_xml_string(SLIDER.format(x=np.sqrt(rod**2 - crank**2)))
    up = np.deg2rad(np.linspace(degrees, 90, 200))  # the crank's angle from the slider's axis
    place = crank * np.cos(up) + np.sqrt(rod**2 - (crank * np.sin(up)) ** 2)
    states = np.zeros((200, 1 + model.nq + model.nv))
    states[:, 3] = place - np.sqrt(rod**2 - crank**2)
    assert close(model, states, np.zeros(1 + model.nq + model.nv), {2}) == [0, 1]
    assert np.allclose(states[:, 1], np.pi / 2 - up, atol=1e-6)


@pytest.mark.parametrize(
    ("equality", "known", "dependent"),
    [
        (LOOP, {0}, [1, 2]),
        (LOOP, set(), []),  # nothing says where the crank is
        (LOOP, {0, 1, 2}, []),
        ("", {0}, []),
        ('<weld body1="hand" body2="rocker"/>', {0}, []),  # a mocap body goes where no state says
        ('<weld body1="finger" body2="rocker"/>', {0}, []),  # nor what it carries
        ('<weld body1="rocker"/>', {0}, [2]),
        ('<joint joint1="rocker" joint2="crank" polycoef="0 .5 0 0 0"/>', {0}, [2]),
    ],
)
def test_which_joints_follow_from_the_known_ones(equality: str, known: set[int], dependent: list[int]) -> None:
    model = mujoco.MjModel.from_xml_string(LINKAGE.format(equality=equality))
    assert dependent_joints(model, known) == dependent
