"""Fetch: an arm that pushes, slides or lifts an object to a goal, sparsely rewarded.

The tasks of Plappert et al., "Multi-Goal Reinforcement Learning: Challenging Robotics Environments and Request for
Research", 2018, https://arxiv.org/abs/1802.09464; theta = 0.5 is gymnasium-robotics' FetchPush-v4, FetchSlide-v4 and
FetchPickAndPlace-v4, of which only the MJCF and the meshes are used.

The gripper is welded to a body that is placed by hand (MuJoCo's mocap): each control step sets it to where the gripper
was last seen, plus the action. What is seen after a step are MuJoCo's positions before the step's last substep, with
the velocities after it; where the fingers are blocked, they are put back to zero after each control step and everything
is seen anew. Control thus needs more than the physics state. These sights are the state's memory: observations, rewards
and controls are functions of the state alone, and a rollout can go on from any recorded sample.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import mujoco
import numpy as np

from sipe_bayes.core.arrays import BoolArray, FloatArray
from sipe_bayes.core.parameters import ParameterSpace
from sipe_bayes.envs.assets import robotics_asset
from sipe_bayes.envs.task import Solved, Task, Transition, scaled


@dataclass(frozen=True)
class _Published:
    """What the three environments share; lengths in metres."""

    reach: float = 0.05  # that an action of 1 moves the gripper's target
    turn: tuple[float, ...] = (1.0, 0.0, 1.0, 0.0)  # added to the quaternion of the gripper seen
    near: float = 0.05  # from the goal, within which it is reached
    clearance: float = 0.1  # between gripper and object at the start
    base: tuple[float, float] = (0.48, 0.0)  # of the robot, beside its x
    approach: tuple[float, ...] = (-0.498, 0.005, -0.431)  # from the gripper's place in the MJCF to that at the start
    settling: int = 200  # substeps in which it goes there
    highest: float = 0.45  # above the table, of goals in the air


@dataclass(frozen=True)
class _Excitation:
    """Actions that move the object; lengths in metres."""

    noise: float = 0.2  # half-width, of the action
    gain: float = 10.0  # action per metre
    beside: float = 0.02  # sideways, beyond which the gripper keeps above the object; and near, within which it grasps
    above: float = 0.08
    finger: float = 0.0255  # of a finger that holds the object


_PUBLISHED, _EXCITATION = _Published(), _Excitation()
_FINGER = "robot0:r_gripper_finger_joint"  # the left one's follows it

_GRIP, _LINK, _OBJECT = "robot0:grip", "robot0:gripper_link", "object0"
# name, sensor, kind of object, object, size: the memory's columns
_SIGHTS: tuple[tuple[str, str, str, str, int], ...] = (
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

    Args:
        file: the published MJCF.
        base: the robot's place along x.
        object: the object's place before the robot goes to its start.
        height: of the gripper at the start, above that of pushing.
        spread: half the square in which objects lie about the gripper.
        goal_spread: half the square in which goals do.
        goal_offset: of the goals along x.
        lifted: half the goals are in the air.
        blocked: the fingers stay shut.
        friction: the MJCF's, of object and table.
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
    """What every episode's start has in common."""

    state: FloatArray  # (S,), but for the object's place
    grip: FloatArray  # the gripper's place (3,), which objects and goals are drawn about
    height: float  # of goals on the table


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
        """The fingers' targets and the mocap body's pose."""
        state = mujoco.mjtState
        return int(state.mjSTATE_CTRL) | int(state.mjSTATE_MOCAP_POS) | int(state.mjSTATE_MOCAP_QUAT)

    def compile(self) -> mujoco.MjModel:
        """The published model, with a sensor for each sight."""
        return self.spec().compile()

    def spec(self) -> mujoco.MjSpec:
        """The published mujoco.MjSpec, with a sensor for each sight."""
        spec = mujoco.MjSpec.from_file(str(robotics_asset(f"fetch/{self.scene.file}")))
        for texture in list(spec.textures):  # a seventh of the model, of which every simulation has its own
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
        data.qpos[:3] = scene.base, *_PUBLISHED.base
        data.joint("object0:joint").qpos[:] = *scene.object, 1, 0, 0, 0
        mujoco.mj_forward(model, data)
        data.mocap_pos[0] = data.site(_GRIP).xpos + np.add(_PUBLISHED.approach, (0, 0, scene.height))
        data.mocap_quat[0] = _PUBLISHED.turn
        mujoco.mj_step(model, data, _PUBLISHED.settling)
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
            while np.linalg.norm(offset) < _PUBLISHED.clearance:
                offset = rng.uniform(-scene.spread, scene.spread, 2)
            state[position : position + 2] = state[seen : seen + 2] = start.grip[:2] + offset
            goal[:] = start.grip + rng.uniform(-scene.goal_spread, scene.goal_spread, 3)
            goal[0] += scene.goal_offset
            goal[2] = start.height
            if scene.lifted and rng.uniform() < 0.5:
                goal[2] += rng.uniform(0, _PUBLISHED.highest)
        return states, goals

    def control(self, model: mujoco.MjModel, states: FloatArray, actions: FloatArray) -> FloatArray:
        """The fingers' targets, where they move, and the mocap body's pose: (..., nu + 7)."""
        actions = np.minimum(np.maximum(actions, self.action_low), self.action_high)
        fingers = states[..., self._fingers[0]][..., ::-1] + actions[..., 3:]  # actuators: left, right
        place = states[..., self._sights["link"]] + _PUBLISHED.reach * actions[..., :3]
        turn = states[..., self._sights["link_quaternion"]] + _PUBLISHED.turn
        return np.concatenate([fingers[..., : model.nu], place, turn], axis=-1)

    def settle(self, model: mujoco.MjModel, states: FloatArray) -> FloatArray:
        """Blocked fingers are put back to zero."""
        if self.scene.blocked:
            states = states.copy()
            states[:, self._fingers[0]] = 0.0
        return states

    def probe(self, model: mujoco.MjModel, before: FloatArray, states: FloatArray) -> FloatArray:
        """Positions before the last substep, velocities after it; the states themselves where fingers are blocked."""
        if self.scene.blocked:
            return states
        late = states.copy()
        late[:, 1 : 1 + model.nq] = before[:, 1 : 1 + model.nq]
        return late

    def remember(self, derived: FloatArray) -> FloatArray:
        """All sights."""
        return derived

    def observe(
        self, model: mujoco.MjModel, states: FloatArray, derived: FloatArray | None, goals: FloatArray | None = None
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
        settings = _EXCITATION
        action = rng.uniform(-settings.noise, settings.noise, (*observations.shape[:-1], self.num_actions))
        if self.scene.blocked:
            action[..., :3] += settings.gain * offset
            return np.clip(action, -1, 1)
        beside = np.linalg.norm(offset[..., :2], axis=-1, keepdims=True) > settings.beside
        near = np.linalg.norm(offset, axis=-1, keepdims=True) < settings.beside
        held = near & (observations[..., 9:10] < settings.finger)
        approach = offset + np.where(beside, (0, 0, settings.above), 0.0)
        action[..., :3] += settings.gain * np.where(held, goal - grip, approach)
        action[..., 3:] += np.where(near, -1, 1)
        return np.clip(action, -1, 1)

    def recorded_goals(self, observations: FloatArray) -> FloatArray:
        """The observations' last columns."""
        return observations[..., -self.goal_size :]

    def achieved_goals(self, states: FloatArray, derived: FloatArray | None) -> FloatArray:
        """Where the object was seen."""
        return states[..., self._sights["object"]].copy()

    def goal_reward(self, achieved: FloatArray, goals: FloatArray) -> FloatArray:
        """-1, or 0 at the goal; NaN where nothing was simulated."""
        return -np.heaviside(_distance(achieved, goals) - _PUBLISHED.near, 0.0)

    def reward(self, step: Transition) -> FloatArray:
        """``goal_reward`` of where the object was seen."""
        return self.goal_reward(self.achieved_goals(step.next_states, None), np.asarray(step.goals))

    def success(self, step: Transition) -> BoolArray:
        """The object near its goal."""
        return _distance(self.achieved_goals(step.next_states, None), np.asarray(step.goals)) < _PUBLISHED.near


def _distance(achieved: FloatArray, goals: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.norm(achieved - goals, axis=-1))


def _euler(x: FloatArray, y: FloatArray, z: FloatArray) -> FloatArray:
    """Angles (..., 3) in rad about x, then the turned y, then the turned z, of frames with the axes x, y, z (..., 3).

    The first is 0 where the second is a right angle.
    """
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
        "Mass of the object, its inertia with it: how far a knock sends it and how much it weighs on a lifting "
        "gripper. Once it slides alone, its mass no longer matters; a light object and a slippery table both make it "
        "go farther.",
    )
    sliding = scaled(
        "sliding_friction",
        friction,
        ["geom:object0.friction", "geom:table0.friction"],
        "1",
        "Sliding friction between object and table, written to both, as MuJoCo takes the larger: how soon a loose "
        "object stops and how a pushed one turns. Above 1, the fingers' own, it makes their grip firmer too.",
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


_TABLE = Scene(
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
_IN_THE_AIR = replace(_TABLE, file="pick_and_place.xml", height=0.2, lifted=True, blocked=False)
_SLIPPERY = replace(
    _TABLE,
    file="slide.xml",
    base=0.05,
    object=(1.7, 1.1, 0.41),
    height=-0.02,
    spread=0.1,
    goal_spread=0.3,
    goal_offset=0.4,
    friction=0.1,
)


def push() -> Fetch:
    """FetchPush: mass and friction of a block."""
    return _task("FetchPush", "An arm with a shut gripper pushes a block to a goal on the table", 0.9, _TABLE)


def slide() -> Fetch:
    """FetchSlide: mass and friction of a puck."""
    return _task("FetchSlide", "An arm hits a puck so that it slides to a goal out of reach", 0.5, _SLIPPERY)


def pick_and_place() -> Fetch:
    """FetchPickAndPlace: mass and friction of a block."""
    summary = "An arm grasps a block and brings it to a goal, half of them in the air"
    return _task("FetchPickAndPlace", summary, 0.8, _IN_THE_AIR)
