"""What the model lacks: the residuals of a fit, what they look like, and the intervals with it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sipe_bayes.calibration.checks.fitted import Fit
from sipe_bayes.calibration.checks.plan import Check, Checks
from sipe_bayes.calibration.problem import Problem
from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.checkpoint import Kept
from sipe_bayes.core.findings import Code, Finding, finding
from sipe_bayes.core.parameters import ParameterSpace
from sipe_bayes.core.thresholds import THRESHOLDS
from sipe_bayes.diagnostics.evaluate import fitted_residuals
from sipe_bayes.diagnostics.misfit.missing_physics import MissingPhysics, missing_physics, spread_alone
from sipe_bayes.diagnostics.misfit.misspecification import misfit
from sipe_bayes.diagnostics.misfit.probed_logs import ProbedLogs
from sipe_bayes.diagnostics.misfit.tolerances import tolerance_findings, untold
from sipe_bayes.diagnostics.records import Misfit, Residual
from sipe_bayes.inference.base import Estimator
from sipe_bayes.inference.random_effects import LogEstimate
from sipe_bayes.inference.recorded import Tell
from sipe_bayes.likelihood import QuadraticPrior, StateSpace
from sipe_bayes.posterior import Particles, Posterior


@dataclass(frozen=True)
class _Missing:
    """A ``MissingPhysics`` as it is kept: draws (M, N) of theta with their weights (M,)."""

    theta: FloatArray
    weights: FloatArray
    causes: tuple[str, ...]
    explained: bool


@dataclass(frozen=True)
class Lacking:
    """What the residuals say.

    Args:
        misfit: what they look like; None where that was not asked, or cannot be told.
        missing: theta with what the model lacks, or may lack, to first order.
        residuals: of each log and channel; none with a ``StateSpace``, whose process noise takes what the model lacks.
        findings: of what they cannot tell, and of numbers that no motion tells.
    """

    misfit: Misfit | None
    missing: _Missing | None
    residuals: tuple[Residual, ...]
    findings: tuple[Finding, ...]

    def further(self, space: ParameterSpace) -> Particles | None:
        """Theta with what the model lacks, or may lack."""
        given = self.missing
        return None if given is None else Particles(given.theta, space, weights=given.weights)

    @property
    def causes(self) -> tuple[str, ...]:
        """For which ``further`` allows."""
        return () if self.missing is None else self.missing.causes

    def physics(self, space: ParameterSpace) -> MissingPhysics | None:
        """What the model lacks, or may lack, to first order."""
        if self.missing is None:
            return None
        further = Particles(self.missing.theta, space, weights=self.missing.weights)
        return MissingPhysics(further, self.missing.causes, self.missing.explained)


NOTHING_ASKED = Lacking(None, None, (), ())


def lacking(
    problem: Problem,
    method: Estimator,
    fit: Fit,
    posterior: Posterior,
    alone: Sequence[LogEstimate],
    conflict: bool,
    checks: Checks,
) -> Lacking:
    """Ask what the model lacks.

    Args:
        problem: with the logs as they were fitted.
        method: that fitted them.
        fit: the windows there.
        posterior: of theta.
        alone: what each log says by itself.
        conflict: whether they disagree.
        checks: that this is one of.
    """

    def made(tell: Tell, kept: Kept) -> Lacking:
        unknown: list[Finding] = []
        probed = _probed(problem, fit, unknown, tell, kept)
        chain = isinstance(problem.likelihood, StateSpace)
        residuals = [] if chain else fitted_residuals(fit.windows, fit.theta, fit.noise, fit.starts)
        looks = None if probed is None else misfit(probed, posterior.stddev.numpy(), method.seed, estimate=fit.theta)
        tell("intervals with it")
        given = problem.prior, conflict or (looks is not None and looks.alarm), method.seed
        if probed is None:
            missing = spread_alone(alone, *given)
        else:
            missing = missing_physics(probed, posterior, *given, problem.tolerances)
        plain = None if missing is None else _plain(missing)
        return Lacking(looks, plain, tuple(residuals), tuple(unknown))

    return checks.of(Check.LACKING, Lacking, made)


def _plain(missing: MissingPhysics) -> _Missing:
    further = missing.further
    return _Missing(further.theta.numpy(), further.weights.numpy(), missing.causes, missing.explained)


def _probed(problem: Problem, fit: Fit, unknown: list[Finding], tell: Tell, kept: Kept) -> ProbedLogs | None:
    """The logs as the checks of their residuals see them; unknown: gets findings of what they cannot tell."""
    if isinstance(problem.likelihood, StateSpace):
        return None
    left = float(np.max(fit.noise.sd / np.maximum(fit.windows.spread, np.finfo(float).tiny)))
    if left < THRESHOLDS.rounding:
        unknown.append(finding(Code.NOISE_FREE, share=left))
        return None
    if fit.windows.impacts:
        unknown.append(finding(Code.MISFIT_NOT_ASKED))
        return None
    windows, starts, prior = fit.windows.part(fit.some), fit.starts[fit.some], QuadraticPrior.of(problem.prior)
    try:
        probed = ProbedLogs(windows, fit.theta, fit.noise, starts, prior, fit.lin, tell, kept)
        if probed.windows.num_windows < fit.windows.num_windows:
            asked, every = probed.windows.num_windows, fit.windows.num_windows
            unknown.append(finding(Code.CHECKS_THINNED, asked=asked, windows=every))
        unknown.extend(tolerance_findings(probed, untold(probed, problem.tolerances)))
    except ValueError as error:  # LinAlgError is one
        unknown.append(finding(Code.CHECKS_SKIPPED, checks=Check.LACKING.value, reason=error))
        return None
    return probed
