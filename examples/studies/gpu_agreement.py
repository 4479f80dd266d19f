"""How far the GPU's float32 and the processor's float64 agree, on every task of the registry and through estimators.

`task`: random theta, commands and starts; the error (median and largest of the rollouts) in what a channel varies by
after 1, 10 and 50 control steps, and for how many steps the two agree to 1 % of that. The humanoid has Newton's solver
in place of PGS, on both sides. `fit`: npe on Pendulum and cem on HalfCheetahLinks with either engine, over several
seeds, whose spread is the Monte Carlo error.

    python examples/studies/gpu_agreement.py task            # Warp's processor device; compiling takes 1 minute a task
    python examples/studies/gpu_agreement.py fit
    python examples/studies/gpu_agreement.py task --device cuda

Results are kept for each device and row, and an interrupted study goes on.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import fields
from importlib.metadata import version
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

import sipe_bayes as sipe
from sipe_bayes.core.files import write_text
from sipe_bayes.envs.registry import TASKS
from sipe_bayes.simulation.audit import spread

HERE = Path(__file__).parent
STEPS, KEPT = 50, (1, 10, 50)
FITS = {
    "npe Pendulum": ("Pendulum", "npe", {"budget": 1000}),
    "cem HalfCheetahLinks": ("HalfCheetahLinks", "cem", {"budget": 400}),
}


def newton(task: Any) -> Any:
    """A task whose model is solved by Newton's method."""
    kind = type(task)

    def compiled(self: Any) -> mujoco.MjModel:
        model = kind.compile(self)
        model.opt.solver = mujoco.mjtSolver.mjSOL_NEWTON
        return model

    made = type(f"Newton{kind.__name__}", (kind,), {"compile": compiled})
    return made(**{f.name: getattr(task, f.name) for f in fields(task)})


def agreement(name: str, device: str, batch: int) -> dict[str, Any]:
    task = sipe.make_task(name)
    task = newton(task) if name.startswith("Humanoid") else task
    try:
        simulator = sipe.Simulator(task, 1, device=device)
    except ValueError as error:
        return {"refused": str(error)}
    rng = np.random.default_rng(0)
    theta = rng.random((batch, len(task.space)))
    actions = rng.uniform(task.action_low, task.action_high, (batch, STEPS, task.num_actions))
    starts, goals = task.initial_states(rng, batch)
    single = simulator.rollout(theta, actions, starts, goals=goals)
    again = simulator.rollout(theta, actions, starts, goals=goals)
    double = simulator.on_processor.rollout(theta, actions, starts, goals=goals)
    error = (np.abs(single.observations - double.observations) / spread(double.observations, double.valid)).max(2)
    apart = ~(error <= 0.01)
    agreed = np.where(apart.any(1), apart.argmax(1) - 1, STEPS)
    return {
        "rollouts": batch,
        "error": {str(k): [float(np.median(error[:, k])), float(error[:, k].max())] for k in KEPT},
        "agreed_steps": {"least": int(agreed.min()), "median": float(np.median(agreed)), "of": STEPS},
        "step_s": simulator.dt,
        "valid": [int(run.valid[:, -1].sum()) for run in (single, double)],
        "same_twice": bool(np.array_equal(single.observations, again.observations, equal_nan=True)),
    }


def fitted(name: str, device: str, seeds: int) -> dict[str, Any]:
    task, method, settings = FITS[name]
    engines = {"cpu": sipe.Simulator(sipe.make_task(task), 1), device: sipe.Simulator(sipe.make_task(task), 1, device)}
    log = sipe.demonstrations(engines["cpu"], count=1, steps=30, seed=0)
    means: dict[str, list[list[float]]] = {engine: [] for engine in engines}
    sds: dict[str, list[list[float]]] = {engine: [] for engine in engines}
    texts: list[str] = []
    for engine, simulator in engines.items():
        for seed in range(seeds):
            estimator = sipe.get_estimator(simulator, method, seed=seed, **settings)
            posterior = estimator.fit(log)
            means[engine].append(posterior.mean.tolist())
            sds[engine].append(posterior.stddev.tolist())
            texts += [f.text for f in estimator.findings if "float" in f.code.name.lower()]
    one, two = (np.array(m) for m in means.values())
    error = np.sqrt((one.var(0, ddof=1) + two.var(0, ddof=1)) / seeds)
    return {
        "seeds": seeds,
        "mean": {engine: np.mean(m, 0).tolist() for engine, m in means.items()},
        "sd": {engine: np.mean(s, 0).tolist() for engine, s in sds.items()},
        "difference_in_standard_errors": (np.abs(one.mean(0) - two.mean(0)) / np.maximum(error, 1e-12)).tolist(),
        "difference_of_one_seed": float(np.abs(one - two).max()),
        "findings": sorted(set(texts)),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", choices=("task", "fit"))
    parser.add_argument("--device", default="warp:cpu")
    parser.add_argument("--batch", type=int, default=16)
    parser.add_argument("--seeds", type=int, default=4)
    parser.add_argument("--only", nargs="*", default=None)
    given = parser.parse_args()
    path = HERE / "results" / "gpu_agreement.json"
    kept = json.loads(path.read_text()) if path.exists() else {}
    here = kept.setdefault(given.device, {"versions": {p: version(p) for p in ("mujoco", "mujoco-warp", "warp-lang")}})
    rows = here.setdefault(given.what, {})
    for name in given.only or (TASKS if given.what == "task" else FITS):
        if name in rows:
            continue
        rows[name] = (
            agreement(name, given.device, given.batch)
            if given.what == "task"
            else fitted(name, given.device, given.seeds)
        )
        print(name, json.dumps(rows[name]), flush=True)
        write_text(path, json.dumps(kept, indent=1) + "\n")


if __name__ == "__main__":
    main()
