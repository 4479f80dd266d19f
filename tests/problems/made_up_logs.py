"""Logs of made-up machines as users have them: other units, turned signs, delays, any order of columns."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
import pandas as pd
import scipy.signal

from sipe_bayes.core.units import find_unit

_HEAD = '<mujoco><option timestep="0.004" integrator="implicitfast"><flag contact="disable"/></option><worldbody>'
PENDULUM = f"""{_HEAD}<body name="rod"><joint name="hinge" axis="0 1 0" damping="0.02"/>
  <geom type="capsule" fromto="0 0 0 0 0 -.4" size=".01" mass=".5"/></body></worldbody>
  <actuator><motor name="motor" joint="hinge"/></actuator></mujoco>"""
ARM = f"""{_HEAD}<body name="upper_arm"><joint name="shoulder" axis="0 1 0" damping="0.1"/>
  <geom type="capsule" fromto="0 0 0 0.3 0 0" size=".02" mass="1"/>
  <body name="forearm" pos=".3 0 0"><joint name="elbow" axis="0 1 0" damping=".05"/>
  <geom type="capsule" fromto="0 0 0 0.25 0 0" size=".02" mass=".6"/></body></body></worldbody>
  <actuator><motor name="shoulder_motor" joint="shoulder"/><motor name="elbow_motor" joint="elbow"/></actuator>
  </mujoco>"""
CART = f"""{_HEAD}<body name="cart"><joint name="slider" type="slide" axis="1 0 0" damping="1"/>
  <geom type="box" size=".1 .05 .05" mass="1"/><body name="pole"><joint name="hinge" axis="0 1 0" damping="0.005"/>
  <geom type="capsule" fromto="0 0 0 0 0 -.5" size=".01" mass=".2"/></body></body></worldbody>
  <actuator><motor name="drive" joint="slider"/></actuator></mujoco>"""
SERVO = f"""{_HEAD}<body name="horn"><joint name="servo" axis="0 1 0" damping="0.05" armature=".005"/>
  <geom type="capsule" fromto="0 0 0 0.15 0 0" size=".01" mass=".3"/></body></worldbody>
  <actuator><position name="servo" joint="servo" kp="8" kv=".3"/></actuator></mujoco>"""


@dataclass(frozen=True)
class Kind:
    """A model, its joints, its actuators with the joint of each, the commands' sizes, and names of columns.

    Each of ``names`` is positions, velocities, commands.
    """

    xml: str
    joints: tuple[str, ...]
    actuators: Mapping[str, str]
    sizes: tuple[float, ...]
    names: tuple[tuple[str, str, str], ...]


KINDS = {
    "pendulum": Kind(PENDULUM, ("hinge",), {"motor": "hinge"}, (1.0,), (
        ("theta", "theta_dot", "torque"), ("q", "dq", "u"), ("angle", "velocity", "tau"),
        ("/joint_states.position[0]", "/joint_states.velocity[0]", "effort"), ("pos", "vel", "cmd"),
    )),
    "arm": Kind(ARM, ("shoulder", "elbow"), {"shoulder_motor": "shoulder", "elbow_motor": "elbow"}, (6.0, 2.0), (
        ("q1 q2", "dq1 dq2", "tau1 tau2"), ("joint_1_pos joint_2_pos", "joint_1_vel joint_2_vel", "torque_1 torque_2"),
        ("shoulder_angle elbow_angle", "shoulder_velocity elbow_velocity", "shoulder_cmd elbow_cmd"),
        ("position[0] position[1]", "velocity[0] velocity[1]", "effort[0] effort[1]"),
        ("qShoulder qElbow", "qdShoulder qdElbow", "uShoulder uElbow"),
    )),
    "cart": Kind(CART, ("slider", "hinge"), {"drive": "slider"}, (6.0,), (
        ("x theta", "x_dot theta_dot", "u"), ("cart_position pole_angle", "cart_velocity pole_velocity", "force"),
        ("slider_pos hinge_pos", "slider_vel hinge_vel", "motor_force"),
        ("pos_cart ang_pole", "vel_cart angvel_pole", "F"), ("x phi", "dx dphi", "action"),
    )),
    "servo": Kind(SERVO, ("servo",), {"servo": "servo"}, (1.6,), (
        ("present_position", "present_velocity", "goal_position"), ("q", "qd", "q_des"),
        ("servo_angle", "servo_speed", "servo_setpoint"), ("position", "velocity", "cmd"),
        ("theta", "omega", "theta_ref"),
    )),
}  # fmt: skip
CLOCKS = (("time", "s", 0.0), ("t_ms", "ms", 0.0), ("timestamp", "ns", 1.7e9), ("t", "us", 3.0), ("time", "ms", 1.0))


@dataclass(frozen=True)
class Truth:
    """What a log holds: (column, target) -> unit and sign, clock, delay in samples."""

    columns: Mapping[tuple[str, str], tuple[str, int]]
    clock: tuple[str, str]
    delay: int


def _real(xml: str, rng: np.random.Generator) -> mujoco.MjModel:
    """Another machine than the model: heavier or lighter, with more friction."""
    model = mujoco.MjModel.from_xml_string(xml)
    factors = rng.uniform(0.75, 1.3, model.nbody)
    model.body_mass[:] *= factors
    model.body_inertia[:] *= factors[:, None]
    model.dof_damping *= rng.uniform(0.7, 2, model.nv)
    model.dof_frictionloss[:] = rng.uniform(0, 0.02, model.nv)
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return model


def _excitation(steps: int, dt: float, sizes: tuple[float, ...], rng: np.random.Generator) -> np.ndarray:
    time = np.arange(steps)[:, None, None] * dt
    waves = np.sin(2 * np.pi * rng.uniform(0.2, 2.0, (len(sizes), 4)) * time + rng.uniform(0, 6, (len(sizes), 4)))
    return 0.5 * np.array(sizes) * waves.sum(axis=2)


def simulated(model: mujoco.MjModel, commands: np.ndarray, dt: float, delay: int) -> tuple[np.ndarray, np.ndarray]:
    """Positions and velocities (n, nv) of a machine that is driven by commands (n, nu), ``delay`` samples late."""
    data, steps = mujoco.MjData(model), round(dt / model.opt.timestep)
    positions, velocities = np.zeros((2, len(commands), model.nv))
    for k in range(len(commands)):
        positions[k], velocities[k] = data.qpos, data.qvel
        data.ctrl[:] = commands[max(0, k - delay)]
        mujoco.mj_step(model, data, steps)
    return positions, velocities


def make_log(folder: Path, kind: Kind, variant: int, seed: int, spring: float = 0.0, steps: int = 1100) -> Truth:
    """Write ``model.xml`` and ``log.csv``; the variant, from 0 to 4, sets rate, units, noise, clock and delay.

    spring: at the first joint, N m/rad or N/m, which the model does not have.
    """
    rng = np.random.default_rng(seed)
    dt, delay = (0.004, 0.004, 0.012, 0.004, 0.008)[variant], (0, 2, 1, 3, 1)[variant]
    commands = _excitation(steps, dt, kind.sizes, rng)
    model = _real(kind.xml, rng)
    model.jnt_stiffness[0] = spring
    positions, velocities = simulated(model, commands, dt, delay)
    angle, length = ("rad", "deg", "rad", "deg", "deg")[variant], ("m", "mm", "m", "mm", "cm")[variant]
    speeds = {True: ("rad/s", "rad/s", "rpm", "deg/s", "rad/s"), False: ("m/s", "m/s", "mm/s", "m/s", "m/s")}
    noise = (2e-4, 5e-4, 1e-3, 0.0, 1e-3)[variant]
    names = [words.split() for words in kind.names[variant]]
    table, truth, signs, hinges = {}, {}, {}, {}
    for j, joint in enumerate(kind.joints):
        hinges[joint] = model.joint(joint).type[0] == mujoco.mjtJoint.mjJNT_HINGE
        unit, sign = angle if hinges[joint] else length, -1 if rng.uniform() < 0.4 else 1
        values = sign * (positions[:, j] + noise * (1.0 if hinges[joint] else 0.3) * rng.standard_normal(steps))
        table[names[0][j]] = values / find_unit(unit).factor
        if variant == 3:
            table[names[0][j]] = np.round(table[names[0][j]], 2)
        truth[names[0][j], f"joint:{joint}.position"] = unit, sign
        speed = sign * velocities[:, j] + 0.02 * rng.standard_normal(steps)
        if variant in (1, 4):
            speed = scipy.signal.lfilter([0.3], [1, -0.7], speed)
        unit = speeds[hinges[joint]][variant]
        table[names[1][j]] = speed / find_unit(unit).factor
        truth[names[1][j], f"joint:{joint}.velocity"] = unit, sign
        signs[joint] = sign
    for j, (actuator, joint) in enumerate(kind.actuators.items()):
        sign = -1 if rng.uniform() < 0.4 else 1
        unit = ("mN m" if hinges[joint] else "mN") if variant == 2 else "N m" if hinges[joint] else "N"
        if kind is KINDS["servo"]:
            unit, sign = angle, signs[joint]
        table[names[2][j]] = sign * commands[:, j] / find_unit(unit).factor
        truth[names[2][j], f"actuator:{actuator}"] = unit, sign
    clock, unit, zero = CLOCKS[variant]
    time = (np.arange(steps) * dt + zero) / find_unit(unit).factor
    table[clock] = time if unit == "s" else np.round(time).astype(np.int64)
    table["temperature"] = 30 + 0.1 * rng.standard_normal(steps)
    (folder / "model.xml").write_text(kind.xml)
    pd.DataFrame({name: table[name] for name in rng.permutation(list(table))}).to_csv(folder / "log.csv", index=False)
    return Truth(truth, (clock, unit), delay)
