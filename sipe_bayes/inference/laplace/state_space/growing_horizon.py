"""Starting points of logs whose first states are known: where segments end that are fitted without process noise.

What whole logs say of theta is sharp, but through contact so rough that a search from afar finds nothing: the trouble
of every initial-value approach to chaotic systems (H. U. Voss, J. Timmer, J. Kurths, "Nonlinear dynamical system
identification from uncertain and indirect measurements", 2004, https://doi.org/10.1142/S0218127404010345). A few
control steps are smooth in theta and say little; nearly half as many more say a little more. ``solver`` fits such
beginnings, ever longer.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.inference.laplace.solver import SegmentSolver
from sipe_bayes.inference.laplace.strategy import SearchProblem, distinct
from sipe_bayes.likelihood.binding import bind
from sipe_bayes.likelihood.settings import BudgetExhausted, Segments
from sipe_bayes.likelihood.state_space.chain import Chain


def grown(problem: SearchProblem, chain: Chain) -> FloatArray | None:
    """Starting points (R, N), perhaps fewer than asked for; None where the budget is too small for any.

    Of what is noticed on the way the problem learns only that the model as given diverges.
    """
    settings = Segments(None, "white", chain.settings.fit, chain.settings.noise_sd, starts="recorded")
    logs = Trajectories.stack(list(chain.trajectories))
    windows = bind(settings, chain.simulator, logs)
    windows.budget = problem.options.tuning.state_space.horizon * (chain.budget - chain.rollouts)
    restarts = problem.options.restarts
    problem = replace(problem, options=replace(problem.options, restarts=max(problem.options.restarts, 2)))
    solver, points = SegmentSolver(problem, windows), None
    try:
        if not windows.impacts:  # else the solver looks at draws itself
            nominal = np.clip(problem.space.default_theta, 0, 1)
            problem = problem.within(solver.screened(nominal, 60)[0][:1])
            solver = SegmentSolver(problem, windows)
        state = solver.start()
        solver = SegmentSolver(replace(problem, find=lambda _: None), windows)
        points = state.points[:1]
        while not state.done:
            state = solver.step(state)
            ends = [one.theta for one in distinct(state.optima)]
            points = np.stack(ends[:restarts]) if ends else state.here.theta[None]
    except BudgetExhausted:
        pass  # what was found may do
    finally:
        chain.rollouts += math.ceil(windows.rollouts)
    return points
