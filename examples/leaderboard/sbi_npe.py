"""sbi called directly, as its tutorial calls it: NPE with its default flow, one round.

    python examples/leaderboard/sbi_npe.py --out runs/leaderboard/sbi_npe

x is what was measured, whole; above 50 numbers it goes through sbi's fully connected embedding. A simulator that makes
no noise of its own gets white noise: of the sd that it states, else of an sd estimated from the log's second
differences. One training serves all observations of a function, else each log has its own. Draws outside the prior are
rejected by sbi. https://sbi.readthedocs.io
"""

from __future__ import annotations

import contextlib
import io
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import torch

from sipe_bayes.benchmark.leaderboard.run import DRAWS, Estimate, Method, run_from_command_line
from sipe_bayes.benchmark.leaderboard.task import Case, Problem, Task
from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.models.sbi_tools import NoTracker, import_sbi
from sipe_bayes.simulation.callable_simulator import CallableSimulator

EMBEDDED, FEATURES, BATCH = 50, 20, 500
Trainer = Callable[[torch.distributions.Distribution, torch.nn.Module], Any]


def npe(prior: torch.distributions.Distribution, embedding: torch.nn.Module) -> Any:
    density = import_sbi("neural_nets").posterior_nn("maf", embedding_net=embedding)
    return import_sbi("inference").NPE(prior, density_estimator=density, tracker=NoTracker(), show_progress_bars=False)


def noise_sd(problem: Problem, case: Case) -> FloatArray | float:
    """Of each number of x."""
    simulator = problem.simulator
    if isinstance(simulator, CallableSimulator):
        return 0.0 if simulator.noise_sd is None else simulator.noise_sd[0]
    windows = problem.windows(case.trajectories)
    jumps = np.diff(np.where(windows.observed, windows.measured, np.nan), n=2, axis=1)
    sd = np.sqrt(np.nanmean(jumps**2, axis=(0, 1)) / 6)
    return np.broadcast_to(sd, windows.measured.shape)[windows.observed]


def prior_of(problem: Problem) -> torch.distributions.Distribution:
    """Of theta, as sbi takes it: uniform in the cube, or normal where the task says so."""
    parts: list[torch.distributions.Distribution] = []
    for parameter in problem.space:
        mean, sd = (torch.tensor([x], dtype=torch.float32) for x in parameter.theta_prior)
        uniform = import_sbi("utils").BoxUniform(torch.zeros(1), torch.ones(1))
        parts.append(torch.distributions.Normal(mean, sd) if torch.isfinite(sd) else uniform)
    return import_sbi("utils").MultipleIndependent(parts) if len(parts) > 1 else parts[0]


def method(seed: int, train: Trainer = npe) -> Method:
    trained: dict[str, Any] = {}

    def learn(task: Task, problem: Problem, case: Case) -> Any:
        rng, count = np.random.default_rng(seed), task.budget // len(case.trajectories)
        theta = problem.prior.sample((count,), generator=torch.Generator().manual_seed(seed)).numpy()
        x = np.concatenate(
            [problem.simulate(case, problem.space.values(theta[k : k + BATCH])) for k in range(0, count, BATCH)]
        )
        x = x + noise_sd(problem, case) * rng.standard_normal(x.shape)
        valid = np.isfinite(x).all(1)
        embedding: torch.nn.Module = torch.nn.Identity()
        if x.shape[1] > EMBEDDED:
            embedding = import_sbi("neural_nets.embedding_nets").FCEmbedding(x.shape[1], output_dim=FEATURES)
        trainer = train(prior_of(problem), embedding)
        pair = (torch.tensor(a[valid], dtype=torch.float32) for a in (theta, x))
        trainer.append_simulations(*pair).train()
        return trainer.build_posterior()

    def sample(task: Task, problem: Problem, case: Case) -> Estimate:
        torch.manual_seed(seed)
        shared = isinstance(problem.simulator, CallableSimulator)
        spent = 0 if shared and task.name in trained else task.budget // len(case.trajectories)
        with contextlib.redirect_stdout(io.StringIO()):
            posterior = trained[task.name] if not spent else learn(task, problem, case)
            if shared:
                trained[task.name] = posterior
            seen = torch.tensor(problem.observed(case), dtype=torch.float32)
            drawn = posterior.sample((DRAWS,), x=seen, show_progress_bars=False).double().numpy()
        inside = ((drawn >= 0) & (drawn <= 1)).all(1)  # a normal prior is cut
        return Estimate(problem.space.values(drawn[inside]), spent * len(case.trajectories))

    return sample


if __name__ == "__main__":
    run_from_command_line("sbi NPE", "sbi's NPE called directly, one round, maf", ["sbi", "torch"], partial(method))
