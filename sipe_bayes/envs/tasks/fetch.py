"""Fetch: an arm that pushes, slides or lifts an object to a goal, sparsely rewarded.

The tasks of Plappert et al., "Multi-Goal Reinforcement Learning: Challenging Robotics Environments and Request for
Research", 2018, https://arxiv.org/abs/1802.09464; theta = 0.5 is gymnasium-robotics' FetchPush-v4, FetchSlide-v4 and
FetchPickAndPlace-v4, of which only the MJCF and the meshes are used.

The gripper is welded to a body that is placed by hand (MuJoCo's mocap): each control step sets it to where the gripper
was last seen, plus the action. What is seen after a step are MuJoCo's positions before the step's last substep, with the
velocities after it; where the fingers are blocked, they are put back to zero after each control step and everything is
seen anew. Control thus needs more than the physics state. These sights are the state's memory: observations, rewards
and controls are functions of the state alone, and a rollout can go on from any recorded sample.
"""

from __future__ import annotations

import importlib.util
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from sipe_bayes.core.parameters import ParameterSpace
from sipe_bayes.envs.task import Solved, Task, Transition, scaled

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

_REACH = 0.05  # metres that an action of 1 moves the gripper's target
_TURN = (1.0, 0.0, 1.0, 0.0)  # what the published environment adds to the quaternion of the gripper seen
_NEAR = 0.05  # metres from the goal within which it is reached
_CLEARANCE = 0.1  # metres between gripper and object at the start
_APPROACH = (-0.498, 0.005, -0.431)  # from the gripper's place in the MJCF to its place at the start, in metres
_SETTLING = 200  # substeps in which it goes there
_HIGHEST = 0.45  # metres above the table, of goals in the air
_FINGER = "robot0:r_gripper_finger_joint"  # the left one's follows it

_GRIP, _LINK, _OBJECT = "robot0:grip", "robot0:gripper_link", "object0"
_SIGHTS = (  # (name, sensor, kind of object, object, size): the memory's columns, in order
    ("grip", "FRAMEPOS", "SITE", _GRIP, 3),
    ("link", "FRAMEPOS", "XBODY", _LINK, 3),
    ("link_quaternion", "FRAMEQUAT", "XBODY", _LINK, 4),
    ("object", "FRAMEPOS", "SITE", _OBJECT, 3),
    ("object_x_axis", "FRAMEXAXIS", "SITE", _OBJECT, 3),
    ("object_y_axis", "FRAMEYAXIS", "SITE", _OBJECT, 3),
    ("object_z_axis", "FRAMEZAXIS", "SITE", _OBJECT, 3),
    ("grip_velocity", "FRAMELINVEL", "SITE", _GRIP, 3),
    ("object_velocity", "FRAMELINVEL", "SITE", _OBJECT, 3),
    ("object_turning", "FRAMEANGVEL", "SITE", _OBJECT, 3),
)


def _xyz(*names: str) -> tuple[str, ...]:
    return tuple(f"{name}_{axis}" for name in names for axis in "xyz")


@dataclass(frozen=True)
class Scene:
    """What tells the three tasks apart; lengths in metres.

    base: the robot's place along x. object: the object's place before the robot goes to its start. height: of the
    gripper at the start, above that of pushing. spread, goal_spread: half the square in which objects and goals lie
    about the gripper. goal_offset: of the goals along x. lifted: half the goals are in the air. blocked: the fingers
    stay shut. friction: the MJCF's, of object and table.
    """

    file: str
    base: float
    object: tuple[float, float, float]
    height: float
    spread: float
    goal_spread: float
    goal_offset: float
    lifted: bool
    blocked: bool
    friction: float


@dataclass(frozen=True)
class _Start:
    """State (S,) at which every episode starts but for the object's place, the gripper's place (3,) that objects and
    goals are drawn about, and the height of goals on the table."""

    state: FloatArray
    grip: FloatArray
    height: float


@dataclass(frozen=True, eq=False, kw_only=True)
class Fetch(Task):
    """A Fetch arm with an object on a table; see the module."""

    scene: Scene

    frame_skip = 20
    stepwise = True
    kinematic = True
    num_actions = 4
    goal_size = 3
    memory_size = sum(size for *_, size in _SIGHTS)
    channels = (
        *_xyz("grip", "object", "object_from_grip"),
        *("right_finger", "left_finger"),
        *_xyz("object_rotation", "object_velocity_from_grip", "object_turning", "grip_velocity"),
        *("right_finger_velocity", "left_finger_velocity"),
        *_xyz("achieved_goal", "desired_goal"),
    )

    @property
    def control_spec(self) -> int:
        state = mujoco.mjtState
        return int(state.mjSTATE_CTRL) | int(state.mjSTATE_MOCAP_POS) | int(state.mjSTATE_MOCAP_QUAT)

    def compile(self) -> Any:
        return self.spec().compile()

    def spec(self) -> Any:
        """The published mujoco.MjSpec, with a sensor for each sight."""
        spec = mujoco.MjSpec.from_file(str(_assets() / self.scene.file))
        for texture in list(spec.textures):  # a seventh of the model, of which every lane has its own
            spec.delete(texture)
        spec.body("table0").first_geom().name = "table0"
        spec.equalities[0].data[3:10] = (0, 0, 0, 1, 0, 0, 0)  # weld the gripper onto the mocap body itself
        for name, sensor, kind, seen, _ in _SIGHTS:
            spec.add_sensor(
                name=name,
                type=getattr(mujoco.mjtSensor, f"mjSENS_{sensor}"),
                objtype=getattr(mujoco.mjtObj, f"mjOBJ_{kind}"),
                objname=seen,
            )
        return spec

    @cached_property
    def _sights(self) -> dict[str, slice]:
        """Columns of the state by the names of ``_SIGHTS``."""
        model = self.published
        ends = 1 + model.nq + model.nv + np.cumsum([0, *(size for *_, size in _SIGHTS)])
        return {name: slice(*ends[i : i + 2]) for i, (name, *_) in enumerate(_SIGHTS)}

    @cached_property
    def _fingers(self) -> tuple[slice, slice]:
        """Columns of the fingers' positions and velocities: right, left."""
        right = self.published.joint(_FINGER)
        position, velocity = 1 + int(right.qposadr[0]), 1 + self.published.nq + int(right.dofadr[0])
        return slice(position, position + 2), slice(velocity, velocity + 2)

    @cached_property
    def _start(self) -> _Start:
        """Found as the published environment finds it: by letting the gripper go there."""
        model, scene = self.published, self.scene
        data = mujoco.MjData(model)
        data.qpos[:3] = scene.base, 0.48, 0.0
        data.joint("object0:joint").qpos[:] = *scene.object, 1, 0, 0, 0
        mujoco.mj_forward(model, data)
        data.mocap_pos[0] = data.site(_GRIP).xpos + np.add(_APPROACH, (0, 0, scene.height))
        data.mocap_quat[0] = _TURN
        mujoco.mj_step(model, data, _SETTLING)
        grip, height = data.site(_GRIP).xpos.copy(), float(data.site(_OBJECT).xpos[2])
        mujoco.mj_forward(model, data)
        state = np.concatenate([[0.0], data.qpos, data.qvel, data.sensordata])
        return _Start(state, grip, height)

    def initial_states(self, rng: np.random.Generator, count: int) -> tuple[FloatArray, FloatArray]:
        """Drawn in the published order, so that equal generators give equal episodes."""
        start, scene = self._start, self.scene
        states, goals = np.tile(start.state, (count, 1)), np.empty((count, 3))
        position = 1 + int(self.published.joint("object0:joint").qposadr[0])
        seen = self._sights["object"].start
        for state, goal in zip(states, goals, strict=True):
            offset = np.zeros(2)
            while np.linalg.norm(offset) < _CLEARANCE:
                offset = rng.uniform(-scene.spread, scene.spread, 2)
            state[position : position + 2] = state[seen : seen + 2] = start.grip[:2] + offset
            goal[:] = start.grip + rng.uniform(-scene.goal_spread, scene.goal_spread, 3)
            goal[0] += scene.goal_offset
            goal[2] = start.height
            if scene.lifted and rng.uniform() < 0.5:
                goal[2] += rng.uniform(0, _HIGHEST)
        return states, goals

    def control(self, model: Any, states: FloatArray, actions: FloatArray) -> FloatArray:
        """The fingers' targets, where they move, and the mocap body's pose: (..., nu + 7)."""
        actions = np.minimum(np.maximum(actions, self.action_low), self.action_high)
        fingers = states[..., self._fingers[0]][..., ::-1] + actions[..., 3:]  # actuators: left, right
        place = states[..., self._sights["link"]] + _REACH * actions[..., :3]
        turn = states[..., self._sights["link_quaternion"]] + _TURN
        return np.concatenate([fingers[..., : model.nu], place, turn], axis=-1)

    def settle(self, model: Any, states: FloatArray) -> FloatArray:
        if self.scene.blocked:
            states = states.copy()
            states[:, self._fingers[0]] = 0.0
        return states

    def probe(self, model: Any, before: FloatArray, states: FloatArray) -> FloatArray:
        if self.scene.blocked:
            return states
        late = states.copy()
        late[:, 1 : 1 + model.nq] = before[:, 1 : 1 + model.nq]
        return late

    def remember(self, derived: FloatArray) -> FloatArray:
        return derived

    def observe(
        self, model: Any, states: FloatArray, derived: FloatArray | None, goals: FloatArray | None = None
    ) -> FloatArray:
        """Velocities are per control step, as published."""
        seen = {name: states[..., columns] for name, columns in self._sights.items()}
        period = self.frame_skip * model.opt.timestep
        grip, place, velocity = seen["grip"], seen["object"], seen["grip_velocity"] * period
        fingers, fingers_velocity = (states[..., columns] for columns in self._fingers)
        rotation = _euler(seen["object_x_axis"], seen["object_y_axis"], seen["object_z_axis"])
        relative, turning = seen["object_velocity"] * period - velocity, seen["object_turning"] * period
        moving = [relative, turning, velocity, fingers_velocity * period]
        desired = np.broadcast_to(np.asarray(goals), place.shape)
        return np.concatenate([grip, place, place - grip, fingers, rotation, *moving, place, desired], axis=-1)

    def excitation(self, observations: FloatArray, rng: np.random.Generator) -> FloatArray:
        """Noisy actions (B, 4) that move the object: knock it sideways, or grasp it and bring it to the goal."""
        grip, offset, goal = observations[..., :3], observations[..., 6:9], observations[..., 28:31]
        action = rng.uniform(-0.2, 0.2, (*observations.shape[:-1], 4))
        if self.scene.blocked:
            action[..., :3] += 10 * offset
            return np.clip(action, -1, 1)
        above = np.linalg.norm(offset[..., :2], axis=-1, keepdims=True) > 0.02
        there = np.linalg.norm(offset, axis=-1, keepdims=True) < 0.02
        held = there & (observations[..., 9:10] < 0.0255)
        action[..., :3] += 10 * np.where(held, goal - grip, offset + np.where(above, (0, 0, 0.08), 0.0))
        action[..., 3:] += np.where(there, -1, 1)
        return np.clip(action, -1, 1)

    def recorded_goals(self, observations: FloatArray) -> FloatArray:
        return observations[..., -self.goal_size :]

    def achieved_goals(self, states: FloatArray, derived: FloatArray | None) -> FloatArray:
        """Where the object was seen."""
        return states[..., self._sights["object"]].copy()

    def goal_reward(self, achieved: FloatArray, goals: FloatArray) -> FloatArray:
        """-1, or 0 at the goal; NaN where nothing was simulated."""
        return -np.heaviside(_distance(achieved, goals) - _NEAR, 0.0)

    def reward(self, step: Transition) -> FloatArray:
        return self.goal_reward(self.achieved_goals(step.next_states, None), np.asarray(step.goals))

    def success(self, step: Transition) -> BoolArray:
        return _distance(self.achieved_goals(step.next_states, None), np.asarray(step.goals)) < _NEAR


def _assets() -> Path:
    """The published MJCF, without importing the package that ships it."""
    spec = importlib.util.find_spec("gymnasium_robotics")
    if spec is None or not spec.submodule_search_locations:
        raise ImportError("the Fetch tasks need the models of gymnasium-robotics: pip install gymnasium-robotics")
    return Path(spec.submodule_search_locations[0]) / "envs" / "assets" / "fetch"


def _distance(achieved: FloatArray, goals: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.norm(achieved - goals, axis=-1))


def _euler(x: FloatArray, y: FloatArray, z: FloatArray) -> FloatArray:
    """Angles (..., 3) in rad about x, then the turned y, then the turned z, of frames with the axes x, y, z (..., 3);
    the first is 0 where the second is a right angle."""
    level = np.hypot(z[..., 1], z[..., 2])
    upright = level <= 4 * np.finfo(float).eps
    about_x = np.where(upright, 0.0, -np.arctan2(z[..., 1], z[..., 2]))
    about_y = -np.arctan2(-z[..., 0], level)
    about_z = np.where(upright, -np.arctan2(-x[..., 1], y[..., 1]), -np.arctan2(y[..., 0], x[..., 0]))
    return np.stack([about_x, about_y, about_z], axis=-1)


def _parameters(friction: float) -> ParameterSpace:
    mass = scaled(
        "object_mass",
        2.0,
        ["body:object0.mass"],
        "kg",
        "Mass of the object, its inertia with it: how far a knock sends it and how much it weighs on a lifting gripper. "
        "Once it slides alone, its mass no longer matters; a light object and a slippery table both make it go farther.",
    )
    sliding = scaled(
        "sliding_friction",
        friction,
        ["geom:object0.friction", "geom:table0.friction"],
        "1",
        "Sliding friction between object and table, written to both, as MuJoCo takes the larger: how soon a loose object "
        "stops and how a pushed one turns. Above 1, the fingers' own, it makes their grip firmer too.",
    )
    return ParameterSpace((mass, sliding))


def _task(name: str, summary: str, share: float, scene: Scene) -> Fetch:
    return Fetch(
        name=name,
        parameters=_parameters(scene.friction),
        summary=summary,
        episode_steps=50,
        solved=Solved("success", share),
        reference=f"gymnasium-robotics {name}-v4",
        scene=scene,
    )


def push() -> Fetch:
    scene = Scene(
        file="push.xml",
        base=0.405,
        object=(1.25, 0.53, 0.4),
        height=0.0,
        spread=0.15,
        goal_spread=0.15,
        goal_offset=0.0,
        lifted=False,
        blocked=True,
        friction=1.0,
    )
    return _task("FetchPush", "An arm with a shut gripper pushes a block to a goal on the table", 0.9, scene)


def slide() -> Fetch:
    scene = Scene(
        file="slide.xml",
        base=0.05,
        object=(1.7, 1.1, 0.41),
        height=-0.02,
        spread=0.1,
        goal_spread=0.3,
        goal_offset=0.4,
        lifted=False,
        blocked=True,
        friction=0.1,
    )
    return _task("FetchSlide", "An arm hits a puck so that it slides to a goal out of reach", 0.5, scene)


def pick_and_place() -> Fetch:
    scene = Scene(
        file="pick_and_place.xml",
        base=0.405,
        object=(1.25, 0.53, 0.4),
        height=0.2,
        spread=0.15,
        goal_spread=0.15,
        goal_offset=0.0,
        lifted=True,
        blocked=False,
        friction=1.0,
    )
    return _task(
        "FetchPickAndPlace", "An arm grasps a block and brings it to a goal, half of them in the air", 0.8, scene
    )
