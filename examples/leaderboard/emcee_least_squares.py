"""emcee on plain least squares: white noise of one sd, which is integrated out, and the prior as the task states it.

    python examples/leaderboard/emcee_least_squares.py --out runs/leaderboard/emcee_least_squares

log p(theta | log) = log prior - D / 2 log sum of squares, each channel over its spread; where the simulator states its
noise, - sum of squares / (2 sd^2). A fifth of the budget finds the best of random draws, four walkers for each unknown
start in a small ball about it, the first half of the rest is left out, as emcee's tutorial does. A simulator that makes
its own noise has no likelihood: that log fails. D. Foreman-Mackey, D. Hogg, D. Lang, J. Goodman 2013, "emcee: The MCMC
Hammer", https://arxiv.org/abs/1202.3665.
"""

from __future__ import annotations

import emcee
import numpy as np
import torch

from sipe_bayes.benchmark.leaderboard.run import DRAWS, Estimate, Method, run_from_command_line
from sipe_bayes.benchmark.leaderboard.task import Case, Problem, Task
from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.simulation.callable_simulator import CallableSimulator

WALKERS, FIRST, BALL = 4, 0.2, 0.01


def log_density(problem: Problem, case: Case, theta: FloatArray) -> FloatArray:
    """Of theta (B, N), minus infinity outside the cube and where a simulation failed."""
    values = np.full(len(theta), -np.inf)
    inside = ((theta >= 0) & (theta <= 1)).all(1)
    if not inside.any():
        return values
    simulator, scale = problem.simulator, problem.scale(case)
    off = (problem.simulate(case, problem.space.values(theta[inside])) - problem.observed(case)) / scale
    squares = np.square(off).sum(1)
    if isinstance(simulator, CallableSimulator):
        likelihood = -squares / (2 * np.square(simulator.noise_sd or (np.nan,))[0])
    else:
        likelihood = -off.shape[1] / 2 * np.log(squares)
    prior = problem.prior.log_prob(torch.from_numpy(theta[inside])).numpy()
    values[inside] = np.nan_to_num(likelihood + prior, nan=-np.inf)
    return values


def method(seed: int) -> Method:
    def sample(task: Task, problem: Problem, case: Case) -> Estimate:
        simulator = problem.simulator
        if isinstance(simulator, CallableSimulator) and simulator.noise_sd is None:
            raise NotImplementedError("the simulator makes its own noise, so there is no sum of squares to sample")
        rng, size, logs = np.random.default_rng(seed), len(problem.space), len(case.trajectories)
        walkers = WALKERS * size
        first = max(1, int(FIRST * task.budget) // logs)
        drawn = problem.prior.sample((first,), generator=torch.Generator().manual_seed(seed)).numpy()
        best = drawn[log_density(problem, case, drawn).argmax()]
        start = np.clip(best + BALL * rng.standard_normal((walkers, size)), 1e-3, 1 - 1e-3)
        steps = (task.budget // logs - first) // walkers - 1
        sampler = emcee.EnsembleSampler(walkers, size, lambda t: log_density(problem, case, t), vectorize=True)
        moves = np.random.RandomState(seed).get_state()
        sampler.run_mcmc(emcee.State(start, random_state=moves), steps)
        kept = sampler.get_chain(discard=steps // 2, flat=True)
        rows = kept[np.linspace(0, len(kept) - 1, DRAWS).astype(int)]
        return Estimate(problem.space.values(rows), (first + (steps + 1) * walkers) * logs)

    return sample


if __name__ == "__main__":
    about = "emcee on the squared error, noise of one sd integrated out"
    run_from_command_line("emcee, least squares", about, ["emcee"], method)
