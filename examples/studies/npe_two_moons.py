"""Is `npe` as good as the sbi it is built on? Two moons, against exact posterior draws and sbi called directly.

    python examples/studies/npe_two_moons.py   # all cells: about an hour and a half on one core
    python examples/studies/npe_two_moons.py --observations 2 --seeds 1 --budget 1000 --draws 500 --rounds 1

Two moons (J.-M. Lueckmann et al. 2021, "Benchmarking Simulation-Based Inference", https://arxiv.org/abs/2101.04653,
task T.8):

    theta ~ U(-1, 1)^2,   x = (r cos a + 0.25, r sin a) + (-|theta_1 + theta_2|, theta_2 - theta_1) / sqrt(2),
    a ~ U(-pi/2, pi/2),   r ~ N(0.1, 0.01^2).

Exact draws: with u = (theta_1 + theta_2) / sqrt(2) and t = (theta_2 - theta_1) / sqrt(2), the map from theta to the
noise p = (x_1 + |u|, x_2 - t) keeps volumes, so theta given x is: p as simulated, |u| = p_1 - x_1 if that is positive,
t = x_2 - p_2, either sign of u, and theta thrown away outside the prior's square.

Accuracy of a classifier that tells draws from exact ones (C2ST, sbi.utils.metrics.c2st), mean over the observations:
0.5 is perfect. Each cell (method, seed) trains on its own simulations; ours and sbi's of one seed are the same ones.
The "npe" and "sbi" cells condition one training on all observations; several rounds are a cell for each observation,
whose standard error is over observations. Cells are kept one by one in runs/, so an interrupted study goes on; the
summary goes to results/. Times are processor seconds of the training alone, of several rounds with their simulations.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import time
import warnings
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import torch

import sipe_bayes as sipe
from sipe_bayes.core.files import write_text
from sipe_bayes.core.parameters import Parameter, ParameterSpace
from sipe_bayes.inference.amortised.npe import NPE
from sipe_bayes.likelihood import Segments
from sipe_bayes.models.sbi_tools import NoTracker, import_sbi, seeded
from sipe_bayes.simulation.callable_simulator import CallableSimulator

HERE = Path(__file__).parent
SPACE = ParameterSpace([Parameter("theta_1", -1.0, 1.0), Parameter("theta_2", -1.0, 1.0)])
EXACT = Segments(noise_sd=(0.0, 0.0))  # the function makes its own noise
SEED = 20260  # of the observations


def noise(count: int, rng: np.random.Generator) -> np.ndarray:
    """``p`` (count, 2): the crescent."""
    angle, radius = rng.uniform(-np.pi / 2, np.pi / 2, count), rng.normal(0.1, 0.01, count)
    return np.stack([radius * np.cos(angle) + 0.25, radius * np.sin(angle)], axis=1)


def two_moons(theta: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """``x`` (B, 2) of theta (B, 2)."""
    shift = np.stack([-np.abs(theta.sum(1)), theta[:, 1] - theta[:, 0]], axis=1) / np.sqrt(2)
    return noise(len(theta), rng) + shift


def exact_posterior(x: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    """Draws (count, 2) of theta given x (2,)."""
    found = np.empty((0, 2))
    while len(found) < count:
        p = noise(4 * count, rng)
        size, t = p[:, 0] - x[0], x[1] - p[:, 1]
        u = size * rng.choice([-1.0, 1.0], len(size))
        theta = np.stack([u - t, u + t], axis=1) / np.sqrt(2)
        found = np.concatenate([found, theta[(size >= 0) & (np.abs(theta) <= 1).all(1)]])
    return found[:count]


def log_of(x: np.ndarray) -> sipe.Trajectory:
    """An observation (2,) as the simulator gives it."""
    return sipe.Trajectory(np.stack([np.zeros(2), x]), np.zeros((1, 0)), 1.0)


def observations(count: int) -> np.ndarray:
    """``x`` (count, 2) of truths from the prior; the first ones are the same for every count."""
    draws = []
    for k in range(count):
        rng = np.random.default_rng([SEED, k])
        draws.append(two_moons(rng.uniform(-1, 1, (1, 2)), rng)[0])
    return np.stack(draws)


def estimator(seed: int, budget: int, rounds: int = 1) -> NPE:
    simulator = CallableSimulator(two_moons, SPACE, name="two moons", seed=seed)
    return NPE(simulator, embedding="none", likelihood=EXACT, budget=budget, seed=seed, rounds=rounds)


def ours(seed: int, budget: int, seen: np.ndarray) -> tuple[list[Callable[[int], np.ndarray]], float]:
    """A sampler for each observation, of one training, and its time."""
    npe, first = estimator(seed, budget), sipe.Trajectories.stack(log_of(seen[0]))
    state = npe.start(first)
    while state.simulated < budget:
        state = npe.step(state, first)
    began = time.process_time()
    state = npe.step(state, first)
    spent = time.process_time() - began
    posteriors = [npe.posterior(state, sipe.Trajectories.stack(log_of(x))) for x in seen]
    return [sampler(p, seed) for p in posteriors], spent


def sequential(
    seed: int, budget: int, rounds: int, seen: np.ndarray
) -> tuple[list[Callable[[int], np.ndarray]], float]:
    """As ``ours``, with the budget spent in rounds for each observation."""
    began = time.process_time()
    posteriors = [estimator(seed, budget, rounds).fit(log_of(x)) for x in seen]
    return [sampler(p, seed) for p in posteriors], time.process_time() - began


def sampler(posterior: sipe.Posterior, seed: int) -> Callable[[int], np.ndarray]:
    return lambda count: posterior.values(count, torch.Generator().manual_seed(seed))


def direct(seed: int, budget: int, seen: np.ndarray, density: str) -> tuple[list[Callable[[int], np.ndarray]], float]:
    """As ``ours``, by sbi as its tutorial calls it, on the same simulations."""
    npe, first = estimator(seed, budget), sipe.Trajectories.stack(log_of(seen[0]))
    state = npe.start(first)
    while state.simulated < budget:
        state = npe.step(state, first)
    made = npe.simulations(state, first)
    theta = torch.tensor(SPACE.values(made.theta), dtype=torch.float32)
    x = torch.from_numpy(made.observations[:, 0, 1])
    prior = import_sbi("utils").BoxUniform(-torch.ones(2), torch.ones(2))
    with seeded(seed), warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
        warnings.simplefilter("ignore")
        trainer = import_sbi("inference").NPE(
            prior, density_estimator=density, show_progress_bars=False, tracker=NoTracker()
        )
        began = time.process_time()
        trainer.append_simulations(theta, x).train()
        spent = time.process_time() - began
    posterior = trainer.build_posterior()

    def sample(row: np.ndarray) -> Callable[[int], np.ndarray]:
        def draw(count: int) -> np.ndarray:
            with seeded(seed):
                given = torch.tensor(row, dtype=torch.float32)
                found = posterior.sample((count,), x=given, show_progress_bars=False)
            return np.asarray(found.numpy(), float)

        return draw

    return [sample(row) for row in seen], spent


def cell(method: str, seed: int, only: int | None, given: argparse.Namespace) -> dict[str, Any]:
    """One training and its C2ST on every observation, or on the one that it is for."""
    chosen = list(range(given.observations)) if only is None else [only]
    seen = observations(given.observations)[chosen]
    if method == "npe":
        samplers, spent = ours(seed, given.budget, seen)
    elif method == "sbi":
        samplers, spent = direct(seed, given.budget, seen, given.density)
    else:
        samplers, spent = sequential(seed, given.budget, given.rounds, seen)
    c2st = import_sbi("utils.metrics").c2st
    scores = []
    for k, x, sample in zip(chosen, seen, samplers, strict=True):
        exact = exact_posterior(x, given.draws, np.random.default_rng([SEED, k, 1]))
        scores.append(float(c2st(torch.from_numpy(exact), torch.from_numpy(sample(given.draws)), seed=1)))
    return {"method": method, "seed": seed, "observation": only, "c2st": scores, "train_seconds": spent}


def summary(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Mean C2ST over observations and seeds of each method, ours less sbi's, and the ratio of the times."""
    found: dict[str, Any] = {}
    for method in dict.fromkeys(row["method"] for row in rows):
        means = np.array([np.mean(row["c2st"]) for row in rows if row["method"] == method])
        times = [row["train_seconds"] for row in rows if row["method"] == method]
        found[method] = {
            "c2st": round(float(means.mean()), 4),
            "standard_error": _error(means),
            "c2st_by_seed": means.round(4).tolist(),
            "train_seconds": np.round(times, 1).tolist(),
        }
    pairs = [
        (a, b) for a in rows for b in rows if (a["method"], b["method"]) == ("npe", "sbi") and a["seed"] == b["seed"]
    ]
    if pairs:
        gaps = np.array([np.mean(a["c2st"]) - np.mean(b["c2st"]) for a, b in pairs])
        ratios = [a["train_seconds"] / b["train_seconds"] for a, b in pairs]
        found["npe less sbi"] = {"c2st": round(float(gaps.mean()), 4), "standard_error": _error(gaps)}
        found["time npe / sbi"] = round(float(np.median(ratios)), 3)
    return found


def _key(row: dict[str, Any]) -> tuple[str, int, int | None]:
    return row["method"], row["seed"], row["observation"]


def _error(values: np.ndarray) -> float | None:
    return round(float(values.std(ddof=1) / np.sqrt(len(values))), 4) if len(values) > 1 else None


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--observations", type=int, default=10)
    parser.add_argument("--seeds", type=int, default=5, help="of npe and sbi; npe rounds takes one")
    parser.add_argument("--budget", type=int, default=10_000, help="simulations")
    parser.add_argument("--draws", type=int, default=2000, help="exact and learned, for each C2ST")
    parser.add_argument("--rounds", type=int, default=2, help="of the sequential cells; 1 leaves them out")
    parser.add_argument("--density", default="nsf", help="sbi's own density estimator")
    parser.add_argument("--out", type=Path, default=HERE / "results" / "npe_two_moons.json")
    given = parser.parse_args()
    settings = {k: v for k, v in vars(given).items() if k not in ("out", "seeds")}
    settings["settings"] = {
        k: v for k, v in estimator(0, given.budget).settings().items() if k not in ("space", "seed")
    }
    settings["versions"] = {name: version(name) for name in ("sbi", "zuko", "torch", "numpy")}
    cells: list[tuple[str, int, int | None]] = [(m, s, None) for s in range(given.seeds) for m in ("npe", "sbi")]
    if given.rounds > 1:
        cells += [(f"npe, {given.rounds} rounds", 0, k) for k in range(given.observations)]
    kept = Path("runs") / f"{given.out.stem}.jsonl"
    kept.parent.mkdir(exist_ok=True)
    rows = [json.loads(line) for line in kept.read_text().splitlines()] if kept.exists() else []
    plain = json.loads(json.dumps(settings))
    if any(row["setting"] != plain for row in rows):
        raise SystemExit(f"{kept}: holds cells of other settings; delete it to start again")
    for key in cells:
        if any(_key(row) == key for row in rows):
            continue
        rows.append({**cell(*key, given), "setting": plain})
        with kept.open("a") as file:
            file.write(json.dumps(rows[-1]) + "\n")
        print(*key, round(float(np.mean(rows[-1]["c2st"])), 4), f"{rows[-1]['train_seconds']:.1f} s", flush=True)
    used = [row for row in rows if _key(row) in cells]
    options = " ".join(
        f"--{k} {getattr(given, k)}" for k in ("observations", "seeds", "budget", "draws", "rounds", "density")
    )
    command = f"python {Path(__file__).relative_to(HERE.parents[1])} {options}"
    found = {"command": command, **settings, **summary(used)}
    given.out.parent.mkdir(parents=True, exist_ok=True)
    write_text(given.out, json.dumps(found, indent=2) + "\n")
    print(json.dumps(summary(used), indent=2))


if __name__ == "__main__":
    main()
