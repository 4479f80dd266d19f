"""Do intervals hold physical values where the model lacks something? Six logs each, plain intervals beside.

    python examples/studies/wrong_models.py                       # hours
    python examples/studies/wrong_models.py --seeds 2
    python examples/studies/wrong_models.py --seeds 2 --size 0.4 --effects load_friction delay direction_friction \
        dry_friction gear_backlash gear_compliance spring offset
    python examples/studies/wrong_models.py --seeds 0             # the tables of what there is

The machines of ``discover.py`` (a pendulum, a double pendulum, a slide; masses and damping unknown, truths drawn in .2
to .8 of their ranges; motors with inertia, without which nothing gives way in a gear), six logs of 5 s with commands of
different sizes, .5 % noise, as large in each. Planted at a joint, of a tenth of the joint's usual force: friction under
load, a delay of two samples, dry friction that differs by direction, dry friction, backlash (3 % of what the joint
moves) and compliance; and nothing. Each is fitted twice: with the library as it is, and without the planted extension
in it (``unknown``), as where nobody has thought of what is missing. ``--size`` plants another share of the force, where
what is missing is no longer a small thing; springs and offsets too can then be asked for.

Coverage is that of 90 % intervals, pooled over parameters: plain ones, and those with what the model lacks or may lack;
``printed`` is what the report shows first: these, and the plain ones within them. An alarm is that of the residuals.
Every fit is one line in runs/, results/wrong_models.json holds the tables, wrong_models_40.json those of a size of .4.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterator, Sequence
from itertools import product
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import torch
from _kept import fits, keep
from discover import DT, MACHINES, commands, plain, values

import sipe_bayes as sipe
from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.files import write_text
from sipe_bayes.core.findings import Severity
from sipe_bayes.core.trajectory import Trajectories, Trajectory
from sipe_bayes.diagnostics.misfit import misfit
from sipe_bayes.envs.mjcf import MjcfEnvironment
from sipe_bayes.inference.laplace import Laplace
from sipe_bayes.likelihood import BoundLikelihood, Noise, QuadraticPrior, Segments, bind
from sipe_bayes.posterior import Posterior
from sipe_bayes.structure.augmented import AugmentedModel
from sipe_bayes.structure.discrepancy import find_discrepancy
from sipe_bayes.structure.extension import Placed, extended, members, placements
from sipe_bayes.structure.machine import Machine, machine_of
from sipe_bayes.structure.registry import EXTENSIONS, get_extension

HERE = Path(__file__).parent
EFFECTS = ("load_friction", "delay", "direction_friction", "dry_friction", "gear_backlash", "gear_compliance")
MORE = ("spring", "offset")
LOGS, SIZE = 6, 0.1
KINDS = ("plain", "lacking", "printed")


def truth_of(placed: Placed, machine: Machine, size: float) -> list[float]:
    """The extension's parameters, by its force or by a share of what its joint moves."""
    if placed.extension.name in ("gear_backlash", "gear_compliance"):
        own = min(machine.joints[placed.site].position, 1.0)
        return [0.3 * size * own, *(float(p.value(0.5)) for p in placed.parameters[1:])]
    return values(placed, machine, size)


def planted(
    simulator: sipe.Simulator, truth: FloatArray, command: FloatArray, dt: float, effect: str, seed: int, size: float
) -> tuple[sipe.Simulator, FloatArray]:
    """The machine that has an effect, of a size by its motion under a command (T, A), and its theta; or "null"."""
    if effect == "null":
        return simulator, truth
    quiet = simulator.rollout(truth[None], command[None], simulator.default_state()[None], dt)
    seen = Trajectories.stack([Trajectory(quiet.observations[0], command, dt, channels=quiet.channels)])
    windows = BoundLikelihood(Segments(), simulator, seen)
    machine = machine_of(windows, truth, windows.no_starts())
    choices = [p for p in placements(get_extension(effect), machine) if len(members(p.site)) == 1]
    one = choices[seed % len(choices)]
    assert isinstance(simulator.environment, MjcfEnvironment)
    own = [float(p.normalise(v)) for p, v in zip(one.parameters, truth_of(one, machine, size), strict=True)]
    engine = sipe.Simulator(extended(simulator.environment, [one]), num_threads=1)
    return engine, np.concatenate([truth, own])


def recorded(name: str, effect: str, seed: int, size: float) -> tuple[sipe.Simulator, np.ndarray, Trajectories]:
    """The plain model, the truth (N,) in theta, and the logs of a machine that has an effect."""
    simulator = plain(name)
    rng = np.random.default_rng([seed, [*MACHINES].index(name), ("null", *EFFECTS, *MORE).index(effect)])
    actions = [commands(name, rng)[0] * rng.uniform(0.5, 1.3) for _ in range(LOGS)]
    truth = rng.uniform(0.2, 0.8, len(simulator.space))
    engine, theta = planted(simulator, truth, actions[0], DT, effect, seed, size)
    start = engine.default_state()[None]
    clean = [engine.rollout(theta[None], command[None], start, DT) for command in actions]
    if not all(one.valid.all() for one in clean):
        raise ValueError(f"{name}, {effect}, seed {seed}: the machine's simulation diverges; plant something else")
    sd = 0.005 * np.sqrt(np.mean([(one.observations[0] ** 2).mean(0) for one in clean], axis=0))  # one sensor's
    logs = []
    for k, (one, command) in enumerate(zip(clean, actions, strict=True)):
        noisy = one.observations[0] + sd * rng.standard_normal(one.observations[0].shape)
        logs.append(Trajectory(noisy, command, DT, name=f"log {k}", channels=one.channels))
    return simulator, truth, Trajectories.stack(logs)


def fitted(name: str, effect: str, seed: int, size: float) -> Iterator[dict[str, Any]]:
    """One fit, a row for each library: with the effect in it and, where there is one, without."""
    simulator, truth, logs = recorded(name, effect, seed, size)
    method, began = Laplace(simulator, seed=seed), time.process_time()
    posterior = method.fit(logs)
    fit_s, theta = time.process_time() - began, posterior.mode.numpy()
    windows = bind(method.likelihood, simulator, logs)
    noise = Noise(np.array(method.diagnostics["noise_sd"]), np.array(method.diagnostics["noise_tau"]))
    starts = method.result.starts_at(theta)
    assert starts is not None
    lin = windows.linearise(theta, starts)
    for unknown in (False, True)[: 1 if effect == "null" else 2]:
        began = time.process_time()
        library = [e for e in EXTENSIONS if not (unknown and e == effect)]
        with mock.patch("sipe_bayes.structure.probes.EXTENSIONS", library):
            model = AugmentedModel(windows, theta, noise, starts, QuadraticPrior.of(method.prior), lin)
        found = find_discrepancy(model)
        seen = misfit(found, posterior.stddev.numpy(), seed)
        kinds = dict(zip(KINDS, (posterior, found.draw(posterior, seed)), strict=False))
        yield {
            "machine": name,
            "effect": effect,
            "seed": seed,
            "unknown": unknown,
            "alarm": seen.alarm,
            "blocking": sorted(str(f.code) for f in method.findings if f.severity is Severity.BLOCKING),
            "truth": truth.tolist(),
            "means": {kind: p.mean.tolist() for kind, p in kinds.items()},
            "sds": {kind: p.stddev.tolist() for kind, p in kinds.items()},
            "ends": {kind: ends(p) for kind, p in kinds.items()},
            "causes": list(found.causes),
            "rollouts": method.rollouts,
            "fit_s": round(fit_s, 1),
            "checks_s": round(time.process_time() - began, 1),
        }


def ends(posterior: Posterior) -> list[list[float]]:
    """Of the 90 % intervals, (2, N) in theta."""
    quantiles: list[list[float]] = posterior.quantile(torch.tensor([0.05, 0.95], dtype=torch.float64)).tolist()
    return quantiles


def printed(row: dict[str, Any]) -> FloatArray:
    """What the report shows first (2, N): the intervals with what the model lacks, and the plain ones within."""
    plain_ends, lacking = np.array(row["ends"]["plain"]), np.array(row["ends"]["lacking"])
    return np.stack([np.minimum(plain_ends[0], lacking[0]), np.maximum(plain_ends[1], lacking[1])])


def shares(rows: list[dict[str, Any]], kinds: Sequence[str] = KINDS) -> dict[str, Any]:
    """Coverage, its standard error by fit, and the median width in the range; how much wider the printed ones are."""
    times = np.concatenate(
        [np.diff(printed(row), axis=0)[0] / np.diff(row["ends"]["plain"], axis=0)[0] for row in rows]
    )
    out: dict[str, Any] = {"fits": len(rows), "alarms": round(float(np.mean([row["alarm"] for row in rows])), 4)}
    out["printed to plain"] = {
        "median": round(float(np.median(times)), 3),
        "mean": round(float(times.mean()), 3),
        "most": round(float(times.max()), 3),
    }
    for kind in kinds:
        inside, widths = [], []
        for row in rows:
            low, high = printed(row) if kind == "printed" else np.array(row["ends"][kind])
            truth = np.array(row["truth"])
            inside.append(float(((low <= truth) & (truth <= high)).mean()))
            widths += (high - low).tolist()
        error = float(np.std(inside) / np.sqrt(len(inside)))
        shown = {"coverage": float(np.mean(inside)), "error": error, "width": float(np.median(widths))}
        out[kind] = {key: round(value, 4) for key, value in shown.items()}
    return out


def tables(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """All wrong models with the library and without the cause in it, right ones, and by effect."""
    wrong = [row for row in rows if row["effect"] != "null"]
    out = {"right models": shares([r for r in rows if r["effect"] == "null"])} if len(wrong) < len(rows) else {}
    silent = [row for row in wrong if not row["alarm"]]
    if silent:
        out["wrong, without an alarm"] = shares(silent)
    doubted = [row for row in wrong if row["alarm"] and row["blocking"]]
    if doubted:
        out["wrong, with an alarm, the fit itself blocked"] = shares(doubted) | {
            "blocking": sorted({code for row in doubted for code in row["blocking"]})
        }
    for unknown, what in ((False, "in the library"), (True, "unknown")):
        mine = [row for row in wrong if row["unknown"] == unknown]
        if mine:
            out[what] = shares(mine)
            out[f"{what}, by effect"] = {
                effect: shares([row for row in mine if row["effect"] == effect])
                for effect in (*EFFECTS, *MORE)
                if any(row["effect"] == effect for row in mine)
            }
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--machines", nargs="+", default=list(MACHINES))
    parser.add_argument("--effects", nargs="+", default=["null", *EFFECTS])
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--size", type=float, default=SIZE, choices=(0.05, SIZE, 0.2, 0.4))
    given = parser.parse_args()
    name = "wrong_models" if given.size == SIZE else f"wrong_models_{100 * given.size:.0f}"
    runs, results = HERE / "runs" / f"{name}.jsonl", HERE / "results" / f"{name}.json"
    rows = fits(runs)
    done = {(r["machine"], r["effect"], r["seed"]) for r in rows if r["unknown"] or r["effect"] == "null"}
    for seed, machine, effect in product(range(given.seeds), given.machines, given.effects):
        if (machine, effect, seed) in done:
            continue
        for row in fitted(machine, effect, seed, given.size):
            rows.append(keep(runs, row))
            truth = np.array(row["truth"])
            held = {
                k: int(((np.array(v[0]) <= truth) & (truth <= np.array(v[1]))).sum()) for k, v in row["ends"].items()
            }
            told = row["unknown"], held, "of", len(truth), row["alarm"], row["causes"], row["fit_s"], row["checks_s"]
            print(machine, effect, seed, *told, flush=True)
        write_text(results, json.dumps(tables(rows), indent=1) + "\n")
    print(json.dumps({k: v for k, v in tables(rows).items() if "by effect" not in k}, indent=1))


if __name__ == "__main__":
    main()
