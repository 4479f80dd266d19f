"""mujoco.sysid as its tutorial calls it: least squares from the model as given, and its own confidence intervals.

    python examples/leaderboard/mujoco_sysid.py --out runs/leaderboard/mujoco_sysid

It takes an MJCF whose joint positions are measured from a known start; masses, dampings and armatures are written by
modifiers. Draws are normal with the sd of its 95 % intervals, independent, cut at the bounds. Every other task fails:
the benchmark's environments observe what is no sensor, functions have no model. Evaluations of the residual are counted
as rollouts. `pip install 'sipe-bayes[leaderboard]'`.
"""

from __future__ import annotations

import contextlib
import io
import logging
from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np
from mujoco import sysid
from scipy.stats import truncnorm

from sipe_bayes.benchmark.leaderboard.run import DRAWS, Estimate, Method, run_from_command_line
from sipe_bayes.benchmark.leaderboard.task import Case, Problem, Task
from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.trajectory import Trajectory
from sipe_bayes.envs.mjcf import MjcfEnvironment

logging.getLogger("absl").setLevel(logging.ERROR)


def writer(target: str) -> Callable[[Any, Any], None]:
    """What writes a value into an MjSpec."""
    (kind, rest), attribute = target.split(":"), target.rpartition(".")[2]
    name = rest.rpartition(".")[0]
    if kind == "joint" and attribute == "armature":
        return lambda spec, p: setattr(spec.joint(name), "armature", p.value[0])
    if kind == "joint" and attribute == "damping":
        return lambda spec, p: spec.joint(name).damping.__setitem__(0, p.value[0])
    if kind == "body" and attribute == "mass":
        return lambda spec, p: setattr(spec.body(name).geoms[0], "mass", p.value[0])
    raise NotImplementedError(f"no modifier for {target}")


def plain_model(environment: MjcfEnvironment) -> Any:
    """The MjSpec with a position sensor for every channel, and no others."""
    spec = environment.spec()
    for sensor in list(spec.sensors):
        spec.delete(sensor)
    for channel in environment.measurements:
        kind, joint = channel.target.removesuffix(".position").split(":")
        if kind != "joint" or not channel.target.endswith(".position"):
            raise NotImplementedError(f"no sensor for {channel.target}")
        objects = {"objtype": mujoco.mjtObj.mjOBJ_JOINT, "objname": joint}
        spec.add_sensor(name=channel.name, type=mujoco.mjtSensor.mjSENS_JOINTPOS, **objects)
    return spec


def sequence(spec: Any, log: Trajectory) -> Any:
    """A log as mujoco.sysid takes it; commands are held over the physics steps of a control step."""
    model = spec.compile()
    step, assert_states = float(model.opt.timestep), log.states
    if assert_states is None:
        raise NotImplementedError("the start is not known")
    state, repeated = assert_states[0], round(log.dt / step)
    position, velocity = state[1 : 1 + model.nq], state[1 + model.nq : 1 + model.nq + model.nv]
    start = sysid.create_initial_state(model, position, velocity, np.zeros(model.na))
    commands = np.repeat(log.actions, repeated, axis=0)
    control = sysid.TimeSeries(np.arange(len(commands)) * step, commands)
    # sensordata of a step are of the state before it and carry the time after it
    times = np.arange(len(log)) * log.dt + step
    measured = sysid.TimeSeries.from_names(times, log.observations[:-1], model)
    return sysid.ModelSequences("model", spec, "log", start, control, measured)


def method(seed: int) -> Method:
    def fit(task: Task, problem: Problem, case: Case) -> Estimate:
        environment = problem.simulator.environment
        if not isinstance(environment, MjcfEnvironment):
            raise NotImplementedError("mujoco.sysid takes an MJCF with sensors")
        spec, parameters, calls = plain_model(environment), sysid.ParameterDict(), [0]
        given = problem.space.values(np.clip(problem.space.default_theta, 0, 1))
        for one, value in zip(problem.space, given, strict=True):
            modifier = writer(one.targets[0])
            parameters.add(sysid.Parameter(one.name, value, one.low, one.high, modifier=modifier))
        logs = [sequence(spec, log) for log in case.trajectories]
        inner = sysid.build_residual_fn(models_sequences=logs, n_threads=1)

        def residual(values: FloatArray, *rest: Any, **more: Any) -> Any:
            calls[0] += 1 if np.ndim(values) < 2 else np.shape(values)[1]
            return inner(values, *rest, **more)

        with contextlib.redirect_stdout(io.StringIO()):  # a line for every iteration
            best, result = sysid.optimize(parameters, residual, verbose=False)
        value = np.asarray(best.as_vector(), float)
        half = sysid.calculate_intervals(inner(value, best, return_pred_all=True)[0], result.jac, alpha=0.05)[1]
        low, high = (np.array([getattr(p, end) for p in problem.space]) for end in ("low", "high"))
        sd = np.clip(np.nan_to_num(half / 1.96, nan=np.inf), 1e-9 * (high - low), 1e3 * (high - low))
        ends = (low - value) / sd, (high - value) / sd
        rng = np.random.default_rng(seed)
        drawn = truncnorm.rvs(*ends, value, sd, size=(DRAWS, len(value)), random_state=rng)
        return Estimate(drawn, calls[0] * len(case.trajectories))

    return fit


if __name__ == "__main__":
    run_from_command_line("mujoco.sysid", "mujoco.sysid from the model as given, its intervals", ["scipy"], method)
