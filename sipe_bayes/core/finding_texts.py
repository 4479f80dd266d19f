"""Every code of a finding, how severe it usually is, and its text: the one place where they stand.

A new finding is an entry of ``Code``; ``{places}`` are filled by ``findings.finding``.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum, StrEnum, auto, unique


class Severity(StrEnum):
    """note: worth knowing. caution: a value or a prediction suffers. blocking: no interval is to be trusted."""

    NOTE = auto()
    CAUTION = auto()
    BLOCKING = auto()


@dataclass(frozen=True)
class Text:
    """How severe a finding usually is, its text with {places}, and what a table's row says of a parameter with it."""

    severity: Severity
    template: str
    row: str = ""


def note(template: str) -> Text:
    """The text of a note."""
    return Text(Severity.NOTE, template)


def caution(template: str, row: str = "") -> Text:
    """The text of a caution."""
    return Text(Severity.CAUTION, template, row)


def blocking(template: str, row: str = "") -> Text:
    """The text of what blocks."""
    return Text(Severity.BLOCKING, template, row)


_NOT_NOISE = (
    "the residuals are not noise ({p}): they look like {cause} ({percent:.3g} % of the residual of {channel}), most in "
    "{log} between {start:.3g} and {stop:.3g} s"
)


@unique
class Code(Enum):
    """What a finding is; the names are stable and stand, in lower case, in result.json."""

    def __str__(self) -> str:
        return self.name.lower()

    # any estimator
    BUDGET_SPENT = blocking(
        "the budget of {budget} rollouts ran out before the method had converged: give a larger one; laplace "
        "goes on with it in the same folder"
    )
    TIME_LIMIT = blocking(
        "The time limit of {seconds:g} s ended the search before it had converged. Run again without a limit to resume"
    )
    INTERNAL_ERROR = caution(
        "The check {check!r} ended with an internal error ({error}, {place}). The fit is not affected; the results of "
        "this check are missing. Please report it"
    )
    CHECKS_SKIPPED = caution("These checks were skipped, because {reason}: {checks}")
    AT_BOUND = caution("{parameters} at a bound: the truth may lie beyond; widen the bounds, or look at the residuals")
    NOT_MIXED = blocking(
        "the {what} have not mixed (R-hat {rhat:.3f}, {ess:.0f} effective{unit}): {remedy} before you trust the "
        "intervals"
    )
    SEARCH_SPREAD = blocking(
        "the spread of {method} is that of its search, not an uncertainty: use laplace or mcmc, or in Python "
        "sipe.Recalibrated"
    )

    # another device than the processor
    ON_PROCESSOR = note(
        "{method} takes finite differences, which float32 is too coarse for: it simulated on the processor in float64, "
        "not on {device}"
    )
    FLOAT32_AGREES = note(
        "{count} of {rollouts} rollouts were simulated again in float64: they differ by at most {percent:.2g} % of "
        "what a channel varies by"
    )
    FLOAT32_DIFFERS = caution(
        "{count} of the {audited} rollouts that were simulated again in float64 differ by more than {tolerance:g} % of "
        "what a channel varies by, the first {steps} control steps ({seconds:.3g} s) after its start: shorter windows, "
        "or the processor"
    )

    # searches and Bayesian optimisation
    PRIOR_HARDLY_USED = caution("{method} searches within the bounds and {use}; bayesopt and npe count it")
    DIVERGED_COUNT_AS_WORST = caution(
        "{count} of {total} simulations {failure} and counted as worst; narrow the bounds if they are many"
    )
    SEARCH_STILL_WIDE = caution("the search is still wide (sd {sd:.2f} of the bounds' range): raise the budget")
    BEST_AT_BOUND = caution("the best point has {parameters} at a bound: the truth may lie beyond it; widen the bounds")
    OTHER_TRAJECTORIES = blocking("the costs are those of other trajectories than these: the posterior is theirs")
    STARTS_NOT_RECORDED = blocking(
        "the trajectories have no recorded states: errors of the windows' estimated starts are not in the posterior; "
        "compare it with laplace or mcmc"
    )
    EPSILON_IMPROBABLE = caution(
        "most of the posterior lies where a cost as low as epsilon is improbable ({probability:.1g}), because there is "
        "so much room there: the intervals are about the prior's; take the mode, evaluate more, or free fewer "
        "parameters"
    )
    DENSITY_ROUGH = caution(
        "the density is known up to a factor only (log normaliser +- {error:.2f}): do not compare log_prob between runs"
    )

    # recalibration
    REFITS_LOST = caution(
        "{share:.0%} of the replicas diverged or could not be fitted: the recalibrated intervals speak of the others "
        "only"
    )
    REFITS_NOT_NORMAL = caution(
        "the estimates of simulated logs do not scatter normally about a line in theta (p = {p:.1g}): the "
        "recalibrated intervals are approximate; verify them with `sipe check`"
    )

    # discover
    SEARCHED_ON_PARTS = note(
        "the search used {used:.3g} of the logs' {all:.3g} s; `sipe calibrate` of its result uses all"
    )
    STRUCTURES_CUT_SHORT = caution(
        "the search ended {why} before {before}{untried}: {remedy}, and the same folder goes on"
    )

    # laplace
    DIVERGES_AS_GIVEN = caution("the model as given diverges on these logs; the search started elsewhere")
    SEPARATE_OPTIMA = caution("the search found {count} separate optima; the posterior is a mixture of them")
    NOT_THE_NORMAL = blocking(
        "The posterior is not the normal that the intervals are taken from: {effective:.1f} of {draws} draws are "
        "effective. Do not rely on the intervals. Compare with mcmc; or give restarts, shorter logs or more channels"
    )
    STARTS_CONTRADICT = blocking(
        "another start of the search ended {distance:.0f} sds away, where process noise explains so much of the logs "
        "that it may be as right: do not rely on the intervals"
    )
    NOISE_EXCEEDS_SCATTER = blocking(
        "The residuals of {channel} are {ratio:.1f} times as large as its samples scatter. Do not rely on the "
        "intervals: the search ended at a wrong optimum, or the model lacks something"
    )
    NOT_JUDGED = blocking(
        "the budget left no room to see whether the posterior is the normal that the intervals are taken from: raise it"
    )
    SEARCH_CUT_SHORT = blocking(
        "the budget ended before the search had settled: the estimate is the best so far, and its intervals are "
        "guessed from the way it has come; give a larger budget, and the same folder goes on"
    )
    SEARCH_UNSETTLED = blocking(
        "The search had not converged after {steps} steps. Do not rely on the intervals; look at the residuals first"
    )
    WILD_SAMPLES = caution(
        "{count} samples of {channels} in {logs} logs were left out of the fit: no smooth motion explains them "
        "(glitches, or what the model lacks)"
    )
    STARTS_AT_REST = blocking(
        "the measurements do not tell the whole pose of joint {joint}: {where} the rest of it where the model has it; "
        "measure {needed}{instead}"
    )
    CHAIN_NOT_FOLLOWED = blocking(
        "joint {joint} of a closed chain does not follow from what is measured all along: the mechanism passes a dead "
        "centre, or its loop does not close; measure joint:{joint}.position"
    )
    IMPACTS = blocking(
        "Bodies strike or slip within the segments of these logs, so the likelihood of segments has many optima. "
        "Use likelihood = 'state_space', in Python sipe.StateSpace()"
    )

    BEYOND_START_NOISE = blocking(
        "The residuals are {times:.1f} times the known measurement noise: the search ended at a wrong optimum, or the "
        "model lacks something. Raise the budget and the restarts"
    )

    # mcmc
    NONLINEAR_STARTS = caution("the windows' starts are strongly nonlinear ({error:.2f} nats): use shorter windows")
    NONLINEAR_STATES = caution(
        "the states are strongly nonlinear (error {error:.2f} nats): hold the intervals against those of laplace"
    )

    # parameters
    NO_EFFECT = caution("{parameters} changes nothing in these logs; its posterior is its prior", "changes nothing")
    DEAD_RANGE = caution("{parameters} changes nothing between {ranges}{unit}", "part of its range changes nothing")
    NOT_DETERMINED = caution(
        "{parameters} is not determined by these logs (contraction {contraction:.2f})", "not determined"
    )
    MODE_AT_BOUND = caution(
        "{parameters} is at its bound {bound:.4g}{unit}: widen it, unless the bound is physical", "at a bound"
    )
    WIDER_AT_BOUND = caution(
        "{parameters}: the interval with what the model lacks is cut at the bound {bound:.4g}{unit}; widen it"
    )
    MEAN_OF_LOGS = caution(
        "{parameters} differs between the logs; held-out ones and identified.xml have the mean, {value:.4g}{unit}"
    )
    NO_RIGID_BODY = caution("{parameters}: in {share:.0f} % of the {density} no rigid body has it (A + B < C)")
    AT_PHYSICAL_BOUND = Text(
        Severity.NOTE,
        "{parameters} is at {bound:.4g}{unit}, and can not be smaller: in this model the logs show none of it up to "
        "the upper end of its interval",
        "none shows",
    )
    RIDGE = caution(
        "{combination} = {value:.4g} ± {width:.1g}{unit} is determined; {alone} not: fix one of them at a measured "
        "value"
    )
    UNEVEN_TARGETS = caution(
        "{parameters}: its targets have different values in the model, so 'the model as given' stands for all at "
        "{default:.4g} {unit}"
    )

    # what the model lacks
    SMALL_MISFIT = caution(
        _NOT_NOISE + "; a small effect that moves no parameter by more than {far:g} sd: {remedy} if you need more"
    )
    MISFIT = caution(_NOT_NOISE + "; {effect}: {remedy}", "model lacks something")
    BEHIND_PLAIN = caution(
        "Free simulations of the training logs miss by {error:.2g} % of the motion with the estimates, and by "
        "{plain:.2g} % with plain least squares"
    )
    LEAST_SQUARES = note(
        "Plain least squares predict better than a fit with correlated noise, or differ from it by more than such "
        "noise allows (Hausman test). Theirs are the estimates; the intervals allow for correlated residuals"
    )
    NOISE_DRIFTS = caution(
        "noise of {channels} has a correlation time as long as the logs ({tau:.2g} s): mostly changes from sample to "
        "sample were fitted, hardly where the motion goes"
    )
    MISFIT_NOT_ASKED = note("It was not tested whether the residuals are noise: bodies touch in most segments")
    NOISE_FREE = note(
        "the model explains the logs but for {share:.0e} of what they move, as where they were simulated without "
        "noise: what is left is rounding, and says nothing of the model; the intervals are those of rounding too"
    )
    UNTOLD = note("{moved}")
    RESIDUALS_LEFT_OUT = note(
        "Residuals, and whether they are noise: with likelihood = 'state_space' the state is unknown at every sample, "
        "and process noise, which is inferred, takes what the model lacks. Errors and signals are over windows from "
        "measured starts."
    )
    PROCESS_NOISE = note(
        "Process noise is largest in the {coordinate}: its sd is {sd:.2g}, {percent} % of how far that moves in a "
        "control step. Steps that stand out and count for little: {count} of {steps}{times}.{meaning}"
    )

    # logs
    OUTSIDE_PRIOR = blocking(
        "log {log} is unlike simulations of the prior ({p}), most in {channel} at {time:.3g} s; {remedy}"
    )
    COLUMN_NOT_FOLLOWED = note(
        "before the fit, the model explains little of the forces that move {channel!r}: {times:.2g} times their change "
        "is left; look at its zero, unit and sign, which sipe init tries, and at what the model lacks"
    )
    LOGS_DISAGREE = blocking("the logs disagree{about} (p = {p:.1g}): {why}{without}", "disagrees between logs")
    TRAIN_WORSE = blocking(
        "on the very logs that it was fitted to the calibrated model is worse than the model as given (its error is "
        "{ratio:.3g} times larger): the search ended in a wrong place; set search.start, narrow the bounds or shorten "
        "the windows"
    )
    HELD_OUT_DIVERGES = caution("held-out {log}, {channel}: the calibrated model diverges there")
    HELD_OUT_WORSE = caution(
        "held-out {log}, {channel}: {rmse:.3g} {unit} is not better than the model as given ({rmse_default:.3g})"
    )
    LOG_CLOCK = note("{samples} samples at {own_rate}, clock jitter up to {jitter_ms:.3g} ms, {done}")
    LOG_GAP = note("no measurement from {start:.3f} to {stop:.3f} s; where rows are missing, commands are held")
    LOG_RATE = note("{channel} comes at {rate}, in one of {every} samples; between them it is not fitted")
    LOG_MISSING = note("{channel}: {missing} of {samples} samples missing, masked")
    LOG_BLANK_COMMANDS = note("{channel}: {blank} blank commands, the one before is held")
    LOG_CLOCKS = note(
        "{count} of {of} columns have clocks of their own and were put on the grid of the others, which begins "
        "{late:.3g} s after the first sample, with the last of the commands"
    )
    LOG_COMMAND_ENDS = caution(
        "{channel}: no command in the last {silent:.3g} s, the one before is held; cut the log there with `span` if "
        "the controller had stopped"
    )
    LOG_JUMPS = caution(
        "{channel} jumps {count} times between two samples, first at {when:.4g} s, where nothing moves so fast: a "
        "counter or an angle that came round, wild samples or lost ones; they rule a fit: mask them or cut the log"
    )
    LOG_WILD = caution("{channel}: {count} samples masked that no smooth motion explains: glitches or lost packets")
    LOG_SLOW = caution(
        "{channels} were recorded at {rate}: too slowly to see what friction and delays do, whose estimates will be "
        "biased; log joints and bodies at 100 Hz or more"
    )
    LOG_CLIPPED = note("{channel}: {clipped} samples stuck at an extreme value: saturated, or at rest")

    # what went in and what came out
    PRIOR_OF_MIXTURE = caution(
        "the earlier posterior is a mixture of {components} normals; one with its mean and covariance stands for it"
    )
    PRIOR_COUNTED_TWICE = caution(
        "the earlier posterior has seen {logs} already: counted twice, the intervals come out too narrow"
    )
    STRUCTURE_UNCERTAIN = caution(
        "Other structures predict these logs as well: the one of this model has a stacking weight of {weight:.2g}. "
        "Intervals hold if its structure is right. The report of `sipe discover` has intervals stacked over all of them"
    )
    COMMAND_DOUBTED = caution(
        "column {column!r} {reason}, and is given as the command of {actuator!r}, which takes {drive}"
    )
    NOT_EXPORTED = caution("{reason}")
    BIAS_NOT_EXPORTED = caution(
        "the MJCF that is written has no place for what a sensor does, {parameters!r}; take it off the measurement"
    )

    # amortised: methods that learn from simulations of the prior
    INVALID_SIMULATIONS = caution("{invalid} of {made} simulations {failure}, {place}; the others were used")
    STILL_IMPROVING = caution("the training was still improving after {passes} {unit}; raise {argument}")
    OTHER_EXPERIMENT = blocking(
        "the log's {differs} differ from those that the simulations replayed: the posterior is that of another "
        "experiment; fit again with this log"
    )
    UNLIKE_SIMULATIONS = blocking("the log is unlike every simulation ({p}): widen the bounds or correct the model")
    TRAINED_ANEW = note("the log's {differs} differ from those that were learned for: simulated and trained anew")
    ROUNDED_OUTPUTS = caution("x{outputs} vary by {sd:.0e} only, as rounding does; give fn's outputs in smaller units")
    FEW_DIFFERENT_PROPOSALS = caution(
        "round {number} looks where the prior hardly goes: {different:.0%} of its theta are different ones; take fewer "
        "rounds, or a larger ``truncated``"
    )
    FEW_ACCEPTED = caution("only {accepted} simulations were accepted; raise the budget or the accepted fraction")
    INVALID_NEAR_ESTIMATE = caution(
        "{invalid} of {made} simulations near the estimate {failure}; the gradient steps took the others"
    )


TEXTS: dict[Code, Text] = {code: code.value for code in Code}
