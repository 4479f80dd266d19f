"""Bodies that turn: a tossed cube on a floor and a pendulum on a ball joint, with frames off their origins."""

from __future__ import annotations

import mujoco
import numpy as np

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.parameters import Parameter
from sipe_bayes.core.rotations import added
from sipe_bayes.core.trajectory import Trajectories, Trajectory
from sipe_bayes.envs.mjcf import MjcfEnvironment
from sipe_bayes.simulation.simulator import Simulator

CUBE = """<mujoco><option timestep="0.0016892" cone="elliptic"/>
  <worldbody><geom name="floor" type="plane" size="3 3 .1" friction=".3"/>
  <body name="cube" pos="0 0 .5"><freejoint name="free"/>
    <geom name="cube" type="box" size=".05 .05 .05" mass=".37" friction=".3"/>
    <site name="tag" pos=".05 .01 .02" euler="20 30 40"/></body></worldbody>
  <sensor><framepos name="tag" objtype="site" objname="tag"/><framequat name="tag_turn" objtype="site" objname="tag"/>
    <velocimeter name="speed" site="tag"/><gyro name="gyro" site="tag"/></sensor></mujoco>"""
BALL = """<mujoco><option timestep="0.002"/><worldbody>
  <body name="arm" pos="0 0 1" euler="10 20 30"><joint name="hinge" axis="0 1 0"/>
    <geom type="capsule" fromto="0 0 0 .3 0 0" size=".02" mass=".4"/>
    <body name="bob" pos=".3 0 0" euler="0 0 50"><joint name="ball" type="ball" damping=".01"/>
      <geom type="capsule" fromto="0 0 0 .1 .05 -.3" size=".02" mass=".3"/>
      <site name="imu" pos="0 0 -.2" euler="40 0 10"/></body></body></worldbody>
  <sensor><gyro name="gyro" site="imu"/><ballquat name="own" joint="ball"/></sensor></mujoco>"""
ROUND = CUBE.replace('type="box" size=".05 .05 .05"', 'type="sphere" size=".05"')
POSE = ("body:cube.position", "body:cube.orientation")
FRICTION = Parameter("friction", 0.05, 0.6, targets=("geom:cube.friction", "geom:floor.friction"))
DAMPING = Parameter("damping", 0.0, 0.05, targets=("joint:ball.damping",))


def cube(*measurements: str, threads: int = 1) -> Simulator:
    environment = MjcfEnvironment.build(CUBE, [FRICTION], [], measurements or POSE)
    return Simulator(environment, num_threads=threads)


def tosses(simulator: Simulator, count: int, steps: int, seed: int, noise: float = 0.0, dt: float = 4 * 0.0016892):
    """Logs (without states) of cubes that fly and land, with noise (m, rad) in every channel, and their states."""
    rng = np.random.default_rng(seed)
    states = np.zeros((count, simulator.state_size))
    for state in states:
        state[1:4] = simulator.default_state()[1:4] + rng.uniform(-0.1, 0.1, 3)
        quaternion = rng.normal(size=4)
        state[4:8] = quaternion / np.linalg.norm(quaternion)
        state[8:14] = [*rng.normal(size=3), *(6 * rng.normal(size=3))]
    theta = np.full((1, 1), 0.5)
    made = simulator.rollout(theta, np.zeros((count, steps, 0)), states, dt)
    assert made.states is not None
    logs = []
    for k in range(count):
        seen = with_noise(made.observations[k], simulator.environment.rotations, noise, rng)
        logs.append(Trajectory(seen, made.actions[k], dt, name=f"toss {k}"))
    return Trajectories.stack(logs), made.states


def with_noise(
    observations: FloatArray, rotations: tuple[tuple[int, int, int], ...], sd: float, rng: np.random.Generator
) -> FloatArray:
    noise = sd * rng.normal(size=observations.shape)
    out = observations + noise
    for triple in map(list, rotations):
        out[:, triple] = added(observations[:, triple], noise[:, triple])
    return out


def turns(model: mujoco.MjModel, states: FloatArray, other: FloatArray) -> FloatArray:
    """Tangents (n, nv) of positions from ``states`` (n, S) to ``other``."""
    out = np.empty((len(states), model.nv))
    for row, one, two in zip(out, states, other, strict=True):
        mujoco.mj_differentiatePos(model, row, 1.0, one[1 : 1 + model.nq].copy(), two[1 : 1 + model.nq].copy())
    return out
