"""A fit as its checks see it: the windows of the training logs at the estimate, and what each log says by itself."""

from __future__ import annotations

import functools
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from sipe_bayes.calibration.checks.plan import Check, Checks
from sipe_bayes.calibration.problem import Problem
from sipe_bayes.core.arrays import FloatArray, IntArray
from sipe_bayes.core.checkpoint import Kept
from sipe_bayes.core.findings import Code, Finding, finding
from sipe_bayes.core.telling import Tell
from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.diagnostics.agreement import linear_estimates
from sipe_bayes.diagnostics.evaluate import LOOKED_AT, channel_noise, white_noise
from sipe_bayes.diagnostics.records import ChannelNoise, LogReport
from sipe_bayes.inference.base import Estimator
from sipe_bayes.likelihood import BoundLikelihood, Linearisation, Noise, StateSpace, bind
from sipe_bayes.structure.augmented import AugmentedModel, DivergesError
from sipe_bayes.structure.discrepancy import LogEstimate


def from_fitted_states(problem: Problem, method: Estimator) -> Problem:
    """The problem with the training logs in the states where a fit with a ``StateSpace`` says that they were."""
    states = None if method.result is None else method.result.states
    return problem if states is None else replace(problem, train=replace(problem.train, states=states))


def _outliers(method: Estimator) -> IntArray:
    return np.zeros((0, 3), np.int64) if method.result is None else method.result.outliers


def tamed(logs: Trajectories, method: Estimator) -> Trajectories:
    """The logs without the samples that the fit left out."""
    if not len(outliers := _outliers(method)):
        return logs
    observations = logs.observations.copy()
    observations[tuple(outliers.T)] = np.nan
    return replace(logs, observations=observations)


def with_wild(problem: Problem, method: Estimator) -> list[LogReport]:
    """What the logs held, with the samples that the fit left out."""
    if not len(outliers := _outliers(method)):
        return list(problem.reports)
    counts = {report.name: Counter(report.wild) for report in problem.reports}
    for log, _, channel in outliers:
        counts[problem.train.names[log]][problem.environment.channels[channel]] += 1
    return [replace(report, wild=dict(counts[report.name])) for report in problem.reports]


@dataclass(frozen=True)
class _At:
    noise: Noise
    starts: FloatArray


@dataclass(frozen=True)
class Fit:
    """The windows of the training logs at theta (N,): noise, and best starts (W, D).

    ``linear``: whether what changes them to first order is of use: not without windows of the fit's own, nor of bodies
    that tumble. ``least_squares``: whether theta is that of plain least squares, though residuals are coloured.
    """

    windows: BoundLikelihood
    theta: FloatArray
    noise: Noise
    starts: FloatArray
    linear: bool
    least_squares: bool = False

    @classmethod
    def of(cls, problem: Problem, method: Estimator, theta: FloatArray, checks: Checks) -> Fit:
        """Of a fit that has ended."""
        windows = bind(problem.segments, problem.simulator, problem.train)
        windows.mask(_outliers(method))
        chain = isinstance(problem.likelihood, StateSpace)

        def made(tell: Tell, kept: Kept) -> _At:
            noise = _noise_of(method, windows, theta)
            if chain:
                return _At(noise, windows.no_starts())
            starts = None if method.result is None else method.result.starts_at(theta)
            return _At(noise, windows.fit_starts(theta, noise)[0] if starts is None else starts)

        at = checks.of(Check.STARTS, _At, made)
        linear = not (chain or windows.impacts or len(windows.trajectories) < 2)
        plain = bool(method.diagnostics.get("least_squares"))
        return cls(windows, theta, at.noise, at.starts, linear, plain)

    @functools.cached_property
    def some(self) -> IntArray:
        """Numbers (K,) of the windows that are linearised: all, or of long logs some, spread evenly over each."""
        return self.windows.spread_over(LOOKED_AT, every_log=True)

    @functools.cached_property
    def lin(self) -> Linearisation | None:
        """What changes ``some`` windows to first order, where that is of use."""
        if not self.linear:
            return None
        return self.windows.part(self.some).linearise(self.theta, self.starts[self.some])

    def channel_noise(self) -> dict[str, ChannelNoise]:
        """Of each fitted channel."""
        return channel_noise(self.windows, self.noise)


def drifting(noise: Mapping[str, ChannelNoise]) -> list[Finding]:
    """That noise of channels, by name, has a correlation time as long as the logs: nearly a random walk."""
    mine = [name for name, own in noise.items() if own.tau_at_limit]
    tau = max((noise[name].tau for name in mine), default=0.0)
    return [finding(Code.NOISE_DRIFTS, channels=", ".join(mine), tau=tau)] if mine else []


def _noise_of(method: Estimator, windows: BoundLikelihood, theta: FloatArray) -> Noise:
    """The residuals' noise: the estimator's, or white of the size that its best point leaves."""
    if "noise_sd" in method.diagnostics:
        return Noise(np.array(method.diagnostics["noise_sd"]), np.array(method.diagnostics["noise_tau"]))
    return white_noise(windows, theta)


def one_by_one(problem: Problem, fit: Fit, checks: Checks) -> list[LogEstimate]:
    """What each of several logs says by itself, to first order; nothing where the simulation diverges.

    With a ``StateSpace``, whose process noise takes what the model lacks, it is asked of windows from the fitted
    states, beside noise as large and as correlated as their residuals. Not asked of bodies that tumble: one log says
    too little of them by itself, and its scatter is in the posterior.
    """

    def made(tell: Tell, kept: Kept) -> list[LogEstimate]:
        part, starts, noise = fit.windows.part(fit.some), fit.starts[fit.some], fit.noise
        if fit.windows.impacts or len(problem.train) < 2:
            return []
        chain = isinstance(problem.likelihood, StateSpace)
        if chain:
            noise = white_noise(part, fit.theta)
        elif fit.least_squares:  # white noise, of which as many samples tell as much
            share = np.exp(-float(part.dt.min()) / np.maximum(noise.tau, 1e-12))
            noise = Noise(noise.sd * np.sqrt((1 + share) / (1 - share)), np.zeros_like(noise.tau))
        try:
            seen = AugmentedModel(part, fit.theta, noise, starts, lin=fit.lin, placed=()).seen
        except DivergesError:
            nothing = np.zeros((len(fit.theta), len(fit.theta)))
            return [LogEstimate(name, fit.theta, nothing) for name in problem.train.names]
        return linear_estimates(seen.discounted if chain else seen)

    return checks.of(Check.LOGS, list[LogEstimate], made)
