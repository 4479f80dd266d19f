"""Options of ``laplace``: what a user chooses, and the tuning of each piece of the search with its reason."""

from __future__ import annotations

from dataclasses import dataclass

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.options import Options, option
from sipe_bayes.inference.importance import ImportanceTuning
from sipe_bayes.inference.laplace.levenberg_marquardt import DampingRule
from sipe_bayes.inference.laplace.pattern_search import PatternTuning
from sipe_bayes.inference.laplace.state_space.options import ChainTuning


@dataclass(frozen=True)
class ScreeningTuning(Options):
    """How starting points are chosen among candidates; see ``window_search.screen``."""

    generations_from: int = option(40, "candidates from which on later ones are drawn around the best", least=1)
    generations: int = option(10, "generations of the cross-entropy method", least=1)
    first_share: float = option(0.4, "share of the candidates that the prior gives", above=0, below=1)
    elite: int = option(6, "best candidates that the next generation surrounds", least=2)
    least_spread: float = option(1e-3, "sd of a generation, so that it does not collapse", "of the cube", above=0)


@dataclass(frozen=True)
class WindowTuning(Options):
    """How the search over windows goes; see ``window_search``."""

    tolerance: float = option(0.02, "gain of a step below which the search stands still", "nats", above=0)
    rough_tolerance: float = option(1e-4, "the same while the noise is only guessed", "of the energy", above=0)
    most_steps: int = option(80, "steps from one starting point; rough ones take half of them at most", least=4)
    subset_gain: float = option(0.5, "gain below which all windows are used, if it was foretold", "of the energy")
    subset_gain_unforetold: float = option(0.1, "the same for a gain that was not foretold", "of the energy")
    foretold: float = option(0.2, "how well a kept Jacobian has to foretell a gain", "relative", above=0)
    most_drift: float = option(0.5, "how far what was foretold since it was taken may be wrong", "nats", above=0)
    open_sd: float = option(0.5, "sd from which a direction counts as open", "of the cube", above=0)
    off_centre: float = option(0.1, "distance from a ridge's middle that is worth going", "of the cube", above=0)
    as_good: float = option(2.0, "how much worse a ridge's middle may be", "nats", above=0)
    most_patterns: int = option(20, "pattern searches that lead on from one starting point", least=0)
    most_points: int = option(10, "starting points, with those found on the way", least=1)
    trials: int = option(10, "rollouts that a step is allowed beside its linearisation", least=1)


@dataclass(frozen=True)
class LaplaceTuning(Options):
    """Numbers of the search that users hardly ever change."""

    damping: DampingRule = option(DampingRule(), "how steps are damped")
    screening: ScreeningTuning = option(ScreeningTuning(), "how starting points are chosen")
    windows: WindowTuning = option(WindowTuning(), "how the search over windows goes")
    importance: ImportanceTuning = option(ImportanceTuning(), "draws where the posterior is no normal")
    pattern: PatternTuning = option(PatternTuning(), "how the surroundings of an optimum are looked at")
    state_space: ChainTuning = option(ChainTuning(), "how the searches over a chain of states go")


@dataclass(frozen=True)
class LaplaceOptions(Options):
    """What ``Laplace`` takes beside what every estimator takes."""

    restarts: int = option(2, "starting points followed, at most: one may end in a side valley", least=1)
    candidates: int = option(8, "points among which they are chosen: draws from the prior", least=0)
    initial: FloatArray | None = option(None, "the starting points (R, N) themselves instead", "of the cube")
    tuning: LaplaceTuning = option(LaplaceTuning(), "numbers of the search itself")
