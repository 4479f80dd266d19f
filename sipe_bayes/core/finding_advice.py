"""What to do about each finding, beyond what its text says: `sipe explain CODE` and the reference print it."""

from __future__ import annotations

import re

from sipe_bayes.core.finding_texts import Code

_COMPARE = "Fit again with `--estimator mcmc` and compare the intervals."
_REMEDY_LACKING = (
    "Run `sipe discover` on the same configuration; it puts in what explains the residuals, and says so. Through "
    "impacts, if it refuses the logs, add what is named as parameters, fit again, and compare the held-out errors."
)
_BOUNDS = (
    "Widen the bounds if the value could lie beyond. Where the bound is physical, zero friction for instance, the "
    "estimate may be right and its interval one-sided. A value that runs away often stands for physics that the model "
    "lacks, or for a wrong sign or unit."
)

ADVICE: dict[Code, str] = {
    Code.BUDGET_SPENT: (
        "Give a larger `budget`: the same command in the same folder goes on with laplace; give other methods another "
        "`--out`."
    ),
    Code.TIME_LIMIT: (
        "The same command without `--time-limit`, or with a longer one, resumes: the limit is no part of the run."
    ),
    Code.INTERNAL_ERROR: (
        "Estimates and intervals are those of the fit. Report the name of the check and the error; the same command "
        "makes the check again."
    ),
    Code.CHECKS_SKIPPED: "Run the same command again: it makes the checks that are missing.",
    Code.AT_BOUND: _BOUNDS,
    Code.NOT_MIXED: (
        "The chains have not forgotten where they began. Raise the budget; fewer free parameters or a parameter "
        "pair on a ridge that is fixed help more than many more steps."
    ),
    Code.SEARCH_SPREAD: (
        "Particles of a search gather where the search went; they may do as a point. For an interval take a method "
        "with a likelihood, or recalibrate."
    ),
    Code.ON_PROCESSOR: "Nothing is wrong. Leave `device` out for this method, or take `npe` or `cem` on a GPU.",
    Code.FLOAT32_AGREES: "Nothing: float32 is as good as float64 for these logs and this model.",
    Code.FLOAT32_DIFFERS: (
        "Where contacts make a motion chaotic, rounding grows like any small difference. Compare shorter pieces "
        "(`window`), or leave `device` out."
    ),
    Code.PRIOR_HARDLY_USED: (
        "An informative prior does not change this method's answer: take `laplace`, `mcmc`, `npe` or `bayesopt` if "
        "it should."
    ),
    Code.DIVERGED_COUNT_AS_WORST: (
        "Some values in the bounds make the simulation explode. A few are harmless; many hide the optimum: narrow "
        "the bounds or take a smaller timestep."
    ),
    Code.SEARCH_STILL_WIDE: "The search ended before it had gathered. More rollouts, or fewer parameters.",
    Code.BEST_AT_BOUND: _BOUNDS,
    Code.OTHER_TRAJECTORIES: "A checkpoint of another fit was taken up. Delete it or name another one.",
    Code.STARTS_NOT_RECORDED: "The method compares simulations from estimated starts, whose errors it does not count.",
    Code.EPSILON_IMPROBABLE: (
        "The search found a good point, but the surrogate spreads over the whole room. Read the mode, not the interval."
    ),
    Code.DENSITY_ROUGH: "Draws and intervals are not affected; only comparisons of `log_prob` between runs are.",
    Code.REFITS_LOST: "Narrow the prior to where the method works, or mend why its fits diverge.",
    Code.REFITS_NOT_NORMAL: (
        "The recalibration's model of the estimates is rough. `sipe check --refits` says whether it still covers."
    ),
    Code.DIVERGES_AS_GIVEN: (
        "The values in the MJCF explode under these commands: look at units and signs of the commands, and at the "
        "timestep."
    ),
    Code.SEPARATE_OPTIMA: (
        "Several places explain the logs about equally well. Look at them in the report; another motion in the log "
        "tells them apart."
    ),
    Code.NOT_THE_NORMAL: (
        "The posterior bends more than a normal follows, or the search stands at a local optimum between contacts. "
        f"Give `search.restarts` and a larger `budget`, cut the logs shorter, or measure velocities. {_COMPARE}"
    ),
    Code.STARTS_CONTRADICT: (
        "Two searches ended in trajectories that exclude each other. Give `search.restarts` and a larger `budget`, cut "
        "the logs shorter, measure velocities, or begin near a value that you trust."
    ),
    Code.NOISE_EXCEEDS_SCATTER: (
        "White noise scatters from one sample to the next as much as in all; this does not. Look at the channel's "
        "residuals. Of a model that is right: give `search.restarts` and a larger `budget`, or cut the logs shorter. "
        "Else see what `sipe discover` finds."
    ),
    Code.NOT_JUDGED: "Raise `budget`: simulating 120 draws from the posterior takes as many rollouts of each log.",
    Code.SEARCHED_ON_PARTS: (
        "Nothing, as a rule: `sipe calibrate` with the discovered configuration fits all of the logs. Where an effect "
        "shows in a few moments only, cut the logs to these."
    ),
    Code.STRUCTURES_CUT_SHORT: (
        "What was not fitted may be what the model lacks. Give a larger budget or more time, with which the same "
        "folder goes on, or fewer candidates by `--only` and `structure.sites`."
    ),
    Code.SEARCH_CUT_SHORT: "Raise `budget`. The message's estimate is a stage on the way.",
    Code.SEARCH_UNSETTLED: (
        "Often a ridge of parameters that act alike, or a rough simulation: fix one of the parameters of a ridge. With "
        f"`state_space` give `measurements.noise_sd` where it is known. {_COMPARE}"
    ),
    Code.WILD_SAMPLES: (
        "Nothing to do for a few. For many see whether the column itself jumps: then look at the sensor, its cable and "
        "its driver; else at what the model lacks."
    ),
    Code.STARTS_AT_REST: (
        "Without a pose a window of a free body starts anywhere but where the body was. Measure it, or take the "
        "likelihood that infers states: then only the errors on held-out logs suffer."
    ),
    Code.CHAIN_NOT_FOLLOWED: (
        "Beyond a dead centre what is measured tells two places of the mechanism. Measure the joint that goes round."
    ),
    Code.IMPACTS: "With `state_space` every sample is a segment of its own, and process noise is estimated.",
    Code.BEYOND_START_NOISE: (
        "Raise `budget`, with another `--out`: the search then begins from more places. Shorter segments have fewer "
        "local optima. If nothing helps, the model lacks something: `sipe discover`."
    ),
    Code.NONLINEAR_STARTS: "Starts are marginalised by a linearisation, which fails over long windows. Halve `window`.",
    Code.NONLINEAR_STATES: "As of starts: states between contacts are linearised. Hold it against `laplace`.",
    Code.NO_EFFECT: (
        "The target is not touched by this motion: a contact that never closes, a limit that is never reached, a "
        "body that does not move. Leave it out, or record what excites it."
    ),
    Code.DEAD_RANGE: (
        "Values there simulate alike, as beyond a limit that is not reached. The interval reaches over all of it; "
        "narrow the bounds to where it acts if you know better."
    ),
    Code.NOT_DETERMINED: (
        "The interval is about the prior's. `sipe suggest --for NAME` says what to send; or fix it at a measured value."
    ),
    Code.MODE_AT_BOUND: _BOUNDS,
    Code.WIDER_AT_BOUND: (
        "The interval would reach further, so that it may miss a value behind the bound. Widen the bounds, unless "
        "nature sets them, and calibrate again."
    ),
    Code.NO_RIGID_BODY: (
        "Nothing is simulated there, and the edge looks as if they were rough. Raise the body's other moments in "
        "the model (of what turns about one axis they do nothing), or narrow the bounds."
    ),
    Code.MEAN_OF_LOGS: (
        "No log had the mean. Where the difference is known, as of a weighed load, say it in the log: `added = "
        '{"body:NAME.mass" = 3.0}`, in held-out logs too; else put the value that you want into the MJCF.'
    ),
    Code.AT_PHYSICAL_BOUND: (
        "While a finding blocks, nothing follows from it: what the fit lacks may stand in its place. Else there is "
        "nothing to do: the model does without it, and the interval is one-sided."
    ),
    Code.RIDGE: (
        "Only the combination acts on the motion. Use it; or weigh, measure or look up one member, and take it out of "
        "the unknowns."
    ),
    Code.UNEVEN_TARGETS: (
        "One value for targets that differ in the model. Use `factor` in place of `bounds` where they should keep "
        "their proportions."
    ),
    Code.SMALL_MISFIT: "The values may be used. For a better prediction put the cause into the model.",
    Code.MISFIT: (f"{_REMEDY_LACKING} Until then read the values as those of a model that is wrong."),
    Code.BEHIND_PLAIN: "Initial states or noise explain what parameters should. Run `sipe discover`.",
    Code.LEAST_SQUARES: "Run `sipe discover`: it looks for the physics that the model lacks.",
    Code.NOISE_DRIFTS: (
        "A model that lacks something leaves such residuals, or a zero that differs between logs: run `sipe discover`. "
        "For predictions compare with "
        '`noise.model = "white"`, whose fit follows the motion itself.'
    ),
    Code.MISFIT_NOT_ASKED: "Judge by the held-out logs.",
    Code.NOISE_FREE: "Nothing to do. A log from a machine has noise: add some before you judge what a log would tell.",
    Code.UNTOLD: (
        "Motion tells masses, inertias and friction only in the scale of the forces, with where they lie, and delays "
        "and a servo's gains with when each joint is read. Weigh one part and fix its mass with `actuator:NAME.gain` "
        "(a servo's `kp`) free; say by `tolerance` of the command how well forces are known, by `geometry_tolerance` "
        "how well the drawing is, by `timing_tolerance` how well time stamps are. Where physics steps are named, write "
        "shorter ones into the model (`<option timestep>`), or use the values in a simulation that takes the same."
    ),
    Code.COLUMN_NOT_FOLLOWED: "Look whether the fit follows it; else at its zero, unit and sign.",
    Code.RESIDUALS_LEFT_OUT: "Look at the size of the process noise in place of the residuals.",
    Code.PROCESS_NOISE: (
        "What the model lacks acts there. A few per cent are usual of a good model; of more add what you suspect as "
        "parameters, or measure with less noise. Where steps stand out, look at the log at these times: a kick, a "
        "contact, a sample that was lost."
    ),
    Code.OUTSIDE_PRIOR: (
        "No values within the bounds simulate such a log. First suspects: unit or sign of that channel, a delay, a "
        "model that was given wrong masses. Then the bounds. Where the calibrated model follows the log, units and "
        "signs are right, and one of twenty right logs is called so: widen the bounds that a value lies at, or run "
        "`sipe discover`."
    ),
    Code.LOGS_DISAGREE: (
        "Did something change between the logs: load, temperature, a zero, a battery, a screw? Then `per_log = "
        "true`. If not, the model lacks what the logs show differently: `sipe discover`."
    ),
    Code.HELD_OUT_DIVERGES: (
        "The calibrated model explodes on a motion that it was not fitted on: look at parameters at a bound, train "
        "on such motion too."
    ),
    Code.TRAIN_WORSE: (
        "The search did not find what it already had. Begin it from better values with `search.start`, narrow the "
        "bounds, or shorten the windows."
    ),
    Code.HELD_OUT_WORSE: (
        "The calibration did not help there. It fits what is peculiar to the training logs, or the model lacks "
        "what matters on this one."
    ),
    Code.LOG_CLOCK: "Nothing to do, unless the jitter is as large as the delays that you look for.",
    Code.LOG_GAP: "Nothing to do where it is short, or rows are there. Else cut it out by `span` if commands changed.",
    Code.LOG_RATE: "Nothing to do.",
    Code.LOG_MISSING: "Nothing to do: masked samples are not fitted.",
    Code.LOG_BLANK_COMMANDS: "See that a blank means 'as before' in your log and not 'off'.",
    Code.LOG_CLOCKS: "See that all clocks count from the same instant: an offset between them looks like a delay.",
    Code.LOG_COMMAND_ENDS: "A held command drives the simulation when the machine's controller may have stopped.",
    Code.LOG_JUMPS: (
        "An angle that comes round takes `wraps = true`. Leave wild samples out (an empty cell is a missing sample), "
        "or cut the log with `span`. A few of them are enough to put every estimate far off."
    ),
    Code.LOG_WILD: "Nothing to do for a few. For many look at the sensor, its cable and its driver.",
    Code.LOG_SLOW: "Record anew at 100 Hz or more; no method finds in a log what is not there.",
    Code.LOG_CLIPPED: "A saturated sensor lies: cut those parts out by `span`, or send less. Rest there is no harm.",
    Code.PRIOR_OF_MIXTURE: "Give the logs of both runs to one fit instead, if the modes lie far apart.",
    Code.PRIOR_COUNTED_TWICE: "Take those logs out of this run, or drop `prior.from`.",
    Code.STRUCTURE_UNCERTAIN: (
        "Compare the values with those of `sipe discover`'s report; where they differ, take its wider intervals, or "
        "record logs that tell the structures apart."
    ),
    Code.COMMAND_DOUBTED: "Name the column that drives the actuator; if this one does, nothing is to be done.",
    Code.NOT_EXPORTED: "The posterior is not touched; only the written model leaves it out.",
    Code.BIAS_NOT_EXPORTED: "A simulated sensor has no such error: correct the measurement where you use it.",
    Code.INVALID_SIMULATIONS: "Narrow the bounds where the simulations explode, if they are more than a few.",
    Code.STILL_IMPROVING: "More training would learn more from the same simulations.",
    Code.OTHER_EXPERIMENT: "The network learned for other commands, lengths or noise. `fit(log, retrain=True)`.",
    Code.UNLIKE_SIMULATIONS: (
        "The network answers for logs that it has seen the like of; of this one it has not. Simulate with noise, "
        "wider bounds, or a better model."
    ),
    Code.TRAINED_ANEW: "Nothing to do but wait.",
    Code.ROUNDED_OUTPUTS: "Outputs that vary by rounding alone tell nothing, and rounding may be taken for a signal.",
    Code.FEW_DIFFERENT_PROPOSALS: "Later rounds learn from few different simulations.",
    Code.FEW_ACCEPTED: "Raise `budget` or `accepted`: the spread of so few draws is itself uncertain.",
    Code.INVALID_NEAR_ESTIMATE: "The estimate lies where simulations explode: look at the bounds and the timestep.",
}


def plain(code: Code) -> str:
    """A finding's text with its places as {words}, without how numbers are written."""
    return re.sub(r"\{(\w+)[^}]*\}", r"{\1}", code.value.template)
