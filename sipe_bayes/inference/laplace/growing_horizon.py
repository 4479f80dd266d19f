"""Starting points of logs whose first states are known: ever longer beginnings are fitted, each from where the last one led.

What whole logs say of theta is sharp, but through contact so rough that a search from afar finds nothing: the trouble of every
initial-value approach to chaotic systems (H. U. Voss, J. Timmer, J. Kurths, "Nonlinear dynamical system identification from
uncertain and indirect measurements", 2004, https://doi.org/10.1142/S0218127404010345). A few control steps are smooth in theta and
say little; nearly half as many more say a little more. Each beginning is fitted without process noise (``window_search``) from the
best of the last optimum and draws from its posterior, which spread where nothing is known yet. Where what comes of it leaves residuals
far above the noise, the beginnings grow once more, in smaller steps.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
import torch
from numpy.typing import NDArray

from sipe_bayes.core.findings import Code, finding
from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.inference.laplace.smoother import roughness
from sipe_bayes.inference.laplace.strategy import SearchProblem, distinct, mixture
from sipe_bayes.inference.laplace.window_search import WindowSearch
from sipe_bayes.inference.laplace.window_state import WindowState
from sipe_bayes.likelihood.binding import bind
from sipe_bayes.likelihood.settings import BudgetExhausted, Segments
from sipe_bayes.likelihood.state_space.chain import Chain
from sipe_bayes.likelihood.windows import Windows

FloatArray = NDArray[np.float64]

_FIRST = 8  # control steps of the first beginning at least
_LONGER = (1.45, 1.2)  # how much longer the next is, at each attempt
_FITS = 3.0  # noise sds: residuals below which no other attempt is made
_SHARE = 0.4  # of the budget in all
_MOST, _GUESSING = 600, 0.3  # rollouts of one beginning of each log, and the share of them that guesses take at most
_DRAWS, _FOLLOWED = 60, 2  # guesses for a beginning, and how many of them are followed


def grown(search: SearchProblem, chain: Chain) -> FloatArray | None:
    """Starting points (R, N), perhaps fewer than asked for; None where even the shortest beginnings diverge, or the budget is too small
    for them. What is said on the way is not of the fit, but that the model as given diverges."""
    limit = chain.rollouts + _SHARE * (chain.budget - chain.rollouts)
    generator = torch.Generator().manual_seed(search.seed)
    best, least = None, np.inf
    for longer in _LONGER:
        points = _attempt(search, chain, limit, longer, generator)
        if points is None:
            break
        try:
            left = _misfit(chain, points[0])
        except BudgetExhausted:
            left = np.inf
        if best is None or left < least:
            best, least = points, left
        if least < _FITS:
            break
    return best


def _attempt(
    search: SearchProblem, chain: Chain, limit: float, longer: float, generator: torch.Generator
) -> FloatArray | None:
    likelihood = Segments(None, "white", chain.settings.fit, chain.settings.noise_sd, starts="recorded")
    points, posterior = search.space.default_theta[None], search.prior
    fitted = False
    for steps in _horizons(chain, longer):
        logs = Trajectories.stack([t.slice(0, min(steps, len(t))) for t in chain.trajectories])
        share = float(logs.length.sum() / chain.trajectories.length.sum())
        windows = bind(likelihood, chain.simulator, logs)
        windows.budget = min(_MOST * len(logs), (limit - chain.rollouts) / share)
        draws = max(0, min(_DRAWS, int(_GUESSING * windows.budget / len(logs))))
        guesses = np.concatenate([points, posterior.sample((draws,), generator=generator).numpy()])
        try:
            found = _fitted(search, windows, guesses, first=not fitted)
        except BudgetExhausted:
            break
        finally:
            chain.rollouts += math.ceil(windows.rollouts * share)
        if found is None:
            break
        fitted = True
        if found.optima:
            kept = [found.optima[k] for k in distinct(found.optima)]
            points = np.stack([one.theta for one in kept[: search.options.restarts]])
            posterior = mixture(kept, search.space)
        else:
            points = found.here.theta[None]
    return points if fitted else None


def _misfit(chain: Chain, theta: FloatArray) -> float:
    """The largest of the channels' residuals (root mean squares) where the commands lead, in sds of a channel's noise as its roughness
    shows it at most; infinite where that diverges."""
    states = chain.predicted(theta)
    found = None if states is None else chain.compare(theta[None], states[None])[0]
    if found is None:
        return np.inf
    size = np.sqrt((found.residual**2).sum(0) / found.observed.sum(0))
    return float((size / np.maximum(roughness(chain), chain.least[0])).max())


def _horizons(chain: Chain, longer: float) -> Iterator[int]:
    """Control steps of the beginnings: in the shortest one every fitted channel has a sample after its start."""
    sampled = chain.observed & ~chain.first[:, None]
    seen = [int(chain.sample[rows].min()) if rows.any() else 0 for rows in sampled.T]
    longest = int(chain.trajectories.length.max())
    steps = float(max(_FIRST, *seen))
    while steps < longest:
        yield round(steps)
        steps *= longer
    yield longest


def _fitted(search: SearchProblem, windows: Windows, guesses: FloatArray, first: bool) -> WindowState | None:
    """The search's state where it or its budget ends; None where all guesses (B, N) diverge. first: whether the first of them is the model
    as given. Raises BudgetExhausted before any step."""
    residual, valid = windows.residuals(guesses, np.tile(windows.no_starts(), (len(guesses), 1, 1, 1)))
    if not valid.any():
        return None
    if first and not valid[0]:
        search.find(finding(Code.DIVERGES_AS_GIVEN))
    squares = np.maximum((residual**2).sum((1, 2)), 1e-300)
    order = np.argsort(np.where(valid, np.log(squares).sum(1), np.inf), kind="stable")
    strategy = WindowSearch(search.within(guesses[order[: min(_FOLLOWED, int(valid.sum()))]]), windows)
    state = strategy.start()
    try:
        while not state.done:
            state = strategy.step(state)
    except BudgetExhausted:
        pass
    return state
