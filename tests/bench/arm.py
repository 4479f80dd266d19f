"""The arm of mujoco.sysid's own end-to-end test, five armatures unknown, for both programs on the same data.

The model follows mujoco/sysid/tests/test_integration.py (DeepMind, Apache-2.0), with the armatures at the values where
that test starts its search. Positions and velocities of the five joints are measured with white noise of 1 % of each
channel's root mean square: sysid scales its residuals by just that and assumes one variance for all of them.
"""

from __future__ import annotations

import contextlib
import io
import time
from dataclasses import dataclass
from typing import Any

import mujoco
import mujoco.rollout
import numpy as np
from numpy.typing import NDArray

from sipe_bayes.core.parameters import Parameter
from sipe_bayes.core.trajectory import Trajectory
from sipe_bayes.envs.mjcf import MjcfEnvironment
from sipe_bayes.inference.laplace import Laplace
from sipe_bayes.likelihood import Segments
from sipe_bayes.simulation.simulator import Simulator

FloatArray = NDArray[np.float64]

JOINTS = tuple(f"joint{j}" for j in range(1, 6))
TRUTH = np.array([0.5, 0.4, 0.3, 0.2, 0.1])  # kg m^2
LOW, HIGH, START = 0.001, 1.0, 0.01
DURATION, NOISE = 2.0, 0.01

_LINKS = (  # mass, inertia, height of the centre of mass, length, axis, damping
    (1.0, "0.01 0.01 0.005", 0.05, 0.1, "0 0 1", 1.0),
    (0.8, "0.008 0.008 0.004", 0.05, 0.1, "0 1 0", 0.8),
    (0.6, "0.006 0.006 0.003", 0.05, 0.1, "0 1 0", 0.6),
    (0.4, "0.004 0.004 0.002", 0.04, 0.08, "0 0 1", 0.4),
    (0.2, "0.002 0.002 0.001", 0.03, 0.06, "0 1 0", 0.2),
)


def arm_xml(armature: float | FloatArray = START) -> str:
    """The MJCF with these armatures (one, or five)."""
    values, bodies, above = np.broadcast_to(armature, 5), "", 0.1
    for joint, value, (mass, inertia, com, length, axis, damping) in zip(JOINTS, values, _LINKS, strict=True):
        bodies += (
            f'<body pos="0 0 {above}"><inertial pos="0 0 {com}" mass="{mass}" diaginertia="{inertia}"/>'
            f'<joint name="{joint}" axis="{axis}" range="-3.14 3.14" armature="{value}" damping="{damping}"/>'
            f'<geom type="capsule" fromto="0 0 0 0 0 {length}" size="0.02"/>'
        )
        above = length
    motors = "".join(f'<motor name="{j}" joint="{j}"/>' for j in JOINTS)
    sensors = "".join(f'<joint{w} name="{j}_{w}" joint="{j}"/>' for w in ("pos", "vel") for j in JOINTS)
    return (
        '<mujoco><compiler angle="radian" autolimits="true"/>'
        '<option integrator="implicitfast" timestep="0.002"><flag contact="disable"/></option>'
        f"<worldbody>{bodies}{'</body>' * 5}</worldbody>"
        f"<actuator>{motors}</actuator><sensor>{sensors}</sensor></mujoco>"
    )


@dataclass(frozen=True)
class ArmLog:
    """What both programs are given. time (T+1,), torque (T, 5), measured (T+1, 10): positions, then velocities."""

    time: FloatArray
    torque: FloatArray
    measured: FloatArray


def arm_log(seed: int) -> ArmLog:
    """The tutorial's five sines for 2 s, simulated at the truth, with noise."""
    model = mujoco.MjModel.from_xml_string(arm_xml(TRUTH))
    t = np.arange(round(DURATION / model.opt.timestep)) * model.opt.timestep
    rows = zip((5.0, 4.0, 3.0, 2.0, 1.0), (0.5, 0.7, 0.4, 0.9, 0.6), (0.0, 0.5, 1.0, 1.5, 2.0), strict=True)
    torque = np.column_stack([a * np.sin(2 * np.pi * f * t + p) for a, f, p in rows])[:-1]
    state, _ = mujoco.rollout.rollout(model, mujoco.MjData(model), np.zeros(11), torque)
    clean = np.concatenate([np.zeros((1, 10)), state[0, :, 1:]])
    scale = NOISE * np.sqrt((clean**2).mean(0))
    noise = scale * np.random.default_rng(seed).standard_normal(clean.shape)
    return ArmLog(t, torque, clean + noise)


@dataclass(frozen=True)
class Estimate:
    """value (5,) and the half-width (5,) of its 95 % interval, in kg m^2; seconds of the fit alone."""

    value: FloatArray
    half: FloatArray
    seconds: float
    rollouts: int = 0

    @property
    def error(self) -> float:
        return float(np.abs(self.value - TRUTH).mean())

    @property
    def inside(self) -> int:
        return int((np.abs(self.value - TRUTH) <= self.half).sum())


def arm_simulator() -> Simulator:
    """Our simulator of the arm, the model's own armatures at the start of the search."""
    parameters = [Parameter(f"{j}.armature", LOW, HIGH, targets=(f"joint:{j}.armature",)) for j in JOINTS]
    channels = [f"joint:{j}.{w}" for w in ("position", "velocity") for j in JOINTS]
    return Simulator(MjcfEnvironment.build(arm_xml(), parameters, JOINTS, channels))


def ours(simulator: Simulator, log: ArmLog, likelihood: Segments, **settings: Any) -> Estimate:
    """``laplace`` on the log; timed is ``fit``."""
    estimator = Laplace(simulator, likelihood=likelihood, **settings)
    trajectory = Trajectory(log.measured, log.torque, simulator.model.opt.timestep)
    begin = time.perf_counter()
    posterior = estimator.fit(trajectory)
    seconds = time.perf_counter() - begin
    low, high = (posterior.space.values(posterior.quantile(q).numpy()) for q in (0.025, 0.975))
    value = posterior.space.values(posterior.mode.numpy())
    return Estimate(value, (high - low) / 2, seconds, estimator.rollouts)


def rival(log: ArmLog) -> Estimate:
    """mujoco.sysid on the log, as its test calls it, with its default optimiser and its own intervals.

    Timed is ``optimize``.
    """
    from mujoco import sysid

    spec = mujoco.MjSpec.from_string(arm_xml())
    model = spec.compile()
    params = sysid.ParameterDict()
    for joint in JOINTS:

        def write(s: Any, p: Any, name: str = joint) -> None:
            s.joint(name).armature = p.value[0]

        params.add(sysid.Parameter(joint, START, LOW, HIGH, modifier=write))
    # sysid labels the sensors of the state before a step with the time after it, as mujoco.rollout returns them
    start = sysid.create_initial_state(model, np.zeros(5), np.zeros(5), np.zeros(0))
    controls = np.concatenate([log.torque, log.torque[-1:]])
    times = log.time[1:]
    measured = sysid.TimeSeries.from_names(times, log.measured[: len(times)], model)
    sequence = sysid.ModelSequences("arm", spec, "log", start, sysid.TimeSeries(log.time, controls), measured)
    residual = sysid.build_residual_fn(models_sequences=[sequence])
    with contextlib.redirect_stdout(io.StringIO()):
        begin = time.perf_counter()
        found, result = sysid.optimize(params, residual, optimizer="mujoco", verbose=False)
        seconds = time.perf_counter() - begin
    final, _, _ = residual(result.x, found)
    _, half = sysid.calculate_intervals(final, result.jac, alpha=0.05)
    return Estimate(np.asarray(result.x, float), np.asarray(half, float), seconds)
