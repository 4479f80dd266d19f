"""The humanoid: 17 link sizes, or damping, stiffness and gear of the 17 actuated joints (51 parameters).

Model, observation and reward are those of Gymnasium's Humanoid-v4 without termination (Tassa, Erez and Todorov,
Synthesis and Stabilization of Complex Behaviors through Online Trajectory Optimization, 2012,
https://doi.org/10.1109/IROS.2012.6386025). An episode lasts 1000 steps of 0.015 s, fallen or not: with termination most
policies end it within a second, too soon to infer from. The 5 a step for being upright are paid while the torso is
between 1 and 2 m high.

The observation's 376 numbers are 45 of position and velocity and 331 that MuJoCo derives: inertia and velocity of every
body about the centre of mass of the whole robot, actuator and contact forces. The model is integrated with Runge-Kutta,
and what MjData holds after a step belongs to the last stage of the last physics step: close to the new state, not at
it. Gymnasium reads that, and so does this task; sensors would give the state before that physics step. The first
observation of an episode has what belongs to the starting state.

Episodes start with the torso at 1.4 m, as published, however long the legs are: legs much longer than the model's own
begin in the ground, which throws the robot up. So the out-of-distribution variant has short ones.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import mujoco
import numpy as np

from sipe_bayes.core.arrays import BoolArray, FloatArray
from sipe_bayes.core.parameters import Parameter, ParameterSpace
from sipe_bayes.envs.assets import compiled_without_visuals, gymnasium_asset
from sipe_bayes.envs.target import Target
from sipe_bayes.envs.targets import bind
from sipe_bayes.envs.task import Solved, Transition, scaled
from sipe_bayes.envs.tasks.links import LinkTask


@dataclass(frozen=True)
class _Published:
    """Humanoid-v4's numbers."""

    step: float = 0.015  # s, five physics steps
    noise: float = 0.01  # half-width of the starting state's uniform distribution
    healthy: tuple[float, float] = (1.0, 2.0)  # heights of the torso in m that are paid for
    upright_reward: float = 5.0  # a step
    forward_reward: float = 1.25  # per m/s
    control_cost: float = 0.1  # per squared action
    action: float = 0.4  # greatest
    solved: float = 5000.0  # ours: what 1000 upright steps earn; it hardly ever lies, or makes up for it by walking


_PUBLISHED = _Published()
_HEIGHT = 3  # columns of the state
_OBSERVED = slice(3, 48)  # qpos without x and y, qvel
_FORCES = slice(0, 331)  # of the derived numbers: all that is observed
_CENTRE = 331  # x of the whole robot's centre of mass, the first of subtree_com

_AXES = ("x", "y", "z")
_MOMENTS = ("xx", "yy", "zz", "xy", "xz", "yz")

_NO_SPRING = 0.001  # N m/rad, stands for the missing spring of the right knee and the elbows
_TRUNK = (
    (
        "torso_width",
        "torso1",
        "Distance of the shoulders and mass of the chest. Its mass trades off against that of the upper waist and"
        " the head.",
    ),
    ("head_radius", "head", "Mass at the top of the trunk. It trades off against that of the chest."),
    ("upper_waist_width", "uwaist", "Mass low in the torso. It trades off against that of the chest."),
    ("lower_waist_width", "lwaist", "Mass between the joints of the waist. It trades off against that of the pelvis."),
    (
        "pelvis_width",
        "butt",
        "Distance of the hips and mass of the pelvis. Its mass trades off against that of the lower waist.",
    ),
)
_LIMBS = (  # once for each side
    (
        "thigh_length",
        "thigh1",
        "Distance of the {side} knee from the hip, with the mass of the thigh. In the leg's reach it trades off "
        "against the shin.",
    ),
    (
        "shin_length",
        "shin1",
        "Distance of the {side} foot from the knee, with the mass of the shin. In the leg's reach it trades off "
        "against the thigh and the foot.",
    ),
    (
        "foot_radius",
        "foot",
        "Height of the {side} ankle above the ground and mass of the foot. In the leg's reach it trades off "
        "against the shin.",
    ),
    (
        "upper_arm_length",
        "uarm1",
        "Distance of the {side} elbow from the shoulder, with the mass of the upper arm. In the arm's swing it "
        "trades off against the lower arm.",
    ),
    (
        "lower_arm_length",
        "larm",
        "Distance of the {side} hand from the elbow, with the mass of the lower arm. In the arm's swing it trades"
        " off against the hand.",
    ),
    (
        "hand_radius",
        "hand",
        "Mass at the end of the {side} arm. In the arm's swing it trades off against the length of the lower arm.",
    ),
)
_OUTSIDE = (1, -1, 1, -1, 1, *(-1, -1, -1, 1, 1, -1), *(-1, -1, -1, 1, 1, -1))  # trunk, right and left limbs

_MOVES = {
    "abdomen_y": "bends the waist forward",
    "abdomen_z": "turns the waist",
    "abdomen_x": "bends the waist sideways",
    "hip_x": "spreads the {side} leg",
    "hip_z": "turns the {side} leg about its length",
    "hip_y": "swings the {side} leg forward",
    "knee": "bends the {side} knee",
    "shoulder1": "swings the {side} arm across the body",
    "shoulder2": "lifts the {side} arm",
    "elbow": "bends the {side} elbow",
}
_JOINTS = (
    *("abdomen_y", "abdomen_z", "abdomen_x"),
    *("right_hip_x", "right_hip_z", "right_hip_y", "right_knee"),
    *("left_hip_x", "left_hip_z", "left_hip_y", "left_knee"),
    *("right_shoulder1", "right_shoulder2", "right_elbow"),
    *("left_shoulder1", "left_shoulder2", "left_elbow"),
)


@dataclass(frozen=True, eq=False)
class Humanoid(LinkTask):
    """Actions in [-0.4, 0.4]; times the gear they are torques in N m."""

    frame_skip = 5
    num_actions = 17
    needs_derived = True
    derived_late = True
    start_noise = _PUBLISHED.noise
    data_fields = ("cinert", "cvel", "qfrc_actuator", "cfrc_ext", "subtree_com")

    def compile(self) -> mujoco.MjModel:
        """The published model."""
        return _compiled()

    @cached_property
    def channels(self) -> tuple[str, ...]:  # type: ignore[override]
        """45 of position and velocity, and 331 that MuJoCo derives."""
        model = self.published
        bodies = [mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_BODY, i) for i in range(model.nbody)]
        joints = [mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_JOINT, i) for i in range(1, model.njnt)]
        inertial = [*(f"inertia_{m}" for m in _MOMENTS), *(f"mass_offset_{a}" for a in _AXES), "mass"]
        return (
            *("torso_z", "torso_qw", "torso_qx", "torso_qy", "torso_qz"),
            *(f"{joint}_angle" for joint in joints),
            *(f"root_{kind}_{axis}" for kind in ("velocity", "angular_velocity") for axis in _AXES),
            *(f"{joint}_velocity" for joint in joints),
            *(f"{body}_{entry}" for body in bodies for entry in inertial),
            *(f"{body}_{kind}_velocity_{a}" for body in bodies for kind in ("angular", "linear") for a in _AXES),
            *(f"root_actuator_{kind}_{axis}" for kind in ("force", "torque") for axis in _AXES),
            *(f"{joint}_actuator_torque" for joint in joints),
            *(f"{body}_contact_{kind}_{a}" for body in bodies for kind in ("torque", "force") for a in _AXES),
        )

    def state_columns(self, model: mujoco.MjModel) -> tuple[int | None, ...]:
        """Positions and velocities."""
        observed: list[int | None] = list(range(_OBSERVED.start, _OBSERVED.stop))
        return tuple(observed + [None] * (len(self.channels) - len(observed)))

    def observe(
        self, model: mujoco.MjModel, states: FloatArray, derived: FloatArray | None, goals: FloatArray | None = None
    ) -> FloatArray:
        """Positions without x and y, velocities, and what MuJoCo derives but for the centre of mass."""
        assert derived is not None
        return np.concatenate([states[..., _OBSERVED], derived[..., _FORCES]], axis=-1)

    def reward(self, step: Transition) -> FloatArray:
        """Speed of the centre of mass forward, 5 for being upright, less the cost of control."""
        assert step.derived is not None
        assert step.next_derived is not None
        forward = (step.next_derived[..., _CENTRE] - step.derived[..., _CENTRE]) / _PUBLISHED.step
        upright = _upright(step.next_states)
        effort = np.einsum("...a,...a->...", step.actions, step.actions)
        return np.asarray(
            _PUBLISHED.forward_reward * forward + _PUBLISHED.upright_reward * upright - _PUBLISHED.control_cost * effort
        )

    def hopeless(self, states: FloatArray) -> BoolArray:
        """Fallen, as the published class ends an episode."""
        return ~_upright(states)

    def bind(self, target: str) -> Target:
        """As every task's; a joint without a spring gets one that stands for none."""
        return super().bind(target) if target.startswith("link:") else _bind(self.published, target)


def _upright(states: FloatArray) -> BoolArray:
    height = states[..., _HEIGHT]
    return np.asarray((height > _PUBLISHED.healthy[0]) & (height < _PUBLISHED.healthy[1]))


def _compiled() -> mujoco.MjModel:
    return compiled_without_visuals(gymnasium_asset("humanoid.xml"))


def _bind(model: mujoco.MjModel, target: str) -> Target:
    """A joint without a spring gets one of 0.001 N m/rad, which stands for none."""
    bound = bind(model, target)
    return replace(bound, value=_NO_SPRING) if not bound.value and target.endswith(".stiffness") else bound


def _joint_parameters(model: mujoco.MjModel, joint: str) -> list[Parameter]:
    """Damping, stiffness and gear of a joint."""
    side, _, kind = joint.partition("_") if joint not in _MOVES else ("", "", joint)
    moves = _MOVES[kind].format(side=side)
    spring = (
        f"Pulls the joint that {moves} back to its rest angle. In slow motion it trades off against the gear."
        if model.joint(joint).stiffness[0]
        else f"The published joint that {moves} has no spring: 0.001 stands for none, too little to be seen in a log. "
        "The posterior should stay the prior."
    )
    brake = f"Brakes the joint that {moves} in proportion to its speed. In fast motion it trades off against the gear."
    motor = (
        f"Torque of the joint that {moves} for a unit action. Raised together with damping and stiffness it changes "
        "little but how the joint answers to inertia and contacts."
    )
    kinds = (
        ("damping", f"joint:{joint}.damping", "N m s/rad", brake),
        ("stiffness", f"joint:{joint}.stiffness", "N m/rad", spring),
        ("gear", f"actuator:{joint}.gear", "N m", motor),
    )
    return [scaled(f"{joint}_{kind}", _bind(model, on).value, [on], unit, text) for kind, on, unit, text in kinds]


def _humanoid(
    name: str, summary: str, parameters: list[Parameter], outside_sign: tuple[int, ...] | None = None
) -> Humanoid:
    return Humanoid(
        name=name,
        parameters=ParameterSpace(parameters),
        summary=summary,
        episode_steps=1000,
        solved=Solved("return", _PUBLISHED.solved),
        reference="gymnasium Humanoid-v4, never terminated",
        action_low=-_PUBLISHED.action,
        action_high=_PUBLISHED.action,
        outside_sign=outside_sign,
    )


def links() -> Humanoid:
    """HumanoidLinks: lengths of the capsules and radii of the spheres that the body is made of, 17 parameters."""
    model = _compiled()
    parameters = []
    sides = [(f"{s}_{n}", f"{s}_{g}", d.format(side=s)) for s in ("right", "left") for n, g, d in _LIMBS]
    for name, geom, description in (*_TRUNK, *sides):
        ball = model.geom(geom).type[0] == mujoco.mjtGeom.mjGEOM_SPHERE
        size = float(model.geom(geom).size[0] if ball else 2 * model.geom(geom).size[1])
        parameters.append(scaled(name, size, [f"link:{geom}.{'radius' if ball else 'length'}"], "m", description))
    return _humanoid("HumanoidLinks", "A humanoid walks; the sizes of its 17 links are unknown.", parameters, _OUTSIDE)


def joints() -> Humanoid:
    """HumanoidJoints: damping, stiffness and gear of the 17 actuated joints, 51 parameters."""
    model = _compiled()
    parameters = [parameter for joint in _JOINTS for parameter in _joint_parameters(model, joint)]
    summary = "A humanoid walks; damping, stiffness and gear of its 17 joints are unknown."
    return _humanoid("HumanoidJoints", summary, parameters)
