"""How a search over windows chooses its starting points: simulations of candidates, by their plain residuals."""

from __future__ import annotations

import numpy as np
import torch

from sipe_bayes.core.arrays import FloatArray, IntArray
from sipe_bayes.core.findings import Code, finding
from sipe_bayes.inference.laplace.strategy import SearchProblem
from sipe_bayes.inference.laplace.windows.growing_windows import told_starts
from sipe_bayes.likelihood.windows import Windows


def screen(problem: SearchProblem, windows: Windows) -> FloatArray:
    """Starting points (R, N): the model as given and the best candidates, by their plain residuals.

    From many candidates on, only the first ones are drawn from the prior, the others in generations from a normal
    around the best ones so far: the cross-entropy method, which finds the narrow valleys that contact leaves.

    Raises:
        ValueError: when every one of the first diverges.
    """
    tuning, count = problem.options.tuning.screening, problem.options.candidates
    generator = torch.Generator().manual_seed(problem.seed)
    later: list[int] = []
    if count >= tuning.generations_from:
        ends = np.linspace(int(tuning.first_share * count), count, tuning.generations + 1)
        later = np.diff(ends.astype(int)).tolist()
    draws = problem.prior.sample((count - sum(later),), generator=generator).numpy()
    points = np.concatenate([problem.space.default_theta[None], draws])
    starts = told_starts(windows, problem.space.default_theta.clip(0, 1), problem.options.tuning.growing)
    loss = _plain_loss(windows, starts, points)
    if not np.isfinite(loss).any():
        raise ValueError(
            f"every one of {len(points)} starting points diverges in the simulation; narrow the bounds, "
            "shorten the model's timestep or the window"
        )
    rng = np.random.default_rng([problem.seed, 1])
    for size in later:
        best = points[_by_loss(loss)[: tuning.elite]]
        drawn = best.mean(0) + (best.std(0) + tuning.least_spread) * rng.standard_normal((size, points.shape[1]))
        points = np.concatenate([points, np.clip(drawn, 0.0, 1.0)])
        loss = np.concatenate([loss, _plain_loss(windows, starts, points[-size:])])
    chosen = _by_loss(loss)
    if np.isfinite(loss[0]):
        chosen = np.concatenate([[0], chosen[chosen != 0]])
    else:
        problem.find(finding(Code.DIVERGES_AS_GIVEN))
    return points[chosen[: problem.options.restarts]]


def _plain_loss(windows: Windows, starts: FloatArray, points: FloatArray) -> FloatArray:
    """Squared residuals (B,) of points (B, N) from starts (W, D), in units of each channel's spread.

    Infinite where one diverges.
    """
    residual, valid = windows.residuals(points, np.tile(starts, (len(points), 1, 1)))
    spread = np.maximum(windows.spread, 1e-12)
    return np.where(valid, ((residual / spread) ** 2).sum((1, 2, 3)), np.inf)


def _by_loss(loss: FloatArray) -> IntArray:
    """Places of the finite ones, the least first."""
    return np.argsort(loss, kind="stable")[: int(np.isfinite(loss).sum())]
