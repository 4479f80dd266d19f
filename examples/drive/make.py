"""Make the log of this example: a linear drive under a position controller that the calibration does not know.

Force commands and a linear encoder of 5 um are logged at 1 kHz with time stamps that jitter by 10 us. The values
drawn here are hidden from the calibration; ``truth.json`` keeps them.

    python examples/drive/make.py [--seed 0] [--out examples/drive]
"""

from __future__ import annotations

import sys
from pathlib import Path

import mujoco
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))
from making import make

RATE, SECONDS = 1000.0, 24.8  # Hz, as the physics, s
BOUNDS = {"mass": (1.0, 5.0), "damping": (0.0, 30.0), "friction": (0.0, 15.0), "offset": (-3.0, 3.0)}


def truthful(path: Path, truth: dict[str, float]) -> mujoco.MjModel:
    """The model with the hidden values."""
    model = mujoco.MjModel.from_xml_path(str(path))
    model.opt.timestep = 1 / RATE
    model.body_inertia[1] *= truth["mass"] / model.body_mass[1]
    model.body_mass[1] = truth["mass"]
    model.dof_damping[0], model.dof_frictionloss[0] = truth["damping"], truth["friction"]
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return model


def wanted(t: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Position (m) that the controller follows: two sines and steps."""
    slow, fast, step = rng.uniform(0.25, 0.4), rng.uniform(0.8, 1.5), rng.uniform(0.1, 0.2)
    waves = 0.1 * np.sin(2 * np.pi * slow * t) + 0.04 * np.sin(2 * np.pi * fast * t + 1)
    return waves + 0.03 * np.sign(np.sin(2 * np.pi * step * t))


def log(truth: dict[str, float], rng: np.random.Generator, out: Path) -> None:
    """Write the log."""
    model = truthful(Path(__file__).parent / "drive.xml", truth)
    count = round(SECONDS * RATE) + 1
    times = np.arange(count) / RATE
    data, goal, rows = mujoco.MjData(model), wanted(times, rng), []
    for time, position in zip(times, goal, strict=True):
        force = np.round(np.clip(900 * (position - data.qpos[0]) - 40 * data.qvel[0], -60, 60), 2)
        data.ctrl[0] = force + truth["offset"]
        rows.append((time + rng.normal(0, 1e-5), force, np.round((data.qpos[0] + rng.normal(0, 3e-6)) / 5e-6)))
        mujoco.mj_step(model, data)
    t, force, x = np.array(rows).T
    columns = {"t": np.round(1e6 * (t - t[0])).astype("i4"), "force": np.round(100 * force).astype("i2")}
    np.savez_compressed(out / "log.npz", **columns, x=x.astype("i4"))


if __name__ == "__main__":
    make(__file__, BOUNDS, log)
