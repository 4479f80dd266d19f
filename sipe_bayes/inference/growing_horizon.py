"""Starting points of logs whose first states are known: ever longer beginnings are fitted, each from where the last one led.

What whole logs say of theta is sharp, but through contact so rough that a search from afar finds nothing: the trouble of every
initial-value approach to chaotic systems (H. U. Voss, J. Timmer, J. Kurths, "Nonlinear dynamical system identification from
uncertain and indirect measurements", 2004, https://doi.org/10.1142/S0218127404010345). A few control steps are smooth in theta and
say little; nearly half as many more say a little more. Each beginning is fitted without process noise (``window_search``) from the
best of the last optimum and draws from its posterior, which spread where nothing is known yet.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Iterator

import numpy as np
import torch
from numpy.typing import NDArray

from sipe_bayes.inference import window_search
from sipe_bayes.inference.optima import Search, distinct_modes
from sipe_bayes.inference.state import State
from sipe_bayes.likelihood import BudgetExhausted, Segments, Windows
from sipe_bayes.state_space import Chain
from sipe_bayes.trajectory import Trajectories

FloatArray = NDArray[np.float64]

_FIRST, _LONGER = 8, 1.45  # control steps of the first beginning; how much longer the next is
_SHARE = 0.4  # of the budget in all
_MOST = 600  # rollouts of one beginning
_DRAWS, _FOLLOWED = 60, 2  # guesses for a beginning, and how many of them are followed


def grown(search: Search, chain: Chain) -> FloatArray | None:
    """Starting points (R, N); None where even the shortest beginnings diverge. What is said on the way is not of the fit."""
    likelihood = Segments(None, "white", chain.settings.fit, chain.settings.noise_sd, starts="recorded")
    limit = chain.rollouts + _SHARE * (chain.budget - chain.rollouts)
    generator = torch.Generator().manual_seed(search.seed)
    points, posterior = search.space.default_theta[None], search.prior
    fitted = False
    for steps in _horizons(int(chain.trajectories.length.max())):
        logs = Trajectories.stack([t.slice(0, min(steps, len(t))) for t in chain.trajectories])
        share = float(logs.length.sum() / chain.trajectories.length.sum())
        windows = likelihood.bind(chain.simulator, logs)
        windows.budget = min(_MOST, (limit - chain.rollouts) / share)
        draws = np.concatenate([points, posterior.sample((_DRAWS,), generator=generator).numpy()])
        try:
            found = _fitted(search, windows, draws)
        except BudgetExhausted:
            break
        finally:
            chain.rollouts += math.ceil(windows.rollouts * share)
        if found is None:
            break
        fitted = True
        if len(found["mode_theta"]):
            points = found["mode_theta"][distinct_modes(found)[: search.restarts]]
            posterior = _quiet(search).posterior(found, logs)
        else:
            points = found["theta"][None]
    return points if fitted else None


def _horizons(longest: int) -> Iterator[int]:
    steps = float(_FIRST)
    while steps < longest:
        yield round(steps)
        steps *= _LONGER
    yield longest


def _fitted(search: Search, windows: Windows, guesses: FloatArray) -> State | None:
    """The search's state where it or its budget ends; None where all guesses (B, N) diverge. Raises BudgetExhausted before any step."""
    residual, valid = windows.residuals(guesses, np.tile(windows.no_starts(), (len(guesses), 1, 1, 1)))
    if not valid.any():
        return None
    squares = np.maximum((residual**2).sum((1, 2)), 1e-300)
    order = np.argsort(np.where(valid, np.log(squares).sum(1), np.inf), kind="stable")
    quiet = _quiet(search)
    quiet.initial = guesses[order[: min(_FOLLOWED, int(valid.sum()))]]
    state = window_search.start(quiet, windows)
    try:
        while not state["done"]:
            state = window_search.step(quiet, windows, state)
    except BudgetExhausted:
        pass
    return state


def _quiet(search: Search) -> Search:
    quiet = copy.copy(search)
    quiet.warn = lambda sentence: None  # type: ignore[method-assign]
    return quiet
