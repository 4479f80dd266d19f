"""Make the logs of this example: pieces of a double pendulum's free swinging, as a camera sees it.

Angles come at 200 Hz with noise of 4 mrad and time stamps in whole milliseconds. The values drawn here are hidden
from the calibration; ``truth.json`` keeps them.

    python examples/double_pendulum/make.py [--seed 0] [--out examples/double_pendulum]
"""

from __future__ import annotations

import sys
from pathlib import Path

import mujoco
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))
from making import make

RATE, SECONDS, PIECES, SUBSTEPS = 200.0, 2.7, 26, 5  # Hz, s, logs, physics steps between samples
NOISE = 0.004  # rad
BOUNDS = {
    "upper_mass": (0.1, 0.4),
    "lower_mass": (0.05, 0.2),
    "upper_com": (-0.08, -0.02),
    "lower_com": (-0.06, -0.01),
    "pivot_damping": (0.0, 0.003),
    "link_damping": (0.0, 0.001),
}


def truthful(path: Path, truth: dict[str, float]) -> mujoco.MjModel:
    """The model with the hidden values."""
    model = mujoco.MjModel.from_xml_path(str(path))
    model.opt.timestep = 1 / (RATE * SUBSTEPS)
    for body, name in ((1, "upper"), (2, "lower")):
        model.body_ipos[body, 2] = truth[f"{name}_com"]
        model.body_inertia[body] *= truth[f"{name}_mass"] / model.body_mass[body]
        model.body_mass[body] = truth[f"{name}_mass"]
    model.dof_damping[:] = truth["pivot_damping"], truth["link_damping"]
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return model


def piece(model: mujoco.MjModel, rng: np.random.Generator) -> list[str]:
    """Rows of time (ms) and both angles (rad), from somewhere within the swing."""
    data, rows = mujoco.MjData(model), []
    data.qpos[:], data.qvel[:] = rng.uniform(-1.8, 1.8, 2), rng.uniform(-3, 3, 2)
    start = rng.uniform(0.5, 2.0)
    mujoco.mj_step(model, data, round(start / model.opt.timestep))
    for k in range(round(SECONDS * RATE)):
        time = start + k / RATE
        pivot, link = data.qpos + rng.normal(0, NOISE, 2)
        rows.append(f"{1e3 * time:.0f},{pivot:.3f},{link:.3f}")
        mujoco.mj_step(model, data, SUBSTEPS)
    return rows


def logs(truth: dict[str, float], rng: np.random.Generator, out: Path) -> None:
    """Write every piece."""
    model = truthful(Path(__file__).parent / "double_pendulum.xml", truth)
    (out / "logs").mkdir(exist_ok=True)
    for number in range(PIECES):
        rows = ["ms,pivot,link", *piece(model, rng)]
        (out / "logs" / f"piece{number:02d}.csv").write_text("\n".join(rows) + "\n")


if __name__ == "__main__":
    make(__file__, BOUNDS, logs)
