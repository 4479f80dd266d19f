"""Does the check of the residuals see what the model lacks, and keep quiet where it lacks nothing?

    python examples/studies/misspecification.py                    # all cells, some ten minutes on one core
    python examples/studies/misspecification.py --cells delay --seeds 5

Logs of a torque-driven pendulum (4 s, 100 Hz, angle with noise of sd 0.01 rad, white or AR(1) with rho 0.9), rod mass
and damping unknown, fitted by `laplace`. Left out of the model, in three sizes: dry friction of 0.03, 0.06 and 0.12 N
m, a delay of the command of 10, 20 and 40 ms, friction of 5, 10 and 20 % of the torque applied; the torque is a sum of
four sines of 0.6 N m. The null is the right model. Beside it a double pendulum with a motor, two unknowns and a channel
at each joint, and the effect, of the middle size, at one of them in turn. The right cause at the right joint has to be
among those that are named, which explain about as much, three at most. An alarm is p <= 0.05. Every fit is one line in
runs/, so an interrupted study goes on.
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
from _kept import fits, keep

import sipe_bayes as sipe
from sipe_bayes.core.files import write_text
from sipe_bayes.core.parameters import Parameter
from sipe_bayes.core.thresholds import THRESHOLDS
from sipe_bayes.core.trajectory import Trajectories, Trajectory
from sipe_bayes.diagnostics.misfit import misfit
from sipe_bayes.envs.mjcf import MjcfEnvironment
from sipe_bayes.likelihood import Noise, bind
from sipe_bayes.structure.augmented import AugmentedModel
from sipe_bayes.structure.discrepancy import find_discrepancy
from sipe_bayes.structure.registry import get_extension

HERE = Path(__file__).parent
RUNS = HERE / "runs" / "misspecification"
ROD = """<body name="rod{k}" pos="0 0 {z}"><joint name="hinge{k}" axis="0 1 0" damping="0.05"/>
<geom type="capsule" fromto="0 0 0 0 0 -0.5" size="0.01" mass="0.6" contype="0" conaffinity="0"/>{rest}</body>"""
XML = """<mujoco><option timestep="0.01" integrator="implicitfast"/><worldbody>{rods}</worldbody>
<actuator>{motors}</actuator></mujoco>"""
DT, STEPS, SD = 0.01, 400, 0.01
SIZES = {  # N m; control steps; share of the torque
    "null": (0.0,),
    "dry friction": (0.03, 0.06, 0.12),
    "delay": (1, 2, 4),
    "friction under load": (0.05, 0.1, 0.2),
}
EXTENSION_OF = {"dry friction": "dry_friction", "delay": "delay", "friction under load": "load_friction"}
SEEDS = {"null": 100, "dry friction": 20, "delay": 20, "friction under load": 20}
NOISES = {"white": 0.0, "ar1": 0.9}


def simulator(joints: int) -> sipe.Simulator:
    """A pendulum of one rod, or of two."""
    names, rods = range(1, joints + 1), ""
    for k in reversed(names):
        rods = ROD.format(k=k, z=0 if k == 1 else -0.5, rest=rods)
    motors = "".join(f'<motor name="motor{k}" joint="hinge{k}"/>' for k in names)
    parameters = [
        unknown
        for k in names
        for unknown in (
            Parameter(f"rod{k}_mass", 0.3, 1.0, targets=(f"body:rod{k}.mass",)),
            Parameter(f"damping{k}", 0.0, 0.2, targets=(f"joint:hinge{k}.damping",)),
        )
    ]
    xml = XML.format(rods=rods, motors=motors)
    channels = [f"joint:hinge{k}.position" for k in names]
    environment = MjcfEnvironment.build(xml, parameters, [f"motor{k}" for k in names], channels)
    return sipe.Simulator(environment, num_threads=1)


def recorded(engine: sipe.Simulator, cell: str, size: float, rho: float, seed: int) -> Trajectory:
    """A log of a machine that has what the cell names, of that size, at one of its joints."""
    joints = engine.model.nv
    rng, at = np.random.default_rng([seed, int(100 * rho), joints]), seed % joints
    clock = np.arange(STEPS) * DT
    frequency, phase = rng.uniform(0.3, 1.5, (4, joints)), rng.uniform(0, 2 * np.pi, (4, joints))
    torque = 0.6 * np.sin(2 * np.pi * frequency * clock[:, None, None] + phase).sum(1)
    model = engine.written(rng.uniform(0.2, 0.7, 2 * joints))
    model.dof_frictionloss[at] = size if cell == "dry friction" else 0.0
    data, angle = mujoco.MjData(model), np.empty((STEPS + 1, joints))
    for k in range(STEPS + 1):
        angle[k] = data.qpos
        sent = torque[min(k, STEPS - 1)].copy()
        if cell == "delay":
            sent[at] = torque[max(0, min(k, STEPS - 1) - int(size)), at]
        data.ctrl[:] = sent
        if cell == "friction under load":
            data.qfrc_applied[at] = -size * abs(sent[at]) * np.tanh(data.qvel[at] / 0.05)
        mujoco.mj_step(model, data)
    noise = np.empty_like(angle)
    white = rng.standard_normal(angle.shape)
    noise[0] = white[0]
    for k in range(1, STEPS + 1):
        noise[k] = rho * noise[k - 1] + np.sqrt(1 - rho**2) * white[k]
    return Trajectory(angle + SD * noise, torque, DT, name=f"seed {seed}", channels=engine.environment.channels)


def one(engine: sipe.Simulator, cell: str, size: float, rho: float, seed: int) -> dict[str, Any]:
    log = recorded(engine, cell, size, rho, seed)
    began = time.process_time()
    method = sipe.get_estimator(engine, "laplace", seed=seed)
    posterior = method.fit(log)
    noise = Noise(*(np.array(method.diagnostics[key]) for key in ("noise_sd", "noise_tau")))
    windows = bind(method.likelihood, engine, Trajectories.stack(log))
    result = misfit(find_discrepancy(AugmentedModel(windows, posterior.mode.numpy(), noise)), seed=seed)
    return {"seed": seed, "cpu_seconds": round(time.process_time() - began, 2), **asdict(result)}


def study(engine: sipe.Simulator, cell: str, size: float, noise: str, seeds: int) -> dict[str, Any]:
    joints = engine.model.nv
    kept = RUNS / f"{cell.replace(' ', '_')}_{size:g}_{noise}_{joints}.jsonl"
    rows = fits(kept)
    rows += [keep(kept, one(engine, cell, size, NOISES[noise], seed)) for seed in range(len(rows), seeds)]
    rows = rows[:seeds]
    alarms = [row for row in rows if row["p"] <= THRESHOLDS.misfit]
    causes = [row["cause"] for row in alarms]
    # causes that explain about as much are named together
    planted = [row for row in alarms if cell != "null"]
    right = [row for row in planted if cause_of(cell, row["seed"] % joints) in row["cause"].split(" or ")]
    channel = [row for row in alarms if row["channel"] == f"joint:hinge{1 + row['seed'] % joints}.position"]
    return {
        "cell": cell,
        "joints": joints,
        "size": size,
        "noise": noise,
        "logs": len(rows),
        "alarms": len(alarms),
        **({} if cell == "null" else {"right_cause_and_joint": len(right), "right_channel": len(channel)}),
        "causes": {cause: causes.count(cause) for cause in sorted(set(causes), key=lambda c: -causes.count(c))},
        "cpu_seconds": float(np.median([row["cpu_seconds"] for row in rows])),
    }


def cause_of(cell: str, joint: int) -> str:
    """What the check calls it."""
    site = f"{'motor' if cell == 'delay' else 'hinge'}{joint + 1}"
    return get_extension(EXTENSION_OF[cell]).sentence(site)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cells", nargs="*", default=list(SIZES), choices=list(SIZES))
    parser.add_argument("--seeds", type=int, help=f"default: {SEEDS}")
    given = parser.parse_args()
    one_rod, two_rods, rows = simulator(1), simulator(2), []
    for cell in given.cells:
        sizes = SIZES[cell]
        cases = [(one_rod, size) for size in sizes] + [(two_rods, sizes[len(sizes) // 2])]
        for (engine, size), noise in product(cases, NOISES):
            rows.append(study(engine, cell, size, noise, given.seeds or SEEDS[cell]))
            print(json.dumps(rows[-1]), flush=True)
    settings = {
        "command": "python examples/studies/misspecification.py",
        "versions": {p: version(p) for p in ("mujoco", "numpy", "scipy")},
        "level": THRESHOLDS.misfit,
        "simulated": 199,
    }
    whole = given.seeds is None and given.cells == list(SIZES)
    name = "misspecification.json" if whole else "misspecification_part.json"
    write_text((HERE / "results" if whole else RUNS) / name, json.dumps({**settings, "rows": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
