"""`laplace` on StateSpace through contact, on machines for which nothing in this package was made or changed.

A gripper that closes on a box and carries it, a wheel that a paddle rolls against a sprung stop, an arm that scrapes a
table, three bumpers in a row; a finger that flicks a knob, a ball on a tray that tilts, a leg that hops on a spring, a
hammer that strikes a nail (`models/`). Truths, noise, lengths and what is counted are those of `contact.py`.

    python examples/studies/contact_unseen.py --seeds 0 20       # a quarter of a minute of a core for most fits

Fits are kept in runs/contact_unseen and an interrupted study goes on; results/contact_unseen.json holds the summary.
Where the numbers are looked at to change the method, the machines move to `contact.py`, and others come here.
"""

from __future__ import annotations

import argparse
import json
from functools import partial
from importlib.metadata import version
from itertools import product
from typing import Any

import contact
import numpy as np
from _kept import ensure, fits

import sipe_bayes as sipe
from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.files import write_text

RUNS, RESULTS = contact.HERE / "runs" / "contact_unseen", contact.HERE / "results" / "contact_unseen.json"
LEVEL, STEPS = 0.01, 200
JOINTS = {
    "gripper": ("lift", "sweep", "left_slide", "right_slide", "obj_x", "obj_z", "obj_turn"),
    "roller": ("paddle", "stop", "wheel_x", "wheel_z", "wheel_turn"),
    "scraper": ("shoulder", "elbow"),
    "bumpers": ("driver", "middle", "last"),
    "finger": ("base", "tip", "knob"),
    "tray": ("tilt", "ball_x", "ball_z", "ball_turn"),
    "monoped": ("x", "z", "hip", "leg"),
    "hammer": ("swing", "wrist", "nail"),
}
MOTORS = {
    "gripper": ("lift", "sweep", "left", "right"),
    "roller": ("push",),
    "scraper": ("shoulder", "elbow"),
    "bumpers": ("push",),
    "finger": ("base", "tip"),
    "tray": ("tilt",),
    "monoped": ("hip", "thrust"),
    "hammer": ("swing",),
}
UNKNOWN = {
    "gripper": [
        ("object_mass", 0.15, 0.8, ("body:object.mass",)),
        ("pad_friction", 0.4, 1.5, ("geom:left_pad.friction", "geom:right_pad.friction")),
        ("finger_damping", 2.0, 14.0, ("joint:left_slide.damping", "joint:right_slide.damping")),
        ("hand_mass", 0.4, 1.6, ("body:hand.mass",)),
    ],
    "roller": [
        ("wheel_mass", 0.4, 1.6, ("body:wheel.mass",)),
        ("stop_stiffness", 60.0, 300.0, ("joint:stop.stiffness",)),
        ("paddle_damping", 2.0, 12.0, ("joint:paddle.damping",)),
        ("friction", 0.2, 1.2, ("geom:wheel.friction", "geom:floor.friction")),
    ],
    "scraper": [
        ("upper_mass", 0.7, 2.5, ("body:upper.mass",)),
        ("friction", 0.2, 1.0, ("geom:tip.friction", "geom:table.friction")),
        ("elbow_damping", 0.1, 1.0, ("joint:elbow.damping",)),
        ("shoulder_damping", 0.2, 1.5, ("joint:shoulder.damping",)),
    ],
    "bumpers": [
        ("middle_mass", 0.3, 1.2, ("body:middle.mass",)),
        ("dry_friction", 0.1, 0.9, ("joint:middle.frictionloss",)),
        ("last_mass", 0.5, 2.0, ("body:last.mass",)),
        ("driver_damping", 1.0, 6.0, ("joint:driver.damping",)),
    ],
    "finger": [
        ("spinner_mass", 0.2, 0.9, ("body:spinner.mass",)),
        ("knob_damping", 0.005, 0.05, ("joint:knob.damping",)),
        ("lower_mass", 0.1, 0.4, ("body:lower.mass",)),
        ("friction", 0.3, 1.3, ("geom:fingertip.friction", "geom:cap.friction")),
    ],
    "tray": [
        ("ball_mass", 0.1, 0.6, ("body:ball.mass",)),
        ("stiffness", 3.0, 12.0, ("joint:tilt.stiffness",)),
        ("tray_mass", 0.6, 2.0, ("body:tray.mass",)),
        ("friction", 0.1, 1.0, ("geom:plate.friction", "geom:ball.friction")),
    ],
    "monoped": [
        ("trunk_mass", 2.0, 5.0, ("body:trunk.mass",)),
        ("leg_stiffness", 500.0, 1500.0, ("joint:leg.stiffness",)),
        ("leg_damping", 5.0, 25.0, ("joint:leg.damping",)),
        ("friction", 0.3, 1.3, ("geom:foot.friction", "geom:floor.friction")),
    ],
    "hammer": [
        ("head_mass", 0.3, 1.2, ("body:head.mass",)),
        ("nail_mass", 0.2, 0.9, ("body:nail.mass",)),
        ("nail_friction", 0.3, 2.5, ("joint:nail.frictionloss",)),
        ("wrist_stiffness", 0.6, 3.0, ("joint:wrist.stiffness",)),
    ],
}


def commands(name: str, seed: int, steps: int, count: int) -> FloatArray:
    """(T, A): sums of sines; about a closed grip, pressed on the table, and as strong as each machine bears."""
    rng = np.random.default_rng([seed, 3])
    frequency, phase = rng.uniform(0.3, 2.0, (3, count)), rng.uniform(0, 2 * np.pi, (3, count))
    times = contact.DT * np.arange(steps)[:, None, None]
    actions = 0.8 * np.sin(2 * np.pi * frequency * times + phase).mean(1)
    if name == "gripper":
        return np.stack([0.06 + 0.1 * actions[:, 0], 0.15 * actions[:, 1], *(0.55 + 0.35 * actions[:, 2:].T)], axis=-1)
    if name == "scraper":
        return np.stack([actions[:, 0] - 0.25, 0.9 * actions[:, 1]], axis=-1)
    if name == "monoped":
        return np.clip(actions * [0.6, 1.4], -1, 1)
    if name in ("finger", "hammer"):
        return np.clip(1.6 * actions - 0.1, -1, 1)
    return np.asarray(actions)


def clean(simulator: sipe.Simulator, name: str, theta: FloatArray, seed: int, steps: int) -> sipe.Trajectory:
    """A log without noise."""
    actions = commands(name, seed, steps, simulator.environment.num_actions)
    return simulator.rollout(theta, actions, simulator.default_state(), dt=contact.DT)[0]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--machines", nargs="+", default=list(UNKNOWN), choices=list(UNKNOWN))
    parser.add_argument("--seeds", type=int, nargs=2, metavar=("FIRST", "END"), default=[0, 10])
    given = parser.parse_args()
    contact.UNKNOWN, contact.JOINTS, contact.MOTORS, contact.clean = UNKNOWN, JOINTS, MOTORS, clean
    file = RUNS / "fits.jsonl"
    for seed, name in product(range(*given.seeds), given.machines):
        which = {"model": name, "level": LEVEL, "steps": STEPS, "seed": seed}
        ensure(file, which, partial(contact.one_fit, name, LEVEL, seed, STEPS))
    rows: list[dict[str, Any]] = sorted(fits(file), key=lambda row: row["seed"])
    table = {
        "command": f"python examples/studies/contact_unseen.py --seeds {given.seeds[0]} {given.seeds[1]}",
        "versions": {p: version(p) for p in ("mujoco", "numpy", "scipy")},
        "machines": {n: contact.summary(own) for n in UNKNOWN if (own := [r for r in rows if r["model"] == n])},
        "all": contact.summary(rows),
    }
    write_text(RESULTS, json.dumps(table, indent=2) + "\n")


if __name__ == "__main__":
    main()
