"""Where the search goes on once short windows have led astray: from where longer ones end.

Where joints are not measured, half a second of a few channels hardly tells where a window starts. Then starts take what
is theta's, and the search ends where neither is right. Windows eight times as long have an eighth of the starts. So
where the noise that is left is three times what the samples scatter by, such windows are fitted by themselves. The
search goes on from their theta, and from states along their simulations, if these follow the log twice as well. Of
the first 48 logs of ``examples/studies/unmeasured.py`` 8 are silently missed without this, none with it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.budget import BudgetExhausted
from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.inference.laplace.optimum import WindowOptimum, WindowState
from sipe_bayes.inference.laplace.solver import SegmentSolver
from sipe_bayes.inference.laplace.strategy import SearchProblem
from sipe_bayes.likelihood import Segments, bind
from sipe_bayes.likelihood.windows import Windows
from sipe_bayes.simulation.simulator import Simulator
from sipe_bayes.simulation.tangents import tangents

_TIMES = 8  # as long


@dataclass(frozen=True)
class Trail:
    """Where longer windows end: theta (N,), and the states along each log (T+1, S)."""

    theta: FloatArray
    states: Sequence[FloatArray]


def led_on(problem: SearchProblem, windows: Windows, state: WindowState) -> WindowState:
    """A finished search on from where longer windows lead; as it is where it is not lost, or they are no better."""
    settings = windows.settings
    asked = bool(state.optima) and not state.longer and settings.window is not None
    if not asked or not windows.num_start or windows.starts_measured:
        return state
    best = max(state.optima, key=lambda one: one.evidence)
    if not (best.sd > 3.0 * windows.level.sd).any():
        return state
    tried, before = replace(state, longer=True), windows.rollouts
    # the search goes on with the rest of the budget; and the model may be what is wrong
    budget = min(0.6 * (windows.budget - before), 2.0 * before)
    counted = replace(problem, tell=lambda what, more: problem.tell(what, math.ceil(before) + more))
    trail, rollouts = trailed(counted, windows.simulator, windows.trajectories, settings, budget)
    windows.rollouts += rollouts
    if trail is None:
        return tried
    begins = np.stack([trail.states[k][s] for k, s in zip(windows.log, windows.start, strict=True)])
    starts = tangents(windows.simulator.model, begins, windows.reference)
    windows.filters.follow(starts, windows.number)
    residual, valid = windows.residuals(trail.theta[None], starts[None])
    left = np.sqrt((residual[0] ** 2).sum((0, 1)) / np.maximum(windows.observed.sum((0, 1)), 1))
    if not valid[0] or not np.log(left / best.sd).mean() < np.log(0.5):
        return tried
    fresh = replace(tried, optima=(), wild=np.zeros((0, 3), np.int64))
    return SegmentSolver(problem, windows).onward(fresh, trail.theta, starts) or tried


def trailed(
    problem: SearchProblem, simulator: Simulator, trajectories: Trajectories, settings: Segments, budget: float
) -> tuple[Trail | None, int]:
    """Where windows eight times as long as those of ``settings`` end, and the rollouts that it took.

    None where ``budget`` is too small.
    """
    shortest = (trajectories.length * trajectories.dt).min()
    length = math.inf if settings.window is None else _TIMES * settings.window
    lengthened = replace(settings, window=None if length > shortest else length, windows=(), seconds=None)
    logs = Trajectories.stack([replace(one, states=None) for one in trajectories])
    windows = bind(lengthened, simulator, logs)
    windows.budget = budget
    search, optima = SegmentSolver(replace(problem, find=lambda _: None), windows), tuple[WindowOptimum, ...]()
    try:
        state = search.start()
        while not state.done:
            state = search.step(state)
            optima = state.optima
            problem.tell(f"windows {_TIMES} times as long, {state.describe()}", math.ceil(windows.rollouts))
    except BudgetExhausted:
        pass  # what was recorded may do
    spent = math.ceil(windows.rollouts)
    if not optima:
        return None, spent
    best = max(optima, key=lambda one: one.evidence)
    thetas = np.tile(best.theta, (windows.num_windows, 1))
    begin = windows.states(best.theta[None], best.starts[None])[0]
    rollout = simulator.rollout(thetas, windows.actions, begin, windows.dt, windows.names, goals=windows.goals)
    assert rollout.states is not None
    states = [np.full((len(one) + 1, begin.shape[1]), np.nan) for one in logs]
    for w, place in zip(*np.nonzero(windows.owned), strict=True):
        states[windows.log[w]][windows.start[w] + place] = rollout.states[w, place]
    if not all(np.isfinite(one[:, 1:]).all() for one in states):
        return None, spent + 1
    return Trail(best.theta, states), spent + 1
