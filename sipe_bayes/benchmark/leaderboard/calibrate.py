"""The method ``calibrate``: ``laplace`` with what the model lacks or may lack, which ``sipe calibrate`` shows first.

That is the interval of ``structure.discrepancy``; nothing is put into a model here. Where the residuals
are no noise it asks for windows: a log that was fitted whole from its known start is fitted again in windows of half a
second, within the same budget. Only of a user's MJCF, which extensions are made for; elsewhere it is ``laplace``. Of a
simulator that makes its own noise there is no likelihood: there it is what ``laplace`` then names in its place,
``npe``, mended by held-back simulations.

Held-out logs are predicted with the most probable values of the first fit, as ``sipe calibrate`` does: where physics
are missing, the model does not predict best with the machine's own values, which that interval is about.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from sipe_bayes.benchmark.leaderboard.run import DRAWS, Estimate, OwnMethod, draws_of
from sipe_bayes.benchmark.leaderboard.task import Case, Problem, Task
from sipe_bayes.calibration.gathered import most_probable
from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.diagnostics.misfit import misfit
from sipe_bayes.envs.mjcf import MjcfEnvironment
from sipe_bayes.inference.arguments import without_likelihood
from sipe_bayes.inference.laplace import Laplace
from sipe_bayes.likelihood import QuadraticPrior, Segments, bind
from sipe_bayes.posterior import Posterior
from sipe_bayes.structure.augmented import AugmentedModel
from sipe_bayes.structure.discrepancy import Discrepancy, find_discrepancy
from sipe_bayes.structure.tolerances import Tolerances, usual

NAME = "calibrate"


@dataclass(frozen=True, eq=False)
class _Fit:
    """A fit of ``laplace`` and the logs it was given."""

    method: Laplace
    posterior: Posterior
    logs: Trajectories

    def found(self, tolerances: Tolerances) -> Discrepancy:
        """What the model lacks, or may lack, to first order."""
        method, theta = self.method, self.posterior.mode.numpy()
        assert isinstance(method.likelihood, Segments)
        windows = bind(method.likelihood, method.simulator, self.logs)
        assert method.result is not None
        starts = method.result.starts_at(theta)
        assert starts is not None
        prior, linearised = QuadraticPrior.of(method.prior), windows.linearise(theta, starts)
        logs = AugmentedModel(windows, theta, method.result.noise, starts, prior, linearised)
        return find_discrepancy(logs, tolerances)


class Calibrate:
    """See the module.

    Args:
        seed: of the fits and the draws.
    """

    def __init__(self, seed: int) -> None:
        self.seed = seed
        self._amortised = OwnMethod("npe", seed)

    def __call__(self, task: Task, problem: Problem, case: Case) -> Estimate:
        """See ``Method``."""
        if without_likelihood(problem.simulator):
            return self._amortised(task, problem, case)
        logs, given = case.trajectories, problem.likelihood
        fit = self._fit(problem, given, logs, task.budget)
        posterior, rollouts, best = fit.posterior, fit.method.rollouts, most_probable(fit.posterior)
        if isinstance(problem.simulator.environment, MjcfEnvironment):
            known = usual(problem.simulator.environment.actuators)
            found = fit.found(known)
            if given.starts == "recorded" and misfit(found, posterior.stddev.numpy(), self.seed).alarm:
                fit = self._fit(problem, Segments(), replace(logs, states=None), task.budget - rollouts)
                rollouts, found = rollouts + fit.method.rollouts, fit.found(known)
            posterior = found.draw(fit.posterior, self.seed)
        drawn = posterior.values(DRAWS, draws_of(self.seed, problem, case))
        return Estimate(drawn, rollouts, problem.space.values(best))

    def _fit(self, problem: Problem, likelihood: Segments, logs: Trajectories, budget: int) -> _Fit:
        method = Laplace(
            problem.simulator,
            prior=problem.prior,
            likelihood=likelihood,
            budget=budget,
            seed=self.seed,
            **problem.settings,  # type: ignore[arg-type]
        )
        return _Fit(method, method.fit(logs), logs)
