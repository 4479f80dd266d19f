"""Options of ``laplace``: what a user chooses, and the tuning of each piece of the search with its reason."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.options import Options, option
from sipe_bayes.inference.importance import ImportanceTuning
from sipe_bayes.inference.laplace.state_space.options import ChainTuning
from sipe_bayes.inference.stretches import StretchTuning


@dataclass(frozen=True)
class SolverTuning(Options):
    """How segments are fitted; see ``solver``."""

    damping: ClassVar[float] = 1e-3  # of the first step: nearly Gauss and Newton's
    plain_gain: ClassVar[float] = 0.5  # nats a parameter, gain of a step below which the plain fit has converged
    most_steps: ClassVar[int] = 60  # from one starting point
    most_points: ClassVar[int] = 6  # with those found on the way
    growth: ClassVar[float] = 1.5  # by which beginnings of segments that meet impacts grow
    least_samples: ClassVar[float] = 200.0  # for each parameter, of the first part of the segments
    explained: ClassVar[float] = 0.1  # share of squares left by initial states that explain the rest: plain fits miss
    silent: ClassVar[float] = 0.02  # share of squares left by fitted initial states below which plain fits tell nothing
    poor: ClassVar[float] = 3.0  # residuals over the samples' scatter from which more starting points are tried
    linearised_steps: float = option(5e5, "physics steps of a linearisation, until the fit has nearly converged")
    whole: float = option(4.0, "times as many at the end, at most: more segments are left out", least=1)
    compares: bool = option(
        True, "whether plain least squares takes over where coloured noise explains too much; else ends earlier"
    )

    @property
    def tolerance(self) -> float:
        """Nats a parameter, gain of a step below which the fit has converged; evidences differ by tens of nats."""
        return 0.05 if self.compares else 0.2


@dataclass(frozen=True)
class LaplaceTuning(Options):
    """Numbers of the search that users hardly ever change."""

    stretches: ClassVar[StretchTuning] = StretchTuning()
    state_space: ClassVar[ChainTuning] = ChainTuning()
    solver: SolverTuning = option(SolverTuning(), "how segments are fitted")
    importance: ImportanceTuning = option(ImportanceTuning(), "draws where the posterior is no normal")


EVIDENCE_TUNING = LaplaceTuning(
    solver=SolverTuning(compares=False, linearised_steps=1e5, whole=1e3), importance=ImportanceTuning(wanted=False)
)
"""Of fits whose evidences are compared: those of different noise do not compare."""


@dataclass(frozen=True)
class LaplaceOptions(Options):
    """What ``Laplace`` takes beside what every estimator takes."""

    restarts: int = option(2, "starting points of a poor fit, at most; with 1 no other optimum is looked for", least=1)
    candidates: int = option(8, "points among which they are chosen: draws from the prior", least=0)
    initial: FloatArray | None = option(None, "the starting points (R, N) themselves instead", "of the cube")
    tuning: LaplaceTuning = option(LaplaceTuning(), "numbers of the search itself")
