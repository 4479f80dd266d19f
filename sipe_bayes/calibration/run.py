"""A configuration in, a calibration out: what ``sipe calibrate`` does, step by step, also from Python."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from sipe_bayes.calibration.config import Config
from sipe_bayes.calibration.output import CHECKPOINT, claim, describe_run, release, write_all
from sipe_bayes.calibration.problem import Problem, method_of, prepare
from sipe_bayes.core.findings import Code
from sipe_bayes.diagnostics.agreement import Disagreement, compare_logs
from sipe_bayes.diagnostics.evaluate import (
    best_starts,
    channel_scores,
    compare_errors,
    fitted_residuals,
    signals,
    white_noise,
)
from sipe_bayes.diagnostics.identifiability import dead_ranges, ridges
from sipe_bayes.diagnostics.misspecification import Misfit, misfit
from sipe_bayes.diagnostics.prior_predictive import OutsidePrior, outside_prior
from sipe_bayes.diagnostics.records import ChannelScore, Residual, Ridge
from sipe_bayes.diagnostics.result import Calibration, ParameterSummary
from sipe_bayes.inference.base import Estimator, Progress
from sipe_bayes.inference.laplace.least_squares import QuadraticPrior
from sipe_bayes.likelihood.binding import bind
from sipe_bayes.likelihood.noise import Noise
from sipe_bayes.likelihood.replicas import observation_noise
from sipe_bayes.likelihood.settings import Segments, StateSpace
from sipe_bayes.likelihood.windows import Windows
from sipe_bayes.posterior import Posterior

FloatArray = NDArray[np.float64]

_DRAWS = 4000  # of the posterior, for summaries
_NOT_DETERMINED = 0.5  # contraction below which a parameter is not determined
_AT_BOUND = 0.02  # of the prior's range: how near to a bound the mode counts as at it


def calibrate(
    problem: Problem,
    estimator: str | None = None,
    seed: int | None = None,
    budget: int | None = None,
    checkpoint: Path | None = None,
    progress: Progress | None = None,
) -> Calibration:
    """Fit, check and summarise. Estimator, seed and budget override the configuration's."""
    began = time.monotonic()
    method = method_of(problem, estimator, seed, budget, checkpoint, progress)
    posterior = method.fit(problem.train)
    if not method.uncertain:
        method.doubt(
            f"the spread of {method.name} is that of its search, not an uncertainty: use laplace or mcmc, or in Python sipe.Recalibrated"
        )

    def tell(what: str) -> None:
        if progress is not None:
            progress(what, method.rollouts, method.budget)

    tell("checking what each parameter changes")
    theta = posterior.mode.numpy()
    scored = {"train": problem.train, "holdout": problem.holdout}
    bound = {
        use: Windows(replace(problem.segments, fit=None), problem.simulator, logs)
        for use, logs in scored.items()
        if logs is not None
    }
    fitted = bind(problem.segments, problem.simulator, problem.train)
    dead = dead_ranges(fitted, theta)
    conflict, skipped = compare_logs(problem.simulator, problem.likelihood, problem.train, theta, method.seed, tell)
    for name in skipped:
        method.warn(f"log {name} could not be fitted by itself; whether it agrees is unknown")
    noise = _noise_of(method, fitted, theta)
    tell("checking what the model lacks")
    lacking, residuals = _residuals(problem, method, fitted, theta, noise, posterior.stddev.numpy())
    outside = _outside(problem, method, fitted)
    tell("simulating the posterior's band")
    draws = posterior.values(_DRAWS, generator=torch.Generator().manual_seed(method.seed))
    summaries = _summaries(problem, posterior, draws, dead, conflict, lacking)
    found = ridges(problem.environment.space, draws, [p.contraction for p in summaries])
    scores = {use: channel_scores(w, theta) for use, w in bound.items()}
    held = scores.get("holdout", [])
    comparison = compare_errors(bound["holdout"], theta) if "holdout" in bound else None
    telling = held if comparison is None or comparison.starts is None else []  # errors that are not the starts'
    return Calibration(
        name=_run_name(problem.config),
        estimator=method.name,
        posterior=posterior,
        prior=problem.prior,
        parameters=summaries,
        train=scores["train"],
        holdout=held,
        warnings=_alarms(lacking, outside) + _warnings(problem, method, summaries, dead, found, conflict, telling),
        doubts=[*method.doubts, *(look.text for look in outside if look.alarm)],
        signals=[s for use, w in reversed(bound.items()) for s in signals(w, use, theta, posterior, method.seed)],
        residuals=residuals,
        ridges=found,
        comparison=comparison,
        misfit=lacking,
        outside=outside,
        left_out=_left_out(problem, method),
        noise=_noise(fitted, noise),
        mixing=method.diagnostics.get("mixing"),
        logs=[r.to_dict() for r in problem.reports],
        rollouts=method.rollouts,
        seconds=time.monotonic() - began,
    )


def _residuals(
    problem: Problem, method: Estimator, fitted: Windows, theta: FloatArray, noise: Noise, sd: FloatArray
) -> tuple[Misfit | None, list[Residual]]:
    """What the residuals look like, and the residuals; nothing with a ``StateSpace``, whose process noise takes what the model
    lacks. sd (N,): of the posterior in theta."""
    if isinstance(problem.likelihood, StateSpace):
        return None, []
    starts = best_starts(fitted, theta, noise)
    try:
        prior = QuadraticPrior.of(problem.prior)
        found = misfit(fitted, theta, noise, starts=starts, sd=sd, prior=prior, seed=method.seed)
    except ValueError as error:  # LinAlgError is one
        method.warn(f"whether the residuals are noise is unknown: {error}")
        found = None
    return found, fitted_residuals(fitted, theta, noise, starts)


def _outside(problem: Problem, method: Estimator, fitted: Windows) -> list[OutsidePrior]:
    noise = observation_noise(method.diagnostics, problem.train, problem.likelihood)
    try:
        return outside_prior(fitted, problem.prior, noise, seed=method.seed)
    except ValueError as error:
        method.warn(f"whether the logs lie within the prior is unknown: {error}")
        return []


def _alarms(lacking: Misfit | None, outside: Sequence[OutsidePrior]) -> list[str]:
    return [look.text for look in (*outside, lacking) if look is not None and look.alarm]


def _left_out(problem: Problem, method: Estimator) -> list[str]:
    """What the report does not look at with a ``StateSpace``, and what its process noise says instead."""
    if isinstance(problem.likelihood, Segments):
        return []
    said = (
        "Residuals, and whether they are noise: with likelihood = 'state_space' the state is unknown at every sample, and process "
        "noise, which is inferred, takes what the model lacks. Errors and signals are over windows from measured starts."
    )
    known = ("process_noise", "movement", "loose")
    if not set(known) <= method.diagnostics.keys():
        return [said]
    chain: Any = method.windows(problem.train)
    return [said, chain.lacking(*(np.array(method.diagnostics[key]) for key in known))]


def _run_name(config: Config) -> str:
    stem = config.path.stem
    return config.path.resolve().parent.name if stem in ("calibrate", "config") else stem


def _summaries(
    problem: Problem,
    posterior: Posterior,
    draws: FloatArray,
    dead: dict[str, list[tuple[float, float]]],
    conflict: Disagreement | None,
    lacking: Misfit | None,
) -> list[ParameterSummary]:
    space = problem.environment.space
    theta = posterior.mode.numpy()
    mode = space.values(theta)
    prior_sd, sd = problem.prior.stddev.numpy(), posterior.stddev.numpy()
    contraction = 1 - sd / np.maximum(prior_sd, 1e-300)
    quantiles = np.quantile(draws, [0.05, 0.5, 0.95], axis=0)
    rows = []
    for j, p in enumerate(space):
        flags = []
        if any(low <= 0 and high >= 1 for low, high in dead.get(p.name, [])):
            flags.append("no_effect")
        elif p.name in dead:
            flags.append("dead_range")
        if contraction[j] < _NOT_DETERMINED:
            flags.append("not_determined")
        elif min(theta[j], 1 - theta[j]) < _AT_BOUND * min(1.0, 10 * sd[j]):
            flags.append("at_bound")
        if conflict is not None and conflict.parameter == p.name:
            flags.append("disagrees")
        if lacking is not None and lacking.matters and (p.name in lacking.moved or not lacking.moved):
            flags.append("misfit")
        if p.log is not None:
            flags.append("nuisance")
        rows.append(
            ParameterSummary(
                name=p.name,
                unit=p.unit,
                targets=p.targets,
                mean=float(draws[:, j].mean()),
                sd=float(draws[:, j].std()),
                q05=float(quantiles[0, j]),
                q50=float(quantiles[1, j]),
                q95=float(quantiles[2, j]),
                mode=float(mode[j]),
                default=p.default,
                contraction=float(contraction[j]),
                flags=tuple(flags),
            )
        )
    return rows


def _warnings(
    problem: Problem,
    method: Estimator,
    summaries: Sequence[ParameterSummary],
    dead: dict[str, list[tuple[float, float]]],
    found: Sequence[Ridge],
    conflict: Disagreement | None,
    holdout: Sequence[ChannelScore],
) -> list[str]:
    own = [f.text for f in method.findings if f.code is not Code.AT_BOUND]  # said below, with the value
    words = [*problem.warnings, *own] + [
        f"{p.name}: its targets have different values in the model, so 'the model as given' stands for all at {p.default:.4g} {p.unit}"
        for p in problem.environment.space
        if problem.environment.uneven(p)
    ]
    if conflict is not None:
        unit = problem.environment.space[problem.environment.space.index(conflict.parameter)].unit
        words.append(conflict.text(unit))
    words += [f"{ridge.text}: fix one of them at a measured value" for ridge in found]
    in_ridge = {name for ridge in found for name in ridge.parameters}
    for p in summaries:
        space = problem.environment.space[problem.environment.space.index(p.name)]
        if "no_effect" in p.flags:
            words.append(f"{p.name} changes nothing in these logs; its posterior is its prior")
        elif "dead_range" in p.flags:
            ranges = ", ".join(f"{space.value(a):.4g} to {space.value(b):.4g}" for a, b in dead[p.name])
            words.append(f"{p.name} changes nothing between {ranges} {p.unit}")
        if "not_determined" in p.flags and "no_effect" not in p.flags and p.name not in in_ridge:
            words.append(f"{p.name} is not determined by these logs (contraction {p.contraction:.2f})")
        if "at_bound" in p.flags:
            bound = space.low if p.mode - space.low < space.high - p.mode else space.high
            words.append(f"{p.name} is at its bound {bound:.4g} {p.unit}: widen it, unless the bound is physical")
    words += [text for s in holdout if (text := _heldout_warning(s))]
    for r in problem.reports:
        if r.gaps or r.resampled or any(r.missing.values()) or any(r.clipped.values()):
            words += [f"log {r.name}: {note}" for note in r.notes]
    return words


def _heldout_warning(s: ChannelScore) -> str:
    """Empty where the calibrated model predicts better than the model as given."""
    where = f"held-out {s.log}, {s.channel}"
    if not np.isfinite(s.rmse):
        return f"{where}: the calibrated model diverges there"
    if not np.isfinite(s.rmse_default) or s.rmse < s.rmse_default:
        return ""
    return f"{where}: {s.rmse:.3g} {s.unit} is not better than the model as given ({s.rmse_default:.3g})"


def _noise_of(method: Estimator, windows: Windows, theta: FloatArray) -> Noise:
    """The residuals' noise: the estimator's, or white of the size that its best point leaves."""
    if "noise_sd" in method.diagnostics:
        return Noise(np.array(method.diagnostics["noise_sd"]), np.array(method.diagnostics["noise_tau"]))
    return white_noise(windows, theta)


def _noise(windows: Windows, noise: Noise) -> dict[str, dict[str, Any]]:
    units = dict(zip(windows.simulator.environment.channels, _units(windows), strict=True))
    rows = zip(windows.fitted, noise.sd.tolist(), noise.tau.tolist(), strict=True)
    return {name: {"sd": sd, "tau": tau, "unit": units[name]} for name, sd, tau in rows}


def _units(windows: Windows) -> tuple[str, ...]:
    return tuple(getattr(windows.simulator.environment, "channel_units", ("",) * len(windows.channels)))


def run(
    config: Path,
    estimator: str | None = None,
    seed: int | None = None,
    budget: int | None = None,
    out: Path | None = None,
    num_threads: int | None = None,
    progress: Progress | None = None,
) -> Calibration:
    """What the command does: read, claim the output folder, fit with a checkpoint, write everything.

    Every input is checked before the folder is touched. The same call after an interruption resumes."""
    problem = prepare(config, num_threads)
    name = estimator or problem.config.estimator
    method_of(problem, name, seed, budget)
    bind(problem.likelihood, problem.simulator, problem.train)
    if problem.holdout is not None:
        Windows(replace(problem.segments, fit=None), problem.simulator, problem.holdout)
    chosen_seed = problem.config.seed if seed is None else seed
    chosen_budget = problem.config.budget if budget is None else budget
    folder = Path("runs") / f"{_run_name(problem.config)}-{name}" if out is None else out
    record = describe_run(problem, name, chosen_seed, chosen_budget)
    claim(folder, record)
    try:
        found = calibrate(problem, name, chosen_seed, chosen_budget, folder / CHECKPOINT, progress)
    except ValueError:
        release(folder)
        raise
    found.run, found.out = record, str(folder)
    if progress is not None:
        progress("writing the report", found.rollouts, found.rollouts)
    write_all(found, problem, folder)
    return found
