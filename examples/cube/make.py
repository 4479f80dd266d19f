"""Make the tosses of this example: a cube thrown on a board, simulated, with the noise of a motion capture.

Friction and the contact's solref are drawn here and hidden from the calibration; ``truth.json`` keeps them.

    python examples/cube/make.py [--seed 0] [--out examples/cube]
"""

from __future__ import annotations

import sys
from pathlib import Path

import mujoco
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))
from making import make

RATE, SECONDS, SUBSTEPS = 148.0, 0.6, 4  # samples per second, a toss, physics steps between samples
POSITION_SD, TURN_SD = 0.002, np.radians(1.0)  # m, rad
TOSSES = 50
TRUTH = {"friction": 0.18, "timeconst": 0.012, "dampratio": 0.55}  # of the tosses in the repository
BOUNDS = {"friction": (0.05, 0.6), "timeconst": (0.005, 0.03), "dampratio": (0.1, 1.2)}


def truthful(path: Path, truth: dict[str, float]) -> mujoco.MjModel:
    """The model with the hidden values."""
    model = mujoco.MjModel.from_xml_path(str(path))
    model.opt.timestep = 1 / (RATE * SUBSTEPS)
    model.geom_friction[:, 0] = truth["friction"]
    model.geom_solref[:] = truth["timeconst"], truth["dampratio"]
    return model


def toss(model: mujoco.MjModel, rng: np.random.Generator) -> np.ndarray:
    """Rows of time, position and quaternion w-x-y-z as measured, the quaternion with an accidental sign."""
    data = mujoco.MjData(model)
    quaternion = rng.normal(size=4)
    data.qpos[:] = [*rng.uniform(-0.1, 0.1, 2), rng.uniform(0.2, 0.35), *(quaternion / np.linalg.norm(quaternion))]
    data.qvel[:] = [*rng.uniform(-1.2, 1.2, 2), rng.uniform(-1.0, 0.2), *rng.normal(0, 4.0, 3)]
    rows = []
    for k in range(round(SECONDS * RATE) + 1):
        turn, noisy = np.zeros(4), np.zeros(4)
        error = rng.normal(0, TURN_SD, 3)
        mujoco.mju_axisAngle2Quat(turn, error / np.linalg.norm(error), np.linalg.norm(error))
        mujoco.mju_mulQuat(noisy, turn, data.qpos[3:7])
        place = data.qpos[:3] + rng.normal(0, POSITION_SD, 3)
        rows.append([k / RATE, *place, *(rng.choice([-1.0, 1.0]) * noisy)])
        mujoco.mj_step(model, data, SUBSTEPS)
    return np.array(rows)


def logs(truth: dict[str, float], rng: np.random.Generator, out: Path) -> None:
    """Write every toss."""
    model = truthful(Path(__file__).parent / "cube.xml", truth)
    (out / "tosses").mkdir(exist_ok=True)
    for number in range(TOSSES):
        rows = [",".join([f"{r[0]:.5f}", *(f"{x:.4f}" for x in r[1:])]) for r in toss(model, rng)]
        text = "\n".join(["time,x,y,z,qw,qx,qy,qz", *rows]) + "\n"
        (out / "tosses" / f"toss{number:02d}.csv").write_text(text)


if __name__ == "__main__":
    make(__file__, BOUNDS, logs, committed=TRUTH)
