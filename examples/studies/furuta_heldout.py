"""The Furuta pendulum: fit on the three +1.5 V chirps, score on the -1.5 V chirps and the swing-ups.

    python examples/studies/furuta_heldout.py

The chirps run free for their whole 10 s, the swing-ups over 0.25 s windows; every window starts from the measured
angles and their slopes. Plain least squares: scipy.optimize.least_squares on both angles of the training chirps, each
divided by its spread, without noise model, prior or start estimation. All errors are RMSE in rad.
"""

from __future__ import annotations

import json
import os
import time
from pathlib import Path
from typing import Any

import numpy as np
from pendulum_heldout import plain_least_squares

import sipe_bayes as sipe
from sipe_bayes.calibration import Problem
from sipe_bayes.diagnostics.evaluate import errors
from sipe_bayes.likelihood import Windows

HERE = Path(__file__).parent
CONFIG = HERE.parent / "furuta_pendulum" / "calibrate.toml"


def scores(problem: Problem, theta: np.ndarray) -> dict[str, dict[str, float]]:
    """RMSE by held-out log and angle."""
    assert problem.holdout is not None
    windows = Windows(problem.likelihood, problem.simulator, problem.holdout)
    found = errors(windows, np.clip(theta, 0, 1)[None])[0]
    return {
        log: dict(zip(windows.fitted, row.round(4).tolist(), strict=True))
        for log, row in zip(problem.holdout.names, found, strict=True)
    }


def chirps(rows: dict[str, dict[str, float]]) -> dict[str, float]:
    """Root mean square over the held-out chirps."""
    picked = [row for log, row in rows.items() if log.startswith("chirp")]
    return {angle: round(float(np.sqrt(np.mean([row[angle] ** 2 for row in picked]))), 4) for angle in picked[0]}


def main() -> None:
    problem = sipe.prepare(CONFIG)
    began = time.monotonic()
    calibration = sipe.calibrate(problem)
    seconds = time.monotonic() - began
    space = problem.environment.space
    ours = scores(problem, calibration.posterior.mode.numpy())
    plain_theta = plain_least_squares(problem, None)
    plain, nominal = scores(problem, plain_theta), scores(problem, space.default_theta)
    ratio = {angle: round(chirps(ours)[angle] / chirps(plain)[angle], 3) for angle in chirps(ours)}
    found: dict[str, Any] = {
        "command": "python examples/studies/furuta_heldout.py",
        "chirps_minus_1.5V": {
            "posterior_mode": chirps(ours),
            "plain_least_squares": chirps(plain),
            "ratio": ratio,
            "nominal": chirps(nominal),
        },
        "by_log": {log: {"posterior_mode": ours[log], "nominal": nominal[log]} for log in ours},
        "parameters": [
            {k: v for k, v in p.to_dict().items() if k in ("name", "unit", "mode", "mean", "sd", "q05", "q95", "flags")}
            for p in calibration.parameters
        ],
        "delay_samples_at_250_Hz": round(250 * next(p.mode for p in calibration.parameters if p.name == "delay"), 2),
        "plain_least_squares_values": dict(zip(space.names, space.values(plain_theta).tolist(), strict=True)),
        "warnings": calibration.warnings,
        "rollouts": calibration.rollouts,
        "seconds": round(seconds, 1),
    }
    result = HERE / "results" / "furuta_heldout.json"
    temporary = result.with_suffix(".tmp")
    temporary.write_text(json.dumps(found, indent=2) + "\n")
    os.replace(temporary, result)
    print(json.dumps(found, indent=2))


if __name__ == "__main__":
    main()
