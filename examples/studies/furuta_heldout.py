"""The Furuta pendulum: fit on the three +1.5 V chirps, score on the -1.5 V chirps and the swing-ups.

    python examples/studies/furuta_heldout.py

The chirps run free for their whole 10 s, the swing-ups over 0.25 s windows; every window starts from the measured
angles and their slopes. All errors are RMSE in rad. Beside them stand those of a plain least-squares fit of the same
three chirps made before this library existed (theta .076, alpha .029 on the -1.5 V chirps); it was not repeated here.
"""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch

import sipe_bayes as sipe
from sipe_bayes.calibration.problem import Problem, method_of
from sipe_bayes.core.files import write_text
from sipe_bayes.diagnostics.evaluate import errors
from sipe_bayes.likelihood import BoundLikelihood

HERE = Path(__file__).parent
REFERENCE = {"theta": 0.076, "alpha": 0.029}
CONFIG = HERE.parent / "furuta_pendulum" / "calibrate.toml"


def scores(problem: Problem, theta: np.ndarray) -> dict[str, dict[str, float]]:
    """RMSE by held-out log and angle."""
    assert problem.holdout is not None
    windows = BoundLikelihood(problem.likelihood, problem.simulator, problem.holdout)
    per_log = errors(windows, np.clip(theta, 0, 1)[None])[0]
    return {
        log: dict(zip(windows.fitted, row.round(4).tolist(), strict=True))
        for log, row in zip(problem.holdout.names, per_log, strict=True)
    }


def chirps(rows: dict[str, dict[str, float]]) -> dict[str, float]:
    """Root mean square over the held-out chirps."""
    picked = [row for log, row in rows.items() if log.startswith("chirp")]
    return {angle: round(float(np.sqrt(np.mean([row[angle] ** 2 for row in picked]))), 4) for angle in picked[0]}


def main() -> None:
    problem = sipe.prepare(CONFIG)
    began = time.monotonic()
    method = method_of(problem, None, 0, None)
    posterior = method.fit(problem.train)
    seconds = time.monotonic() - began
    space, mode = problem.environment.space, posterior.mode.numpy()
    ours, nominal = scores(problem, mode), scores(problem, space.default_theta)
    draws = posterior.values(4000, generator=torch.Generator().manual_seed(0))
    values = space.values(mode)
    summary: dict[str, Any] = {
        "command": "python examples/studies/furuta_heldout.py",
        "chirps_minus_1.5V": {
            "posterior_mode": chirps(ours),
            "reference_least_squares": REFERENCE,
            "ratio": {angle: round(chirps(ours)[angle] / REFERENCE[angle], 3) for angle in REFERENCE},
            "nominal": chirps(nominal),
        },
        "by_log": {log: {"posterior_mode": ours[log], "nominal": nominal[log]} for log in ours},
        "parameters": {
            p.name: {"unit": p.unit, "mode": float(values[j]), "mean": float(x.mean()), "sd": float(x.std())}
            for j, (p, x) in enumerate(zip(space, draws.T, strict=True))
        },
        "delay_samples_at_250_Hz": round(250 * float(values[space.index("delay")]), 2),
        "warnings": method.warnings,
        "rollouts": method.rollouts,
        "seconds": round(seconds, 1),
    }
    result = HERE / "results" / "furuta_heldout.json"
    write_text(result, json.dumps(summary, indent=2) + "\n")
    print(json.dumps(summary, indent=2))


if __name__ == "__main__":
    main()
