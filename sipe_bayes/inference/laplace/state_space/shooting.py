"""A trajectory through contacts by multiple shooting: windows without process noise, twice as long each time.

A smoother changes all states at once, and one stiff impact refuses the step of the whole log; process noise then takes
what is left, with an estimate in a wrong valley of the trajectory. Short windows with free starts meet in theta alone,
so that each takes as much of a step as serves it best, and an impact that is missed holds back its own window. Fitted,
two of them foretell where a window twice as long starts, until whole logs follow without process noise (H. G. Bock,
"Recent advances in parameter identification techniques for ODE", 1983,
https://doi.org/10.1007/978-1-4684-7324-7_7). The beginnings of the windows grow as ``growing_windows`` has it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.inference.laplace.growing_windows import grown, level
from sipe_bayes.inference.laplace.state_space.smoother import ChainPoint
from sipe_bayes.inference.laplace.strategy import SearchProblem
from sipe_bayes.inference.laplace.window_state import Phase, Position
from sipe_bayes.likelihood.binding import bind
from sipe_bayes.likelihood.settings import BudgetExhausted, Segments
from sipe_bayes.likelihood.state_space.chain import Chain
from sipe_bayes.likelihood.windows import Windows


def shot(
    problem: SearchProblem, chain: Chain, theta: FloatArray, states: list[FloatArray], budget: float
) -> ChainPoint | None:
    """Theta and states where the longest windows that follow the logs end, from theta (N,).

    Each window begins at the one of ``states``, (K, S) each, that it follows best from.

    None where none follows them, or ``budget``, rollouts for all of it, ends first.
    """
    tuning = problem.options.tuning
    horizon, best, least = tuning.state_space.shooting.first, None, np.inf
    limit = chain.rollouts + budget
    logs = Trajectories.stack([replace(t, states=None) for t in chain.trajectories])
    for seconds in _lengths(chain, tuning.state_space.shooting.window):
        settings = Segments(seconds, "white", chain.settings.fit, chain.settings.noise_sd)
        windows = bind(settings, chain.simulator, logs)
        windows.budget = limit - chain.rollouts
        try:
            windows.reference = _best_starts(windows, theta, [one[_rows(chain, windows)] for one in states])
            here = Position.at(windows, theta, tuning.damping, subset=False)
            here = replace(here, phase=Phase.GROW, horizon=min(horizon, int(windows.steps.max())))
            while here.phase is Phase.GROW:
                here = grown(windows, windows, problem.quadratic_prior, here, tuning.growing, tuning.damping)
            simulated, misfit = _simulated(chain, windows, here)
        except BudgetExhausted:
            return best
        finally:
            chain.rollouts += math.ceil(windows.rollouts)
        if misfit > max(tuning.state_space.shooting.follows, least):
            return best  # chaos: longer ones follow no better
        theta, horizon, least = here.theta, int(windows.steps.max()), min(misfit, least)
        best, states = ChainPoint(theta, simulated), [*states, simulated]
    return best


def _lengths(chain: Chain, first: int) -> Iterator[float | None]:
    """Seconds of the windows; at last None: whole logs."""
    seconds = first * float(chain.trajectories.dt.max())
    while seconds < float((chain.trajectories.length * chain.trajectories.dt).min()):
        yield seconds
        seconds *= 2
    yield None


def _rows(chain: Chain, windows: Windows) -> FloatArray:
    """Number (W,) of the chain's state where each window starts."""
    return np.asarray(np.flatnonzero(chain.first)[windows.log] + windows.start)


def _best_starts(windows: Windows, theta: FloatArray, states: list[FloatArray]) -> FloatArray:
    """Of first states (W, S) of the windows, for each window those from which a simulation follows it best."""
    squares, scale = [], level(windows).sd
    for one in states:
        windows.reference = one
        predicted, _ = windows.predict(theta[None], windows.no_starts()[None])
        square = np.where(windows.observed, ((windows.measured - predicted[0]) / scale) ** 2, 0.0).sum((1, 2))
        squares.append(np.where(np.isfinite(square), square, np.inf))
    best = np.argmin(squares, axis=0)
    return np.stack(states)[best, np.arange(len(best))]


def _simulated(chain: Chain, windows: Windows, here: Position) -> tuple[FloatArray, float]:
    """The chain's states (K, S) on the windows' simulations, and the worst channel's residual in noise sds."""
    windows.spend(1)
    thetas, begin = np.tile(here.theta, (windows.num_windows, 1)), windows.states(here.starts)
    rollout = chain.simulator.rollout(thetas, windows.actions, begin, windows.dt, windows.names, goals=windows.goals)
    assert rollout.states is not None
    residual, valid = windows.residuals(here.theta[None], here.starts[None])
    if not valid[0]:
        return chain.reference, np.inf
    w, place = np.nonzero(windows.owned)
    at = _rows(chain, windows)[w] + place
    states = chain.reference.copy()
    states[at] = chain.moved(chain.reference[at], chain.difference(rollout.states[w, place], chain.reference[at]))
    squares = (residual[0] / level(windows).sd) ** 2
    return states, float(np.sqrt(squares.sum((0, 1)) / windows.observed.sum((0, 1))).max())
