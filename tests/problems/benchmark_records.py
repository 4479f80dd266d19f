"""Records of the benchmark, made up: points near the truth, the prior and its mean."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

import sipe_bayes as sipe
from sipe_bayes.benchmark.records import Look, Record
from sipe_bayes.diagnostics.scores import score
from sipe_bayes.posterior import Dirac, Posterior, prior

NAMES = ("mass_1", "friction_2")
SPACE = sipe.ParameterSpace([sipe.Parameter(name, 0.0, 1.0) for name in NAMES])
BOTH = ("in_distribution", "out_of_distribution")
TRUTHS = {"in_distribution": (0.25, 0.8), "default": (0.5, 0.5), "out_of_distribution": (-0.1, 1.1)}
EVIL = r"</table><script>alert(1)</script> 100 % & $x$ #1 \input{a} _b^c~ ½ é 中"


def make(
    task: str = "Door", estimator: str = "adr", seed: int = 0, setting: str = "direct",
    variant: str = "in_distribution", at: Any = None, label: str = "", **other: Any,
) -> Record:  # fmt: skip
    """A record whose posterior is the point ``at``, the prior or its mean."""
    truth = np.array(TRUTHS[variant])
    posterior: Posterior = Dirac([0.5, 0.5] if at is None else at, SPACE)
    posterior = prior(SPACE) if estimator == "prior" else posterior
    made: dict[str, Any] = {
        "budget": 1000, "steps": 50, "status": "done", "seconds": 2.0, "cpu_seconds": 3.0, "rollouts": 1000,
        "names": list(NAMES), "truth": truth.tolist(), "mean": posterior.mean.tolist(), "sd": posterior.stddev.tolist(),
        "scores": score(posterior, truth), "determined": [True, False] if variant == "in_distribution" else None,
        "history": [Look(n, 0.6 + n / 1e4, 0.1) for n in (100, 1000)],
        "log": "excitation", "versions": {"mujoco": "4.0.0"},
        "checksums": {"log": f"{task}{variant}{seed}", "source": "a"}, "command": "sipe benchmark run --suite quick",
    }  # fmt: skip
    cell = f"{task}/{estimator}/{label or setting}/{variant}/seed{seed}"
    return Record(cell, task, estimator, setting, variant, seed, **{**made, **other})


def near(error: float, seed: int, variant: str = "in_distribution") -> list[float]:
    """A point about ``error`` from the truth, a little different with every seed."""
    return list(np.clip(np.array(TRUTHS[variant]) + error * (1 + 0.1 * seed) * np.array([1, -1]), 0, 1))


def every() -> list[Record]:
    """A small run of everything: three tasks, three estimators and a toy one, both baselines."""
    errors = {"laplace": 0.001, "adr": 0.1, "simopt": 0.12, "toy": 0.3}
    tasks = ("Door", "FetchPush", "Relocate")
    records = [
        make(task, name, seed, variant=variant, at=near(error, seed, variant))
        for task in tasks for variant in BOTH for name, error in errors.items() for seed in range(3)
    ]  # fmt: skip
    records += [
        make(task, name, variant=variant) for task in tasks for variant in BOTH for name in ("prior", "prior_mean")
    ]
    records += [make(t, "adr", s, "learned_reward", at=near(0.2, s)) for t in tasks for s in range(2)]
    records += [make(t, "adr", s, "policy", at=near(0.2, s), converged=s != 1) for t in tasks for s in range(3)]
    records += [
        make("Door", "maml", s, "gradient_steps", at=near(0.3 / (1 + n), s), label=f"gradient_steps={n}",
             values={"gradient_steps": n})
        for n in range(3) for s in range(2)
    ]  # fmt: skip
    records += [
        make(t, "adr", s, "sweep", at=near(error, s), label=f"sweep,particles={n}", values={"particles": n})
        for t in ("FetchPush", "Relocate") for n, error in ((4, 0.05), (10, 0.2)) for s in range(3)
    ]  # fmt: skip
    failed = make(
        "Door", "npe", status="failed", traceback=f"Traceback\n  File\nValueError: {EVIL}", scores=None, mean=[], sd=[]
    )
    records[0] = dataclasses.replace(records[0], warnings=[f"mass_1 at a bound: {EVIL}"], command=EVIL)
    return [*records, failed]
