"""From a log to a policy.

Does it pay to train under the posterior? A pendulum whose rod is heavier and longer than its model says.

    python examples/transfer/transfer.py            # minutes on two cores; goes on after an interruption
    python examples/transfer/transfer.py --seeds 1  # a third of that
    python examples/transfer/transfer.py --seeds 1 --steps 1000 --out /tmp/look   # whether it runs

1. The target, a simulated pendulum that stands for the machine and whose mass and length nobody knows, is moved to
   and fro for 5 s and recorded with 5 % noise.
2. ``laplace`` gets the log and gives a posterior of mass, length and damping.
3. DDPG agents are trained under five randomisations: the posterior, its most probable point, the uniform prior, the
   model as it is, and, as what nobody has, the truth. All for as many steps, with the same settings and seeds.
4. Each is tested on the target as it is: 50 episodes. ``transfer.png`` and ``transfer.json`` lie beside this file.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

import sipe_bayes as sipe
from sipe_bayes.core.files import to_json, write_bytes, write_text
from sipe_bayes.posterior import prior

HERE = Path(__file__).parent
TASK, EPISODES, CORES = "Pendulum", 50, 2
TRUTH = np.array([0.85, 0.8, 0.5])  # theta of mass, length, damping; the model as it is has 0.5 of each
NAMES = ("truth", "posterior", "point", "prior", "model as it is")


def fit() -> sipe.Posterior:
    """The posterior of the log of the target."""
    target = sipe.make(TASK)
    target.set_parameters(TRUTH)
    log = sipe.demonstrations(target, count=1, steps=100, noise=0.05)
    estimator = sipe.get_estimator(TASK, "laplace", likelihood=sipe.Segments(noise="white"), seed=0)
    return estimator.fit(log)


def randomisation(name: str, posterior: sipe.Posterior) -> sipe.Posterior:
    space = posterior.space
    return {
        "truth": sipe.Dirac(TRUTH, space),
        "posterior": posterior,
        "point": sipe.Dirac(posterior.mode, space),
        "prior": prior(space),
        "model as it is": sipe.Dirac(np.full(len(space), 0.5), space),
    }[name]


def trained(name: str, seed: int, steps: int, runs: Path) -> dict[str, Any]:
    """An agent's returns in the target: at the end, and along its training."""
    import torch

    from sipe_bayes.benchmark.transfer.study import settings
    from sipe_bayes.models.policy import load_policy
    from sipe_bayes.rl.evaluation import evaluate
    from sipe_bayes.rl.train import read_curve, train

    torch.set_num_threads(1)
    began = time.process_time()
    task, folder = sipe.make_task(TASK), runs / f"{name.replace(' ', '-')}-{seed}-{steps}"
    under = sipe.Randomization(randomisation(name, sipe.load_posterior(runs / "posterior")))
    every = steps // 10
    policy = train(
        *(task, steps, seed, folder, settings(task, steps)),
        resume=True,
        randomization=under,
        evaluate_every=every,
        checkpoint_every=every,
    )
    rows, curve = read_curve(folder), []
    for row in rows:
        met = evaluate(load_policy(folder / "policies" / f"{row.step}.safetensors"), task, 10, 1, TRUTH)
        curve.append((row.step, met.mean))
    found = evaluate(policy, task, EPISODES, 2, TRUTH)
    return {
        "name": name,
        "seed": seed,
        "return": found.mean,
        "cpu_seconds": time.process_time() - began,
        "curve": curve,
    }


def draw(found: list[dict[str, Any]], posterior: sipe.Posterior) -> bytes:
    """Left: the posterior's mass and length. Middle: returns in the target along the training. Right: at the end."""
    from matplotlib.figure import Figure

    from sipe_bayes.report.colours import CHAINS, DEFAULT, MEASURED, PRIOR
    from sipe_bayes.report.drawing import png

    colours = dict(zip(NAMES, (MEASURED, CHAINS[0], CHAINS[1], PRIOR, DEFAULT), strict=True))
    figure = Figure(figsize=(9.6, 3.2), layout="constrained")
    left, middle, right = figure.subplots(1, 3)
    space = posterior.space
    values = posterior.values(1000)
    left.plot(values[:, 0], values[:, 1], ".", color=CHAINS[0], ms=1.5, alpha=0.5, label="posterior")
    for theta, name, marker in ((TRUTH, "truth", "o"), (np.full(3, 0.5), "model as it is", "s")):
        left.plot(*space.values(theta)[:2], marker, color=colours[name], label=name)
    left.set(xlim=(space[0].low, space[0].high), ylim=(space[1].low, space[1].high))
    left.set(xlabel="mass, kg", ylabel="length, m", title="posterior (the axes: the prior)")
    left.legend(frameon=False)
    for k, name in enumerate(NAMES):
        mine = [row for row in found if row["name"] == name]
        curves = np.array([row["curve"] for row in mine])
        middle.plot(curves[0, :, 0], curves[:, :, 1].mean(0), color=colours[name], label=name)
        returns = np.array([row["return"] for row in mine])
        right.barh(-k, returns.mean(), color=colours[name], alpha=0.4)
        right.plot(returns, np.full(len(returns), -k), ".", color=colours[name])
    middle.set(xlabel="control steps of training", ylabel="return", title="in the target")
    right.set(xlabel="return", title="at the end; every dot a seed")
    right.set_yticks([-k for k in range(len(NAMES))], NAMES)
    return png(figure)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--steps", type=int, default=20_000, help="control steps of each training")
    parser.add_argument("--out", type=Path, default=HERE)
    given = parser.parse_args()
    began, runs = time.perf_counter(), given.out / "runs"
    posterior = fit()
    posterior.save(runs / "posterior")
    sipe.show_results(posterior)
    print(f"posterior: {time.perf_counter() - began:.0f} s", flush=True)
    os.environ["OMP_NUM_THREADS"] = "1"  # of the processes that follow
    found = []
    with ProcessPoolExecutor(CORES, multiprocessing.get_context("spawn")) as pool:
        jobs = [pool.submit(trained, name, seed, given.steps, runs) for seed in range(given.seeds) for name in NAMES]
        for job in jobs:
            found.append(job.result())
            row = found[-1]
            print(
                f"{row['name']}, seed {row['seed']}: return {row['return']:.0f}, {row['cpu_seconds']:.0f} CPU s",
                flush=True,
            )
    for name in NAMES:
        returns = [row["return"] for row in found if row["name"] == name]
        print(f"{name}: {np.mean(returns):.0f} (seeds {', '.join(f'{r:.0f}' for r in returns)})")
    seconds = time.perf_counter() - began
    write_text(given.out / "transfer.json", to_json({"steps": given.steps, "seconds": seconds, "agents": found}) + "\n")
    write_bytes(given.out / "transfer.png", draw(found, posterior))
    print(f"{given.out / 'transfer.png'}, {seconds:.0f} s")


if __name__ == "__main__":
    main()
