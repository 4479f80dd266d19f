"""Make the logs of this example: a two-link arm under a tracking controller that the calibration does not know.

Torques (as commanded) and angles of encoders with 16384 steps a turn are logged at 500 Hz with time stamps that
jitter by 50 us. The values drawn here are hidden from the calibration; ``truth.json`` keeps them.

    python examples/arm/make.py [--seed 0] [--out examples/arm]
"""

from __future__ import annotations

import sys
from pathlib import Path

import mujoco
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))
from making import make

RATE, SECONDS, RUNS = 500.0, 10.0, 10  # Hz, as the physics, s, logs
TICK = 2 * np.pi / 16384  # rad
STIFFNESS, DAMPING = np.array([60.0, 25.0]), np.array([5.0, 1.5])  # of the controller
BOUNDS = {
    "upper_com": (-0.25, -0.05),
    "lower_mass": (0.3, 1.5),
    "lower_com": (-0.2, -0.03),
    "shoulder_armature": (0.0, 0.1),
    "elbow_armature": (0.0, 0.05),
    "shoulder_damping": (0.0, 0.6),
    "elbow_damping": (0.0, 0.3),
    "shoulder_friction": (0.0, 0.6),
    "elbow_friction": (0.0, 0.3),
}


def truthful(path: Path, truth: dict[str, float]) -> mujoco.MjModel:
    """The model with the hidden values."""
    model = mujoco.MjModel.from_xml_path(str(path))
    model.opt.timestep = 1 / RATE
    model.body_ipos[1, 2], model.body_ipos[2, 2] = truth["upper_com"], truth["lower_com"]
    model.body_inertia[2] *= truth["lower_mass"] / model.body_mass[2]
    model.body_mass[2] = truth["lower_mass"]
    for field in ("armature", "damping", "friction"):
        values = [truth[f"shoulder_{field}"], truth[f"elbow_{field}"]]
        getattr(model, "dof_frictionloss" if field == "friction" else f"dof_{field}")[:] = values
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return model


def wanted(t: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Angles (T, 2) in rad that the controller follows: three sines for each joint."""
    frequency, phase = rng.uniform(0.1, 1.2, (3, 2)), rng.uniform(0, 2 * np.pi, (3, 2))
    size = rng.uniform(0.15, 0.5, (3, 2))
    waves = size * np.sin(2 * np.pi * frequency * t[:, None, None] + phase)
    angles: np.ndarray = waves.sum(1)
    return angles


def log(model: mujoco.MjModel, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Time (T,) in us, torques (T, 2) in .01 N m, angles (T, 2) in ticks."""
    count = round(SECONDS * RATE)
    times = np.arange(count) / RATE
    data, goal = mujoco.MjData(model), wanted(times, rng)
    data.qpos[:] = goal[0]
    torques, angles = [], []
    for angle in goal:
        torque = STIFFNESS * (angle - data.qpos) - DAMPING * data.qvel
        data.ctrl[:] = np.clip(np.round(torque, 2), *model.actuator_ctrlrange.T)
        torques.append(data.ctrl.copy())
        angles.append(np.round((data.qpos + rng.normal(0, TICK / 2, 2)) / TICK))
        mujoco.mj_step(model, data)
    stamps = 100 * np.round(1e4 * (times + rng.normal(0, 5e-5, count))).astype("i4")
    return {"time": stamps, "torque": np.round(1e2 * np.array(torques)).astype("i2"), "angle": np.array(angles, "i2")}


def logs(truth: dict[str, float], rng: np.random.Generator, out: Path) -> None:
    """Write every run."""
    model = truthful(Path(__file__).parent / "arm.xml", truth)
    (out / "logs").mkdir(exist_ok=True)
    for run in range(RUNS):
        np.savez_compressed(out / "logs" / f"run{run}.npz", **log(model, rng))


if __name__ == "__main__":
    make(__file__, BOUNDS, logs)
