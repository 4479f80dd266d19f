"""Small models for the engine, with parameters, commands and measurements, and a plain mj_step loop beside it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from sipe_bayes.core.parameters import Parameter
from sipe_bayes.envs.channels import Channel
from sipe_bayes.envs.mjcf import MjcfEnvironment
from sipe_bayes.simulation.simulator import Simulator

FULL = mujoco.mjtState.mjSTATE_FULLPHYSICS
HORIZON = 24

PENDULUM = """<mujoco><option timestep="0.004"/><worldbody><body name="rod">
  <joint name="hinge" axis="0 1 0" damping="0.05" frictionloss="0.02"/>
  <geom type="capsule" fromto="0 0 0 0 0 -.5" size=".02" mass="1"/></body></worldbody>
  <actuator><motor name="motor" joint="hinge"/></actuator></mujoco>"""
CART_POLE = """<mujoco><option timestep="0.004" integrator="implicitfast"/><worldbody><body name="cart">
  <joint name="slider" type="slide" axis="1 0 0" damping="0.1"/><geom type="box" size=".1 .1 .05" mass="1"/>
  <body name="pole" pos="0 0 .05"><joint name="hinge" axis="0 1 0"/>
  <inertial pos="0 0 .3" mass=".2" diaginertia=".006 .006 .003"/></body></body></worldbody>
  <actuator><motor name="motor" joint="slider" gear="3"/></actuator></mujoco>"""
ARM = """<mujoco><option timestep="0.004"/><worldbody><geom name="floor" type="plane" size="3 3 .1"/>
  <body name="upper" pos="0 0 .6"><joint name="shoulder" axis="0 1 0" damping="0.1"/>
    <geom type="capsule" fromto="0 0 0 .3 0 0" size=".03" mass=".5"/>
    <body name="lower" pos=".3 0 0"><joint name="elbow" axis="0 1 0" damping="0.1"/>
      <geom type="capsule" fromto="0 0 0 .3 0 0" size=".03" mass=".3"/>
      <site name="tip" pos=".3 0 0"/></body></body>
  <body name="box" pos=".3 0 .1"><freejoint/><geom name="box" type="box" size=".1 .1 .1" mass=".4"/></body>
  </worldbody>
  <actuator><motor name="m1" joint="shoulder"/><motor name="m2" joint="elbow"/></actuator>
  <sensor><accelerometer name="acc" site="tip"/><gyro name="gyro" site="tip"/>
    <framepos name="pos" objtype="body" objname="box"/><jointpos name="enc" joint="elbow"/></sensor>
  </mujoco>"""
SERVO = """<mujoco><option timestep="0.004"/><worldbody><body name="rod">
  <joint name="hinge" axis="0 1 0" armature=".01"/>
  <geom type="capsule" fromto="0 0 0 0 0 -.5" size=".02" mass="1"/></body></worldbody>
  <actuator><general name="servo" joint="hinge" dyntype="filter" dynprm=".03" gainprm="20"
    biastype="affine" biasprm="0 -20 -1"/></actuator></mujoco>"""


@dataclass(frozen=True)
class Case:
    xml: str
    parameters: tuple[Parameter, ...]
    actuators: tuple[str, ...]
    measurements: tuple[str | Channel, ...]

    def environment(self) -> MjcfEnvironment:
        return MjcfEnvironment.build(self.xml, self.parameters, self.actuators, self.measurements)


def p(name: str, low: float, high: float, *targets: str, **more: Any) -> Parameter:
    return Parameter(name, low, high, targets=targets, **more)


HINGE = ("joint:hinge.position", "joint:hinge.velocity")
ARM_SENSORS = tuple(f"sensor:{s}[{i}]" for s in ("acc", "gyro", "pos") for i in range(3))
CASES = {
    "pendulum": Case(
        PENDULUM,
        (
            p("mass", 0.5, 2, "body:rod.mass", scale="log"),
            p("friction", 0, 0.1, "joint:hinge.frictionloss"),
            p("com", -0.4, -0.1, "body:rod.com_z"),
        ),
        ("motor",),
        HINGE,
    ),
    "cart-pole": Case(
        CART_POLE,
        (
            p("cart", 0.5, 2, "body:cart.mass"),
            p("inertia", 0.004, 0.008, "body:pole.inertia_yy"),
            p("tilt", -0.001, 0.001, "body:pole.inertia_xz"),
            p("gear", 1, 5, "actuator:motor.gear"),
        ),
        ("motor",),
        ("joint:slider.position", *HINGE),
    ),
    "arm": Case(
        ARM,
        (
            p("lower", 0.5, 2, "body:lower.mass", relative=True),
            p("slip", 0.2, 1.5, "geom:box.friction", "geom:floor.friction"),
            p("box", -0.05, 0.05, "body:box.com_x"),
            p("gravity", -12, -8, "option.gravity_z"),
        ),
        ("m1", "m2"),
        ("joint:shoulder.position", "joint:elbow.velocity", *ARM_SENSORS, "sensor:enc"),
    ),
    "servo": Case(
        SERVO,
        (
            p("kp", 5, 40, "actuator:servo.kp"),
            p("kv", 0, 2, "actuator:servo.kv"),
            p("d", 0, 1, "joint:hinge.damping"),
        ),
        ("servo",),
        HINGE,
    ),
    "delay": Case(
        PENDULUM,
        (p("delay", 0, 0.03, "actuator:motor.delay"), p("offset", -0.5, 0.5, "actuator:motor.offset")),
        ("motor",),
        HINGE,
    ),
}


def draw(case: Case, batch: int = 7, seed: int = 0) -> tuple[Simulator, Any, Any, Any]:
    """A simulator with one thread and random theta (B, N), actions (B, T, A) and starts (B, S)."""
    simulator, rng = Simulator(case.environment(), 1), np.random.default_rng(seed)
    model = simulator.model
    starts = np.tile(simulator.default_state(), (batch, 1))
    starts[:, 1 + model.nq : 1 + model.nq + model.nv] = rng.normal(0, 0.5, (batch, model.nv))
    actions = rng.normal(0, 1, (batch, HORIZON, len(case.actuators)))
    return simulator, rng.random((batch, len(case.parameters))), actions, starts


def plain(environment: MjcfEnvironment, theta: Any, actions: Any, start: Any, dt: float, skip: int) -> tuple[Any, int]:
    """States (T+1, S) of one lane by mj_step, and the first physics step that warned, from 1."""
    model = environment.compile()
    environment.write(model, environment.space.values(theta))
    mujoco.mj_setConst(model, mujoco.MjData(model))
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_WARMSTART
    model.opt.timestep, data = dt / skip, mujoco.MjData(model)
    mujoco.mj_setState(model, data, start, FULL)
    states, bad = [start], len(actions) * skip + 1
    for t, action in enumerate(np.repeat(actions, skip, axis=0)):
        data.ctrl[environment._controls] = action
        mujoco.mj_step(model, data)
        mujoco.mj_getState(model, data, state := np.empty_like(start), FULL)
        states.append(state)
        if data.warning.number.any():
            bad = t + 1
            break
    states += states[-1:] * (len(actions) * skip + 1 - len(states))
    return np.array(states)[::skip], bad
