"""How a calibrated model predicts its logs, held-out ones too: errors, bands, and the logs' place in the prior."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from sipe_bayes.calibration.checks.fitted import Fit
from sipe_bayes.calibration.checks.plan import Check, Checks
from sipe_bayes.calibration.gathered import not_better, worse_in_training
from sipe_bayes.calibration.problem import Problem
from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.checkpoint import Kept
from sipe_bayes.core.findings import Code, Finding, finding
from sipe_bayes.core.telling import Tell
from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.diagnostics.bands import predictive_bands
from sipe_bayes.diagnostics.evaluate import both_predicted, channel_scores, compare_errors, signals
from sipe_bayes.diagnostics.prior_predictive import OutsidePrior, follows, outside_prior
from sipe_bayes.diagnostics.records import ChannelScore, Comparison, Signal
from sipe_bayes.inference.base import Estimator
from sipe_bayes.likelihood import BoundLikelihood, observation_noise, wild_residuals
from sipe_bayes.posterior import Posterior


@dataclass(frozen=True)
class Compared:
    """Held-out errors against those of the model as given, and training errors that grew."""

    comparison: Comparison | None = None
    worse: tuple[Finding, ...] = ()

    def findings(self, holdout: Sequence[ChannelScore]) -> list[Finding]:
        """Errors that grew: in training, and held out unless they are mostly those of the measured starts."""
        of_starts = self.comparison is not None and self.comparison.starts is not None
        return [*self.worse, *([] if of_starts else not_better(holdout))]


@dataclass(frozen=True)
class Predictions:
    """Of the logs at theta (N,), by use: windows from measured starts, predicted (2, W, L, C), and the errors there."""

    theta: FloatArray
    windows: dict[str, BoundLikelihood]
    predicted: dict[str, FloatArray]
    train: list[ChannelScore]
    holdout: list[ChannelScore]

    @classmethod
    def of(cls, problem: Problem, theta: FloatArray, checks: Checks) -> Predictions:
        """Simulate the logs."""
        logs = {"train": problem.train} | ({} if problem.holdout is None else {"holdout": problem.holdout})
        windows = {use: every_channel(problem, own) for use, own in logs.items()}

        def simulated(tell: Tell, kept: Kept) -> dict[str, FloatArray]:
            return {use: both_predicted(one, theta) for use, one in windows.items()}

        predicted = checks.of(Check.PREDICTIONS, dict[str, FloatArray], simulated)
        for use, one in windows.items():
            one.mask(wild_residuals(one, np.where(one.observed, one.measured - predicted[use][0], 0.0)))
        scores = {use: channel_scores(one, theta, predicted[use]) for use, one in windows.items()}
        return cls(theta, windows, predicted, scores["train"], scores.get("holdout", []))

    def compared(self, checks: Checks) -> Compared:
        """The errors beside those of the model as given."""

        def made(tell: Tell, kept: Kept) -> Compared:
            comparison = None
            if "holdout" in self.windows:
                tell("held-out logs")
                comparison = compare_errors(self.windows["holdout"], self.theta)
            tell("training logs")
            return Compared(comparison, tuple(worse_in_training(self.windows["train"], self.theta, self.train)))

        return checks.of(Check.COMPARISON, Compared, made)

    def bands(
        self, posterior: Posterior, further: Posterior | None, seed: int, checks: Checks
    ) -> dict[str, tuple[FloatArray, FloatArray]]:
        """The ends (W, L, C) of 90 % bands by use: of the posterior, or of that with what the model lacks."""

        def made(tell: Tell, kept: Kept) -> dict[str, tuple[FloatArray, FloatArray]]:
            believed, lacking = (posterior, False) if further is None else (further, True)
            return predictive_bands(self.windows, self.predicted, self.theta, believed, seed, lacking)

        return checks.of(Check.BANDS, dict[str, tuple[FloatArray, FloatArray]], made)

    def signals(self, bands: Mapping[str, tuple[FloatArray, FloatArray]]) -> list[Signal]:
        """What the report draws, held-out logs first; the ends (W, L, C) of their bands by use, if there are any."""
        drawn = []
        for use, windows in reversed(self.windows.items()):
            none = np.full_like(self.predicted[use][0], np.nan)
            drawn += signals(windows, use, self.predicted[use], bands.get(use, (none, none)))
        return drawn


def every_channel(problem: Problem, logs: Trajectories) -> BoundLikelihood:
    """The logs bound, in all channels, as they are scored and drawn."""
    return BoundLikelihood(replace(problem.segments, fit=None), problem.simulator, logs)


@dataclass(frozen=True)
class Place:
    """Of each log its place among simulations of the prior; findings of why that is unknown."""

    logs: tuple[OutsidePrior, ...] = ()
    findings: tuple[Finding, ...] = ()


def place_in_prior(problem: Problem, method: Estimator, fit: Fit, seen: Predictions, checks: Checks) -> Place:
    """Whether any parameters within the bounds would give such logs."""

    def made(tell: Tell, kept: Kept) -> Place:
        followed = follows(seen.windows["train"], seen.predicted["train"][0])
        noise = observation_noise(method.diagnostics, problem.train, problem.likelihood, fit.windows.simulator)
        try:
            looks = outside_prior(fit.windows, problem.prior, noise, seed=method.seed, followed=followed)
        except ValueError as error:
            return Place((), (finding(Code.CHECKS_SKIPPED, checks=Check.PRIOR.value, reason=error),))
        return Place(tuple(looks))

    return checks.of(Check.PRIOR, Place, made)
