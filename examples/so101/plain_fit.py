"""A plain least-squares fit of the SO-101's 31 parameters, to compare ``sipe calibrate`` with.

    python examples/so101/plain_fit.py [--out plain.json]

Gauss-Newton on segments of 1 s that begin at smoothed states. It has no noise model and gives no intervals. The
parameters have the names that they have in ``calibrate.toml``; bounds are the same.
"""

from __future__ import annotations

import argparse
import copy
import json
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np
from mujoco import rollout
from numpy.typing import NDArray
from scipy.signal import savgol_filter

FOLDER = Path(__file__).parent
TRAIN = "multisine", "prbs_excitation", "large_amplitude"
HELD_OUT = "chirp_sweep", "friction_gravity", "backlash_detection", "step_response", "pick_place"
JOINTS = "shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper"
ARM = 5  # joints that errors are counted over: all but the gripper
KINDS = "kp", "damping", "friction", "armature", "zero"
NAMES = (*(f"{joint}_{kind}" for kind in KINDS for joint in JOINTS), "delay")
NOMINAL = {"kp": 17.8, "damping": 0.6, "friction": 0.052, "armature": 0.028, "zero": 0.0}
BOUNDS = {"kp": (1, 90), "damping": (1e-3, 6), "friction": (1e-3, 2), "armature": (1e-4, 0.1)}
LOWER = np.r_[np.log(np.repeat([low for low, _ in BOUNDS.values()], 6)), np.full(6, -0.2), 0.0]
UPPER = np.r_[np.log(np.repeat([high for _, high in BOUNDS.values()], 6)), np.full(6, 0.2), 0.08]
DIFFERENCE = np.r_[np.full(24, 0.03), np.full(6, 0.002), 0.004]  # steps of the finite differences
LENGTH, EVERY = 1.0, 3.0  # s: a segment of 1 s begins every 3 s
STEP = 0.004  # s, integration step
Floats = NDArray[np.float64]


class Log(NamedTuple):
    """Times (T,) in s; commands and positions (T, 6) in rad."""

    time: Floats
    command: Floats
    position: Floats


class Segment(NamedTuple):
    """``LENGTH`` seconds of a log from ``begin`` on, with the smoothed position and velocity (6,) there."""

    log: Log
    begin: float
    position: Floats
    velocity: Floats


def load_model() -> mujoco.MjModel:
    model = mujoco.MjModel.from_xml_path(str(FOLDER / "so101.xml"))
    model.opt.timestep = STEP
    return model


def load_log(motion: str, model: mujoco.MjModel) -> Log:
    table = np.genfromtxt(FOLDER / "logs" / f"{motion}.csv", delimiter=",", skip_header=1)
    command, position = table[:, 1:7].copy(), table[:, 7:13].copy()
    low, high = model.jnt_range[5]
    for column in (command[:, 5], position[:, 5]):  # the gripper: 0 to 1 of its range
        column[:] = low + column * (high - low)
    return Log(table[:, 0], command, position)


def cut_segments(log: Log) -> list[Segment]:
    dt = float(np.median(np.diff(log.time)))
    grid = np.arange(log.time[0], log.time[-1], dt)
    even = np.stack([np.interp(grid, log.time, column) for column in log.position.T], axis=1)
    position = savgol_filter(even, 7, 3, axis=0)
    velocity = savgol_filter(even, 7, 3, deriv=1, delta=dt, axis=0)
    begins = np.searchsorted(grid, np.arange(0.2, log.time[-1] - LENGTH - 0.1, EVERY))
    return [Segment(log, float(grid[k]), position[k], velocity[k]) for k in begins]


def pack(values: Mapping[str, float]) -> Floats:
    """Values by name as a vector (31,): logarithms of the first 24, as ``NAMES`` has them."""
    x = np.array([values[name] for name in NAMES])
    return np.r_[np.log(x[:24]), x[24:]]


def unpack(x: Floats) -> dict[str, float]:
    return dict(zip(NAMES, [*np.exp(x[:24]), *x[24:]], strict=True))


def nominal_values() -> dict[str, float]:
    return {**{f"{joint}_{kind}": NOMINAL[kind] for kind in KINDS for joint in JOINTS}, "delay": 0.0}


def write_model(nominal: mujoco.MjModel, x: Floats) -> mujoco.MjModel:
    model = copy.copy(nominal)
    kp, damping, friction, armature = np.exp(x[:24]).reshape(4, 6)
    model.actuator_gainprm[:, 0], model.actuator_biasprm[:, 1] = kp, -kp
    model.dof_damping.reshape(model.nv, -1)[:, 0] = damping
    model.dof_frictionloss[:], model.dof_armature[:] = friction, armature
    mujoco.mj_setConst(model, mujoco.MjData(model))  # how soft dry friction is goes with the armature
    return model


def commands_at(log: Log, times: Floats) -> Floats:
    """The commands (len(times), 6) that hold at these times."""
    return log.command[np.clip(np.searchsorted(log.time, times, side="right") - 1, 0, len(log.time) - 1)]


def errors_along(log: Log, begin: float, length: float, simulated: Floats) -> Floats:
    """Simulated less measured positions (samples, 6); ``simulated`` (steps, 6) holds those after each step."""
    inside = (log.time > begin) & (log.time <= begin + length - STEP)
    at = (log.time[inside] - begin) / STEP - 1
    low = np.clip(at.astype(int), 0, len(simulated) - 2)
    share = (at - low)[:, None]
    return (1 - share) * simulated[low] + share * simulated[low + 1] - log.position[inside]


def simulate(
    nominal: mujoco.MjModel, candidates: Sequence[Floats], segments: Sequence[Segment], length: float
) -> Floats:
    """Positions as they are measured (candidates, segments, steps, 6)."""
    steps, size = round(length / STEP), mujoco.mj_stateSize(nominal, mujoco.mjtState.mjSTATE_FULLPHYSICS)
    states = np.zeros((len(candidates), len(segments), size))
    controls = np.empty((len(candidates), len(segments), steps, 6))
    for x, state, control in zip(candidates, states, controls, strict=True):
        for k, (log, begin, position, velocity) in enumerate(segments):
            state[k, 1:13] = np.r_[position - x[24:30], velocity]
            control[k] = commands_at(log, begin + (np.arange(steps) + 0.5) * STEP - x[30])  # in the middle of steps
    models = [model for x in candidates for model in [write_model(nominal, x)] * len(segments)]
    data = mujoco.MjData(nominal)
    out, _ = rollout.rollout(models, [data], states.reshape(-1, size), controls.reshape(-1, steps, 6))
    zeros = np.array(candidates)[:, None, None, 24:30]
    return out[:, :, 1:7].reshape(len(candidates), len(segments), steps, 6) + zeros


def residuals(nominal: mujoco.MjModel, candidates: Sequence[Floats], segments: Sequence[Segment]) -> Floats:
    """(candidates, samples, 6)."""
    simulated = simulate(nominal, candidates, segments, LENGTH)
    return np.array(
        [
            np.concatenate([errors_along(s.log, s.begin, LENGTH, q) for s, q in zip(segments, row, strict=True)])
            for row in simulated
        ]
    )


def fit(nominal: mujoco.MjModel, x: Floats, segments: Sequence[Segment], iterations: int = 8) -> Floats:
    """Gauss-Newton with a weak pull to where it begins."""
    prior, weight, begin = x.copy(), 0.1 * np.r_[np.ones(24), np.full(7, 1e3)], time.perf_counter()
    for iteration in range(iterations):
        r = residuals(nominal, [x, *(x + np.diag(DIFFERENCE))], segments)
        sd = np.sqrt(np.square(r[0]).mean(0))
        jacobian = ((r[1:] - r[0]) / DIFFERENCE[:, None, None] / sd).reshape(31, -1).T
        hessian, gradient = jacobian.T @ jacobian, jacobian.T @ (r[0] / sd).ravel() + weight * (x - prior)
        damped = [hessian + np.diag(weight + share * np.diag(hessian)) for share in (1e-3, 0.1, 1, 10)]
        trials = [np.clip(x - np.linalg.solve(matrix, gradient), LOWER, UPPER) for matrix in damped]
        costs = np.square(residuals(nominal, trials, segments) / sd).sum((1, 2))
        print(f"iteration {iteration}, {time.perf_counter() - begin:.0f} s: RMSE {sd.round(4)} rad", flush=True)
        if not costs.min() <= 0.999 * np.square(r[0] / sd).sum():
            break
        x = trials[int(costs.argmin())]
    return x


def free_run(nominal: mujoco.MjModel, values: Mapping[str, float], log: Log, length: float = 30.0) -> Floats:
    """Errors (samples, 6) of one simulation from the log's first sample on, at rest there."""
    x = pack(values)
    whole = Segment(log, 0.0, log.position[0], np.zeros(6))
    return errors_along(log, 0.0, length, simulate(nominal, [x], [whole], length)[0, 0])


def held_out_errors(values: Mapping[str, float]) -> dict[str, float]:
    """RMSE in rad over the five arm joints by motion: the first 30 s of each held-out log, one simulation."""
    nominal = load_model()
    errors = {motion: free_run(nominal, values, load_log(motion, nominal)) for motion in HELD_OUT}
    return {motion: float(np.sqrt(np.square(error[:, :ARM]).mean())) for motion, error in errors.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, help="JSON file for values and errors")
    out, begin = parser.parse_args().out, time.perf_counter()
    nominal = load_model()
    segments = [segment for motion in TRAIN for segment in cut_segments(load_log(motion, nominal))]
    values = unpack(fit(nominal, pack({**nominal_values(), "delay": 1e-3}), segments))
    used = {"wall_s": time.perf_counter() - begin, "cpu_s": time.process_time()}
    for kind in KINDS:
        print(f"{kind:10}", *(f"{values[f'{joint}_{kind}']:10.4f}" for joint in JOINTS))
    print(f"delay      {values['delay']:10.4f} s; {len(segments)} segments, {used['cpu_s']:.0f} CPU s")
    before, after = held_out_errors(nominal_values()), held_out_errors(values)
    for motion in HELD_OUT:
        print(f"{motion:20} RMSE {after[motion]:.4f} rad; nominal model {before[motion]:.4f} rad")
    if out is not None:
        out.write_text(json.dumps({"values": values, "errors": after, **used}, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
