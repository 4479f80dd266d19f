"""Options of ``laplace``: what a user chooses, and the tuning of each piece of the search with its reason."""

from __future__ import annotations

from dataclasses import dataclass

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.options import Options, option
from sipe_bayes.inference.importance import ImportanceTuning
from sipe_bayes.inference.laplace.levenberg_marquardt import DampingRule
from sipe_bayes.inference.laplace.state_space.options import ChainTuning
from sipe_bayes.inference.stretches import StretchTuning


@dataclass(frozen=True)
class LongerTuning(Options):
    """When longer windows are tried where starts are not measured, and how; see ``longer_windows``."""

    lost: float = option(3.0, "noise from which the logs are not followed", "of the samples' scatter", above=1)
    times: int = option(8, "how many times as long they are: as many starts fewer", least=2)
    share: float = option(
        0.6, "of the budget that is left, for their search: the rest goes on from there", above=0, below=1
    )
    most: float = option(2.0, "times what the search has cost, for theirs: the model may be what is wrong", above=0)
    better: float = option(0.5, "residuals from which the search goes on there", "of those before", above=0, below=1)


@dataclass(frozen=True)
class SolverTuning(Options):
    """How segments are fitted; see ``solver``."""

    damping: float = option(1e-3, "of the first step: nearly Gauss and Newton's", above=0)
    tolerance: float = option(0.05, "gain of a step below which the fit has converged", "nats a parameter", above=0)
    plain_gain: float = option(0.5, "the same of the plain fit", "nats a parameter", above=0)
    most_steps: int = option(60, "steps from one starting point", least=2)
    most_points: int = option(6, "starting points, with those found on the way", least=1)
    linearised_steps: float = option(5e5, "physics steps of a linearisation, until the fit has nearly converged")
    growth: float = option(1.5, "by which beginnings of segments that meet impacts grow: one at a time", above=1)
    whole: float = option(4.0, "times as many at the end, at most: more segments are left out", least=1)
    compares: bool = option(
        True, "whether plain least squares takes over where coloured noise explains what it should not"
    )
    poor: float = option(3.0, "residuals over what samples scatter by from which more starting points are tried")


@dataclass(frozen=True)
class LaplaceTuning(Options):
    """Numbers of the search that users hardly ever change."""

    damping: DampingRule = option(DampingRule(), "how steps are damped")
    solver: SolverTuning = option(SolverTuning(), "how segments are fitted")
    longer: LongerTuning = option(LongerTuning(), "what is tried where starts are not measured and short windows fail")
    importance: ImportanceTuning = option(ImportanceTuning(), "draws where the posterior is no normal")
    stretches: StretchTuning = option(StretchTuning(), "how far a posterior is looked at beyond its normal")
    state_space: ChainTuning = option(ChainTuning(), "how the searches over a chain of states go")


EVIDENCE_TUNING = LaplaceTuning(solver=SolverTuning(compares=False), importance=ImportanceTuning(wanted=False))
"""Of fits whose evidences are compared: those of different noise do not compare."""


@dataclass(frozen=True)
class LaplaceOptions(Options):
    """What ``Laplace`` takes beside what every estimator takes."""

    restarts: int = option(2, "starting points of a poor fit, at most; with 1 no other optimum is looked for", least=1)
    candidates: int = option(8, "points among which they are chosen: draws from the prior", least=0)
    initial: FloatArray | None = option(None, "the starting points (R, N) themselves instead", "of the cube")
    tuning: LaplaceTuning = option(LaplaceTuning(), "numbers of the search itself")
