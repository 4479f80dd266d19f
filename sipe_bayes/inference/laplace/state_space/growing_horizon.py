"""Starting points of logs whose first states are known: ever longer beginnings, each fitted from the last one's end.

What whole logs say of theta is sharp, but through contact so rough that a search from afar finds nothing: the trouble
of every initial-value approach to chaotic systems (H. U. Voss, J. Timmer, J. Kurths, "Nonlinear dynamical system
identification from uncertain and indirect measurements", 2004, https://doi.org/10.1142/S0218127404010345). A few
control steps are smooth in theta and say little; nearly half as many more say a little more. Each beginning is fitted
without process noise (``WindowSearch``) from the best of the last optimum and draws from its posterior, which spread
where nothing is known yet. Where what comes of it leaves residuals far above the noise, the beginnings grow once more,
in smaller steps.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
import torch

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.findings import Code, finding
from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.inference.laplace.state_space.noise import roughness
from sipe_bayes.inference.laplace.strategy import SearchProblem, distinct, mixture
from sipe_bayes.inference.laplace.windows.search import WindowSearch
from sipe_bayes.inference.laplace.windows.state import WindowState
from sipe_bayes.likelihood.binding import bind
from sipe_bayes.likelihood.settings import BudgetExhausted, Segments
from sipe_bayes.likelihood.state_space.chain import Chain
from sipe_bayes.likelihood.state_space.differences import compare
from sipe_bayes.likelihood.windows import Windows


def grown(problem: SearchProblem, chain: Chain) -> FloatArray | None:
    """Starting points (R, N) from ever longer beginnings, perhaps fewer than asked for.

    Of what is noticed on the way the problem learns only that the model as given diverges. None where even the shortest
    beginnings diverge, or the budget is too small for them.
    """
    tuning = problem.options.tuning.state_space.horizon
    limit = chain.rollouts + tuning.budget_share * (chain.budget - chain.rollouts)
    generator = torch.Generator().manual_seed(problem.seed)
    best, least = None, np.inf
    for growth in (tuning.growth, tuning.slower_growth):
        points = _attempt(problem, chain, limit, growth, generator)
        if points is None:
            break
        try:
            misfit = _misfit(chain, points[0])
        except BudgetExhausted:
            misfit = np.inf
        if best is None or misfit < least:
            best, least = points, misfit
        if least < tuning.fits:
            break
    return best


def _attempt(
    problem: SearchProblem, chain: Chain, limit: float, growth: float, generator: torch.Generator
) -> FloatArray | None:
    """Where beginnings that grow by a factor lead; ``limit``: rollouts in all."""
    likelihood = Segments(None, "white", chain.settings.fit, chain.settings.noise_sd, starts="recorded")
    tuning = problem.options.tuning.state_space.horizon
    points, posterior = problem.space.default_theta[None], problem.prior
    fitted = False
    for steps in _horizons(chain, tuning.first, growth):
        logs = Trajectories.stack([t.slice(0, min(steps, len(t))) for t in chain.trajectories])
        share = float(logs.length.sum() / chain.trajectories.length.sum())
        windows = bind(likelihood, chain.simulator, logs)
        windows.budget = min(tuning.most_rollouts * len(logs), (limit - chain.rollouts) / share)
        draws = max(0, min(tuning.draws, int(tuning.guess_share * windows.budget / len(logs))))
        guesses = np.concatenate([points, posterior.sample((draws,), generator=generator).numpy()])
        try:
            search = _fitted(problem, windows, guesses, first=not fitted)
        except BudgetExhausted:
            break
        finally:
            chain.rollouts += math.ceil(windows.rollouts * share)
        if search is None:
            break
        fitted = True
        if search.optima:
            kept = distinct(search.optima)
            points = np.stack([one.theta for one in kept[: problem.options.restarts]])
            posterior = mixture(kept, problem.space)
        else:
            points = search.here.theta[None]
    return points if fitted else None


def _misfit(chain: Chain, theta: FloatArray) -> float:
    """The largest of the channels' residuals (root mean squares) where the commands lead; infinite if that diverges.

    In sds of a channel's noise as its roughness shows it at most.
    """
    states = chain.predicted(theta)
    linear = None if states is None else compare(chain, theta[None], states[None])[0]
    if linear is None:
        return np.inf
    size = np.sqrt((linear.residual**2).sum(0) / linear.observed.sum(0))
    return float((size / np.maximum(roughness(chain), chain.least[0])).max())


def _horizons(chain: Chain, first: int, growth: float) -> Iterator[int]:
    """Control steps of the beginnings: in the shortest one every fitted channel has a sample after its start."""
    sampled = chain.observed & ~chain.first[:, None]
    needed = [int(chain.sample[rows].min()) if rows.any() else 0 for rows in sampled.T]
    longest = int(chain.trajectories.length.max())
    steps = float(max(first, *needed))
    while steps < longest:
        yield round(steps)
        steps *= growth
    yield longest


def _fitted(problem: SearchProblem, windows: Windows, guesses: FloatArray, first: bool) -> WindowState | None:
    """The search's state where it or its budget ends; None where all guesses (B, N) diverge.

    first: whether the first of them is the model as given. Raises BudgetExhausted before any step.
    """
    residual, valid = windows.residuals(guesses, np.tile(windows.no_starts(), (len(guesses), 1, 1, 1)))
    if not valid.any():
        return None
    if first and not valid[0]:
        problem.find(finding(Code.DIVERGES_AS_GIVEN))
    squares = np.maximum((residual**2).sum((1, 2)), 1e-300)
    order = np.argsort(np.where(valid, np.log(squares).sum(1), np.inf), kind="stable")
    followed = min(problem.options.tuning.state_space.horizon.followed, int(valid.sum()))
    strategy = WindowSearch(problem.within(guesses[order[:followed]]), windows)
    state = strategy.start()
    try:
        while not state.done:
            state = strategy.step(state)
    except BudgetExhausted:
        pass
    return state
