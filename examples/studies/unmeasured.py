"""`laplace` where joints are not measured: silent misses and coverage, with half-second windows and state space.

Four machines: a hanging arm of two links of which only the tip is recorded, the same of which only the upper joint is,
a cart of which the pole is not seen, and two carts on springs of which only the first is. Three seconds at 100 Hz,
sums of sines as commands, white noise of half a percent of each channel's spread, starts drawn, truths uniform in
[0.2, 0.8]^N. z is the error in sds; a silent miss is a fit with a parameter more than five of its sds off and no
blocking finding.

    python examples/studies/unmeasured.py                # a quarter of an hour of a core; --logs 4 for a look

Results: results/unmeasured.json
"""

from __future__ import annotations

import argparse
import json
import time
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

import sipe_bayes as sipe
from sipe_bayes.benchmark.measurement import source
from sipe_bayes.core.files import write_text
from sipe_bayes.core.findings import Severity
from sipe_bayes.core.parameters import Parameter

RESULTS = Path(__file__).parent / "results" / "unmeasured.json"
DT, STEPS, LEVEL = 0.01, 300, 0.005
LIKELIHOODS = {"half-second windows": sipe.Segments(), "state space": sipe.StateSpace()}
ARM = """<mujoco><option timestep="0.002"/><worldbody><body name="upper" pos="0 0 1">
<joint name="shoulder" axis="0 1 0" damping=".05"/>
<geom type="capsule" fromto="0 0 0 0 0 -.3" size=".02" mass=".5" contype="0" conaffinity="0"/>
<body name="lower" pos="0 0 -.3"><joint name="elbow" axis="0 1 0" damping=".03"/>
<geom type="capsule" fromto="0 0 0 0 0 -.25" size=".015" mass=".3" contype="0" conaffinity="0"/>
<site name="tip" pos="0 0 -.25"/></body></body></worldbody>
<actuator><motor name="first" joint="shoulder"/><motor name="second" joint="elbow"/></actuator>
<sensor><framepos name="tip" objtype="site" objname="tip"/></sensor></mujoco>"""
CART = """<mujoco><option timestep="0.002"/><worldbody><body name="cart"><joint name="rail" type="slide" axis="1 0 0"
damping="1"/><geom type="box" size=".1 .05 .05" mass="1" contype="0" conaffinity="0"/>
<body name="pole"><joint name="hinge" axis="0 1 0" damping=".02"/>
<geom type="capsule" fromto="0 0 0 0 0 -.5" size=".02" mass=".4" contype="0" conaffinity="0"/></body></body></worldbody>
<actuator><motor name="first" joint="rail"/></actuator></mujoco>"""
CARTS = """<mujoco><option timestep="0.002"/><worldbody><body name="near"><joint name="near" type="slide" axis="1 0 0"
damping=".6" stiffness="40"/><geom type="box" size=".1 .05 .05" mass="1" contype="0" conaffinity="0"/>
<site name="a"/></body>
<body name="far" pos=".5 0 0"><joint name="far" type="slide" axis="1 0 0" damping=".4"/>
<geom type="box" size=".1 .05 .05" mass=".7" contype="0" conaffinity="0"/><site name="b"/></body></worldbody>
<tendon><spatial name="spring" stiffness="60" springlength=".5"><site site="a"/><site site="b"/></spatial></tendon>
<actuator><motor name="first" joint="near"/></actuator></mujoco>"""
DAMPING = [
    Parameter("lower_mass", 0.1, 0.6, targets=("body:lower.mass",)),
    Parameter("shoulder_damping", 0.0, 0.2, targets=("joint:shoulder.damping",)),
    Parameter("elbow_damping", 0.0, 0.1, targets=("joint:elbow.damping",)),
]
POLE = [
    Parameter("pole_mass", 0.1, 0.8, targets=("body:pole.mass",)),
    Parameter("rail_damping", 0.2, 2.0, targets=("joint:rail.damping",)),
    Parameter("hinge_damping", 0.0, 0.1, targets=("joint:hinge.damping",)),
]
SPRINGS = [
    Parameter("far_mass", 0.2, 1.5, targets=("body:far.mass",)),
    Parameter("near_damping", 0.1, 1.5, targets=("joint:near.damping",)),
    Parameter("stiffness", 20.0, 100.0, targets=("joint:near.stiffness",)),
]
# model, unknowns, motors with the size of their command, channels, joints with the spread of their start
MACHINES: dict[str, tuple[str, list[Parameter], dict[str, float], list[str], float]] = {
    "arm, its tip": (ARM, DAMPING, {"first": 0.8, "second": 0.3}, ["sensor:tip[0]", "sensor:tip[2]"], 0.4),
    "arm, its upper joint": (ARM, DAMPING, {"first": 0.8, "second": 0.3}, ["joint:shoulder.position"], 0.4),
    "cart, without its pole": (CART, POLE, {"first": 4.0}, ["joint:rail.position"], 0.6),
    "first of two carts": (CARTS, SPRINGS, {"first": 8.0}, ["joint:near.position"], 0.1),
}


def one_fit(machine: str, likelihood: sipe.Segments | sipe.StateSpace, seed: int) -> dict[str, Any]:
    """Errors in sds, which intervals hold, and what blocks."""
    xml, unknown, motors, channels, spread = MACHINES[machine]
    simulator = sipe.Simulator(sipe.MjcfEnvironment.build(xml, unknown, list(motors), channels), num_threads=1)
    rng, times = np.random.default_rng([seed, 17]), DT * np.arange(STEPS)
    theta = rng.uniform(0.2, 0.8, len(unknown))
    frequency, phase = rng.uniform(0.5, 2.0, (2, len(motors), 3)) * [[[1.0]], [[np.pi]]]
    waves = np.sin(2 * np.pi * frequency[..., None] * times + phase[..., None]).sum(1)
    actions = (np.array(list(motors.values()))[:, None] * waves).T
    state = simulator.default_state()
    state[1 : 1 + simulator.model.nq] += rng.uniform(-spread, spread, simulator.model.nq)
    motion = simulator.rollout(theta, actions[None], state[None], dt=DT).observations[0]
    noisy = motion + LEVEL * motion.std(axis=0) * rng.standard_normal(motion.shape)
    estimator = sipe.get_estimator(simulator, "laplace", likelihood=likelihood, seed=seed)
    begin = time.process_time()
    posterior = estimator.fit(sipe.Trajectory(noisy, actions, DT))
    low, high = posterior.quantile([0.05, 0.95]).numpy()
    return {
        "z": ((posterior.mean.numpy() - theta) / posterior.stddev.numpy()).tolist(),
        "sd": posterior.stddev.tolist(),
        "held": ((low <= theta) & (theta <= high)).tolist(),
        "blocked": any(item.severity is Severity.BLOCKING for item in estimator.findings),
        "rollouts": estimator.rollouts,
        "seconds": time.process_time() - begin,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--logs", type=int, default=40)
    given, cells = parser.parse_args(), {}
    for machine in MACHINES:
        for name, likelihood in LIKELIHOODS.items():
            fits = [one_fit(machine, likelihood, seed) for seed in range(500, 500 + given.logs)]
            held, z = np.array([fit["held"] for fit in fits]), np.abs([fit["z"] for fit in fits]).max(1)
            blocked = np.array([fit["blocked"] for fit in fits])
            cells[f"{machine}, {name}"] = cell = {
                "logs": given.logs,
                "coverage_90": round(float(held.mean()), 3),
                "standard_error": round(float(held.mean(1).std(ddof=1) / np.sqrt(given.logs)), 3),
                "misses": int((z > 5).sum()),
                "silent_misses": int(((z > 5) & ~blocked).sum()),
                "worst_silent_z": round(float(z[~blocked].max(initial=0.0)), 1),
                "blocked": int(blocked.sum()),
                "processor_seconds_median": round(float(np.median([fit["seconds"] for fit in fits])), 1),
            }
            print(machine, name, json.dumps(cell), flush=True)
    table = {
        "command": f"python examples/studies/unmeasured.py --logs {given.logs}",
        "source": source(),
        "versions": {p: version(p) for p in ("mujoco", "numpy", "scipy")},
        "cells": cells,
    }
    write_text(RESULTS, json.dumps(table, indent=2) + "\n")


if __name__ == "__main__":
    main()
