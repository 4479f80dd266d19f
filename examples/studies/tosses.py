"""Do intervals through impacts hold the truth? Bodies thrown on a floor, truths and tosses by seed.

    python examples/studies/tosses.py                              # 20 sets of each body: an hour and a half
    python examples/studies/tosses.py --body brick --seeds 5

A brick and an L of two boxes, unlike the cube of `examples/cube` in shape, size, mass and spin: each seed draws another
friction, time constant and damping ratio of the contact, throws the body, and measures it at 120 Hz with noise of
1.5 mm and .7 degrees, quaternions with accidental signs. Fits are kept one by one in runs/, so that an interrupted
study goes on; the summary goes to results/tosses.json. Coverage is that of the 90 % intervals, pooled over parameters,
with its standard error clustered by set.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

import numpy as np
from _kept import fits, keep

from sipe_bayes.core.files import write_text
from sipe_bayes.core.parameters import Parameter
from sipe_bayes.core.rotations import product, quaternions, rotation_vectors
from sipe_bayes.core.trajectory import Trajectories, Trajectory
from sipe_bayes.envs.mjcf import MjcfEnvironment
from sipe_bayes.inference.laplace import Laplace
from sipe_bayes.simulation.simulator import Simulator

RATE, SECONDS, SUBSTEPS = 120.0, 0.6, 4  # samples per second, a toss, physics steps between samples
POSITION_SD, TURN_SD = 0.0015, np.radians(0.7)  # m, rad
BOUNDS = {"friction": (0.05, 0.9), "timeconst": (0.005, 0.03), "dampratio": (0.1, 1.2)}
BODIES = {
    "brick": '<geom name="one" type="box" size=".08 .03 .015" mass=".25"/>',
    "ell": '<geom name="one" type="box" size=".06 .015 .015" pos=".03 0 0" mass=".12"/>'
    '<geom name="two" type="box" size=".015 .04 .015" pos="-.03 .055 0" mass=".08"/>',
}
_INSIDE = 0.15, 0.7  # share of the bounds within which truths lie
_FAR = 6.0  # sds of the posterior: the fit is elsewhere


def simulator(body: str) -> Simulator:
    """Of the body above a floor, its contact unknown."""
    text = f"""<mujoco><option timestep="{1 / RATE / SUBSTEPS}" cone="elliptic" impratio="10"/>
      <default><geom friction=".4"/></default><worldbody>
      <geom name="floor" type="plane" size="3 3 .1"/>
      <body name="body" pos="0 0 .3"><freejoint/>{BODIES[body]}</body></worldbody></mujoco>"""
    geoms = [f"geom:{name}" for name in ("floor", "one", "two") if f'name="{name}"' in text]
    fields = {"friction": "friction", "timeconst": "solref_timeconst", "dampratio": "solref_dampratio"}
    parameters = [
        Parameter(name, *BOUNDS[name], targets=tuple(f"{geom}.{field}" for geom in geoms))
        for name, field in fields.items()
    ]
    measured = ["body:body.position", "body:body.orientation"]
    return Simulator(MjcfEnvironment.build(text, parameters, [], measured), num_threads=1)


def thrown(machine: Simulator, theta: np.ndarray, count: int, rng: np.random.Generator) -> Trajectories:
    """``count`` tosses of a machine at theta (N,), as a motion capture sees them."""
    steps = round(SECONDS * RATE)
    states = np.tile(machine.default_state(), (count, 1))
    for state in states:
        quaternion = rng.normal(size=4)
        state[1:4] = [*rng.uniform(-0.1, 0.1, 2), rng.uniform(0.13, 0.25)]
        state[4:8] = quaternion / np.linalg.norm(quaternion)
        state[8:14] = [*rng.uniform(-1.0, 1.0, 2), rng.uniform(-1.0, 0.3), *rng.normal(0, 7.0, 3)]
    made = machine.rollout(theta[None], np.zeros((count, steps, 0)), states, 1 / RATE)
    logs = []
    for k, seen in enumerate(made.observations):
        place = seen[:, :3] + rng.normal(0, POSITION_SD, (steps + 1, 3))
        turn = product(quaternions(rng.normal(0, TURN_SD, (steps + 1, 3))), quaternions(seen[:, 3:]))
        turn *= rng.choice([-1.0, 1.0], (steps + 1, 1))
        values = np.concatenate([place, rotation_vectors(turn)], axis=1)
        logs.append(Trajectory(values, np.zeros((steps, 0)), 1 / RATE, name=f"toss {k}"))
    return Trajectories.stack(logs)


def one_fit(body: str, seed: int, count: int) -> dict[str, Any]:
    """Throw a body, fit, and record where the truth lies."""
    machine, rng = simulator(body), np.random.default_rng([sorted(BODIES).index(body), seed])
    theta = rng.uniform(*_INSIDE, len(machine.space))
    logs = thrown(machine, theta, count, rng)
    begin = time.monotonic(), time.process_time()
    method = Laplace(machine, seed=seed)
    posterior = method.fit(logs)
    low, high = posterior.quantile([0.05, 0.95]).numpy()
    return {
        "body": body,
        "seed": seed,
        "tosses": count,
        "inside": ((low <= theta) & (theta <= high)).tolist(),
        "width": (high - low).round(4).tolist(),
        "sds_off": ((posterior.mean.numpy() - theta) / posterior.stddev.numpy()).round(3).tolist(),
        "sd": posterior.stddev.tolist(),
        "findings": [str(item.code) for item in method.findings],
        "blocked": bool(method.findings.blocking),
        "rollouts": method.rollouts,
        "wall_s": round(time.monotonic() - begin[0], 1),
        "cpu_s": round(time.process_time() - begin[1], 1),
    }


def summary(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Coverage with its standard error, of those that no finding blocks, and what the fits took."""
    out = {}
    for body in BODIES:
        mine = [row for row in rows if row["body"] == body]
        inside, widths = (np.array([row[key] for row in mine], float) for key in ("inside", "width"))
        ended = [np.mean(row["inside"]) for row in mine if not row["blocked"]]
        if ended:
            out[body] = {
                "sets": len(mine),
                "tosses": sorted({row["tosses"] for row in mine}),
                "converged": len(ended),
                "coverage": round(float(np.mean(ended)), 3),
                "standard_error": round(float(np.std(ended) / np.sqrt(len(ended))), 3),
                "by_parameter": dict(zip(BOUNDS, inside.mean(0).round(3).tolist(), strict=True)),
                "median_width": dict(zip(BOUNDS, np.median(widths, 0).round(3).tolist(), strict=True)),
                "seeds_far_off": [row["seed"] for row in mine if np.abs(row["sds_off"]).max() > _FAR],
                "median_rollouts": float(np.median([row["rollouts"] for row in mine])),
                "median_cpu_s": float(np.median([row["cpu_s"] for row in mine])),
            }
    return out


def main() -> None:
    """Fit what is not yet kept, print and write the summary."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--body", choices=sorted(BODIES), action="append")
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--tosses", type=int, default=12)
    given = parser.parse_args()
    path = Path("runs") / "tosses.jsonl"
    rows = fits(path)
    known = {(row["body"], row["seed"], row["tosses"]) for row in rows}
    for seed in range(1, given.seeds + 1):
        for body in given.body or sorted(BODIES):
            if (body, seed, given.tosses) not in known:
                rows.append(keep(path, one_fit(body, seed, given.tosses)))
                print(json.dumps(rows[-1]), flush=True)
    text = json.dumps(summary(rows), indent=2)
    print(text)
    write_text(Path(__file__).parent / "results" / "tosses.json", text + "\n")


if __name__ == "__main__":
    main()
