"""Tuning of the searches over a chain of states, each number with its reason."""

from __future__ import annotations

from dataclasses import dataclass

from sipe_bayes.core.options import Options, option
from sipe_bayes.inference.laplace.levenberg_marquardt import DampingRule


@dataclass(frozen=True)
class NoiseTuning(Options):
    """How noise sds are guessed and estimated; see ``noise``."""

    freedom: float = option(4.0, "degrees of freedom of the Student t that weighs jumps in the regression", above=0)
    free_share: float = option(0.1, "process noise where not every coordinate is measured", "of the movement", above=0)
    shares: int = option(4, "first guesses tried: that, and tenths of it", least=1)
    most_factor: float = option(
        10.0, "how far a noise sd may move at a time: the linearisation is of the old one", above=1
    )
    search_steps: int = option(12, "steps of an estimate, which the next one goes on from", least=1)
    least_share: float = option(
        1e-5, "process noise at least: below it rounding rules the normal equations", "of the movement", above=0
    )
    prior_power: float = option(0.5, "power of a process noise in its prior, which keeps it off zero", above=0)


@dataclass(frozen=True)
class AverageTuning(Options):
    """How theta's normal is averaged over the noise; see ``noise_average``."""

    draws: int = option(800, "Metropolis steps, along one axis of the noise each: an eliminated chain", least=2)
    step: float = option(2.4, "length of a step", "sds of the normal", above=0)
    least_curvature: float = option(0.5, "of an axis, which bounds that sd: process noise may be open below", above=0)
    difference: float = option(0.2, "of the logarithms, for the curvature", above=0)


@dataclass(frozen=True)
class OutlierTuning(Options):
    """Which jumps become outliers; see ``outlying_jumps``."""

    stands_out: float = option(2.5, "size from which a jump is proposed", "of the median jump", above=1)
    most: float = option(0.05, "share of the jumps that may be outliers, also the probability of one", above=0, below=1)
    unsettled_after: int = option(4, "estimates of the noise after which an unsettled search proposes some", least=1)
    proposals: int = option(3, "how often a search proposes some", least=0)


@dataclass(frozen=True)
class SmoothingTuning(Options):
    """How the search from measured states goes; see ``search``."""

    tolerance: float = option(0.5, "nats that a step must promise; less does not show in an interval", "nats", above=0)
    still: float = option(0.01, "move of theta below which the regression ends", "of the cube", above=0)
    most_regressions: int = option(6, "steps of the regression", least=1)
    same: float = option(0.02, "distance of regressed thetas that is none", "of the cube", above=0)
    first_steps: int = option(3, "steps before the first estimate of the noise, which was only guessed", least=1)
    steps: int = option(2, "steps between estimates of the noise", least=1)
    most_estimates: int = option(10, "estimates of the noise", least=1)
    settled: float = option(1.0, "gain below which a new noise does not matter", "nats", above=0)
    most_filters: int = option(3, "estimates of the noise after which the filter runs", least=0)
    dropped: float = option(0.5, "drop of the process noise after which it does", "mean logarithm", above=0)
    filter_steps: int = option(4, "steps from the filter's states", least=1)
    filter_width: float = option(4.0, "of the first states' covariance, where the filter begins", above=0)


@dataclass(frozen=True)
class WideTuning(Options):
    """How steps by differences as long as the posterior is wide go; see ``posterior_linearisation``."""

    tolerance: float = option(0.5, "nats that a step must promise; less does not show in an interval", "nats", above=0)
    alike: float = option(0.3, "how far the mean, and logs of the sds, differ of normals that are alike", "sd", above=0)
    steps: int = option(3, "steps between estimates of the noise", least=1)
    most_estimates: int = option(10, "estimates of the noise", least=1)
    last_estimates: int = option(4, "the same where the search was likeliest, if it ended elsewhere", least=1)
    settled: float = option(2.0, "gain below which a new noise does not matter", "nats", above=0)
    settled_each: float = option(0.01, "the same where more: contact is rough", "nats of a measurement", least=0)
    still: float = option(0.1, "how far a parameter has moved that has not", "squared sds", above=0)
    as_good: float = option(10.0, "how much likelier an estimate that has settled may be left", "nats", least=0)
    least_theta_step: float = option(1e-4, "shortest difference by theta: rounding", "of the cube", above=0)
    most_theta_step: float = option(0.1, "longest one: a line is none across the cube", "of the cube", above=0)
    least_state_step: float = option(1e-6, "shortest difference by states: rounding", "rad or m, and a second", above=0)
    most_state_step: float = option(0.3, "longest one: a line is none across a step", "of the movement", above=0)
    linearisations: int = option(10, "taken about an optimum through contact, for the scatter of its mean", least=0)


@dataclass(frozen=True)
class ChainTuning(Options):
    """Numbers of the searches over a chain of states."""

    damping: DampingRule = option(DampingRule(least_refused=1e-4), "how steps are damped: a refused one is far off")
    noise: NoiseTuning = option(NoiseTuning(), "how noise is guessed and estimated")
    noise_average: AverageTuning = option(AverageTuning(), "how intervals are averaged over the noise")
    outliers: OutlierTuning = option(OutlierTuning(), "which jumps become outliers")
    smoothing: SmoothingTuning = option(SmoothingTuning(), "the search from measured states")
    wide: WideTuning = option(WideTuning(), "steps by differences as long as the posterior is wide")
    horizon: float = option(0.4, "of the budget, for starting points from known first states", above=0, below=1)
    absorbed: float = option(0.1, "share of the samples that process noise explains, from which segments lead", above=0)
