"""The humanoid against Gymnasium's Humanoid-v4, against plain MuJoCo and against models compiled from edited XML."""

from __future__ import annotations

import warnings
import xml.etree.ElementTree as ElementTree
from typing import Any

import gymnasium
import mujoco
import numpy as np
import pytest
from numpy.typing import NDArray

from sipe_bayes.envs.assets import gymnasium_asset
from sipe_bayes.envs.inertia import body_frame_inertia
from sipe_bayes.envs.registry import make_task
from sipe_bayes.envs.tasks.humanoid import Humanoid
from sipe_bayes.simulation.engine import Run
from sipe_bayes.simulation.simulator import Simulator

FloatArray = NDArray[np.float64]

TASKS = ("HumanoidLinks", "HumanoidJoints")
WARMSTART = mujoco.mjtDisableBit.mjDSBL_WARMSTART
STATE = mujoco.mjtState.mjSTATE_FULLPHYSICS
UNFOLLOWED = ("bvh_", "body_iquat")  # prefixes; a forearm with its hand is round, its principal axes are any two across
SIDES = ("right", "left")


@pytest.fixture(scope="module", params=TASKS)
def simulator(request: pytest.FixtureRequest) -> Simulator:
    return Simulator(make_task(request.param), num_threads=2)


@pytest.fixture(scope="module")
def published() -> Any:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        env: Any = gymnasium.make("Humanoid-v4", terminate_when_unhealthy=False).unwrapped
    env.model.opt.disableflags |= WARMSTART
    return env


def random_theta(task: Humanoid, seed: int, low: float = -0.2, high: float = 1.2) -> FloatArray:
    return np.random.default_rng(seed).uniform(low, high, len(task.space))


def humanoid(simulator: Simulator) -> Humanoid:
    assert isinstance(simulator.environment, Humanoid)
    return simulator.environment


@pytest.mark.parametrize("seed", range(3))
def test_parity_with_the_published_environment(
    simulator: Simulator, published: Any, seed: int, request: pytest.FixtureRequest
) -> None:
    """HumanoidLinks as published; HumanoidJoints with its three missing springs in the reference as well."""
    task = humanoid(simulator)
    springs = published.model.jnt_stiffness
    without = np.argwhere(springs[1:18].reshape(17, -1)[:, 0] == 0)[:, 0] + 1
    assert [published.model.joint(j).name for j in without] == ["right_knee", "right_elbow", "left_elbow"]
    if task.name == "HumanoidJoints":  # these get a spring of 0.001 N m/rad, which must have a default to be scaled
        springs.reshape(len(springs), -1)[without, 0] = 0.001
    request.addfinalizer(lambda: springs.reshape(len(springs), -1).__setitem__((without, 0), 0.0))
    observations = [published.reset(seed=seed)[0]]
    start = task.states(published.data.qpos[None].copy(), published.data.qvel[None].copy())
    actions = np.random.default_rng(seed).uniform(-0.5, 0.5, (100, 17))  # beyond the actuators' limits as well
    rewards = []
    for action in actions:
        observation, reward, *_ = published.step(action)
        observations.append(observation)
        rewards.append(reward)
    motion = simulator.rollout(np.full(len(task.space), 0.5), actions, start)
    assert motion.rewards is not None
    np.testing.assert_allclose(motion.observations[0], observations, rtol=0, atol=1e-9)
    np.testing.assert_allclose(motion.rewards[0], rewards, rtol=0, atol=1e-9)
    assert np.abs(motion.observations[0, :, -78:]).max() > 100  # the ground was felt
    assert min(rewards) < 1 < 4 < max(rewards)  # upright and fallen


def test_start_is_the_published_distribution() -> None:
    states, goals = make_task(TASKS[0]).initial_states(np.random.default_rng(0), 2000)
    centre = np.zeros(48)
    centre[3], centre[4] = 1.4, 1.0
    away = states[:, 1:] - centre[1:]
    assert goals is None
    assert (states[:, 0] == 0).all()
    assert (np.abs(away) <= 0.01).all()
    assert (np.abs(away).max(0) > 0.0099).all()  # fails by chance once in 3e7
    assert (np.abs(away.mean(0)) < 6 * 0.01 / np.sqrt(3 * 2000)).all()


def test_derived_numbers_are_the_lanes_own(simulator: Simulator) -> None:
    """Inertia, velocity and forces of a lane belong to the body that its theta gives it."""
    task = humanoid(simulator)
    theta = np.stack([random_theta(task, seed) for seed in range(3)])
    rng = np.random.default_rng(0)
    actions, (start, _) = rng.uniform(-0.4, 0.4, (3, 60, 17)), task.initial_states(rng, 3)
    motion = simulator.rollout(theta, actions, start, allow_outside=True)
    for lane in range(3):
        model = edited(task, theta[lane])
        data = mujoco.MjData(model)
        mujoco.mj_setState(model, data, start[lane], STATE)
        for t in range(60):
            data.ctrl[:] = actions[lane, t]
            mujoco.mj_step(model, data, task.frame_skip)
            mujoco.mj_rnePostConstraint(model, data)
            expected = [data.qpos[2:], data.qvel, data.cinert, data.cvel, data.qfrc_actuator, data.cfrc_ext]
            np.testing.assert_allclose(
                motion.observations[lane, t + 1], np.concatenate([e.ravel() for e in expected]), rtol=0, atol=1e-9
            )
        mass = task.channels.index("torso_mass")
        assert motion.observations[lane, 1, mass] == pytest.approx(model.body("torso").mass[0], rel=1e-12)
    assert len(np.unique(motion.observations[:, 1, mass])) == (3 if task.name == "HumanoidLinks" else 1)


@pytest.mark.parametrize("seed", range(3))
def test_in_place_equals_compiled(simulator: Simulator, seed: int) -> None:
    task = humanoid(simulator)
    theta = random_theta(task, seed)
    written, compiled = simulator.written(theta), edited(task, theta)
    for name in dir(compiled):
        expected = getattr(compiled, name)
        if isinstance(expected, np.ndarray) and not name.startswith(UNFOLLOWED):
            np.testing.assert_allclose(getattr(written, name), expected, rtol=1e-10, atol=1e-10, err_msg=name)
    for body in range(1, compiled.nbody):
        expected = body_frame_inertia(compiled, body)
        np.testing.assert_allclose(body_frame_inertia(written, body), expected, rtol=1e-10, atol=1e-12)
    rng = np.random.default_rng(seed)
    (start, _), actions = task.initial_states(rng, 1), rng.uniform(-0.4, 0.4, (1, 100, 17))
    states = [
        simulator.engine.advance(Run(task.frame_skip, [model], np.array([model.opt.timestep]), actions, start))[0]
        for model in (written, compiled)
    ]
    np.testing.assert_allclose(states[0], states[1], rtol=0, atol=1e-9)


def test_every_parameter_moves_it(simulator: Simulator) -> None:
    task = humanoid(simulator)
    n = len(task.space)
    theta = np.full((2 * n + 1, n), 0.5)
    theta[np.arange(n), np.arange(n)], theta[n + np.arange(n), np.arange(n)] = 0.25, 0.75
    rng = np.random.default_rng(0)
    motion = simulator.rollout(theta, rng.uniform(-0.4, 0.4, (1, 20, 17)), task.initial_states(rng, 1)[0])
    assert motion.states is not None
    change = np.abs(motion.states[:-1] - motion.states[-1]).max((1, 2)).reshape(2, n)
    print({p.name: c for p, c in zip(task.space, change.T.tolist(), strict=True)})
    assert (change > 0).all()
    faint = {p.name for p, c in zip(task.space, change.T, strict=True) if c.max() < 1e-3}
    expected = {"right_knee_stiffness", "right_elbow_stiffness", "left_elbow_stiffness"}
    assert faint == (expected if task.name == "HumanoidJoints" else set())


def edited(task: Humanoid, theta: FloatArray) -> Any:
    """The model compiled from humanoid.xml with theta written into its text."""
    root = ElementTree.parse(gymnasium_asset("humanoid.xml")).getroot()
    factors = {p.name: v / p.default for p, v in zip(task.space, task.space.values(theta), strict=True)}
    {"HumanoidLinks": edit_links, "HumanoidJoints": edit_joints}[task.name](root, factors)
    spec = mujoco.MjSpec.from_string(ElementTree.tostring(root, "unicode"))
    spec.compiler.discardvisual = True
    model = spec.compile()
    model.opt.disableflags |= WARMSTART
    return model


def edit_joints(root: Any, factors: dict[str, float]) -> None:
    defaults = {"damping": 1.0, "stiffness": 0.0}
    for joint in root.find("worldbody").iter("joint"):
        if joint.get("name") == "root":
            continue
        for attribute, default in defaults.items():
            value, factor = float(joint.get(attribute, default)), factors[f"{joint.get('name')}_{attribute}"]
            joint.set(attribute, repr(float((value or 0.001) * factor)))
    for motor in root.find("actuator"):
        motor.set("gear", repr(float(motor.get("gear")) * float(factors[f"{motor.get('name')}_gear"])))


def edit_links(root: Any, factors: dict[str, float]) -> None:
    def numbers(text: str) -> FloatArray:
        return np.array(text.split(), float)

    def stretch(geom: str, factor: float, fixed: float) -> tuple[FloatArray, FloatArray]:
        """Lengthen a capsule about the point at ``fixed`` between its ends; how far the two ends moved."""
        element = root.find(f".//geom[@name='{geom}']")
        ends = numbers(element.get("fromto")).reshape(2, 3)
        stays = ends[0] + fixed * (ends[1] - ends[0])
        moved = stays + factor * (ends - stays)
        write(element, "fromto", moved.ravel())
        return moved[0] - ends[0], moved[1] - ends[1]

    def shift(kind: str, name: str, by: FloatArray) -> None:
        element = root.find(f".//{kind}[@name='{name}']")
        write(element, "pos", numbers(element.get("pos")) + by)

    def write(element: Any, attribute: str, values: Any) -> None:
        element.set(attribute, " ".join(repr(float(v)) for v in values))

    def grow(geom: str, factor: float) -> None:
        element = root.find(f".//geom[@name='{geom}']")
        write(element, "size", numbers(element.get("size")) * factor)

    shoulders, hips = stretch("torso1", factors["torso_width"], 0.5), stretch("butt", factors["pelvis_width"], 0.5)
    stretch("uwaist", factors["upper_waist_width"], 0.5)
    stretch("lwaist", factors["lower_waist_width"], 0.5)
    grow("head", factors["head_radius"])
    for side, shoulder, hip in zip(SIDES, shoulders, hips, strict=True):
        shift("body", f"{side}_upper_arm", shoulder)
        shift("body", f"{side}_thigh", hip)
        shift("body", f"{side}_shin", stretch(f"{side}_thigh1", factors[f"{side}_thigh_length"], 0)[1])
        shift("body", f"{side}_foot", stretch(f"{side}_shin1", factors[f"{side}_shin_length"], 0)[1])
        shift("body", f"{side}_lower_arm", stretch(f"{side}_uarm1", factors[f"{side}_upper_arm_length"], 0)[1])
        shift("geom", f"{side}_hand", stretch(f"{side}_larm", factors[f"{side}_lower_arm_length"], 0)[1])
        grow(f"{side}_foot", factors[f"{side}_foot_radius"])
        grow(f"{side}_hand", factors[f"{side}_hand_radius"])
