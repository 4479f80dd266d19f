"""Coverage of `laplace` with its default windows where one sensor comes late, or filtered, by an unknown time.

Four machines: a ball on a beam and a pole on a cart, which a camera sees late; an arm whose tip a camera sees late; a
blimp in late motion capture. The delay is uniform in 0.015 to 0.1 s, or a filter has such a time constant,
of which 0 to 0.12 s are allowed; the other values are uniform in the middle 70 % of their ranges. 5 s at 50 Hz, two
seconds of motion before them, commands of sums of sines, the late signal read off a simulation in steps of 2 ms. z is
the error in sds; a silent miss is a fit with a value more than five of its sds off and no blocking finding.

    python examples/studies/late_sensors.py      # ten minutes of a core; --logs 4 for a look

Nothing was tuned on the arm, the blimp and the filters. Results: results/late_sensors.json
"""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

import numpy as np

import sipe_bayes as sipe
from sipe_bayes.benchmark.measurement import source
from sipe_bayes.core import rotations
from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.files import write_text
from sipe_bayes.core.findings import Severity
from sipe_bayes.core.parameters import Parameter
from sipe_bayes.envs.channels import Channel
from sipe_bayes.envs.mjcf import MjcfEnvironment

HERE = Path(__file__).parent
RESULTS, MODELS = HERE / "results" / "late_sensors.json", HERE / "models"
DT, FINE, STEPS, BEFORE = 0.02, 10, 250, 100


@dataclass(frozen=True)
class Machine:
    """What is logged, what is unknown, and which channels come late.

    Args:
        channels: targets with the sd of their noise.
        late: which of them come late, all by the same time.
        amplitudes: of the commands, by actuator.
        unknown: name, bounds and targets.
    """

    channels: dict[str, float]
    late: tuple[str, ...]
    amplitudes: dict[str, float]
    unknown: tuple[tuple[str, float, float, tuple[str, ...]], ...]


MACHINES = {
    "beam": Machine(
        {"joint:tilt.position": 0.001, "joint:roll.position": 0.0012},
        ("joint:roll.position",),
        {"servo": 0.3},
        (
            ("kp", 4.0, 16.0, ("actuator:servo.kp",)),
            ("tilt_damping", 0.01, 0.3, ("joint:tilt.damping",)),
            ("ball_mass", 0.05, 0.2, ("body:ball.mass",)),
            ("roll_damping", 0.01, 0.08, ("joint:roll.damping",)),
        ),
    ),
    "cart": Machine(
        {"joint:x.position": 0.0005, "joint:swing.position": 0.003},
        ("joint:swing.position",),
        {"push": 1.0},
        (
            ("damping", 0.5, 5.0, ("joint:x.damping",)),
            ("pole_mass", 0.1, 0.4, ("body:pole.mass",)),
            ("swing_damping", 0.001, 0.02, ("joint:swing.damping",)),
            ("gear", 5.0, 20.0, ("actuator:push.gear",)),
        ),
    ),
    "arm": Machine(
        {
            "joint:shoulder.position": 0.001,
            "joint:elbow.position": 0.001,
            "sensor:tip[0]": 0.003,
            "sensor:tip[2]": 0.003,
        },
        ("sensor:tip[0]", "sensor:tip[2]"),
        {"shoulder": 2.0, "elbow": 0.7},
        (
            ("forearm_mass", 0.2, 1.0, ("body:forearm.mass",)),
            ("shoulder_damping", 0.1, 0.8, ("joint:shoulder.damping",)),
            ("elbow_damping", 0.03, 0.3, ("joint:elbow.damping",)),
            ("elbow_armature", 0.002, 0.02, ("joint:elbow.armature",)),
        ),
    ),
    "blimp": Machine(
        {"body:hull.position": 0.002, "body:hull.orientation": 0.005},
        ("body:hull.position", "body:hull.orientation"),
        {"left": 0.3, "right": 0.3, "lift": 0.2},
        (
            ("mass", 0.3, 1.0, ("body:hull.mass",)),
            ("drag", 0.05, 0.5, ("joint:free.damping",)),
            ("thrust", 0.5, 2.0, ("actuator:left.gear", "actuator:right.gear")),
        ),
    ),
}
KINDS = {"delay": (0.015, 0.1), "filter": (0.015, 0.1)}
TURNED = "blimp"  # whose orientation has a delay and no filter


def simulator_of(name: str, kind: str) -> sipe.Simulator:
    """The machine with its unknowns, the last of which is the delay or the time constant."""
    machine = MACHINES[name]
    late = Parameter(kind, 0.0, 0.12, targets=tuple(f"sensor:{target}.{kind}" for target in machine.late))
    unknown = [Parameter(name, low, high, targets=targets) for name, low, high, targets in machine.unknown]
    channels = [Channel(target, target) for target in machine.channels]
    path = str(MODELS / f"{name}.xml")
    return sipe.Simulator(MjcfEnvironment.build(path, [*unknown, late], list(machine.amplitudes), channels), 1)


def truth(simulator: sipe.Simulator, kind: str, seed: int) -> FloatArray:
    """(N,)."""
    rng, space = np.random.default_rng([seed, 7]), simulator.space
    theta = rng.uniform(0.15, 0.85, len(space))
    theta[-1] = space[-1].normalise(rng.uniform(*KINDS[kind]))
    return np.asarray(theta)


def log_of(simulator: sipe.Simulator, name: str, kind: str, theta: FloatArray, seed: int) -> sipe.Trajectory:
    """Late or filtered channels as a finer simulation has them, which began earlier; all with noise."""
    machine, rng = MACHINES[name], np.random.default_rng([seed, 3])
    steps = BEFORE + STEPS
    frequency, phase = rng.uniform(0.2, 2.0, (4, len(machine.amplitudes))), rng.uniform(0, 2 * np.pi, (4, 1))
    wave = np.sin(2 * np.pi * frequency * DT * np.arange(steps)[:, None, None] + phase).mean(1)
    actions = wave * np.array(list(machine.amplitudes.values()))
    prompt, seconds = np.append(theta[:-1], 0.0), float(simulator.space[-1].value(theta[-1]))
    fine = simulator.rollout(prompt, np.repeat(actions, FINE, 0), simulator.default_state(), dt=DT / FINE)[
        0
    ].observations
    late = np.array([any(name.startswith(t) for t in machine.late) for name in simulator.environment.channels])
    at = FINE * np.arange(BEFORE, steps + 1)
    sensed = fine[at].copy()
    if kind == "delay":
        before, share = divmod(at - seconds * FINE / DT, 1.0)
        here, there = (fine[before.astype(int) + k] for k in (0, 1))
        between = here + share[:, None] * (there - here)
        for triple in map(list, simulator.environment.rotations):
            turn = share[:, None] * rotations.between(there[:, triple], here[:, triple])
            between[:, triple] = rotations.added(here[:, triple], turn)
        sensed[:, late] = between[:, late]
    else:
        decay, slow = np.exp(-DT / FINE / seconds), fine[:, late].copy()
        for k in range(1, len(slow)):  # of a signal that is linear from sample to sample
            gain = 1 - (1 - decay) * seconds * FINE / DT
            slow[k] = decay * slow[k - 1] + (1 - decay) * fine[k - 1, late] + gain * (fine[k] - fine[k - 1])[late]
        sensed[:, late] = slow[at]
    sd = [
        next(sd for target, sd in machine.channels.items() if name.startswith(target))
        for name in simulator.environment.channels
    ]
    noise = rng.standard_normal(sensed.shape) * sd
    noisy = sensed + noise
    for triple in map(list, simulator.environment.rotations):
        noisy[:, triple] = rotations.added(sensed[:, triple], noise[:, triple])
    return sipe.Trajectory(noisy, actions[BEFORE:], DT)


def one_fit(name: str, kind: str, seed: int) -> tuple[FloatArray, FloatArray, bool]:
    """Errors in sds, which intervals hold, and whether a finding blocks."""
    simulator = simulator_of(name, kind)
    theta = truth(simulator, kind, seed)
    estimator = sipe.get_estimator(simulator, "laplace", seed=seed)
    posterior = estimator.fit(log_of(simulator, name, kind, theta, seed))
    low, high = posterior.quantile([0.05, 0.95]).numpy()
    blocked = any(item.severity is Severity.BLOCKING for item in estimator.findings)
    z = (posterior.mean.numpy() - theta) / posterior.stddev.numpy()
    return np.asarray(z), np.asarray((low <= theta) & (theta <= high)), blocked


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--machines", nargs="+", default=list(MACHINES), choices=list(MACHINES))
    parser.add_argument("--logs", type=int, default=40)
    given = parser.parse_args()
    cells = {}
    for name in given.machines:
        for kind in ("delay",) if name == TURNED else KINDS:
            fits = [one_fit(name, kind, seed) for seed in range(300, 300 + given.logs)]
            z, held, blocked = (np.array(column) for column in zip(*fits, strict=True))
            worst = np.abs(z).max(1)
            cells[f"{name}, {kind}"] = cell = {
                "logs": given.logs,
                "coverage_90": round(float(held.mean()), 3),
                "standard_error": round(float(held.mean(1).std(ddof=1) / np.sqrt(given.logs)), 3),
                "coverage_90_of_the_time": round(float(held[:, -1].mean()), 3),
                "rms_z": np.sqrt((z**2).mean(0)).round(2).tolist(),
                "worst_silent_z": round(float(worst[~blocked].max(initial=0.0)), 1),
                "silent_misses": int(((worst > 5) & ~blocked).sum()),
                "blocked": int(blocked.sum()),
            }
            print(name, kind, json.dumps(cell), flush=True)
    machines = "" if given.machines == list(MACHINES) else f" --machines {' '.join(given.machines)}"
    table = {
        "command": f"python examples/studies/late_sensors.py{machines}" + f" --logs {given.logs}" * (given.logs != 40),
        "source": source(),
        "versions": {p: version(p) for p in ("mujoco", "numpy", "scipy")},
        "cells": cells,
    }
    write_text(RESULTS, json.dumps(table, indent=2) + "\n")


if __name__ == "__main__":
    main()
