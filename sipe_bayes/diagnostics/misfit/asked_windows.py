"""Windows whose residuals are asked what the model lacks: all, or through impacts those that it follows."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.checkpoint import NOTHING_KEPT, Kept
from sipe_bayes.diagnostics.misfit.probed_logs import ProbedLogs
from sipe_bayes.inference.laplace.windows.growing_windows import grows
from sipe_bayes.inference.laplace.windows.state import Followed
from sipe_bayes.inference.recorded import Tell, silent
from sipe_bayes.likelihood.noise import Noise
from sipe_bayes.likelihood.quadratic_prior import QuadraticPrior
from sipe_bayes.likelihood.windows import Linearisation, Windows


@dataclass(frozen=True)
class AskedWindows:
    """Windows at an estimate.

    Args:
        windows: those.
        theta: (N,) the estimate.
        starts: (W, D) there.
        noise: (C,) of these windows.
        prior: of theta.
        lin: at theta and starts, where it is known.
        chosen: through impacts all windows, among which these were chosen, and which are followed where.
    """

    windows: Windows
    theta: FloatArray
    starts: FloatArray
    noise: Noise
    prior: QuadraticPrior
    lin: Linearisation | None
    chosen: tuple[Windows, Followed] | None = None

    @classmethod
    def at(cls, at: Followed, windows: Windows, prior: QuadraticPrior, lin: Linearisation | None = None) -> Self:
        """Those of some windows that are followed, at their optimum."""
        starts = at.starts[at.kept]
        return cls(at.of(windows), at.theta, starts, at.noise, at.held(prior), lin, (windows, at))

    @property
    def among(self) -> int:
        """How many windows they were chosen from."""
        return (self.windows if self.chosen is None else self.chosen[0]).num_windows

    def probed(self, tell: Tell = silent, kept: Kept = NOTHING_KEPT) -> ProbedLogs:
        """With what extensions would do to them; of what follows impacts, noise may be larger for a while.

        Args:
            tell: called with what is being done.
            kept: keeps what extensions do, and draws of the null.
        """
        steady = not grows(self.windows)
        return ProbedLogs(
            self.windows, self.theta, self.noise, self.starts, self.prior, self.lin, tell, kept, steady=steady
        )
