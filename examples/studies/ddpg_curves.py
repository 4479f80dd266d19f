"""Learning curves of DDPG on the half-cheetah, ours and Stable-Baselines3's.

Both have the same settings, on the same environment.

    python examples/studies/ddpg_curves.py run      # every cell that is not there yet; goes on after an interruption
    python examples/studies/ddpg_curves.py run --select ours/0
    python examples/studies/ddpg_curves.py table    # results/ddpg_curves.csv, .json and .png of the cells there are
    python examples/studies/ddpg_curves.py          # both

A cell is method/seed. Interrupted, ours goes on from its checkpoint and Stable-Baselines3's begins anew. Each point of
a curve is the mean return of ten whole episodes without noise, from the same ten starting states for both. The final
return is the mean of a curve's last five points; the area under the curve, in millions, is by trapezoids from its first
point on. Beside them stands what equal settings mean alike in the two programs, and what they leave different.
"""

from __future__ import annotations

import argparse
import csv
import io
import json
import time
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import torch

import sipe_bayes as sipe
from sipe_bayes.core.files import to_json, write_text
from sipe_bayes.report.colours import CHAINS
from sipe_bayes.report.drawing import new_figure, styled
from sipe_bayes.report.show import save_figure
from sipe_bayes.rl.evaluation import STARTS, evaluate
from sipe_bayes.rl.settings import Settings
from sipe_bayes.rl.train import read_curve, train

HERE = Path(__file__).parent
RUNS = HERE / "runs" / "ddpg_curves"
TASK, STEPS, SEEDS, POINTS, EPISODES, LAST = "HalfCheetahLinks", 100_000, 3, 20, 10, 5
METHODS = {"ours": ("sipe_bayes", CHAINS[0], "-"), "stable_baselines3": ("Stable-Baselines3", CHAINS[5], "--")}
ALIKE = (
    "networks of 256 and 256 ReLU units, tanh on the actor's output, one critic; an actor's loss of -mean Q",
    "Adam with betas (0.9, 0.999) and epsilon 1e-8 for both networks, no weight decay, gradients not clipped",
    "after each control step one update of critic, actor (seeing the new critic) and targets, in this order",
    "targets without noise: Stable-Baselines3's DDPG clips TD3's target noise to 0 and updates the actor every time",
    "noise on actions is white, its sd in half ranges, and the sum is clipped to the range before it is stored",
    "an episode that runs out of time bootstraps (info['TimeLimit.truncated'] there, truncated here); none terminates",
    "observations and rewards are neither normalised nor clipped; the replay buffer never overflows",
)
DIFFERENCES = (
    "Stable-Baselines3 adds the exploration noise to the random actions of the start too; ours leaves them uniform.",
    "Stable-Baselines3 updates for the first time one step later than ours, and evaluates before a step's update, not "
    "after.",
    "Stable-Baselines3 stores observations in float64, ours in float32; the networks of both see float32.",
    "Other random numbers: first weights (of one distribution, uniform within 1 / sqrt(inputs)), starts, actions, "
    "batches.",
)


def settings(steps: int) -> Settings:
    return Settings(start_steps=min(10_000, steps // 4), capacity=2 * steps + 2_000)


def run_ours(seed: int, steps: int, folder: Path) -> dict[str, Any]:
    every = steps // POINTS
    run: dict[str, Any] = {"evaluate_every": every, "evaluation_episodes": EPISODES, "checkpoint_every": every}
    train(TASK, steps, seed, folder / f"ours-{seed}", settings(steps), resume=True, **run)
    rows = read_curve(folder / f"ours-{seed}")
    return {"seconds": rows[-1].wall_seconds, "curve": [[row.step, row.return_mean] for row in rows]}


def run_stable_baselines3(seed: int, steps: int, folder: Path) -> dict[str, Any]:
    from stable_baselines3 import DDPG
    from stable_baselines3.common.noise import NormalActionNoise

    del folder  # nothing of an unfinished cell is kept
    environment, ours = sipe.make(TASK), settings(steps)
    count = environment.task.num_actions
    model = DDPG(
        "MlpPolicy",
        environment,
        policy_kwargs={"net_arch": list(ours.hidden)},
        learning_rate=ours.learning_rate,
        buffer_size=ours.capacity,
        learning_starts=ours.start_steps,
        batch_size=ours.batch,
        tau=ours.tau,
        gamma=ours.discount,
        train_freq=(1, "step"),
        gradient_steps=1,
        action_noise=NormalActionNoise(np.zeros(count), np.full(count, ours.exploration)),
        device="cpu",
        seed=seed,
    )
    simulator = sipe.Simulator(environment.task, num_threads=1)
    curve: list[list[float]] = []

    def evaluated(*_: Any) -> bool:
        if model.num_timesteps % (steps // POINTS) == 0:
            found = evaluate(lambda seen: model.predict(seen, deterministic=True)[0], simulator, EPISODES, STARTS.curve)
            curve.append([model.num_timesteps, found.mean])
        return True

    begin = time.perf_counter()
    model.learn(steps, callback=evaluated, log_interval=10**9)
    return {"seconds": time.perf_counter() - begin, "curve": curve}


def run(steps: int, folder: Path, select: str) -> None:
    torch.set_num_threads(1)
    folder.mkdir(parents=True, exist_ok=True)
    work = {"ours": run_ours, "stable_baselines3": run_stable_baselines3}
    for seed in range(SEEDS):
        for method in METHODS:
            file = folder / f"{method}-{seed}.json"
            if select in f"{method}/{seed}" and not file.exists():
                record = {"method": method, "seed": seed, "steps": steps, **work[method](seed, steps, folder)}
                write_text(file, json.dumps(record))
                print(f"{method} {seed}: return {record['curve'][-1][1]:.0f}, {record['seconds']:.0f} s", flush=True)


def table(steps: int, folder: Path, results: Path) -> None:
    files = [folder / f"{method}-{seed}.json" for method in METHODS for seed in range(SEEDS)]
    cells = [json.loads(file.read_text(encoding="utf-8")) for file in files if file.exists()]
    if any(cell["steps"] != steps for cell in cells):
        raise SystemExit(f"--folder {folder}: holds cells of other than {steps} steps; give --steps or another folder")
    results.mkdir(parents=True, exist_ok=True)
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(("method", "seed", "step", "return_mean"))
    writer.writerows((c["method"], c["seed"], step, round(mean, 3)) for c in cells for step, mean in c["curve"])
    write_text(results / "ddpg_curves.csv", text.getvalue())
    given = settings(steps)
    found = {
        "command": "python examples/studies/ddpg_curves.py",
        "versions": {p: version(p) for p in ("mujoco", "numpy", "torch", "stable-baselines3", "gymnasium")},
        "task": TASK,
        "steps": steps,
        "settings": given.plain(),
        "alike": ALIKE,
        "differences": DIFFERENCES,
        "missing_cells": [file.stem for file in files if not file.exists()],
        "seconds": {f"{c['method']}-{c['seed']}": round(c["seconds"], 1) for c in cells},
        "scores": scores(cells),
    }
    write_text(results / "ddpg_curves.json", to_json(found, indent=1) + "\n")
    if cells:
        save_figure(drawn(cells, given.start_steps), results / "ddpg_curves.png")
    print(statement(found))


def scores(cells: list[dict[str, Any]]) -> dict[str, Any]:
    """Final return and area of each method's seeds.

    Of all cells, how far the means are apart and whether ours lies between Stable-Baselines3's extremes.
    """
    found: dict[str, Any] = {}
    for name, of_curve in (("final_return", final_return), ("area_millions", area)):
        here = found[name] = {}
        for method in METHODS:
            values = [of_curve(np.array(c["curve"])) for c in cells if c["method"] == method]
            if values:
                here[method] = {
                    "seeds": [round(v, 3) for v in values],
                    "mean": round(float(np.mean(values)), 3),
                    "sd": round(float(np.std(values, ddof=1)), 3) if len(values) > 1 else None,
                    "low": round(min(values), 3),
                    "high": round(max(values), 3),
                }
        if len(cells) == len(METHODS) * SEEDS:
            other = here["stable_baselines3"]
            spread = np.hypot(here["ours"]["sd"], other["sd"]) / np.sqrt(SEEDS)
            here["difference_in_standard_errors"] = round((here["ours"]["mean"] - other["mean"]) / float(spread), 2)
            here["ours_within_spread"] = other["low"] <= here["ours"]["mean"] <= other["high"]
    return found


def final_return(curve: np.ndarray) -> float:
    return float(curve[-LAST:, 1].mean())


def area(curve: np.ndarray) -> float:
    return float(np.trapezoid(curve[:, 1], curve[:, 0])) / 1e6


def statement(found: dict[str, Any]) -> str:
    lines = []
    for name, here in found["scores"].items():
        for method, (label, *_) in METHODS.items():
            if method in here:
                row = here[method]
                lines.append(
                    f"{name}, {label}: {row['mean']:.4g} ({row['low']:.4g} to {row['high']:.4g} over "
                    f"{len(row['seeds'])} of {SEEDS} seeds)"
                )
        if "ours_within_spread" in here:
            within = "within" if here["ours_within_spread"] else "OUTSIDE"
            apart = abs(here["difference_in_standard_errors"])
            lines.append(
                f"{name}: our mean is {within} the spread of Stable-Baselines3's seeds, {apart:.1f} standard errors "
                "from theirs"
            )
    missing = found["missing_cells"]
    return "\n".join(
        [*lines, f"{len(missing)} of {len(METHODS) * SEEDS} cells missing{': ' if missing else ''}{', '.join(missing)}"]
    )


@styled
def drawn(cells: list[dict[str, Any]], start_steps: int) -> Any:
    """Each seed's curve thin, each method's mean thick."""
    figure = new_figure(3.6, 6.4)
    axes = figure.subplots()
    axes.axvspan(0, start_steps / 1000, color="#EEEEEE", lw=0)
    axes.text(
        start_steps / 2000,
        0.98,
        "random\nactions",
        ha="center",
        va="top",
        fontsize=8,
        color="#555555",
        transform=axes.get_xaxis_transform(),
    )
    for method, (label, colour, dashes) in METHODS.items():
        curves = [np.array(c["curve"]) for c in cells if c["method"] == method]
        for curve in curves:
            axes.plot(curve[:, 0] / 1000, curve[:, 1], color=colour, ls=dashes, lw=0.7, alpha=0.55)
        if curves:
            mean = np.mean(curves, axis=0)
            label = f"{label}, {len(curves)} seed{'s' * (len(curves) > 1)} and their mean"
            axes.plot(mean[:, 0] / 1000, mean[:, 1], color=colour, ls=dashes, lw=2.2, label=label)
    axes.set(xlabel="control steps, thousands", ylabel=f"return, mean of {EPISODES} episodes")
    axes.set_xlim(left=0)
    axes.margins(x=0)
    axes.grid(axis="y", color="#DDDDDD", lw=0.6)
    axes.set_title(f"DDPG on {TASK}", loc="left")
    figure.legend(loc="outside upper left", ncols=2)
    return figure


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("command", nargs="?", choices=("run", "table"), help="default: both")
    parser.add_argument("--select", default="", help="part of method/seed")
    parser.add_argument("--steps", type=int, default=STEPS, help=f"a multiple of {POINTS}")
    parser.add_argument("--folder", type=Path, default=RUNS, help="of the cells")
    parser.add_argument("--results", type=Path, default=HERE / "results")
    given = parser.parse_args()
    if given.steps < POINTS or given.steps % POINTS:
        parser.error(f"--steps {given.steps}: expected a multiple of {POINTS}")
    if given.command != "table":
        run(given.steps, given.folder, given.select)
    if given.command != "run":
        table(given.steps, given.folder, given.results)
