"""A configuration in, a calibration out: what ``sipe calibrate`` does, step by step, also from Python."""

from __future__ import annotations

import functools
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from sipe_bayes.calibration.gathered import (
    Marginals,
    most_probable,
    not_better,
    of_logs,
    uneven_targets,
    unmeasured_starts,
    worse_in_training,
)
from sipe_bayes.calibration.output import CHECKPOINT, IDENTITY, claim, describe_run, release, write_all
from sipe_bayes.calibration.problem import Problem, method_of, prepare
from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.findings import Code, Finding, finding
from sipe_bayes.core.thresholds import THRESHOLDS
from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.diagnostics.agreement import Disagreement, disagreement, linear_estimates, log_estimates, parts_of
from sipe_bayes.diagnostics.bands import band_coverage, predictive_bands
from sipe_bayes.diagnostics.evaluate import (
    best_starts,
    both_predicted,
    channel_scores,
    compare_errors,
    fitted_residuals,
    fitted_units,
    signals,
    white_noise,
)
from sipe_bayes.diagnostics.identifiability import dead_ranges, ridges
from sipe_bayes.diagnostics.misfit.missing_physics import MissingPhysics, missing_physics, spread_alone
from sipe_bayes.diagnostics.misfit.misspecification import misfit
from sipe_bayes.diagnostics.misfit.probed_logs import ProbedLogs
from sipe_bayes.diagnostics.misfit.tolerances import open_gains, tolerance_findings
from sipe_bayes.diagnostics.prior_predictive import OutsidePrior, follows, outside_prior
from sipe_bayes.diagnostics.records import ChannelNoise, ChannelScore, Comparison, Mixing, Residual, Signal
from sipe_bayes.diagnostics.result import Calibration
from sipe_bayes.envs.unknowns import bounded_by_nature
from sipe_bayes.inference.base import Estimator
from sipe_bayes.inference.laplace.estimator import Laplace
from sipe_bayes.inference.laplace.windows.growing_windows import grows
from sipe_bayes.inference.random_effects import LogEstimate
from sipe_bayes.inference.recorded import Progress, Tell
from sipe_bayes.inference.registry import estimator_class
from sipe_bayes.likelihood.binding import bind
from sipe_bayes.likelihood.noise import Noise
from sipe_bayes.likelihood.quadratic_prior import QuadraticPrior
from sipe_bayes.likelihood.replicas import observation_noise
from sipe_bayes.likelihood.settings import StateSpace
from sipe_bayes.likelihood.state_space.process_noise import process_noise_findings
from sipe_bayes.likelihood.wild_samples import wild_residuals
from sipe_bayes.likelihood.windows import Linearisation, Windows
from sipe_bayes.posterior import Posterior

_CHECKING = "checking what the model lacks"


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
        checkpoint: file that an interrupted fit goes on from.
        progress: called along the way.
    """
    began = time.monotonic()
    method = method_of(problem, estimator, seed, budget, checkpoint, progress)
    posterior = method.fit(problem.train)
    tell = functools.partial(_tell, method, progress)
    tell("checking what each parameter changes")
    theta, space = most_probable(posterior), problem.environment.space
    logs = _tamed(problem.train, method)
    problem = _from_fitted_states(problem, method)
    fit = _Fit.of(problem, method, theta)
    problem = replace(problem, train=_tamed(problem.train, method))
    alone, conflict, unknown = _one_by_one(replace(problem, train=logs), fit, method.seed, tell)
    probed, residuals = _residuals(problem, method, fit, unknown, tell)
    lacks = None if probed is None else misfit(probed, posterior.stddev.numpy(), method.seed)
    tell("simulating the posterior's band")
    marginals = Marginals.of(posterior, problem.prior, method.seed, bounded_by_nature(problem.simulator.model, space))
    combinations = ridges(space, marginals.draws, marginals.contraction.tolist())
    doubted = conflict is not None or (lacks is not None and lacks.alarm)
    given = problem.prior, doubted, method.seed
    missing = missing_physics(probed, posterior, *given, problem.tolerances) if probed else spread_alone(alone, *given)
    predictions = _Predictions.of(problem, theta)
    outside = _outside(problem, method, fit, predictions, unknown)
    bands = predictions.bands(posterior, missing if doubted else None, method.seed)
    noticed = (
        *(look.finding for look in (*outside, lacks) if look is not None and look.alarm),
        *problem.findings,
        *unmeasured_starts(problem.simulator, logs, problem.likelihood, problem.holdout is not None),
        *_own(method, lacks is not None),
        *unknown,
        *uneven_targets(problem.environment),
        *([] if conflict is None else [conflict.finding]),
        *(ridge.finding(Code.RIDGE_TO_RESOLVE) for ridge in combinations),
        *marginals.findings(dead_ranges(fit.windows, theta), combinations),
        *predictions.findings(),
        *of_logs(problem.reports),
        *_left_out(problem, method),
    )
    return Calibration(
        name=run_name(problem.config.path),
        estimator=method.name,
        posterior=posterior,
        prior=problem.prior,
        parameters=marginals.summaries(None if missing is None else missing.further),
        causes=() if missing is None else missing.causes,
        further=None if missing is None else missing.further,
        train=predictions.train,
        holdout=predictions.holdout,
        findings=noticed,
        signals=predictions.signals(bands),
        residuals=residuals,
        ridges=combinations,
        bands=band_coverage(predictions.windows["holdout"], *bands["holdout"]) if "holdout" in bands else None,
        comparison=predictions.comparison,
        misfit=lacks,
        outside=outside,
        noise=_channel_noise(fit.windows, fit.noise),
        mixing=_mixing(method),
        logs=list(problem.reports),
        rollouts=method.rollouts,
        seconds=time.monotonic() - began,
    )


def _from_fitted_states(problem: Problem, method: Estimator) -> Problem:
    """The problem with the training logs in the states where a fit with a ``StateSpace`` says that they were."""
    states = method.fitted_states(problem.train) if isinstance(method, Laplace) else None
    return problem if states is None else replace(problem, train=replace(problem.train, states=states))


def _tamed(logs: Trajectories, method: Estimator) -> Trajectories:
    """The logs without the samples that the fit left out."""
    if not isinstance(method, Laplace) or not len(method.wild):
        return logs
    observations = logs.observations.copy()
    observations[tuple(method.wild.T)] = np.nan
    return replace(logs, observations=observations)


@dataclass(frozen=True)
class _Fit:
    """The windows of the training logs at theta (N,): noise, best starts (W, D), and what changes them to first order.

    ``lin`` is None where it is no use: without windows of the fit's own, or of bodies that tumble.
    """

    windows: Windows
    theta: FloatArray
    noise: Noise
    starts: FloatArray
    lin: Linearisation | None

    @classmethod
    def of(cls, problem: Problem, method: Estimator, theta: FloatArray) -> _Fit:
        windows = bind(problem.segments, problem.simulator, problem.train)
        if isinstance(method, Laplace):
            windows.mask(method.wild)
        noise = _noise_of(method, windows, theta)
        if isinstance(problem.likelihood, StateSpace):
            return cls(windows, theta, noise, windows.no_starts(), None)
        starts = method.fitted_starts(theta) if isinstance(method, Laplace) else None
        starts = best_starts(windows, theta, noise) if starts is None else starts
        alone = grows(windows) or len(windows.trajectories) < 2
        return cls(windows, theta, noise, starts, None if alone else windows.linearise(theta, starts))


@dataclass(frozen=True)
class _Predictions:
    """Of the logs at theta (N,), by use: windows from measured starts, the errors there, the held-out ones compared."""

    theta: FloatArray
    windows: dict[str, Windows]
    predicted: dict[str, FloatArray]
    train: list[ChannelScore]
    holdout: list[ChannelScore]
    comparison: Comparison | None

    @classmethod
    def of(cls, problem: Problem, theta: FloatArray) -> _Predictions:
        logs = {"train": problem.train} | ({} if problem.holdout is None else {"holdout": problem.holdout})
        windows = {use: _every_channel(problem, own) for use, own in logs.items()}
        predicted = {use: both_predicted(one, theta) for use, one in windows.items()}
        for use, one in windows.items():
            one.mask(wild_residuals(one, np.where(one.observed, one.measured - predicted[use][0], 0.0)))
        scores = {use: channel_scores(one, theta, predicted[use]) for use, one in windows.items()}
        compared = None
        if "holdout" in windows:
            compared = compare_errors(windows["holdout"], theta, predicted=predicted["holdout"])
        return cls(theta, windows, predicted, scores["train"], scores.get("holdout", []), compared)

    def findings(self) -> list[Finding]:
        """Errors that became larger: in training, and held out unless they are mostly those of the measured starts."""
        of_starts = self.comparison is not None and self.comparison.starts is not None
        worse = worse_in_training(self.windows["train"], self.theta, self.train)
        return worse if of_starts else [*worse, *not_better(self.holdout)]

    def bands(
        self, posterior: Posterior, missing: MissingPhysics | None, seed: int
    ) -> dict[str, tuple[FloatArray, FloatArray]]:
        """The ends (W, L, C) of 90 % bands by use: of the posterior, or where the model lacks something for that."""
        believed, lacking = (posterior, False) if missing is None else (missing.further, True)
        return predictive_bands(self.windows, self.predicted, self.theta, believed, seed, lacking)

    def signals(self, bands: Mapping[str, tuple[FloatArray, FloatArray]]) -> list[Signal]:
        """What the report draws, held-out logs first; the ends (W, L, C) of their bands by use."""
        drawn = []
        for use, windows in reversed(self.windows.items()):
            drawn += signals(windows, use, self.predicted[use], bands[use])
        return drawn


def _every_channel(problem: Problem, logs: Trajectories) -> Windows:
    """Windows of logs by which they are scored and drawn, in all channels."""
    return Windows(replace(problem.segments, fit=None), problem.simulator, logs)


def _tell(method: Estimator, progress: Progress | None, what: str) -> None:
    if progress is not None:
        progress(what, method.rollouts, method.rollouts)  # the fit is over


def _one_by_one(
    problem: Problem, fit: _Fit, seed: int, tell: Tell
) -> tuple[list[LogEstimate], Disagreement | None, list[Finding]]:
    """What each of several logs says by itself, how they disagree, and a finding for each that could not be fitted.

    To first order, and where they then disagree, by a fit of each. Not asked of bodies that tumble: one log says too
    little of them by itself, and its scatter is in the posterior.
    """
    if grows(fit.windows):
        return [], None, []
    space = problem.environment.space
    if fit.lin is not None and fit.lin.valid:
        alone = linear_estimates(fit.windows, fit.theta, fit.starts, fit.noise, fit.lin, parts_of(fit.windows))
        if disagreement(space, alone) is None:
            return alone, None, []
    alone, skipped = log_estimates(problem.simulator, problem.likelihood, problem.train, fit.theta, seed, tell)
    return alone, disagreement(space, alone), [finding(Code.AGREEMENT_UNKNOWN, log=name) for name in skipped]


def _mixing(method: Estimator) -> Mixing | None:
    measured = method.diagnostics.get("mixing")
    return Mixing.of(measured, method.space.names) if measured else None


def _own(method: Estimator, asked: bool) -> list[Finding]:
    """What the estimator noticed itself; bounds are told by parameter, with their values.

    asked: whether what the model lacks is asked for, so that nothing else need say that a channel is not followed.
    """
    elsewhere = {Code.AT_BOUND, Code.NOISE_EXCEEDS_SCATTER} if asked else {Code.AT_BOUND}
    spread = [] if method.uncertain else [finding(Code.SEARCH_SPREAD, method=method.name)]
    return [item for item in method.findings if item.code not in elsewhere] + spread


def _channel_noise(fitted: Windows, noise: Noise) -> dict[str, ChannelNoise]:
    rows = zip(noise.sd.tolist(), noise.tau.tolist(), fitted_units(fitted), strict=True)
    return {channel: ChannelNoise(*row) for channel, row in zip(fitted.fitted, rows, strict=True)}


def _residuals(
    problem: Problem, method: Estimator, fit: _Fit, unknown: list[Finding], tell: Tell
) -> tuple[ProbedLogs | None, list[Residual]]:
    """The logs as the checks of their residuals see them, and the residuals.

    Nothing with a ``StateSpace``, whose process noise takes what the model lacks. unknown: gets findings of what they
    cannot tell.
    """
    tell(_CHECKING)
    if isinstance(problem.likelihood, StateSpace):
        return None, []
    windows, theta, noise, starts = fit.windows, fit.theta, fit.noise, fit.starts
    if {Code.SCATTER, Code.SCATTER_UNKNOWN} & {item.code for item in method.findings}:
        unknown.append(finding(Code.MISFIT_NOT_ASKED))
        return None, fitted_residuals(windows, theta, noise, starts)
    left = float(np.max(noise.sd / np.maximum(windows.spread, np.finfo(float).tiny)))
    if left < THRESHOLDS.rounding:
        unknown.append(finding(Code.NOISE_FREE, share=left))
        return None, fitted_residuals(windows, theta, noise, starts)
    try:
        prior = QuadraticPrior.of(problem.prior)
        probed = ProbedLogs(windows, theta, noise, starts, prior, fit.lin, lambda what: tell(f"{_CHECKING}: {what}"))
        if probed.windows.num_windows < windows.num_windows:
            asked = probed.windows.num_windows
            unknown.append(finding(Code.CHECKS_THINNED, asked=asked, windows=windows.num_windows))
        unknown.extend(tolerance_findings(probed, open_gains(probed, problem.tolerances)))
    except ValueError as error:  # LinAlgError is one
        unknown.append(finding(Code.MISFIT_UNKNOWN, reason=error))
        probed = None
    return probed, fitted_residuals(windows, theta, noise, starts)


def _outside(
    problem: Problem, method: Estimator, fit: _Fit, seen: _Predictions, unknown: list[Finding]
) -> list[OutsidePrior]:
    followed = follows(seen.windows["train"], seen.predicted["train"][0])
    noise = observation_noise(method.diagnostics, problem.train, problem.likelihood, fit.windows.simulator)
    try:
        return outside_prior(fit.windows, problem.prior, noise, seed=method.seed, followed=followed)
    except ValueError as error:
        unknown.append(finding(Code.OUTSIDE_PRIOR_UNKNOWN, reason=error))
        return []


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


def _noise_of(method: Estimator, windows: Windows, theta: FloatArray) -> Noise:
    """The residuals' noise: the estimator's, or white of the size that its best point leaves."""
    if "noise_sd" in method.diagnostics:
        return Noise(np.array(method.diagnostics["noise_sd"]), np.array(method.diagnostics["noise_tau"]))
    return white_noise(windows, theta)


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

    Raises:
        ValueError: for input that cannot be used; the message is one line with the remedy.
    """
    problem = prepare(config, num_threads, device)
    name = estimator or problem.config.estimator
    method_of(problem, name, seed, budget)
    bind(problem.likelihood, problem.simulator, problem.train)
    if problem.holdout is not None:
        _every_channel(problem, problem.holdout)
    chosen_seed = problem.config.seed if seed is None else seed
    chosen_budget = problem.config.budget if budget is None else budget
    folder = Path("runs") / f"{run_name(problem.config.path)}-{name}" if out is None else out
    record = describe_run(problem, name, chosen_seed, chosen_budget)
    keys = [key for key in IDENTITY if key != "budget" or not estimator_class(name).goes_on]
    claim(folder, {**record, "status": "started"}, keys=keys)
    try:
        calibration = calibrate(problem, name, chosen_seed, chosen_budget, folder / CHECKPOINT, progress)
    except ValueError:
        release(folder)
        raise
    calibration = replace(calibration, run=record, out=str(folder))
    if progress is not None:
        progress("writing the report", calibration.rollouts, calibration.rollouts)
    return write_all(calibration, problem, folder)
