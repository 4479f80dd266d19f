"""The simple pendulum's held-out error: posterior mode against plain least squares, and what the real logs say.

    python examples/studies/pendulum_heldout.py

Plain least squares: scipy.optimize.least_squares on the angle over 0.5 s windows of `ddp` from measured starts, without
noise model, prior or start estimation. All errors are RMSE in rad over 0.5 s windows from the same measured starts.
Then `ddp` and `direct_collocation` are calibrated together, to see whether the report finds that they disagree, and the
ridge between mass and distance is freed, to see whether it is named.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import scipy.optimize

import sipe_bayes as sipe
from sipe_bayes.calibration.config import load_config
from sipe_bayes.calibration.problem import Problem
from sipe_bayes.core.files import write_text
from sipe_bayes.diagnostics.evaluate import errors
from sipe_bayes.likelihood import BoundLikelihood

HERE = Path(__file__).parent
CONFIG = HERE.parent / "simple_pendulum" / "calibrate.toml"


def plain_least_squares(problem: Problem, window: float | None) -> np.ndarray:
    """Theta that minimises the squared residuals of the training logs over windows from measured starts."""
    windows = BoundLikelihood(replace(problem.likelihood, window=window), problem.simulator, problem.train)
    scale = np.nanstd(np.where(windows.observed, windows.measured, np.nan), axis=(0, 1))

    def residual(theta: np.ndarray) -> np.ndarray:
        return (windows.residuals(np.clip(theta, 0, 1)[None], windows.no_starts()[None])[0][0] / scale).ravel()

    start = np.clip(problem.environment.space.default_theta, 0.01, 0.99)
    bounds = (np.zeros_like(start), np.ones_like(start))
    return scipy.optimize.least_squares(residual, start, bounds=bounds, diff_step=1e-5, x_scale="jac").x


def heldout(problem: Problem, theta: np.ndarray) -> dict[str, float]:
    """RMSE in rad of the angle, by log."""
    assert problem.holdout is not None
    windows = BoundLikelihood(problem.likelihood, problem.simulator, problem.holdout)
    return dict(zip(problem.holdout.names, errors(windows, theta[None])[0, :, 0].round(5).tolist(), strict=True))


def both_logs(uses: dict[str, str]) -> Problem:
    config = load_config(CONFIG)
    logs = tuple(log.model_copy(update={"use": uses.get(log.name, log.use)}) for log in config.logs)
    return sipe.prepare(config.model_copy(update={"logs": logs}))


def with_distance() -> Problem:
    """The configuration with the place of the weight free as well."""
    config = load_config(CONFIG)
    entry = config.parameters[0].model_copy(
        update={"name": "weight_com", "targets": ("body:weight.com_z",), "bounds": (-0.2, 0.2)}
    )
    return sipe.prepare(config.model_copy(update={"parameters": (*config.parameters, entry)}))


def main() -> None:
    problem = sipe.prepare(CONFIG)
    posterior = sipe.get_estimator(
        problem.simulator, "laplace", prior=problem.prior, likelihood=problem.likelihood, seed=0
    ).fit(problem.train)
    mode, plain = posterior.mode.numpy(), plain_least_squares(problem, 0.5)
    ours, least = heldout(problem, mode), heldout(problem, plain)
    space = problem.environment.space
    found: dict[str, Any] = {
        "command": "python examples/studies/pendulum_heldout.py",
        "posterior_mode": ours,
        "plain_least_squares": least,
        "ratio": {log: round(ours[log] / least[log], 4) for log in ours},
        "model_as_given": heldout(problem, space.default_theta),
        "values": {
            name: {"mode": float(a), "plain_least_squares": float(b)}
            for name, a, b in zip(space.names, space.values(mode), space.values(plain), strict=True)
        },
    }
    together = sipe.calibrate(both_logs({"direct_collocation": "train"}))
    found["ddp_and_direct_collocation"] = {"warnings": together.warnings}
    ridge = sipe.calibrate(with_distance())
    found["mass_and_distance_free"] = {"ridges": [r.text for r in ridge.ridges], "warnings": ridge.warnings}
    result = HERE / "results" / "pendulum_heldout.json"
    write_text(result, json.dumps(found, indent=2) + "\n")
    print(json.dumps(found, indent=2))


if __name__ == "__main__":
    main()
