"""Does the search over structures name what a model lacks, and keep quiet where it lacks nothing?

    python examples/studies/discover.py                                   # all cells, twenty logs each; days
    python examples/studies/discover.py --sizes middle --noises white --seeds 3
    python examples/studies/discover.py --machines so101 --sizes middle --noises white --seeds 1    # not run yet
    python examples/studies/discover.py --seeds 0                         # tables and picture of what there is

Machines: a pendulum with a motor, a double pendulum with a motor at each joint, and a horizontal slide with a drive;
mass and damping of each body unknown, positions measured (5 s, 100 Hz) with noise of half a percent of their
root-mean-square, white or AR(1) with rho 0.9; commands are sums of sines. Planted is one extension of the library at
one joint, in three sizes: what its force (or what it does to the command) is of the joint's usual force, 5, 10 and 20
%; delays and lags of 1, 2 and 4 samples, powers of 1.1, 1.2 and 1.4. A slide has no cogging. The null is the right
model. The fourth machine, by name alone, is the SO-101 arm of examples/so101 with its 31 unknowns in the middle of
their ranges and the commands of ten seconds of large_amplitude.csv; it has dry friction and a delay already.

A cause is named where a structure of the reported set holds it:
several that explain a log about as well are all named (a slide's motor with a zero error moves as one on a tilted
rail); at the right joint where they hold it there. ``first`` asks for it in the structure that is written out.
Coverage is that of 90 % intervals of the masses, without the search and stacked over the set. Every search is one line
in runs/, so an interrupted study goes on; results/discover.json holds the tables, results/discover.png what was named
where, results/discover_weights.png which share of the structures holds what was planted, by weight.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterable
from functools import cache
from itertools import pairwise, product
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import torch
from _kept import fits, keep
from scipy.stats import beta

import sipe_bayes as sipe
from sipe_bayes.calibration.problem import Problem
from sipe_bayes.core.files import write_text
from sipe_bayes.core.parameters import Parameter
from sipe_bayes.core.trajectory import Trajectories, Trajectory
from sipe_bayes.envs.mjcf import MjcfEnvironment
from sipe_bayes.likelihood import BoundLikelihood, Segments
from sipe_bayes.structure import discover
from sipe_bayes.structure.extension import Placed, extended, members, placements
from sipe_bayes.structure.fitted import Fitting
from sipe_bayes.structure.machine import Machine, machine_of
from sipe_bayes.structure.registry import get_extension

HERE = Path(__file__).parent
RUNS = HERE / "runs" / "discover.jsonl"
DT, STEPS = 0.01, 500
EDGES = (0.0, 0.1, 0.3, 0.5, 0.7, 0.9, 1.0)
ROD = """<body name="{n}" pos="0 0 {z}"><joint name="{j}" axis="0 1 0" damping="0.05" armature="0.005"/>
<geom type="capsule" fromto="0 0 0 0 0 -0.4" size="0.02" mass="0.6" contype="0" conaffinity="0"/>{rest}</body>"""
HEAD = '<mujoco><option timestep="0.005" integrator="implicitfast"/><worldbody>'
MACHINES = {
    "pendulum": (
        HEAD
        + ROD.format(n="rod", z=0, j="hinge", rest="")
        + '</worldbody><actuator><motor name="motor" joint="hinge"/></actuator></mujoco>',
        (("rod", "hinge", "motor", 1.2),),
    ),
    "double": (
        HEAD
        + ROD.format(n="upper", z=0, j="shoulder", rest=ROD.format(n="lower", z=-0.4, j="elbow", rest=""))
        + '</worldbody><actuator><motor name="drive1" joint="shoulder"/><motor name="drive2" joint="elbow"/></actuator>'
        "</mujoco>",
        (("upper", "shoulder", "drive1", 2.0), ("lower", "elbow", "drive2", 0.8)),
    ),
    "slide": (
        HEAD + '<body name="cart"><joint name="rail" type="slide" axis="1 0 0" damping="2" armature="0.2"/>'
        '<geom type="box" size="0.1 0.1 0.1" mass="1" contype="0" conaffinity="0"/></body></worldbody>'
        '<actuator><motor name="drive" joint="rail"/></actuator></mujoco>',
        (("cart", "rail", "drive", 6.0),),
    ),
}
NOWHERE = {("slide", "cogging"), ("so101", "dry_friction"), ("so101", "delay")}
SIZES = {"small": 0.05, "middle": 0.1, "large": 0.2}
NOISES = {"white": 0.0, "ar1": 0.9}
EFFECTS = (
    "dry_friction",
    "quadratic_damping",
    "spring",
    "hardening_spring",
    "direction_friction",
    "stribeck",
    "load_friction",
    "delay",
    "offset",
    "force_limit",
    "force_drop",
    "cogging",
    "lag",
    "dead_zone",
    "power",
    "direction_gain",
    "hysteresis",
    "cubic_damping",
)


def plain(machine: str) -> sipe.Simulator:
    """The machine's model, with its unknowns."""
    if machine == "so101":
        return sipe.Simulator(arm().simulator.environment, num_threads=1)
    xml, parts = MACHINES[machine]
    parameters = [
        unknown
        for body, joint, _, _ in parts
        for unknown in (
            Parameter(f"{body}_mass", 0.3, 1.5, targets=(f"body:{body}.mass",)),
            Parameter(f"{joint}_damping", 0.0, 6.0 if machine == "slide" else 0.3, targets=(f"joint:{joint}.damping",)),
        )
    ]
    actuators, channels = [a for _, _, a, _ in parts], [f"joint:{j}.position" for _, j, _, _ in parts]
    return sipe.Simulator(MjcfEnvironment.build(xml, parameters, actuators, channels), num_threads=1)


@cache
def arm() -> Problem:
    """The SO-101 and its logs."""
    return sipe.prepare(HERE.parent / "so101" / "calibrate.toml", 1)


def commands(machine: str, rng: np.random.Generator) -> np.ndarray:
    """(1, STEPS, A): sums of five sines of 0.2 to 2 Hz; of the arm those of a log, as they are."""
    if machine == "so101":
        return arm().train[-1].actions[None, :STEPS]
    clock, columns = np.arange(STEPS) * DT, []
    for _, _, _, size in MACHINES[machine][1]:
        tones = np.sin(2 * np.pi * rng.uniform(0.2, 2.0, (5, 1)) * clock + rng.uniform(0, 2 * np.pi, (5, 1)))
        columns.append(size * tones.mean(0) * 1.6)
    return np.stack(columns, axis=-1)[None]


def values(placed: Placed, machine: Machine, size: float) -> list[float]:
    """The extension's parameters where its force is a share ``size`` of the usual one."""
    name, site = placed.extension.name, placed.site
    joint = site if site in machine.joints else machine.joint_of(site)
    assert joint is not None
    own = machine.joints[joint]
    force = size * own.force
    return {
        "dry_friction": [force],
        "quadratic_damping": [force / own.velocity**2],
        "spring": [force / own.position, 0.3 * own.position],
        "hardening_spring": [0.0, force / own.position**3],
        "direction_friction": [force, 0.0],
        "stribeck": [2 * force, 0.2 * own.velocity],
        "load_friction": [size],
        "delay": [machine.dt * {0.05: 1, 0.1: 2, 0.2: 4, 0.4: 8}[size]],
        "offset": [size * machine.commands.get(site, 1.0)],
        "force_limit": [machine.forces.get(site, 1.0) * {0.05: 1.7, 0.1: 1.5, 0.2: 1.2, 0.4: 1.0}[size]],
        "force_drop": [size / machine.forces.get(site, 1.0)],
        "cogging": [force, 0.0, 7.0],
        "lag": [machine.dt * {0.05: 1, 0.1: 2, 0.2: 4, 0.4: 8}[size]],
        "dead_zone": [size * machine.forces.get(site, 1.0)],
        "power": [1 + 2 * size, machine.forces.get(site, 1.0)],
        "direction_gain": [size],
        "hysteresis": [force, 0.3 * own.position],
        "cubic_damping": [force / own.velocity**3],
    }[name]


def truth_of(name: str, simulator: sipe.Simulator) -> np.ndarray:
    """Theta (N,) of a machine: the model's own, and the middle of the ranges of the arm."""
    return np.full(len(simulator.space), 0.5) if name == "so101" else simulator.space.default_theta


def recorded(name: str, effect: str, size: float, rho: float, seed: int) -> tuple[Trajectories, str]:
    """A log of a machine that has an effect, and the label of what it has."""
    simulator, rng = plain(name), np.random.default_rng([seed, EFFECTS.index(effect) + 1 if effect != "null" else 0])
    actions, start = commands(name, rng), simulator.default_state()[None]
    theta, label, dt = truth_of(name, simulator), "", float(arm().train.dt[0]) if name == "so101" else DT
    quiet = simulator.rollout(theta[None], actions, start, dt)
    if effect != "null":
        seen = Trajectories.stack([Trajectory(quiet.observations[0], actions[0], dt, channels=quiet.channels)])
        windows = BoundLikelihood(Segments(), simulator, seen)
        machine = machine_of(windows, theta, windows.no_starts())
        choices = [p for p in placements(get_extension(effect), machine) if len(members(p.site)) == 1]
        one = choices[seed % len(choices)]
        label, truth = one.label, values(one, machine, size)
        environment = simulator.environment
        assert isinstance(environment, MjcfEnvironment)
        engine = sipe.Simulator(extended(environment, [one]), num_threads=1)
        own = [float(p.normalise(v)) for p, v in zip(one.parameters, truth, strict=True)]
        quiet = engine.rollout(np.concatenate([theta, own])[None], actions, engine.default_state()[None], dt)
    clean = quiet.observations[0]
    sd = 0.005 * np.sqrt((clean**2).mean(0))
    noise = rng.standard_normal(clean.shape)
    for t in range(1, len(noise)):
        noise[t] = rho * noise[t - 1] + np.sqrt(1 - rho**2) * noise[t]
    log = Trajectory(clean + sd * noise, actions[0], dt, name="log", channels=quiet.channels)
    return Trajectories.stack([log]), label


def searched(name: str, effect: str, size: str, noise: str, seed: int) -> dict[str, Any]:
    """One search, as a row."""
    trajectories, label = recorded(name, effect, SIZES.get(size, 0.0), NOISES[noise], seed)
    simulator, begin = plain(name), time.monotonic()
    structures = discover(simulator, trajectories, seed=seed)
    space, truth = simulator.space, truth_of(name, simulator)
    masses = [j for j, p in enumerate(space) if p.name.endswith(("_mass", "_kp"))]
    fitting: Fitting = structures.search.fitting
    alone = structures.posterior_of(structures.plain)
    inside = {}
    for key, posterior in (("before", alone), ("after", structures.posterior)):
        low, high = posterior.quantile(torch.tensor([0.05, 0.95], dtype=torch.float64)).numpy()
        inside[key] = [bool(low[j] <= truth[j] <= high[j]) for j in masses]
    best = structures.best
    row = next(r for r in structures.table() if r.labels == best.labels)
    return {
        "machine": name,
        "effect": effect,
        "size": size,
        "noise": noise,
        "seed": seed,
        "planted": label,
        "named": list(best.labels),
        "set": [list(one.labels) for one in structures.supported],
        "weights": [r.weight for r in structures.table() if r.tied],
        "gain": row.gain,
        "error": row.error,
        "offers": [[o.label, round(o.gain, 2)] for o in structures.offers()[:6]],
        "inside": inside,
        "logs": len(fitting.trajectories),
        "rollouts": structures.rollouts,
        "seconds": time.monotonic() - begin,
    }


def answer(row: dict[str, Any]) -> list[str]:
    """The extensions of the set that a search reports, those of the structure that is written out first."""
    return list(dict.fromkeys(label for labels in row["set"] for label in labels))


def shares(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """What was right in searches of one kind."""
    out: dict[str, Any] = {"searches": len(rows), "something named": mean(bool(r["named"]) for r in rows)}
    planted = [r for r in rows if r["effect"] != "null"]
    if planted:
        kinds = [{name.partition(":")[0] for name in answer(r)} for r in planted]
        out["named"] = mean(r["effect"] in kind for r, kind in zip(planted, kinds, strict=True))
        out["at the right place"] = mean(r["planted"] in answer(r) for r in planted)
        out["alone"] = mean(
            len(r["set"]) == 1 and kind == {r["effect"]} for r, kind in zip(planted, kinds, strict=True)
        )
        out["first"] = mean(r["planted"] in r["named"] for r in planted)
    for key in ("before", "after"):
        out[f"coverage {key}"] = mean(x for r in rows for x in r["inside"][key])
    return {**out, "median seconds": float(np.median([r["seconds"] for r in rows]))}


def mean(values: Iterable[bool]) -> float:
    """Share of what is true."""
    return float(np.mean(list(values)))


def tables(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Shares by size and noise, and of each cell."""
    out: dict[str, Any] = {"searches": len(rows), "weights": reliability(rows), "all": {}, "cells": {}}
    for key in sorted({(r["size"], r["noise"]) for r in rows}):
        out["all"]["/".join(key)] = shares([r for r in rows if (r["size"], r["noise"]) == key])
    for cell in sorted({(r["machine"], r["effect"], r["size"], r["noise"]) for r in rows}):
        mine = [r for r in rows if (r["machine"], r["effect"], r["size"], r["noise"]) == cell]
        out["cells"]["/".join(cell)] = shares(mine)
    return out


def reliability(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """By weight: of so many structures with extensions, the mean weight and which share holds what was planted."""
    pairs = [
        (weight, row["effect"] in {label.partition(":")[0] for label in labels})
        for row in rows
        for labels, weight in zip(row["set"], row["weights"], strict=True)
        if labels
    ]
    out = []
    for low, high in pairwise(EDGES):
        mine = [pair for pair in pairs if low < pair[0] <= high]
        if mine:
            weight, right = np.array(mine, float).T
            out.append({"from": low, "structures": len(mine), "weight": weight.mean(), "right": right.mean()})
    return out


def reliability_picture(rows: list[dict[str, Any]], path: Path) -> None:
    """The share that is right by weight, with 90 % intervals."""
    figure, axes = plt.subplots(figsize=(5.6, 4.6), layout="constrained")
    axes.plot([0, 1], [0, 1], color="#999999", lw=1)
    for one in reliability(rows):
        n, right = one["structures"], one["structures"] * one["right"]
        ends = beta.ppf([0.05, 0.95], right + 0.5, n - right + 0.5)
        axes.plot([one["weight"]] * 2, ends, color="#1f5fa8", lw=2)
        axes.plot(one["weight"], one["right"], "o", color="#1f5fa8")
        axes.annotate(f"{n}", (one["weight"], one["right"]), (7, -12), textcoords="offset points", fontsize=9)
    axes.set(xlim=(0, 1.1), ylim=(0, 1.04), xlabel="weight of a structure", ylabel="share that holds what was planted")
    axes.set_title("Weights of the reported structures (numbers: how many)", fontsize=11)
    figure.savefig(path, dpi=120)
    plt.close(figure)


def picture(rows: list[dict[str, Any]], path: Path) -> None:
    """What was named for each planted effect, middle and large sizes."""
    rows = [r for r in rows if r["size"] != "small"]
    planted = [e for e in ("null", *EFFECTS) if any(r["effect"] == e for r in rows)]
    seen = {label.partition(":")[0] for r in rows for label in answer(r)}
    names = ["nothing", *(e for e in EFFECTS if e in planted), *sorted(seen - set(EFFECTS))]
    share = np.zeros((len(planted), len(names)))
    for i, effect in enumerate(planted):
        mine = [{label.partition(":")[0] for label in answer(r)} or {"nothing"} for r in rows if r["effect"] == effect]
        share[i] = [mean(name in kind for kind in mine) for name in names]
    figure, axes = plt.subplots(figsize=(9.5, 6.2), layout="constrained")
    axes.imshow(share, cmap="Blues", vmin=0, vmax=1, aspect="auto")
    for i, j in zip(*np.nonzero(share), strict=True):
        colour = "white" if share[i, j] > 0.6 else "#222222"
        axes.text(j, i, f"{100 * share[i, j]:.0f}", ha="center", va="center", color=colour, fontsize=9)
    axes.set_xticks(range(len(names)), [n.replace("_", " ") for n in names], rotation=55, ha="right")
    counts = [sum(r["effect"] == e for r in rows) for e in planted]
    axes.set_yticks(range(len(planted)), [f"{e.replace('_', ' ')} ({n})" for e, n in zip(planted, counts, strict=True)])
    axes.set_xlabel("named (a search may name several)")
    axes.set_ylabel("planted (searches)")
    axes.set_title("What is named, in % of the searches; effects of 10 % of the joint's usual force and more")
    figure.savefig(path, dpi=120)
    plt.close(figure)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--machines", nargs="+", default=list(MACHINES))
    parser.add_argument("--effects", nargs="+", default=["null", *EFFECTS])
    parser.add_argument("--sizes", nargs="+", default=list(SIZES))
    parser.add_argument("--noises", nargs="+", default=list(NOISES))
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--out", type=Path, default=RUNS)
    parser.add_argument("--name", default="discover", help="of the files in results/")
    given = parser.parse_args()
    rows = fits(given.out)
    done = {(r["machine"], r["effect"], r["size"], r["noise"], r["seed"]) for r in rows}
    for seed, noise, name, effect in product(range(given.seeds), given.noises, given.machines, given.effects):
        for size in given.sizes if effect != "null" else ["none"]:
            if (name, effect, size, noise, seed) in done or (name, effect) in NOWHERE:
                continue
            row = keep(given.out, searched(name, effect, size, noise, seed))
            rows.append(row)
            print(
                f"{name:9s} {row['planted'] or 'null':28s} {size:6s} {noise:5s} {answer(row)} "
                f"{row['gain']:.1f} ± {row['error']:.1f} {row['seconds']:.0f} s",
                flush=True,
            )
            write_text(HERE / "results" / f"{given.name}.json", json.dumps(tables(rows), indent=1) + "\n")
    write_text(HERE / "results" / f"{given.name}.json", json.dumps(tables(rows), indent=1) + "\n")
    picture(rows, HERE / "results" / f"{given.name}.png")
    reliability_picture(rows, HERE / "results" / f"{given.name}_weights.png")


if __name__ == "__main__":
    main()
