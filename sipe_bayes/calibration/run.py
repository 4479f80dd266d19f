"""A configuration in, a calibration out: what ``sipe calibrate`` does, step by step, also from Python."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

import numpy as np

from sipe_bayes.calibration.checks.fitted import Fit, drifting, from_fitted_states, one_by_one, tamed, with_wild
from sipe_bayes.calibration.checks.followed import not_followed
from sipe_bayes.calibration.checks.lacking import NOTHING_ASKED, Lacking, lacking
from sipe_bayes.calibration.checks.plan import NO_PLAN, Check, Checks, plan_of, rollouts_of, with_checks
from sipe_bayes.calibration.checks.predictions import Compared, Place, Predictions, every_channel, place_in_prior
from sipe_bayes.calibration.checks.ranges import ranges_that_change_nothing
from sipe_bayes.calibration.force_scale import find_open_scale
from sipe_bayes.calibration.gathered import (
    Marginals,
    most_probable,
    no_rigid_bodies,
    of_logs,
    uneven_targets,
    unmeasured_starts,
)
from sipe_bayes.calibration.output import (
    CHECKPOINT,
    CHECKS,
    IDENTITY,
    PACKAGES,
    claimed,
    describe_run,
    write_all,
    write_fit,
)
from sipe_bayes.calibration.problem import Problem, method_of, prepare
from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.checkpoint import NOTHING_KEPT, Kept, fingerprint_of
from sipe_bayes.core.files import installed_version
from sipe_bayes.core.findings import Code, Finding, Findings, Guard, Outcome, finding
from sipe_bayes.core.validation import at_least
from sipe_bayes.diagnostics.agreement import disagreement
from sipe_bayes.diagnostics.bands import band_coverage
from sipe_bayes.diagnostics.result import Calibration
from sipe_bayes.envs.unknowns import bounded_by_nature
from sipe_bayes.inference.base import Estimator
from sipe_bayes.inference.recorded import Progress, digest
from sipe_bayes.inference.registry import estimator_class
from sipe_bayes.likelihood import StateSpace, bind, process_noise_findings
from sipe_bayes.posterior import Particles
from sipe_bayes.structure.discrepancy import LogEstimate

S = TypeVar("S")


def calibrate(
    problem: Problem,
    estimator: str | None = None,
    seed: int | None = None,
    budget: int | None = None,
    checkpoint: Path | None = None,
    progress: Progress | None = None,
    time_limit: float | None = None,
    keep: Callable[[Calibration], object] | None = None,
    announce: Callable[[str], None] | None = None,
) -> Calibration:
    """Fit, check and summarise. An exception in a check is one of the result's ``findings``, and loses nothing else.

    Args:
        problem: a configuration read and bound.
        estimator: default the configuration's.
        seed: default the configuration's.
        budget: rollouts of the fit; default the configuration's, then the estimator's.
        checkpoint: file that an interrupted fit goes on from; what its checks found is kept in `checks` beside it.
        progress: called along the way.
        time_limit: s, after which the search ends with its best estimate and checks are skipped; default none. The
            same call with another limit resumes.
        keep: called with the result of the fit alone, as soon as there is one.
        announce: called with a question that a fit cannot answer, and with a first estimate in words, long before that.
    """
    began = time.monotonic()
    method = method_of(problem, estimator, seed, budget, checkpoint, progress)
    method.time_limit = math.inf if time_limit is None else at_least("time_limit", time_limit, 0)
    method.announce = announce or method.announce
    guard, plan = Guard(began + method.time_limit), NO_PLAN
    if progress is not None:
        plan = guard.run("forecast", lambda: plan_of(problem, method)).otherwise(plan)
        method.progress = with_checks(progress, plan, method, len(problem.train))
    if announce is not None:
        ask = guard.run("scale of the forces", lambda: find_open_scale(problem)).otherwise(())
        if ask:
            announce(
                f"{', '.join(ask)} are not identifiable together: with all of them 10 % larger the motion is the same. "
                "Fix one of them at a measured value, such as a weighed mass; else only their ratios can be used."
            )
    posterior = method.fit(problem.train)
    model, space = problem.simulator.model, problem.environment.space
    marginals = guard.run(
        "marginals of the posterior",
        lambda: Marginals.of(posterior, problem.prior, method.seed, bounded_by_nature(model, space)),
    )
    first = Calibration(
        name=run_name(problem.config.path),
        estimator=method.name,
        posterior=posterior,
        prior=problem.prior,
        parameters=guard.run("summary of each parameter", lambda: marginals.value.summaries()).otherwise([]),
        train=[],
        holdout=[],
        findings=(*problem.findings, *method.findings, *guard.findings),
        logs=list(problem.reports),
        rollouts=method.rollouts,
        seconds=time.monotonic() - began,
        checked=False,
    )
    if keep is not None:
        keep(first)
    kept = guard.run("what is kept of checks", lambda: _kept(problem, method, checkpoint)).otherwise(NOTHING_KEPT)
    checks = Checks(kept, progress, method.rollouts, plan, rollouts_of(problem))
    answers = _checked(problem, method, first, checks, guard)
    result = _described(problem, method, first, marginals, answers, guard)
    return replace(result, seconds=time.monotonic() - began)


def _kept(problem: Problem, method: Estimator, checkpoint: Path | None) -> Kept:
    """What keeps the results of the checks: those of this very fit."""
    held = None if problem.holdout is None else digest(problem.holdout)
    versions = {name: installed_version(name) for name in PACKAGES}
    setup = problem.config.model_dump(mode="json", by_alias=True), method.settings(), digest(problem.train), held
    folder = None if checkpoint is None else checkpoint.parent / CHECKS
    return Kept(folder, fingerprint_of(repr(setup), versions, method.snapshot))


@dataclass(frozen=True)
class _Answers:
    """What the checks say, each as far as it came to its end.

    Args:
        recorded: the problem without the samples that the fit left out.
        fitted: the same with the states that the fit says.
        doubted: whether logs disagree, or the residuals are not noise.
    """

    recorded: Problem
    fitted: Problem
    fit: Outcome[Fit]
    alone: list[LogEstimate]
    conflict: Finding | None
    lacks: Lacking
    further: Particles | None
    predictions: Outcome[Predictions]
    compared: Compared
    place: Place
    bands: dict[str, tuple[FloatArray, FloatArray]]
    dead: dict[str, list[tuple[float, float]]]
    doubted: bool


def _checked(problem: Problem, method: Estimator, first: Calibration, checks: Checks, guard: Guard) -> _Answers:
    """Make the checks, each by itself."""
    posterior, space, seed = first.posterior, problem.environment.space, method.seed

    def check(which: Check, make: Callable[[], S]) -> Outcome[S]:
        return guard.run(which.value, make, skippable=True)

    theta = guard.run("the most probable value", lambda: most_probable(posterior))
    tame = guard.run("samples left out", lambda: replace(problem, train=tamed(problem.train, method)))
    own = tame.otherwise(problem)
    states = guard.run("states of the fit", lambda: from_fitted_states(problem, method))
    fit = check(Check.STARTS, lambda: Fit.of(states.value, method, theta.value, checks))
    alone = check(Check.LOGS, lambda: one_by_one(own, fit.value, checks)).otherwise([])
    conflict = guard.run("agreement of the logs", lambda: disagreement(space, alone)).otherwise(None)
    fitted = replace(own, train=replace(own.train, states=states.otherwise(problem).train.states))
    lacks = check(
        Check.LACKING,
        lambda: lacking(fitted, method, fit.value, posterior, alone, conflict is not None, checks),
    ).otherwise(NOTHING_ASKED)
    further = guard.run("intervals with what the model lacks", lambda: lacks.further(space)).otherwise(None)
    doubted = conflict is not None or (lacks.misfit is not None and lacks.misfit.alarm)
    predictions = check(Check.PREDICTIONS, lambda: Predictions.of(fitted, theta.value, checks))
    compared = check(Check.COMPARISON, lambda: predictions.value.compared(checks)).otherwise(Compared())
    place = check(Check.PRIOR, lambda: place_in_prior(fitted, method, fit.value, predictions.value, checks)).otherwise(
        Place()
    )
    bands = check(
        Check.BANDS,
        lambda: predictions.value.bands(posterior, further if doubted else None, seed, checks),
    ).otherwise({})
    dead = check(Check.RANGES, lambda: ranges_that_change_nothing(fit.value, checks)).otherwise({})
    return _Answers(
        own, fitted, fit, alone, conflict, lacks, further, predictions, compared, place, bands, dead, doubted
    )


def _described(
    problem: Problem,
    method: Estimator,
    first: Calibration,
    marginals: Outcome[Marginals],
    answers: _Answers,
    guard: Guard,
) -> Calibration:
    """The fit with what its checks say, as records and as diagnostics."""
    lacks, predictions = answers.lacks, answers.predictions
    parameters = guard.run(
        "summaries with what the model lacks", lambda: marginals.value.summaries(answers.further)
    ).otherwise(first.parameters)
    ridges = guard.run("ridges", lambda: marginals.value.ridges).otherwise([])
    noise = guard.run("noise of the channels", lambda: answers.fit.value.channel_noise()).otherwise({})
    held = answers.bands.get("holdout")
    bands = guard.run(
        "coverage of the bands", lambda: held and band_coverage(predictions.value.windows["holdout"], *held)
    ).otherwise(None)
    signals = guard.run("signals", lambda: predictions.value.signals(answers.bands)).otherwise([])
    result = replace(
        first,
        parameters=parameters,
        causes=lacks.causes,
        further=answers.further,
        train=predictions.value.train if predictions.made else [],
        holdout=predictions.value.holdout if predictions.made else [],
        signals=signals,
        residuals=list(lacks.residuals),
        ridges=ridges,
        bands=bands,
        comparison=answers.compared.comparison,
        misfit=lacks.misfit,
        outside=list(answers.place.logs),
        noise=noise,
        mixing=method.diagnostics.get("mixing", {}),
        logs=guard.run("samples left out of each log", lambda: with_wild(problem, method)).otherwise(first.logs),
        checked=not guard.is_late,
    )
    noticed = guard.gather(_looks(problem, method, marginals, answers, result))
    return replace(result, findings=(*noticed, *guard.findings))


def _looks(
    problem: Problem, method: Estimator, marginals: Outcome[Marginals], answers: _Answers, result: Calibration
) -> dict[str, Callable[[], Sequence[Finding]]]:
    """What gives the diagnostics, by name, in the order in which they are told."""
    lacks, place, compared = answers.lacks, answers.place, answers.compared
    wider = result.parameters if answers.doubted else ()
    drifts = {} if Findings(lacks.findings).of(Code.NOISE_FREE) else result.noise
    asked = lacks.misfit is not None and not answers.fit.value.windows.impacts
    return {
        "alarms": lambda: [
            *(look.finding for look in (*place.logs, lacks.misfit) if look is not None and look.alarm),
            *problem.findings,
        ],
        "unmeasured starts": lambda: unmeasured_starts(
            problem.simulator, answers.recorded.train, problem.likelihood, problem.holdout is not None
        ),
        "diagnostics of the estimator": lambda: _own(method, asked),
        "rigid bodies": lambda: no_rigid_bodies(problem.environment, result.posterior, method.seed),
        "diagnostics of the checks": lambda: [
            *(
                finding(Code.CHECKS_SKIPPED, checks=Check.LOGS.value, log=name, reason="the simulation diverges")
                for name in (log.name for log in answers.alone if not log.information.any())
            ),
            *lacks.findings,
            *place.findings,
        ],
        "drifting noise": lambda: drifting(drifts),
        "uneven targets": lambda: uneven_targets(problem.environment),
        "disagreement": lambda: [] if answers.conflict is None else [answers.conflict],
        "ridges to resolve": lambda: [ridge.finding for ridge in result.ridges],
        "bounds and contraction": lambda: marginals.value.findings(answers.dead, wider),
        "errors that grew": lambda: compared.findings(result.holdout),
        "logs as read": lambda: of_logs(problem.reports),
        "process noise": lambda: _left_out(answers.fitted, method),
    }


def _own(method: Estimator, asked: bool) -> list[Finding]:
    """What the estimator noticed itself, and what its edge may be; bounds are told by parameter, with their values.

    asked: whether what the model lacks is asked of all windows, so that nothing else need say what is not followed.
    """
    elsewhere = {Code.AT_BOUND, Code.NOISE_EXCEEDS_SCATTER} if asked else {Code.AT_BOUND}
    spread = [] if method.uncertain else [finding(Code.SEARCH_SPREAD, method=method.name)]
    return [item for item in method.findings if item.code not in elsewhere] + spread


def _left_out(problem: Problem, method: Estimator) -> list[Finding]:
    """What the report does not look at with a ``StateSpace``, and what its process noise says instead."""
    if not isinstance(problem.likelihood, StateSpace):
        return []
    noticed = [finding(Code.RESIDUALS_LEFT_OUT)]
    known = ("process_noise", "movement", "outliers")
    if set(known) <= method.diagnostics.keys():
        chain = bind(problem.likelihood, problem.simulator, problem.train)
        process, movement, outliers = (np.array(method.diagnostics[key]) for key in known)
        noticed.extend(process_noise_findings(chain, process, movement, outliers))
    return noticed


def run_name(config: Path) -> str:
    """What a run is called: as the configuration's file, or its folder where the file's name says nothing."""
    return config.resolve().parent.name if config.stem in ("calibrate", "config", "discover") else config.stem


def run(
    config: Path,
    estimator: str | None = None,
    seed: int | None = None,
    budget: int | None = None,
    out: Path | None = None,
    num_threads: int | None = None,
    progress: Progress | None = None,
    device: str = "cpu",
    tell: Callable[[str], None] | None = None,
    time_limit: float | None = None,
) -> Calibration:
    """What the command does: read, claim the output folder, fit with a checkpoint, write everything.

    The posterior and a first ``result.json`` are written as soon as the fit ends, before its checks. Every input is
    checked before the folder is touched. The same call after an interruption resumes.

    Args:
        config: the TOML file.
        estimator: default the configuration's.
        seed: default the configuration's.
        budget: rollouts of the fit; default the configuration's, then the estimator's.
        out: folder of the results; default runs/NAME-ESTIMATOR.
        num_threads: native ones; default all cores.
        progress: called along the way.
        device: that it simulates on, as ``Simulator`` has them.
        tell: called with a line for what no simulation follows and what no body has, before the fit takes its time, and
            for a first estimate.
        time_limit: s of fit and checks, as of ``calibrate``.

    Raises:
        ValueError: for input that cannot be used; the message is one line with the remedy.
    """
    problem = prepare(config, num_threads, device)
    name = estimator or problem.config.estimator
    method_of(problem, name, seed, budget)
    bind(problem.likelihood, problem.simulator, problem.train)
    if problem.holdout is not None:
        every_channel(problem, problem.holdout)
    lost = (*no_rigid_bodies(problem.environment, problem.prior, 0, prior=True), *not_followed(problem))
    problem = replace(problem, findings=(*problem.findings, *lost))
    if tell is not None:
        for item in lost:
            tell(item.text)
    chosen_seed = problem.config.seed if seed is None else seed
    chosen_budget = problem.config.budget if budget is None else budget
    folder = Path("runs") / f"{run_name(problem.config.path)}-{name}" if out is None else out
    record = describe_run(problem, name, chosen_seed, chosen_budget)
    keys = [key for key in IDENTITY if key != "budget" or not estimator_class(name).goes_on]
    with claimed(folder, {**record, "status": "started"}, keys=keys):

        def keep(first: Calibration) -> None:
            write_fit(replace(first, run=record, out=str(folder)), folder, Guard())

        settings = name, chosen_seed, chosen_budget, folder / CHECKPOINT, progress, time_limit
        calibration = replace(calibrate(problem, *settings, keep, tell), run=record, out=str(folder))
        if progress is not None:
            progress("writing the report", calibration.rollouts, calibration.rollouts)
        return write_all(calibration, problem, folder)
