"""Approximate Bayesian computation by rejection: the simulations of the prior that look most like the log.

J. Pritchard et al. 1999, "Population growth of human Y chromosomes" (https://doi.org/10.1093/oxfordjournals.molbev.a026091),
as sbi's MCABC does it. With summary statistics S (``models.statistics``), scaled to unit variance over the simulations,
the fraction ``accepted`` of smallest |S(x_i) - S(x)| is kept: equally weighted draws of
p(theta | |S(x') - S(x)| < epsilon), which is wider than the posterior and reaches it as epsilon goes to zero.

``regression=True``: M. Beaumont, W. Zhang, D. Balding 2002, "Approximate Bayesian Computation in Population Genetics"
(https://doi.org/10.1093/genetics/162.4.2025): accepted theta are moved by what a linear regression on S says that their
distance from the log is worth.

Deviations. The regression acts on Phi^-1(theta), so that its draws stay in the cube, on the statistics that vary, and weighs
the accepted alike, as sbi does, where the paper has Epanechnikov weights. Simulations lose the samples that the log lacks.
"""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray

from sipe_bayes.core.checkpoint import State
from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.core.validation import flag, positive
from sipe_bayes.inference.amortised.prior_sampling import PriorSampling
from sipe_bayes.inference.amortised.simulations import Simulations
from sipe_bayes.models.sbi_tools import import_sbi, seeded
from sipe_bayes.posterior import Particles, Posterior
from sipe_bayes.posterior.flow import to_cube, to_line

FloatArray = NDArray[np.float64]

_FEW = 30  # accepted draws below which their spread says little
_SPARE = 2  # accepted simulations for each coefficient of the regression


class ABC(PriorSampling):
    """Particles of equal weight; see the module's docstring.

    accepted: fraction of the valid simulations that is kept, at least one. regression: linear adjustment of the accepted.
    """

    name: ClassVar[str] = "abc"

    def __init__(self, simulator: Any, *, accepted: float = 0.05, regression: bool = False, **settings: Any) -> None:
        super().__init__(simulator, **settings)
        self.accepted, self.regression = positive("accepted", accepted), flag("regression", regression)
        if self.accepted > 1:
            raise ValueError(f"accepted: expected a fraction above 0 and at most 1, got {accepted}; try 0.05")

    def settings(self) -> dict[str, Any]:
        return {**super().settings(), "accepted": self.accepted, "regression": self.regression}

    def train(self, simulations: Simulations, trajectories: Trajectories) -> State:
        """Nothing but the scale of the statistics is learned."""
        statistics = self.statistics(simulations.observations, trajectories)
        sd = statistics.std(0)
        varies = sd > 1e-7 * (np.abs(statistics).max(0) + 1e-30)
        scale = np.where(varies, sd, np.inf)
        return {"theta": simulations.theta, "statistics": statistics, "scale": scale}

    def infer(self, state: State, trajectories: Trajectories) -> Posterior:
        observed = self.statistics(trajectories.observations[None], trajectories)
        if not np.isfinite(observed).all():
            raise ValueError("trajectories: no control step has all channels measured at both ends; resample the log")
        varies = np.isfinite(state["scale"])
        simulated = state["statistics"][:, varies] / state["scale"][varies]
        target = observed[0, varies] / state["scale"][varies]
        theta = torch.from_numpy(state["theta"])
        kept = max(1, round(self.accepted * len(theta)))
        if self.regression and kept < _SPARE * (1 + len(target)):
            raise ValueError(
                f"regression: {kept} accepted simulations are too few for {len(target)} statistics, "
                f"expected {_SPARE * (1 + len(target))}; raise accepted or the budget, or leave the regression out"
            )
        line, distances = self._accept(to_line(theta), torch.from_numpy(simulated), torch.from_numpy(target), kept)
        self._report(distances, simulated, target)
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
            quantile = (kept + 0.5) / len(line)
            accepted, summary = rejection(
                target, len(line), quantile=min(quantile, 1.0), lra=self.regression, return_summary=True
            )
        return accepted.double(), summary["distances"].numpy()

    def _report(self, distances: FloatArray, simulated: FloatArray, target: FloatArray) -> None:
        spread = float(np.sqrt(2 * simulated.shape[1]))  # distance of two independent simulations, root mean square
        self.diagnostics.update(accepted=len(distances), epsilon=float(distances.max()), nearest=float(distances.min()))
        self.diagnostics["epsilon_relative"] = float(distances.max()) / spread
        if len(distances) < _FEW:
            self.warn(f"only {len(distances)} simulations were accepted; raise the budget or the accepted fraction")


class _Given:
    """A "prior" for sbi that draws the theta that were simulated, in their order."""

    def __init__(self, theta: torch.Tensor) -> None:
        self.theta = theta

    def sample(self, shape: tuple[int, ...]) -> torch.Tensor:
        return self.theta
