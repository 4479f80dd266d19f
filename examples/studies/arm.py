"""Do 95 % intervals hold the truth 95 % of the time, ours and mujoco.sysid's, on the arm of mujoco.sysid's tutorial?

    python examples/studies/arm.py                                   # four cells of 400 logs, some hours
    python examples/studies/arm.py --cells "2 s, white" --fits 20    # twenty of one cell

The arm has five hinges, whose armatures are unknown; the model is the one that the installed mujoco.sysid tests itself
with. As in the tutorial: armatures .5, .4, .3, .2, .1 kg m^2 sought in [.01, .6], sines as torques, positions at 500 Hz
with noise of .6 rad, the first state known (at rest). Both searches start at .01, which is the model as given;
mujoco.sysid warns that this is a bound. Intervals count as far as they lie within the bounds. The noise is white or
first-order autoregressive with rho .99, of the same sd; logs take 2 or 10 s. Ours is `laplace` with its default noise
model, which estimates rho, over the whole log at once (`Segments(None, starts="recorded")`). Both methods run in turn
on the same log, one thread each, with default settings; mujoco.sysid's divide each joint's residuals by their size,
which weighs equal noise unequally. As there is one truth, an exact posterior need not cover it in 95 % of logs where a
log says little beside the bounds; what it covers stands beside. Fits are kept one by one in runs/arm, so an interrupted
study goes on; each run writes the summary of all fits there are to results/. Coverage is pooled over the armatures, its
standard error clustered by log. The interval score of T. Gneiting, A. Raftery 2007, "Strictly Proper Scoring Rules",
https://doi.org/10.1198/016214506000001437, Section 6.2, in kg m^2, is smaller for intervals that are narrow and right.
"""

from __future__ import annotations

import argparse
import io
import json
import logging
import time
from contextlib import redirect_stdout
from importlib.metadata import version
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from _kept import fits, keep
from mujoco import sysid
from numpy.typing import NDArray

import sipe_bayes as sipe
from sipe_bayes.benchmark.leaderboard.arm import (
    HIGH,
    JOINTS,
    LOW,
    NOISE,
    RHO,
    START,
    TRUTH,
    arm,
    recorded,
    torques,
    xml,
)
from sipe_bayes.core.files import to_json, write_text
from sipe_bayes.posterior import GaussianMixture

FloatArray = NDArray[np.float64]

HERE = Path(__file__).parent
RUNS = HERE / "runs" / "arm"
LEVEL = 0.95
CELLS = {
    f"{seconds} s, {noise}": (seconds, rho) for seconds in (2, 10) for noise, rho in (("white", 0.0), ("AR(1)", RHO))
}
FITS, _EXACT = 400, 400


def ours(simulator: sipe.Simulator, log: sipe.Trajectory, seed: int) -> dict[str, Any]:
    likelihood = sipe.Segments(None, starts="recorded")
    estimator = sipe.get_estimator(simulator, "laplace", likelihood=likelihood, seed=seed)
    posterior = estimator.fit(log)
    low, high = posterior.quantile([(1 - LEVEL) / 2, (1 + LEVEL) / 2]).numpy()
    values = [LOW + (HIGH - LOW) * x for x in (posterior.mean.numpy(), low, high)]
    truth = (TRUTH - LOW) / (HIGH - LOW)
    return {
        **_row(*values),
        "sds_off": ((posterior.mean.numpy() - truth) / posterior.stddev.numpy()).round(3).tolist(),
        "sd": posterior.stddev.tolist(),
        "blocked": bool(estimator.findings.blocking),
        "rollouts": estimator.rollouts,
        "warnings": estimator.warnings,
    }


def theirs(log: sipe.Trajectory) -> dict[str, Any]:
    spec = mujoco.MjSpec.from_string(xml())
    for sensor in [s for s in spec.sensors if s.name.endswith("_vel")]:
        spec.delete(sensor)
    model, parameters = spec.compile(), sysid.ParameterDict()
    for j in JOINTS:
        parameter = sysid.Parameter(
            j, START, LOW, HIGH, modifier=lambda s, p, j=j: setattr(s.joint(j), "armature", p.value[0])
        )
        parameters.add(parameter)
    time_ = np.arange(len(log.actions) + 1) * log.dt
    state = sysid.create_initial_state(model, np.zeros(model.nq), np.zeros(model.nv), np.zeros(model.na))
    # mujoco.rollout's sensordata of a step are of the state before it and carry the time after it
    measured = sysid.TimeSeries.from_names(time_[1:], log.observations[:-1], model)
    control = sysid.TimeSeries(time_[:-1], log.actions)
    residual = sysid.build_residual_fn(
        models_sequences=[sysid.ModelSequences("arm", spec, "log", state, control, measured)], n_threads=1
    )
    with redirect_stdout(io.StringIO()):  # a line for every iteration
        found, result = sysid.optimize(parameters, residual, verbose=False)
    value = found.as_vector()
    final = residual(value, found, return_pred_all=True)[0]
    _, half = sysid.calculate_intervals(final, result.jac, alpha=1 - LEVEL)
    return _row(value, value - half, value + half)


def _row(value: FloatArray, low: FloatArray, high: FloatArray) -> dict[str, Any]:
    low, high = np.clip(low, LOW, HIGH), np.clip(high, LOW, HIGH)
    missed = np.maximum(low - TRUTH, 0) + np.maximum(TRUTH - high, 0)
    return {
        "error": (value - TRUTH).tolist(),
        "width": (high - low).tolist(),
        "covered": (missed == 0).tolist(),
        "interval_score": (high - low + 2 / (1 - LEVEL) * missed).tolist(),
    }


def one(simulator: sipe.Simulator, cell: str, seed: int) -> dict[str, Any]:
    """Both methods on one log; CPU seconds each."""
    log, rows = recorded(simulator, TRUTH, *CELLS[cell], seed), {"seed": seed}
    for name, fit in (("sipe_bayes", lambda: ours(simulator, log, seed)), ("mujoco.sysid", lambda: theirs(log))):
        began, cpu = time.perf_counter(), time.process_time()
        row = fit()
        rows[name] = {
            **row,
            "seconds": round(time.perf_counter() - began, 3),
            "cpu_seconds": round(time.process_time() - cpu, 3),
        }
    return rows


def summary(rows: list[dict[str, Any]]) -> dict[str, Any]:
    covered, error = (np.array([r[k] for r in rows], float) for k in ("covered", "error"))
    return {
        "coverage_95": round(float(covered.mean()), 4),
        "standard_error": round(float(covered.mean(1).std(ddof=1) / np.sqrt(len(rows))), 4),
        "coverage_by_joint": covered.mean(0).round(3).tolist(),
        "rmse": float(np.sqrt((error**2).mean())),
        "median_width": float(np.median([r["width"] for r in rows])),
        "mean_interval_score": float(np.mean([r["interval_score"] for r in rows])),
        "median_seconds": float(np.median([r["seconds"] for r in rows])),
        "median_cpu_seconds": float(np.median([r["cpu_seconds"] for r in rows])),
        "with_warnings": sum(bool(r.get("warnings")) for r in rows),
    }


def kept(cell: str) -> Path:
    return RUNS / f"{cell.replace(', ', '-').replace(' ', '')}.jsonl"


def study(simulator: sipe.Simulator, cell: str, count: int) -> None:
    """A cell: fit what is missing."""
    for seed in range(len(fits(kept(cell))), count):
        keep(kept(cell), one(simulator, cell, seed))


def summaries(simulator: sipe.Simulator, cell: str) -> dict[str, Any] | None:
    """Of a cell's fits; None without any."""
    rows = fits(kept(cell))
    if len(rows) < 2:
        return None
    mine, rival = ([r[name] for r in rows] for name in ("sipe_bayes", "mujoco.sysid"))
    ratio = float(np.median([a["seconds"] / b["seconds"] for a, b in zip(mine, rival, strict=True)]))
    return {
        "fits": len(rows),
        "sipe_bayes": summary(mine),
        "mujoco.sysid": summary(rival),
        "median_time_ratio": ratio,
        "exact_posterior": exact(simulator, cell),
    }


def exact(simulator: sipe.Simulator, cell: str) -> dict[str, float]:
    """What an exact posterior comes to here.

    Coverage of one truth, whose place within the bounds counts where the log says little, with its standard error, and
    the median width. The model is linearised at the truth and the noise is known.
    """
    seconds, rho = CELLS[cell]
    theta, step = (TRUTH - LOW) / (HIGH - LOW), 1e-4
    rows = theta + step * np.concatenate([np.eye(len(theta)), -np.eye(len(theta))])
    dt = float(simulator.model.opt.timestep)
    commands = torques(seconds, dt)
    seen = np.stack(
        [simulator.rollout(row, commands, simulator.default_state(), dt=dt).observations[0] for row in rows]
    )
    slopes = (seen[: len(theta)] - seen[len(theta) :]) / (2 * step)
    white = (
        np.concatenate([slopes[:, :1], (slopes[:, 1:] - rho * slopes[:, :-1]) / np.sqrt(1 - rho**2)], axis=1) / NOISE
    )
    flat = white.reshape(len(theta), -1)
    covariance = np.linalg.inv(flat @ flat.T)
    rng, found = np.random.default_rng(0), []
    for mean in rng.multivariate_normal(theta, covariance, _EXACT):
        posterior = GaussianMixture([0.0], mean[None], covariance[None], simulator.space)
        low, high = (LOW + (HIGH - LOW) * q for q in posterior.quantile([(1 - LEVEL) / 2, (1 + LEVEL) / 2]).numpy())
        found.append(_row(TRUTH, low, high))
    covered = np.array([row["covered"] for row in found], float)
    return {
        "coverage_95": round(float(covered.mean()), 4),
        "standard_error": round(float(covered.mean(1).std(ddof=1) / np.sqrt(_EXACT)), 4),
        "median_width": float(np.median([row["width"] for row in found])),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cells", nargs="*", default=list(CELLS), choices=list(CELLS))
    parser.add_argument("--fits", type=int, default=FITS)
    given = parser.parse_args()
    logging.getLogger("absl").setLevel(logging.ERROR)
    simulator = arm()
    for cell in given.cells:
        study(simulator, cell, given.fits)
    cells = {cell: found for cell in CELLS if (found := summaries(simulator, cell))}
    for cell, found in cells.items():
        print(cell, json.dumps(found), flush=True)
    if given.fits != FITS:
        return
    versions = {p: version(p) for p in ("mujoco", "numpy", "scipy")}
    found = {"command": "python examples/studies/arm.py", "versions": versions, "cells": cells}
    write_text(HERE / "results" / "arm.json", to_json(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
