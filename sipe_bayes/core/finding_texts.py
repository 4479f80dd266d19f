"""Every code of a finding, how severe it usually is, and its text: the one place where they stand.

A new finding is a line in ``Code`` and an entry in ``TEXTS``; ``{places}`` are filled by ``findings.finding``.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum, auto


class Severity(StrEnum):
    """note: worth knowing. caution: a value or a prediction suffers. blocking: no interval is to be trusted."""

    NOTE = auto()
    CAUTION = auto()
    BLOCKING = auto()


class Code(StrEnum):
    """What a finding is; the names are stable and stand in result.json."""

    # any estimator
    BUDGET_SPENT = auto()
    AT_BOUND = auto()  # a median
    NOT_MIXED = auto()
    SEARCH_SPREAD = auto()

    # searches and Bayesian optimisation
    PRIOR_HARDLY_USED = auto()
    DIVERGED_COUNT_AS_WORST = auto()
    SEARCH_STILL_WIDE = auto()
    BEST_AT_BOUND = auto()
    OTHER_TRAJECTORIES = auto()
    STARTS_NOT_RECORDED = auto()
    EPSILON_IMPROBABLE = auto()
    DENSITY_ROUGH = auto()

    # recalibration
    REFITS_LOST = auto()
    REFITS_NOT_NORMAL = auto()

    # laplace
    DIVERGES_AS_GIVEN = auto()
    SEPARATE_OPTIMA = auto()
    PROCESS_NOISE_UNSETTLED = auto()
    SEARCH_CUT_SHORT = auto()
    SEARCH_UNSETTLED = auto()
    NOT_SMOOTH = auto()
    ROUGH_EVERYWHERE = auto()
    NOT_LOOKED_AROUND = auto()
    TOO_FEW_DRAWS = auto()
    # mcmc
    NONLINEAR_STARTS = auto()
    NONLINEAR_STATES = auto()

    # parameters
    NO_EFFECT = auto()
    DEAD_RANGE = auto()
    NOT_DETERMINED = auto()
    MODE_AT_BOUND = auto()
    RIDGE = auto()
    RIDGE_TO_RESOLVE = auto()
    RIDGE_EXPECTED = auto()
    NEVER_EXCITED = auto()
    NOT_DETERMINED_EXPECTED = auto()
    UNEVEN_TARGETS = auto()

    # what the model lacks
    NO_MISFIT = auto()
    SMALL_MISFIT = auto()
    MISFIT = auto()
    MISFIT_SHIFTS = auto()
    MISFIT_UNKNOWN = auto()
    RESIDUALS_LEFT_OUT = auto()
    PROCESS_NOISE = auto()
    PROCESS_OUTLIERS = auto()
    PROCESS_NOISE_SMALL = auto()
    PROCESS_NOISE_LARGE = auto()

    # logs
    WITHIN_PRIOR = auto()
    OUTSIDE_PRIOR = auto()
    OUTSIDE_PRIOR_UNKNOWN = auto()
    LOGS_DISAGREE = auto()
    LOGS_DISAGREE_UNEXPLAINED = auto()
    AGREEMENT_UNKNOWN = auto()
    HELD_OUT_DIVERGES = auto()
    HELD_OUT_WORSE = auto()
    LOG_CLOCK = auto()
    LOG_RESAMPLED = auto()
    LOG_GAP = auto()
    LOG_MISSING = auto()
    LOG_BLANK_COMMANDS = auto()
    LOG_CLIPPED = auto()

    # what went in and what came out
    PRIOR_OF_MIXTURE = auto()
    PRIOR_COUNTED_TWICE = auto()
    NOT_EXPORTED = auto()
    BIAS_NOT_EXPORTED = auto()

    # amortised: methods that learn from simulations of the prior
    INVALID_SIMULATIONS = auto()
    STILL_IMPROVING = auto()
    OTHER_EXPERIMENT = auto()
    UNLIKE_SIMULATIONS = auto()
    TRAINED_ANEW = auto()
    ROUNDED_OUTPUTS = auto()
    FEW_DIFFERENT_PROPOSALS = auto()
    FEW_ACCEPTED = auto()
    INVALID_NEAR_ESTIMATE = auto()


@dataclass(frozen=True)
class Text:
    """How severe a finding usually is, its text with {places}, and what a table's row says of a parameter with it."""

    severity: Severity
    template: str
    row: str = ""


_NOTE, _CAUTION, _BLOCKING = Severity.NOTE, Severity.CAUTION, Severity.BLOCKING

_LOOKS_LIKE = (
    "{cause} ({percent:.2g} % of the residual of {channel}), most in {log} between {start:.3g} and {stop:.3g} s"
)
_NOT_NOISE = "the residuals are not noise (p = {p:.2g}): they look like " + _LOOKS_LIKE
_RIDGE = "{combination} = {value:.4g} ± {width:.1g}{unit} "

TEXTS: dict[Code, Text] = {
    # any estimator
    Code.BUDGET_SPENT: Text(_CAUTION, "the budget of {budget} rollouts ran out before the method had converged"),
    Code.AT_BOUND: Text(
        _CAUTION,
        "{parameters} at a bound: the truth may lie beyond it; widen the bounds, or look at the residuals",
    ),
    Code.NOT_MIXED: Text(
        _BLOCKING,
        "the {what} have not mixed (R-hat {rhat:.3f}, {ess:.0f} effective{unit}): {remedy} before you trust the "
        "intervals",
    ),
    Code.SEARCH_SPREAD: Text(
        _BLOCKING,
        "the spread of {method} is that of its search, not an uncertainty: use laplace or mcmc, or in Python "
        "sipe.Recalibrated",
    ),
    # searches and Bayesian optimisation
    Code.PRIOR_HARDLY_USED: Text(_CAUTION, "{method} searches within the bounds and {use}; bayesopt and npe count it"),
    Code.DIVERGED_COUNT_AS_WORST: Text(
        _CAUTION,
        "{count} of {total} simulations {failure} and counted as worst; narrow the bounds if they are many",
    ),
    Code.SEARCH_STILL_WIDE: Text(
        _CAUTION,
        "the search is still wide (sd {sd:.2f} of the bounds' range): raise the budget, or expect nothing of it",
    ),
    Code.BEST_AT_BOUND: Text(
        _CAUTION, "the best point has {parameters} at a bound: the truth may lie beyond it; widen the bounds"
    ),
    Code.OTHER_TRAJECTORIES: Text(
        _BLOCKING, "the costs are those of other trajectories than these: the posterior is theirs"
    ),
    Code.STARTS_NOT_RECORDED: Text(
        _BLOCKING,
        "the trajectories have no recorded states: errors of the windows' estimated starts are not in the posterior; "
        "compare it with laplace or mcmc",
    ),
    Code.EPSILON_IMPROBABLE: Text(
        _CAUTION,
        "most of the posterior lies where a cost as low as epsilon is improbable ({probability:.1g}), because there is "
        "so much room there: the intervals are about the prior's; take the mode, evaluate more, or free fewer "
        "parameters",
    ),
    Code.DENSITY_ROUGH: Text(
        _CAUTION,
        "the density is known up to a factor only (log normaliser +- {error:.2f}): do not compare log_prob between "
        "runs",
    ),
    # recalibration
    Code.REFITS_LOST: Text(
        _CAUTION,
        "{share:.0%} of the replicas diverged or could not be fitted: the recalibrated intervals speak of the others "
        "only",
    ),
    Code.REFITS_NOT_NORMAL: Text(
        _CAUTION,
        "the estimates of simulated logs do not scatter normally about a line in theta (p = {p:.1g}): the "
        "recalibrated intervals are approximate; verify them with `sipe check`",
    ),
    # laplace
    Code.DIVERGES_AS_GIVEN: Text(_CAUTION, "the model as given diverges on these logs; the search started elsewhere"),
    Code.SEPARATE_OPTIMA: Text(
        _CAUTION, "the search found {count} separate optima; the posterior is a mixture of them"
    ),
    Code.PROCESS_NOISE_UNSETTLED: Text(
        _BLOCKING, "the process noise had not settled: do not rely on the intervals; more restarts may help"
    ),
    Code.SEARCH_CUT_SHORT: Text(
        _BLOCKING,
        "the budget ended before the search had settled: the estimate is the best so far, and its intervals are "
        "guessed from the way it has come; raise the budget",
    ),
    Code.SEARCH_UNSETTLED: Text(
        _BLOCKING,
        "the search had not settled after {steps} steps: look at the residuals before you trust the intervals",
    ),
    Code.NOT_SMOOTH: Text(
        _BLOCKING,
        "at the optimum the linearisation still foretold a gain of {gain:.1f} nats that no step found: the "
        "simulation is not smooth there (friction, contact or delay); compare with mcmc before you trust the "
        "intervals",
    ),
    Code.ROUGH_EVERYWHERE: Text(
        _BLOCKING,
        "the simulation is rough at every scale around the optimum (contact): the intervals hold what fits no worse "
        "than its nearest neighbours, and the search may have missed a better place; compare with npe or bayessim",
    ),
    Code.NOT_LOOKED_AROUND: Text(
        _BLOCKING,
        "the budget left no room to look around the optimum: where contact is rough, the intervals may be too narrow",
    ),
    Code.TOO_FEW_DRAWS: Text(
        _BLOCKING,
        "the posterior is no normal, and {draws} draws from it came to {effective:.1f} effective ones: compare with "
        "mcmc before you trust the intervals",
    ),
    # mcmc
    Code.NONLINEAR_STARTS: Text(
        _CAUTION, "the windows' starts are strongly nonlinear (error {error:.2f} nats): use shorter windows"
    ),
    Code.NONLINEAR_STATES: Text(
        _CAUTION,
        "the states are strongly nonlinear (error {error:.2f} nats): hold the intervals against those of laplace",
    ),
    # parameters
    Code.NO_EFFECT: Text(
        _CAUTION, "{parameters} changes nothing in these logs; its posterior is its prior", "changes nothing"
    ),
    Code.DEAD_RANGE: Text(
        _CAUTION, "{parameters} changes nothing between {ranges} {unit}", "part of its range changes nothing"
    ),
    Code.NOT_DETERMINED: Text(
        _CAUTION, "{parameters} is not determined by these logs (contraction {contraction:.2f})", "not determined"
    ),
    Code.MODE_AT_BOUND: Text(
        _CAUTION,
        "{parameters} is at its bound {bound:.4g} {unit}: widen it, unless the bound is physical",
        "at a bound",
    ),
    Code.RIDGE: Text(_NOTE, _RIDGE + "is determined; {alone} not"),
    Code.RIDGE_TO_RESOLVE: Text(_CAUTION, "{ridge}: fix one of them at a measured value"),
    Code.RIDGE_EXPECTED: Text(_CAUTION, _RIDGE + "would be determined; {alone} not"),
    Code.NEVER_EXCITED: Text(_CAUTION, "{parameters} is never excited: its posterior will be what is known now"),
    Code.NOT_DETERMINED_EXPECTED: Text(
        _CAUTION, "{parameters} would not be determined (expected contraction {contraction:.2f})"
    ),
    Code.UNEVEN_TARGETS: Text(
        _CAUTION,
        "{parameters}: its targets have different values in the model, so 'the model as given' stands for all at "
        "{default:.4g} {unit}",
    ),
    # what the model lacks
    Code.NO_MISFIT: Text(
        _NOTE, "the residuals pass for noise (p = {p:.2g}); what they resemble most is " + _LOOKS_LIKE
    ),
    Code.SMALL_MISFIT: Text(
        _CAUTION,
        _NOT_NOISE + "; a small effect that moves no parameter by more than {far:g} sd: {remedy} if you need more",
    ),
    Code.MISFIT: Text(_CAUTION, _NOT_NOISE + "; do not trust the intervals' width: {remedy}", "model lacks something"),
    Code.MISFIT_SHIFTS: Text(
        _CAUTION,
        _NOT_NOISE + "; with it in the model the estimate would move, {moved}: {remedy}",
        "model lacks something",
    ),
    Code.MISFIT_UNKNOWN: Text(_CAUTION, "whether the residuals are noise is unknown: {reason}"),
    Code.RESIDUALS_LEFT_OUT: Text(
        _NOTE,
        "Residuals, and whether they are noise: with likelihood = 'state_space' the state is unknown at every sample, "
        "and process noise, which is inferred, takes what the model lacks. Errors and signals are over windows from "
        "measured starts.",
    ),
    Code.PROCESS_NOISE: Text(
        _NOTE,
        "Process noise is largest in the {coordinate}: its sd is {sd:.2g}, {percent} % of how far that moves in a "
        "control step.",
    ),
    Code.PROCESS_OUTLIERS: Text(
        _NOTE,
        "{count} of {steps} control steps stand out and count for little, as where a contact is missed: at {times}.",
    ),
    Code.PROCESS_NOISE_SMALL: Text(_NOTE, "The model follows the logs closely{elsewhere}."),
    Code.PROCESS_NOISE_LARGE: Text(
        _NOTE,
        "A model that lacks nothing needs next to none: look for what it lacks there before you trust the values.",
    ),
    # logs
    Code.WITHIN_PRIOR: Text(_NOTE, "log {log} is like simulations of the prior (p = {p:.2g})"),
    Code.OUTSIDE_PRIOR: Text(
        _BLOCKING,
        "log {log} is unlike simulations of the prior (p = {p:.2g}), most in {channel} at {time:.3g} s: widen the "
        "bounds, or correct the model, units or signs",
    ),
    Code.OUTSIDE_PRIOR_UNKNOWN: Text(_CAUTION, "whether the logs lie within the prior is unknown: {reason}"),
    Code.LOGS_DISAGREE: Text(
        _CAUTION,
        "the logs disagree about {parameters} (p = {p:.1g}): {estimates} {unit}; give it per_log = true, model what "
        "changed, or leave a log out{without}",
        "disagrees between logs",
    ),
    Code.LOGS_DISAGREE_UNEXPLAINED: Text(
        _CAUTION,
        "the logs disagree (p = {p:.1g}) and no single parameter explains it: the model lacks something that differs "
        "between them; {parameters} explains most ({estimates} {unit}){without}",
        "disagrees between logs",
    ),
    Code.AGREEMENT_UNKNOWN: Text(_CAUTION, "log {log} could not be fitted by itself; whether it agrees is unknown"),
    Code.HELD_OUT_DIVERGES: Text(_CAUTION, "held-out {log}, {channel}: the calibrated model diverges there"),
    Code.HELD_OUT_WORSE: Text(
        _CAUTION,
        "held-out {log}, {channel}: {rmse:.3g} {unit} is not better than the model as given ({rmse_default:.3g})",
    ),
    Code.LOG_CLOCK: Text(
        _NOTE, "{samples} samples passed through unchanged at {rate}; clock jitter {jitter_ms:.3g} ms"
    ),
    Code.LOG_RESAMPLED: Text(
        _NOTE, "{samples} samples at {own_rate}, clock jitter {jitter_ms:.3g} ms, resampled to {rate}"
    ),
    Code.LOG_GAP: Text(_NOTE, "no measurement from {start:.3f} to {stop:.3f} s; commands are held there"),
    Code.LOG_MISSING: Text(_NOTE, "{channel}: {missing} of {samples} samples missing, masked"),
    Code.LOG_BLANK_COMMANDS: Text(_NOTE, "{channel}: {blank} blank commands, the one before is held"),
    Code.LOG_CLIPPED: Text(_NOTE, "{channel}: {clipped} samples stuck at an extreme value, perhaps saturated"),
    # what went in and what came out
    Code.PRIOR_OF_MIXTURE: Text(
        _CAUTION,
        "the earlier posterior is a mixture of {components} normals; one with its mean and covariance stands for it",
    ),
    Code.PRIOR_COUNTED_TWICE: Text(
        _CAUTION,
        "the earlier posterior has seen {logs} already: counted twice, the intervals come out too narrow",
    ),
    Code.NOT_EXPORTED: Text(_CAUTION, "{reason}"),
    Code.BIAS_NOT_EXPORTED: Text(
        _CAUTION, "identified.xml has no place for the sensor bias {parameters!r}; subtract it from the measurement"
    ),
    # amortised: methods that learn from simulations of the prior
    Code.INVALID_SIMULATIONS: Text(
        _CAUTION, "{invalid} of {made} simulations {failure}, {place}; the others were used"
    ),
    Code.STILL_IMPROVING: Text(_CAUTION, "the training was still improving after {passes} {unit}; raise {argument}"),
    Code.OTHER_EXPERIMENT: Text(
        _BLOCKING,
        "the log's {differs} differ from those that the simulations replayed: the posterior is that of another "
        "experiment; fit again with this log",
    ),
    Code.UNLIKE_SIMULATIONS: Text(
        _BLOCKING,
        "the log is unlike every simulation: widen the bounds, or correct the model, before you trust the result",
    ),
    Code.TRAINED_ANEW: Text(
        _NOTE, "the log's {differs} differ from those that were learned for: simulated and trained anew"
    ),
    Code.ROUNDED_OUTPUTS: Text(
        _CAUTION, "x{outputs} vary by {sd:.0e} only, as rounding does; give fn's outputs in smaller units"
    ),
    Code.FEW_DIFFERENT_PROPOSALS: Text(
        _CAUTION,
        "round {number} looks where the prior hardly goes: {different:.0%} of its theta are different ones; take fewer "
        "rounds, or a larger ``truncated``",
    ),
    Code.FEW_ACCEPTED: Text(
        _CAUTION, "only {accepted} simulations were accepted; raise the budget or the accepted fraction"
    ),
    Code.INVALID_NEAR_ESTIMATE: Text(
        _CAUTION,
        "{invalid} of {made} simulations near the estimate {failure}; the gradient steps took the others",
    ),
}
