"""Options of ``laplace``: what a user chooses, and the tuning of each piece of the search with its reason."""

from __future__ import annotations

from dataclasses import dataclass

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.options import Options, option
from sipe_bayes.inference.importance import ImportanceTuning
from sipe_bayes.inference.laplace.levenberg_marquardt import DampingRule
from sipe_bayes.inference.laplace.state_space.options import ChainTuning
from sipe_bayes.inference.laplace.windows.pattern_search import PatternTuning
from sipe_bayes.inference.stretches import StretchTuning


@dataclass(frozen=True)
class ScreeningTuning(Options):
    """How starting points are chosen among candidates; see ``screening``."""

    generations_from: int = option(40, "candidates from which on later ones are drawn around the best", least=1)
    generations: int = option(10, "generations of the cross-entropy method", least=1)
    first_share: float = option(0.4, "share of the candidates that the prior gives", above=0, below=1)
    elite: int = option(6, "best candidates that the next generation surrounds", least=2)
    least_spread: float = option(1e-3, "sd of a generation, so that it does not collapse", "of the cube", above=0)


@dataclass(frozen=True)
class WindowTuning(Options):
    """How the search over windows goes; see ``windows.search``."""

    tolerance: float = option(0.02, "gain of a step below which the search stands still", "nats", above=0)
    rough_tolerance: float = option(1e-4, "the same while the noise is only guessed", "of the energy", above=0)
    most_steps: int = option(80, "steps from one starting point; rough ones take half of them at most", least=4)
    foretold: float = option(0.2, "how well a kept Jacobian has to foretell a gain", "relative", above=0)
    most_drift: float = option(0.5, "how far what was foretold since it was taken may be wrong", "nats", above=0)
    open_sd: float = option(0.5, "sd from which a direction counts as open", "of the cube", above=0)
    off_centre: float = option(0.1, "distance from a ridge's middle that is worth going", "of the cube", above=0)
    as_good: float = option(2.0, "how much worse a ridge's middle may be", "nats", above=0)
    most_patterns: int = option(20, "pattern searches that lead on from one starting point", least=0)
    most_points: int = option(10, "starting points, with those found on the way", least=1)
    trials: int = option(10, "rollouts that a step is allowed beside its linearisation", least=1)


@dataclass(frozen=True)
class GrowingTuning(Options):
    """How beginnings of windows grow."""

    first: float = option(0.25, "share of the longest window that they begin with", above=0, most=1)
    growth: float = option(1.25, "factor by which they grow: little enough that one impact comes at a time", above=1)
    enough: float = option(1e-3, "gain of a step below which they grow", "of the energy", above=0)
    most_steps: int = option(12, "steps after which they grow all the same", least=1)
    start_steps: int = option(4, "the same where only the starts are looked for", least=1)
    telling: float = option(0.1, "beginning that tells a start that is not fitted: few fly longer", "s", above=0)
    fewest_steps: int = option(8, "control steps of that, at least: two unknowns of six coordinates", least=2)
    damping: float = option(1e-2, "of the first step of longer ones, at most", above=0)
    widest: float = option(
        0.02, "differences that they begin with: contact jumps over shorter ones", above=0, below=0.5
    )
    finer: float = option(8.0, "factor by which differences shrink where nothing is left to gain over them", above=1)
    rougher: float = option(2.0, "growth of the slope over shorter differences that tells jumps", above=1)
    shares: tuple[float, ...] = option((1.0, 0.4, 0.1, 0.0), "of its step, of which a start takes the best")
    groups: int = option(8, "groups of windows fitted apart at most, two windows each at least", least=4)
    fewest: int = option(4, "groups whose scatter says something", least=4)
    reliable: int = option(6, "groups among which some may be told to be lost", least=4)
    rough: float = option(3.0, "scatter over what the linearisation says from which that is not believed", above=1)
    lost: float = option(10.0, "distance from the median of a group whose search was lost", "robust sds", above=0)


@dataclass(frozen=True)
class FollowedTuning(Options):
    """Which windows count as followed through impacts, and when their optimum is the posterior; see ``followed``."""

    chance: float = option(0.05, "that a right model's noise leaves any window out", above=0)
    far: float = option(4.0, "from which a sample is left out: noise alone lies there once in 16,000", "sds", above=0)
    most_far: float = option(0.05, "of a window's samples of a channel: with more it is not followed", above=0, most=1)
    least: int = option(2, "samples that count in a window, however long they remember", "samples", least=1)
    wider: float = option(1e-3, "change of theta over which slopes are compared", "of the cube", above=0)
    differs: float = option(0.5, "of the larger slope, by which the two may differ in a window", above=0)
    matters: float = option(1.0, "that a parameter moves a window over its range: smaller slopes", "sds", above=0)
    first: int = option(6, "control steps on which starts of lost windows are looked for first", least=1)
    rounds: int = option(6, "in which windows are chosen; but for the last a step follows each", least=1)
    settled: float = option(0.1, "that a step has to promise", "nats", above=0)
    fewest: int = option(4, "followed windows that say something", least=1)
    share: float = option(0.25, "of the windows that has to be followed: fewer are those that happen to fit", above=0)
    loose: float = option(1.4, "of the samples' scatter: with so much noise hardly a window is followed", above=1)
    moves: float = option(2.0, "of the simulation's rounding: a channel that scatters less rests", above=0)
    most: float = option(0.5, "of the windows, from which their optimum may be the posterior", above=0, most=1)
    apart: float = option(1e-3, "chance of groups of them as different, below which it is not", above=0, most=1)


@dataclass(frozen=True)
class ContactTuning(Options):
    """How starting points are found from beginnings at known states; see ``contact_starts``."""

    candidates: int = option(60, "points among which they are chosen, by one control step: it is cheap", least=1)
    followed: int = option(6, "of them that go downhill: half of them come to the same place", least=1)
    freedom: float = option(4.0, "degrees of freedom of Student's t: bears windows beyond an impact", above=0)
    growth: float = option(1.25, "how much longer a beginning is than the one before", above=1)
    widest: float = option(0.02, "differences at first: contact jumps over shorter ones", "of the cube", above=0)
    narrowest: float = option(1e-4, "the last ones at least: what follows goes further", "of the cube", above=0)
    finer: float = option(8.0, "factor by which they shrink where nothing is left to gain over them", above=1)
    enough: float = option(1e-3, "gain of a step below which nothing is", "of the energy", above=0)
    most_steps: int = option(40, "steps on one beginning", least=1)
    hopeless: float = option(0.1, "how much worse a place is that is left aside", "nats of a sample", above=0)
    hops: int = option(
        60, "searches from far around the best place, while more than the starts' noise is left", least=0
    )
    far: float = option(8.0, "how far: beyond several jumps", "sds", above=0)
    determined: float = option(0.2, "sd below which single control steps tell a parameter", "of the cube", above=0)
    nearby: int = option(6, "further searches on longer beginnings, from around a place that fits", least=0)
    away: float = option(3.0, "how far around: beyond the next jump", "sds", above=0)
    nearby_share: float = option(0.3, "of the budget: then there are none around one that fits to the end", above=0)
    fitting_share: float = option(0.15, "of the budget: then no more candidates are followed once one fits", above=0)
    first_share: float = option(
        0.45, "of the budget: then there are none from far around, nor around places of a way that ends", above=0
    )
    budget_share: float = option(0.6, "of the budget in all: the rest is the search's", above=0, below=1)
    anew_share: float = option(0.2, "of the budget, that has to be left to begin anew with", above=0)
    long: int = option(256, "control steps from which a log on which nothing touches is fitted so as well", least=32)


@dataclass(frozen=True)
class LongerTuning(Options):
    """When longer windows are tried where starts are not measured, and how; see ``windows.longer_windows``."""

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
    screening: ScreeningTuning = option(ScreeningTuning(), "how starting points are chosen")
    windows: WindowTuning = option(WindowTuning(), "how the search over windows goes")
    growing: GrowingTuning = option(GrowingTuning(), "how windows of bodies that tumble grow")
    followed: FollowedTuning = option(FollowedTuning(), "of which windows the posterior is through impacts")
    contact: ContactTuning = option(ContactTuning(), "how starting points through contact are found")
    longer: LongerTuning = option(LongerTuning(), "what is tried where starts are not measured and short windows fail")
    importance: ImportanceTuning = option(ImportanceTuning(), "draws where the posterior is no normal")
    stretches: StretchTuning = option(StretchTuning(), "how far a posterior is looked at beyond its normal")
    pattern: PatternTuning = option(PatternTuning(), "how the surroundings of an optimum are looked at")
    state_space: ChainTuning = option(ChainTuning(), "how the searches over a chain of states go")


@dataclass(frozen=True)
class LaplaceOptions(Options):
    """What ``Laplace`` takes beside what every estimator takes."""

    restarts: int = option(2, "starting points of a poor fit, at most; with 1 no other optimum is looked for", least=1)
    candidates: int = option(8, "points among which they are chosen: draws from the prior", least=0)
    initial: FloatArray | None = option(None, "the starting points (R, N) themselves instead", "of the cube")
    tuning: LaplaceTuning = option(LaplaceTuning(), "numbers of the search itself")
