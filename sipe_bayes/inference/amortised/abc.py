"""Approximate Bayesian computation by rejection: the simulations of the prior that look most like the log.

J. Pritchard et al. 1999, "Population growth of human Y chromosomes"
(https://doi.org/10.1093/oxfordjournals.molbev.a026091), as sbi's MCABC does it. With summary statistics S
(``models.statistics``), scaled to unit variance over the simulations, the fraction ``accepted`` of smallest
|S(x_i) - S(x)| is kept: equally weighted draws of p(theta | |S(x') - S(x)| < epsilon), which is wider than the
posterior and reaches it as epsilon goes to zero. ``summary``: or S is what a regression on the simulations makes of the
log (``inference.amortised.summaries``), in ranges of the parameters and not scaled.

``regression=True``: M. Beaumont, W. Zhang, D. Balding 2002, "Approximate Bayesian Computation in Population Genetics"
(https://doi.org/10.1093/genetics/162.4.2025): accepted theta are moved by what a linear regression on S says that their
distance from the log is worth.

Deviations:

- The regression acts on Phi^-1(theta), so that its draws stay in the cube, on the statistics that vary, and weighs the
  accepted alike, as sbi does, where the paper has Epanechnikov weights.
- Simulations lose the samples that the log lacks.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.findings import Code
from sipe_bayes.core.options import Options, option
from sipe_bayes.core.thresholds import THRESHOLDS
from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.inference.amortised.held_back import HeldBackOptions
from sipe_bayes.inference.amortised.prior_sampling import PriorSampling, PriorSamplingOptions, PriorSamplingState
from sipe_bayes.inference.amortised.simulations import Simulations
from sipe_bayes.inference.amortised.summaries import REGRESSED, Summaries
from sipe_bayes.likelihood import noise_level
from sipe_bayes.models.sbi_tools import import_sbi, seeded
from sipe_bayes.posterior import Particles, Posterior
from sipe_bayes.posterior.flow import to_cube, to_line


@dataclass(frozen=True)
class ABCOptions(HeldBackOptions, PriorSamplingOptions):
    """Options of ``ABC``."""

    accepted: float = option(0.05, "fraction of the valid simulations that is kept, at least one", above=0, most=1)
    regression: bool = option(False, "linear adjustment of the accepted")
    summary: str = option(
        "statistics",
        'what is compared; "regressed": theta as regressed on the simulations; '
        '"robust": the same, of which the log\'s is by minimum distance',
        among=("statistics", *REGRESSED),
    )


@dataclass(frozen=True)
class Bank:
    """What rejection chooses from.

    Attributes:
        theta: (n, N) of the valid simulations.
        statistics: (n, F) of them.
        scale: (F,), by which they are divided, infinite where they hardly vary.
        summaries: how they are made; None of plain statistics.
    """

    theta: FloatArray
    statistics: FloatArray
    scale: FloatArray
    summaries: Summaries | None = None


class ABC(PriorSampling[PriorSamplingState[Bank], Bank]):
    """Rejection on the statistics (sbi); amortised. Particles of equal weight."""

    name: ClassVar[str] = "abc"
    options_type: ClassVar[type[Options]] = ABCOptions
    state_type: ClassVar = PriorSamplingState[Bank]
    options: ABCOptions

    def train(self, simulations: Simulations, trajectories: Trajectories) -> Bank:
        """Nothing but the scale of the statistics is learned."""
        theta, observations = simulations.theta, simulations.observations
        statistics, summaries = self.statistics(observations, trajectories), None
        if self.options.summary in REGRESSED:
            noise = noise_level(trajectories, self.likelihood, self.simulator)
            summaries, statistics = Summaries.of(
                theta, observations, statistics, trajectories, noise, self.options.summary
            )
        sd = statistics.std(0)
        varies = sd > 1e-7 * (np.abs(statistics).max(0) + 1e-30)
        return Bank(theta, statistics, np.where(varies, sd if summaries is None else 1.0, np.inf), summaries)

    def infer(self, learned: Bank, trajectories: Trajectories) -> Posterior:
        """The nearest of the simulations; raises ValueError where the log has no statistics, or they are too few."""
        observed = self.statistics(trajectories.observations[None], trajectories)
        if not np.isfinite(observed).all():
            raise ValueError("trajectories: no control step has all channels measured at both ends; resample the log")
        if learned.summaries is not None:
            observed = learned.summaries(trajectories.observations, observed)
        varies = np.isfinite(learned.scale)
        simulated = learned.statistics[:, varies] / learned.scale[varies]
        target = observed[0, varies] / learned.scale[varies]
        theta = torch.from_numpy(learned.theta)
        kept = max(1, round(self.options.accepted * len(theta)))
        least = 2 * (1 + len(target))  # two for each coefficient
        if self.options.regression and kept < least:
            raise ValueError(
                f"regression: {kept} accepted simulations are too few for {len(target)} statistics, expected {least}; "
                "raise accepted or the budget, or leave the regression out"
            )
        line, distances = self._accept(to_line(theta), torch.from_numpy(simulated), torch.from_numpy(target), kept)
        self._report(distances, simulated)
        return Particles(to_cube(line).clamp(0.0, 1.0), self.space)

    def _accept(
        self, line: torch.Tensor, simulated: torch.Tensor, target: torch.Tensor, kept: int
    ) -> tuple[torch.Tensor, FloatArray]:
        """Accepted z (kept, N), adjusted if asked for, and their distances (kept,), by sbi."""
        inference = import_sbi("inference")
        with seeded(self.seed):
            rejection = inference.MCABC(
                lambda _: simulated,  # "simulates" the simulations there are, in their order
                _Given(line),
                distance="l2",
                simulation_batch_size=len(line),
                show_progress_bars=False,
            )
            quantile = min((kept + 0.5) / len(line), 1.0)
            accepted, summary = rejection(
                target, len(line), quantile=quantile, lra=self.options.regression, return_summary=True
            )
        return accepted.double(), summary["distances"].numpy()

    def _report(self, distances: FloatArray, simulated: FloatArray) -> None:
        spread = float(np.sqrt(2 * simulated.var(0).sum()))  # distance of two independent ones, root mean square
        self.diagnostics.update(accepted=len(distances), epsilon=float(distances.max()), nearest=float(distances.min()))
        self.diagnostics["epsilon_relative"] = float(distances.max()) / spread
        if len(distances) < THRESHOLDS.few_accepted:
            self.find(Code.FEW_ACCEPTED, accepted=len(distances))


class _Given:
    """A "prior" for sbi that draws the theta that were simulated, in their order."""

    def __init__(self, theta: torch.Tensor) -> None:
        self.theta = theta

    def sample(self, shape: tuple[int, ...]) -> torch.Tensor:
        return self.theta
