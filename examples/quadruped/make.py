"""Make the logs of this example: a four-legged machine that shifts its weight and lifts its feet, simulated.

Set-points, encoders and an inertial unit are logged at 200 Hz, samples before the command that answers them. The
inertial unit has noise and a bias on each axis; the machine stands anywhere on the floor, turned anyhow. The values
drawn here are hidden from the calibration; ``truth.json`` keeps them.

    python examples/quadruped/make.py [--seed 0] [--out examples/quadruped]
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import mujoco
import numpy as np

DT, STEPS, STANDS = 0.005, 240, 1.5  # s, control steps of a log, s that it stands before
LEGS = ("fl", "fr", "rl", "rr")
JOINTS = [f"{leg}_{joint}" for leg in LEGS for joint in ("hip", "knee")]
POSE = np.tile([0.75, -1.5], 4)  # rad
BOUNDS = {"trunk_mass": (4.5, 8.0), "friction": (0.4, 0.9), "damping": (0.1, 0.5)}
BIAS_SD = {"gyro": 0.02, "accelerometer": 0.15}  # rad/s, m/s^2
NOISE_SD = np.repeat([1e-3, 0.01, 0.1], [8, 3, 3])  # rad, rad/s, m/s^2


def drawn(rng: np.random.Generator) -> dict[str, float]:
    """What the machine is, and the biases of its inertial unit."""
    truth = {name: float(rng.uniform(*bounds)) for name, bounds in BOUNDS.items()}
    biases = {f"{sensor}_bias_{axis}": float(rng.normal(0, sd)) for sensor, sd in BIAS_SD.items() for axis in "xyz"}
    return truth | biases


def truthful(path: Path, truth: dict[str, float]) -> mujoco.MjModel:
    """The model with the hidden values."""
    spec = mujoco.MjSpec.from_file(str(path))
    spec.geom("trunk").mass = truth["trunk_mass"]
    for leg in LEGS:
        spec.geom(f"{leg}_foot").friction[0] = truth["friction"]
    model = spec.compile()
    model.dof_damping[6:] = truth["damping"]
    return model


def goals(time: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Set-points (T, 8) in rad: squats, leans and sways, and from half the log on a trot in place."""
    rate, phase = rng.uniform(0.6, 1.4, 3), rng.uniform(0, 2 * np.pi, 3)
    squat, lean, sway = (np.sin(2 * np.pi * f * time + p) for f, p in zip(rate, phase, strict=True))
    begun = np.clip(time / 0.3, 0, 1)
    out = np.tile(POSE, (len(time), 1))
    trots = time > 0.5 * time[-1]
    for k, diagonal in enumerate((1, -1, -1, 1)):
        lift = np.where(trots, 0.25 * np.clip(diagonal * np.sin(2 * np.pi * 2.5 * (time - 0.5 * time[-1])), 0, 1), 0)
        side = 1 if k % 2 else -1
        out[:, 2 * k] += begun * (0.05 * squat + 0.025 * side * lean + 0.05 * sway) + 0.5 * lift
        out[:, 2 * k + 1] -= begun * (0.1 * squat + 0.05 * side * lean) + lift
    return out


def log(model: mujoco.MjModel, truth: dict[str, float], rng: np.random.Generator) -> np.ndarray:
    """Rows of time, set-points, encoders, gyro and accelerometer."""
    data, time = mujoco.MjData(model), DT * np.arange(STEPS + 1)
    wanted, substeps = goals(time, rng), round(DT / model.opt.timestep)
    yaw, data.qpos[7:] = rng.uniform(-np.pi, np.pi), POSE
    data.qpos[:2], data.qpos[3:7] = rng.uniform(-1, 1, 2), [np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)]
    data.ctrl[:] = wanted[0]
    mujoco.mj_step(model, data, round(STANDS / model.opt.timestep))
    bias = np.array([truth[f"{sensor}_bias_{axis}"] for sensor in BIAS_SD for axis in "xyz"])
    rows = []
    for goal in wanted:
        mujoco.mj_forward(model, data)
        rows.append(np.concatenate([data.qpos[7:], data.sensordata + bias]))
        data.ctrl[:] = goal
        mujoco.mj_step(model, data, substeps)
    measured = np.array(rows) + NOISE_SD * rng.standard_normal((STEPS + 1, len(NOISE_SD)))
    return np.concatenate([time[:, None], wanted, measured], axis=1)


def main() -> None:
    """Write the logs and the truth."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent)
    given = parser.parse_args()
    rng = np.random.default_rng(given.seed)
    truth = drawn(rng)
    model = truthful(Path(__file__).parent / "quadruped.xml", truth)
    given.out.mkdir(parents=True, exist_ok=True)
    axes = [f"{sensor}_{axis}" for sensor in ("gyro", "acc") for axis in "xyz"]
    header = ",".join(["time", *(f"goal_{joint}" for joint in JOINTS), *JOINTS, *axes])
    for name in ("train", "held_out"):
        rows = log(model, truth, rng)
        np.savetxt(given.out / f"{name}.csv", rows, "%.5g", ",", header=header, comments="")
    (given.out / "truth.json").write_text(json.dumps(truth, indent=2) + "\n")


if __name__ == "__main__":
    main()
