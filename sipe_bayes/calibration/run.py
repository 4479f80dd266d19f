"""A configuration in, a calibration out: what ``sipe calibrate`` does, step by step, also from Python."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from sipe_bayes.calibration.checks.fitted import Fit, drifting, from_fitted_states, one_by_one, tamed, with_wild
from sipe_bayes.calibration.checks.followed import not_followed
from sipe_bayes.calibration.checks.lacking import lacking
from sipe_bayes.calibration.checks.plan import Checks, Plan, plan_of, rollouts_of, with_checks
from sipe_bayes.calibration.checks.predictions import Predictions, every_channel, place_in_prior
from sipe_bayes.calibration.checks.ranges import ranges_that_change_nothing
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
)
from sipe_bayes.calibration.problem import Problem, method_of, prepare
from sipe_bayes.core.checkpoint import Kept, fingerprint_of
from sipe_bayes.core.files import installed_version
from sipe_bayes.core.findings import Code, Finding, Findings, finding
from sipe_bayes.diagnostics.agreement import disagreement
from sipe_bayes.diagnostics.bands import band_coverage
from sipe_bayes.diagnostics.records import Mixing
from sipe_bayes.diagnostics.result import Calibration
from sipe_bayes.envs.unknowns import bounded_by_nature
from sipe_bayes.inference.base import Estimator
from sipe_bayes.inference.laplace.windows.growing_windows import grows
from sipe_bayes.inference.recorded import Progress, digest
from sipe_bayes.inference.registry import estimator_class
from sipe_bayes.likelihood.binding import bind
from sipe_bayes.likelihood.settings import StateSpace
from sipe_bayes.likelihood.state_space.process_noise import process_noise_findings
from sipe_bayes.posterior import Posterior


def calibrate(
    problem: Problem,
    estimator: str | None = None,
    seed: int | None = None,
    budget: int | None = None,
    checkpoint: Path | None = None,
    progress: Progress | None = None,
) -> Calibration:
    """Fit, check and summarise.

    Args:
        problem: a configuration read and bound.
        estimator: default the configuration's.
        seed: default the configuration's.
        budget: rollouts of the fit; default the configuration's, then the estimator's.
        checkpoint: file that an interrupted fit goes on from; what its checks found is kept in `checks` beside it.
        progress: called along the way.
    """
    began = time.monotonic()
    method = method_of(problem, estimator, seed, budget, checkpoint, progress)
    posterior, checks = _fitted(problem, method, checkpoint, progress)
    theta, space, logs = most_probable(posterior), problem.environment.space, tamed(problem.train, method)
    problem = from_fitted_states(problem, method)
    fit = Fit.of(problem, method, theta, checks)
    problem = replace(problem, train=tamed(problem.train, method))
    alone = one_by_one(replace(problem, train=logs), fit, method.seed, checks)
    conflict = disagreement(space, alone.estimates)
    lacks = lacking(problem, method, fit, posterior, alone.estimates, conflict is not None, checks)
    misfit, missing = lacks.misfit, lacks.physics(space)
    doubted = conflict is not None or (misfit is not None and misfit.alarm)
    marginals = Marginals.of(posterior, problem.prior, method.seed, bounded_by_nature(problem.simulator.model, space))
    summaries = marginals.summaries(lacks.further(space), apart=bool(lacks.put_in))
    predictions = Predictions.of(problem, theta, checks)
    outside = place_in_prior(problem, method, fit, predictions, checks)
    bands = predictions.bands(posterior, missing if doubted else None, method.seed, checks)
    noticed = (
        *(look.finding for look in (*outside.logs, misfit) if look is not None and look.alarm),
        *problem.findings,
        *unmeasured_starts(problem.simulator, logs, problem.likelihood, problem.holdout is not None),
        *_own(problem, method, posterior, misfit is not None and not grows(fit.windows)),
        *(finding(Code.AGREEMENT_UNKNOWN, log=name) for name in alone.skipped),
        *lacks.findings,
        *(() if Findings(lacks.findings).of(Code.NOISE_FREE) else drifting(fit.channel_noise())),
        *outside.findings,
        *uneven_targets(problem.environment),
        *([] if conflict is None else [conflict.finding]),
        *marginals.worth_measuring(),
        *(ridge.finding(Code.RIDGE_TO_RESOLVE) for ridge in marginals.ridges),
        *marginals.findings(ranges_that_change_nothing(fit, checks), summaries if doubted else ()),
        *predictions.findings(),
        *of_logs(problem.reports),
        *_left_out(problem, method),
    )
    return Calibration(
        name=run_name(problem.config.path),
        estimator=method.name,
        posterior=posterior,
        prior=problem.prior,
        parameters=summaries,
        causes=lacks.causes,
        further=lacks.further(space),
        put_in=lacks.put_in,
        train=predictions.train,
        holdout=predictions.holdout,
        findings=noticed,
        signals=predictions.signals(bands),
        residuals=list(lacks.residuals),
        ridges=marginals.ridges,
        bands=band_coverage(predictions.windows["holdout"], *bands["holdout"]) if "holdout" in bands else None,
        comparison=predictions.comparison,
        misfit=misfit,
        outside=list(outside.logs),
        noise=fit.channel_noise(),
        mixing=_mixing(method),
        logs=with_wild(problem, method),
        rollouts=method.rollouts,
        seconds=time.monotonic() - began,
    )


def _fitted(
    problem: Problem, method: Estimator, checkpoint: Path | None, progress: Progress | None
) -> tuple[Posterior, Checks]:
    """The posterior, and the checks that come after it, with what an interrupted run kept of them."""
    plan = Plan()
    if progress is not None:
        plan = plan_of(problem, method)
        method.progress = with_checks(progress, plan, method, len(problem.train))
    posterior = method.fit(problem.train)
    held = None if problem.holdout is None else digest(problem.holdout)
    versions = {name: installed_version(name) for name in PACKAGES}
    setup = problem.config.model_dump(mode="json", by_alias=True), method.settings(), digest(problem.train), held
    folder = None if checkpoint is None else checkpoint.parent / CHECKS
    kept = Kept(folder, fingerprint_of(repr(setup), versions, method.snapshot))
    return posterior, Checks(kept, progress, method.rollouts, plan, rollouts_of(problem))


def _mixing(method: Estimator) -> Mixing | None:
    measured = method.diagnostics.get("mixing")
    return Mixing.of(measured, method.space.names) if measured else None


def _own(problem: Problem, method: Estimator, posterior: Posterior, asked: bool) -> list[Finding]:
    """What the estimator noticed itself, and what its edge may be; bounds are told by parameter, with their values.

    asked: whether what the model lacks is asked of all windows, so that nothing else need say what is not followed.
    """
    elsewhere = {Code.AT_BOUND, Code.NOISE_EXCEEDS_SCATTER} if asked else {Code.AT_BOUND}
    spread = [] if method.uncertain else [finding(Code.SEARCH_SPREAD, method=method.name)]
    noticed = [item for item in method.findings if item.code not in elsewhere]
    return noticed + spread + no_rigid_bodies(problem.environment, posterior, method.seed)


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
) -> Calibration:
    """What the command does: read, claim the output folder, fit with a checkpoint, write everything.

    Every input is checked before the folder is touched. The same call after an interruption resumes.

    Args:
        config: the TOML file.
        estimator: default the configuration's.
        seed: default the configuration's.
        budget: rollouts of the fit; default the configuration's, then the estimator's.
        out: folder of the results; default runs/NAME-ESTIMATOR.
        num_threads: native ones; default all cores.
        progress: called along the way.
        device: that it simulates on, as ``Simulator`` has them.
        tell: called with a line for what no simulation follows and what no body has, before the fit takes its time.

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
        calibration = calibrate(problem, name, chosen_seed, chosen_budget, folder / CHECKPOINT, progress)
        calibration = replace(calibration, run=record, out=str(folder))
        if progress is not None:
            progress("writing the report", calibration.rollouts, calibration.rollouts)
        return write_all(calibration, problem, folder)
