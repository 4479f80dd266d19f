"""Every threshold of a verdict, each with its unit and its reason: the one place where they stand.

A threshold decides what is said of a result: at a bound, determined, mixed, worse. How a search proceeds is an option
of its method, and a numerical tolerance stands where it is used. A new threshold is a field of ``Thresholds``.
"""

from __future__ import annotations

from dataclasses import dataclass

from sipe_bayes.core.options import Options, option


@dataclass(frozen=True)
class Thresholds(Options):
    """What a number has to reach for something to be said of it."""

    # one parameter
    at_bound: float = option(
        0.02,
        "a median or mode nearer to a bound than this sits on it: a truth beyond would have pushed it there",
        "of the range",
    )
    bound_sds: float = option(1.0, "the same of a mode that is nearer than at_bound and than so many of its sds", "sds")
    not_determined: float = option(
        0.5,
        "a parameter that contracts less keeps more than half of the prior's sd: the logs do not determine it",
        "contraction",
    )
    task_determines: float = option(
        0.5,
        "a log of the benchmark that leaves less of a parameter counts as determining it, whatever methods say",
        "of the prior's sd",
    )
    well_determined: float = option(
        0.8, "a parameter that contracts more has an interval of at most a fifth of the prior's", "contraction"
    )
    idle: float = option(0.1, "a calibrated posterior that contracts less says no more than the prior", "contraction")
    no_effect: float = option(
        1e-7,
        "a parameter that moves no channel by more changes nothing: ten times what rounding of a rollout does",
        "of the signal's spread",
    )

    # several parameters
    ridge: float = option(
        0.03,
        "an eigenvalue of the correlation matrix below it: the combination is six times better known than its members",
        "of one",
    )
    ridge_member: float = option(
        0.25, "a parameter with a smaller loading is no member of a ridge", "of the largest loading"
    )

    sure_of_structure: float = option(
        0.9,
        "a structure with a smaller stacking weight leaves out of a 90 % interval more than that interval does",
        "weight",
    )

    # logs and what the model lacks
    logs_disagree: float = option(
        0.01, "false alarms of logs that agree; rare, since each pair of logs is a chance", "p-value"
    )
    slow_log: float = option(
        25.0, "a joint stops, turns round and answers within a hundredth of a second or two: slower logs miss it", "Hz"
    )
    misfit: float = option(
        0.05, "false alarms of residuals that are noise, and of logs that the prior gives", "p-value"
    )
    unlike: float = option(
        0.01, "false alarms of logs that simulations of a trained method are held against", "p-value"
    )
    followed: float = option(
        0.5, "simulations that leave less follow a log: wrong units and signs leave about all", "of its bends"
    )
    rounding: float = option(1e-5, "residuals below it are rounding, of which nothing is asked", "of what a log moves")
    small_misfit: float = option(
        0.1, "a cause that explains less of every channel's residual is small", "of the residual"
    )
    much_process_noise: float = option(
        0.1, "process noise below it leaves the motion to the model", "of the movement in a control step"
    )
    far_shift: float = option(
        1.0, "a parameter that would move further if the model had the cause is not to be trusted", "posterior sds"
    )

    # predictions of held-out logs
    comparison: float = option(0.05, "false alarms of two models that predict alike", "p-value of the paired t-test")
    band_off: float = option(
        0.05,
        "bands that hold so much more or less than they say, beyond two standard errors, are not relied on",
        "share",
    )
    method_comparison: float = option(
        0.05, "false alarms of one method compared with another, or with a baseline", "p-value"
    )
    alike: float = option(1.05, "errors within this factor of one another count as the same", "ratio")
    same: float = option(1.005, "errors within this factor agree to about three digits: they are the same", "ratio")
    starts_rule: float = option(
        0.95, "measured starts that make more of the error rule it: both models get starts of their own", "of the error"
    )

    # chains and calibration
    mixed: float = option(1.05, "chains with a larger R-hat have not mixed", "R-hat")
    miscalibrated: float = option(
        0.01, "false alarms of one check of all parameters when every posterior is right", "p-value"
    )
    shown_interval: float = option(0.9, "the central interval whose coverage sentences speak of", "of the mass")

    pareto_k: float = option(
        0.7, "above it importance weights have so heavy a tail that no number of draws mends them", "Pareto shape k"
    )
    least_effective_share: float = option(
        0.1, "weights of which less is effective are of a normal one and a half sds off, whatever k", "of the draws"
    )
    effective_share: float = option(
        0.5, "weights of which more is effective are nearly alike, whatever the shape of their tail", "of the draws"
    )

    start_noise: float = option(
        1e-3, "below it noise of what simulations leave would not be as small as that of known starts", "probability"
    )
    contradiction: float = option(
        1e-3, "below it two starts of a search that ended as far apart would contradict each other", "probability"
    )

    noise_excess: float = option(
        2.0, "fitted noise that is so much larger than a channel's scatter from sample to sample is none", "of that"
    )

    gross: float = option(0.25, "from which residuals are a good part of what a channel does", "of its spread")

    # searches
    search_wide: float = option(
        0.15, "a search whose distribution is wider was cut short: half of a uniform prior's sd", "sd, of the range"
    )
    best_at_bound: float = option(
        2e-3, "an evaluated point nearer to a bound went there as far as it could", "of the range"
    )
    mixed_draws: float = option(400.0, "fewer effective draws tell an interval's ends badly", "draws")
    epsilon_probability: float = option(
        0.01, "where epsilon is less probable at the median draw, the prior's room rules", "probability"
    )
    rough_density: float = option(0.2, "a larger standard error of log Z moves a density by a fifth", "nats")

    # a GPU's simulations
    float32_difference: float = option(
        0.01, "where float32 and float64 differ by more, rounding shows beside what parameters do", "of a spread"
    )

    # recalibration
    refits_lost: float = option(0.1, "more refits that fail leave out a part of the prior", "of the refits")
    refits_odd: float = option(0.01, "false alarms of estimates that scatter normally about a line", "p-value")

    # amortised methods
    few_valid: int = option(10, "of fewer valid simulations nothing is learned", "simulations")
    few_accepted: int = option(30, "the spread of fewer accepted draws says little", "draws")
    invalid_elsewhere: float = option(
        1e-3,
        "false alarms of invalid simulations that lie all over the prior; rare, as each parameter is a chance",
        "p-value",
    )
    first_sample_sds: float = option(
        3.0, "a log that begins further from all simulations has another start", "sds of the noise"
    )
    noise_ratio: float = option(
        2.0,
        "a training serves no log whose noise differs more: estimates from 60 samples do in less than 1 % of pairs",
        "ratio of sds",
    )


THRESHOLDS = Thresholds()
