"""Does the check of the residuals see what the model lacks, and keep quiet where it lacks nothing?

    python examples/studies/misspecification.py                    # all cells, some five minutes on one core
    python examples/studies/misspecification.py --cells delay --seeds 5

Logs of a torque-driven pendulum (4 s, 100 Hz, angle with noise of sd 0.01 rad, white or AR(1) with rho 0.9), rod mass and damping
unknown, fitted by `laplace`. Left out of the model, in three sizes: dry friction of 0.03, 0.06 and 0.12 N m, a delay of the command of
10, 20 and 40 ms, friction of 5, 10 and 20 % of the torque applied; the torque is a sum of four sines of 0.6 N m. For the smallest dry
friction even a fit that has it as a third parameter leaves an sd of a quarter of it with white noise and of half with AR(1). The null is
the right model. An alarm is p <= 0.05. Every fit is one line in runs/, so an interrupted study goes on.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import asdict
from importlib.metadata import version
from itertools import product
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

import sipe_bayes as sipe
from sipe_bayes.atomic import write_text
from sipe_bayes.diagnostics.misspecification import LEVEL, SIMULATED, misfit
from sipe_bayes.envs.mjcf import MjcfEnvironment
from sipe_bayes.noise import Noise
from sipe_bayes.parameters import Parameter
from sipe_bayes.trajectory import Trajectories, Trajectory

HERE = Path(__file__).parent
RUNS = HERE / "runs" / "misspecification"
XML = """
<mujoco><option timestep="0.01" integrator="implicitfast"/>
  <worldbody><body name="rod"><joint name="hinge" axis="0 1 0" damping="0.05"/>
    <geom type="capsule" fromto="0 0 0 0 0 -0.5" size="0.01" mass="0.6" contype="0" conaffinity="0"/></body></worldbody>
  <actuator><motor name="motor" joint="hinge"/></actuator></mujoco>"""
DT, STEPS, SD = 0.01, 400, 0.01
SIZES = {  # N m; control steps; share of the torque
    "null": (0.0,),
    "dry friction": (0.03, 0.06, 0.12),
    "delay": (1, 2, 4),
    "friction under load": (0.05, 0.1, 0.2),
}
SEEDS = {"null": 100, "dry friction": 20, "delay": 20, "friction under load": 20}
NOISES = {"white": 0.0, "ar1": 0.9}


def simulator() -> sipe.Simulator:
    parameters = [
        Parameter("rod_mass", 0.3, 1.0, targets=("body:rod.mass",)),
        Parameter("damping", 0.0, 0.2, targets=("joint:hinge.damping",)),
    ]
    environment = MjcfEnvironment.build(XML, parameters, ["motor"], ["joint:hinge.position"])
    return sipe.Simulator(environment, num_threads=1)


def recorded(engine: sipe.Simulator, cell: str, size: float, rho: float, seed: int) -> Trajectory:
    """A log of a machine that has what the cell names, of that size."""
    rng = np.random.default_rng([seed, int(100 * rho)])
    clock = np.arange(STEPS) * DT
    frequency, phase = rng.uniform(0.3, 1.5, 4), rng.uniform(0, 2 * np.pi, 4)
    torque = 0.6 * np.sin(2 * np.pi * frequency * clock[:, None] + phase).sum(1)
    model = engine.written(rng.uniform(0.2, 0.7, 2))
    model.dof_frictionloss[0] = size if cell == "dry friction" else 0.0
    data, angle = mujoco.MjData(model), np.empty(STEPS + 1)
    for k in range(STEPS + 1):
        angle[k] = data.qpos[0]
        sent = torque[max(0, min(k, STEPS - 1) - (int(size) if cell == "delay" else 0))]
        data.ctrl[0] = sent
        if cell == "friction under load":
            data.qfrc_applied[0] = -size * abs(sent) * np.tanh(data.qvel[0] / 0.05)
        mujoco.mj_step(model, data)
    noise = np.empty(STEPS + 1)
    white = rng.standard_normal(STEPS + 1)
    noise[0] = white[0]
    for k in range(1, STEPS + 1):
        noise[k] = rho * noise[k - 1] + np.sqrt(1 - rho**2) * white[k]
    channels = engine.environment.channels
    return Trajectory((angle + SD * noise)[:, None], torque[:, None], DT, name=f"seed {seed}", channels=channels)


def one(engine: sipe.Simulator, cell: str, size: float, rho: float, seed: int) -> dict[str, Any]:
    log = recorded(engine, cell, size, rho, seed)
    began = time.process_time()
    method = sipe.get_estimator(engine, "laplace", seed=seed)
    posterior = method.fit(log)
    noise = Noise(*(np.array(method.diagnostics[key]) for key in ("noise_sd", "noise_tau")))
    windows = method.likelihood.bind(engine, Trajectories.stack(log))
    found = misfit(windows, posterior.mode.numpy(), noise, seed=seed)
    return {"seed": seed, "cpu_seconds": round(time.process_time() - began, 2), **asdict(found)}


def study(engine: sipe.Simulator, cell: str, size: float, noise: str, seeds: int) -> dict[str, Any]:
    kept = RUNS / f"{cell.replace(' ', '_')}_{size:g}_{noise}.jsonl"
    kept.parent.mkdir(parents=True, exist_ok=True)
    rows = [json.loads(line) for line in kept.read_text().splitlines()] if kept.exists() else []
    for seed in range(len(rows), seeds):
        rows.append(one(engine, cell, size, NOISES[noise], seed))
        with kept.open("a") as file:
            file.write(json.dumps(rows[-1]) + "\n")
    rows = rows[:seeds]
    causes = [row["cause"] for row in rows if row["p"] <= LEVEL]
    alarms = {cause: causes.count(cause) for cause in sorted(set(causes), key=lambda c: -causes.count(c))}
    seconds = float(np.median([row["cpu_seconds"] for row in rows]))
    return {
        "cell": cell,
        "size": size,
        "noise": noise,
        "logs": len(rows),
        "alarms": len(causes),
        "causes": alarms,
        "cpu_seconds": seconds,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cells", nargs="*", default=list(SIZES), choices=list(SIZES))
    parser.add_argument("--seeds", type=int, help=f"default: {SEEDS}")
    given = parser.parse_args()
    engine, rows = simulator(), []
    for cell in given.cells:
        for size, noise in product(SIZES[cell], NOISES):
            rows.append(study(engine, cell, size, noise, given.seeds or SEEDS[cell]))
            print(json.dumps(rows[-1]), flush=True)
    settings = {
        "command": "python examples/studies/misspecification.py",
        "versions": {p: version(p) for p in ("mujoco", "numpy", "scipy")},
        "level": LEVEL,
        "simulated": SIMULATED,
    }
    whole = given.seeds is None and given.cells == list(SIZES)
    name = "misspecification.json" if whole else "misspecification_part.json"
    write_text((HERE / "results" if whole else RUNS) / name, json.dumps({**settings, "rows": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
