"""Make the logs of this example: a servo that lifts a weight, simulated, with what a real log has.

Set-points and positions are exchanged at 190 Hz and get time stamps that jitter by .3 ms, the encoder has 4096 steps a
turn. The values drawn here are hidden from the calibration; ``truth.json`` keeps them.

    python examples/servo/make.py [--seed 0] [--out examples/servo]
"""

from __future__ import annotations

import sys
from pathlib import Path

import mujoco
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))
from making import make

RATE, SECONDS, RUNS, SUBSTEPS = 190.0, 4.0, 16, 6  # Hz, s, logs, physics steps between samples
TICK = 2 * np.pi / 4096  # rad
BOUNDS = {"kp": (4.0, 20.0), "friction": (0.0, 0.4), "damping": (0.0, 0.6), "armature": (0.0, 0.06)}


def truthful(path: Path, truth: dict[str, float]) -> mujoco.MjModel:
    """The model with the hidden values."""
    model = mujoco.MjModel.from_xml_path(str(path))
    model.opt.timestep = 1 / (RATE * SUBSTEPS)
    model.dof_frictionloss[0], model.dof_damping[0] = truth["friction"], truth["damping"]
    model.dof_armature[0] = truth["armature"]
    model.actuator_gainprm[0, 0], model.actuator_biasprm[0, 1] = truth["kp"], -truth["kp"]
    mujoco.mj_setConst(model, mujoco.MjData(model))  # friction is as soft as the inertia makes it
    return model


def goals(run: int, t: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Set-points (rad): sines, sweeps, steps and slow ramps in turn."""
    size, phase = rng.uniform(0.4, 1.2), rng.uniform(0, 2 * np.pi)
    if run % 4 == 0:
        return size * np.sin(2 * np.pi * rng.uniform(0.4, 1.2) * t + phase)
    if run % 4 == 1:
        return 0.6 * size * np.sin(2 * np.pi * (0.3 + 0.4 * t) * t + phase)
    if run % 4 == 2:
        return size * np.sign(np.sin(2 * np.pi * rng.uniform(0.5, 1.0) * t + phase))
    return size * (2 / np.pi) * np.arcsin(np.sin(2 * np.pi * rng.uniform(0.2, 0.4) * t + phase))


def log(model: mujoco.MjModel, run: int, rng: np.random.Generator) -> list[str]:
    """Rows of time (s), set-point and position (ticks)."""
    count = round(SECONDS * RATE)
    times = np.arange(count) / RATE
    ticks = np.round(goals(run, times, rng) / TICK)
    data, rows = mujoco.MjData(model), []
    for time, goal in zip(times, ticks, strict=True):
        data.ctrl[0] = TICK * goal
        measured = np.round((data.qpos[0] + rng.normal(0, 5e-4)) / TICK)
        stamp = time + np.clip(rng.normal(0, 3e-4), -1e-3, 1e-3)
        rows.append(f"{stamp:.4f},{goal:.0f},{measured:.0f}")
        mujoco.mj_step(model, data, SUBSTEPS)
    return rows


def logs(truth: dict[str, float], rng: np.random.Generator, out: Path) -> None:
    """Write every run."""
    model = truthful(Path(__file__).parent / "servo.xml", truth)
    (out / "logs").mkdir(exist_ok=True)
    for run in range(RUNS):
        rows = ["time,goal,position", *log(model, run, rng)]
        (out / "logs" / f"run{run:02d}.csv").write_text("\n".join(rows) + "\n")


if __name__ == "__main__":
    make(__file__, BOUNDS, logs)
