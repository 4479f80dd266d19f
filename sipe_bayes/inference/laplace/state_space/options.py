"""Tuning of the search over a chain of states, each number with its reason."""

from __future__ import annotations

from typing import ClassVar

from sipe_bayes.inference.laplace.levenberg_marquardt import DampingRule


class NoiseTuning:
    """How noise sds are guessed and estimated; see ``noise``."""

    freedom: ClassVar[float] = 4.0  # degrees of freedom of the Student t that weighs jumps in the regression
    free_share: ClassVar[float] = 0.1  # process noise where not every coordinate is measured (of the movement)
    shares: ClassVar[int] = 4  # first guesses tried: that, and tenths of it
    most_factor: ClassVar[float] = 10.0  # how far a noise sd may move at a time: the linearisation is of the old one
    search_steps: ClassVar[int] = 12  # steps of an estimate, which the next one goes on from
    least_share: ClassVar[float] = 1e-5  # least process noise: below it rounding rules (of the movement)
    prior_power: ClassVar[float] = 0.5  # power of a process noise in its prior, which keeps it off zero


class AverageTuning:
    """How theta's normal is averaged over the noise; see ``noise_average``."""

    draws: ClassVar[int] = 800  # Metropolis steps at most, along one axis of the noise each: an eliminated chain
    exact: ClassVar[float] = 0.01  # relative error of the sds with which it ends earlier
    step: ClassVar[float] = 2.4  # length of a step (sds of the normal)
    least_curvature: ClassVar[float] = 0.5  # of an axis, which bounds that sd: process noise may be open below
    difference: ClassVar[float] = 0.2  # of the logarithms, for the curvature


class OutlierTuning:
    """Which jumps become outliers; see ``outlying_jumps``."""

    stands_out: ClassVar[float] = 2.5  # size from which a jump is proposed (of the median jump)
    most: ClassVar[float] = 0.05  # share of the jumps that may be outliers, also the probability of one
    proposals: ClassVar[int] = 3  # how often a search proposes some


class SmoothingTuning:
    """How the search from measured states goes; see ``search``."""

    tolerance: ClassVar[float] = 0.5  # nats that a step must promise; less does not show in an interval (nats)
    still: ClassVar[float] = 0.01  # move of theta below which the regression ends (of the cube)
    most_regressions: ClassVar[int] = 6  # steps of the regression
    same: ClassVar[float] = 2 * still  # distance of regressed thetas that is none (of the cube)
    first_steps: ClassVar[int] = 3  # steps before the first estimate of the noise, which was only guessed
    steps: ClassVar[int] = 2  # steps between estimates of the noise
    most_estimates: ClassVar[int] = 10  # estimates of the noise
    settled: ClassVar[float] = 1.0  # gain below which a new noise does not matter (nats)
    blind: ClassVar[float] = 1.0  # damping above which short differences tell nothing of steps: wide ones take over
    most_filters: ClassVar[int] = 3  # estimates of the noise after which the filter runs
    dropped: ClassVar[float] = 0.5  # drop of the process noise after which it does (mean logarithm)
    filter_steps: ClassVar[int] = 4  # steps from the filter's states
    filter_width: ClassVar[float] = 4.0  # of the first states' covariance, where the filter begins


class WideTuning:
    """How steps by differences as long as the posterior is wide go; see ``posterior_linearisation``."""

    tolerance: ClassVar[float] = SmoothingTuning.tolerance  # nats that a step must promise
    alike: ClassVar[float] = 0.3  # how far the mean, and logs of the sds, differ of normals that are alike (sd)
    steps: ClassVar[int] = 3  # steps between estimates of the noise
    most_estimates: ClassVar[int] = 20  # estimates of the noise
    last_estimates: ClassVar[int] = 4  # the same where the search was likeliest, if it ended elsewhere
    settled: ClassVar[float] = 2.0  # gain below which a new noise does not matter (nats)
    settled_each: ClassVar[float] = 0.01  # the same where more: contact is rough (nats of a measurement)
    still: ClassVar[float] = 0.1  # how far a parameter has moved that has not (squared sds)
    as_good: ClassVar[float] = 10.0  # how much likelier an estimate that has settled may be left (nats)
    least_theta_step: ClassVar[float] = 1e-4  # shortest difference by theta: rounding (of the cube)
    most_theta_step: ClassVar[float] = 0.1  # longest one: a line is none across the cube (of the cube)
    least_state_step: ClassVar[float] = 1e-6  # shortest difference by states: rounding (rad or m, and a second)
    most_state_step: ClassVar[float] = 0.3  # longest one: a line is none across a step (of the movement)
    linearisations: ClassVar[int] = 5  # taken about an optimum through contact, for the scatter of its mean


class ChainTuning:
    """Numbers of the search over a chain of states."""

    damping: ClassVar[DampingRule] = DampingRule()  # how steps are damped
    noise: ClassVar[NoiseTuning] = NoiseTuning()  # how noise is guessed and estimated
    noise_average: ClassVar[AverageTuning] = AverageTuning()  # how intervals are averaged over the noise
    outliers: ClassVar[OutlierTuning] = OutlierTuning()  # which jumps become outliers
    smoothing: ClassVar[SmoothingTuning] = SmoothingTuning()  # the search from measured states
    wide: ClassVar[WideTuning] = WideTuning()  # steps by differences as long as the posterior is wide
    absorbed: ClassVar[float] = 0.1  # share of the samples that process noise explains, from which segments lead
