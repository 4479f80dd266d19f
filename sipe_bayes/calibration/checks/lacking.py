"""What the model lacks: the residuals of a fit, what they look like, and the intervals with it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from sipe_bayes.calibration.checks.fitted import Fit
from sipe_bayes.calibration.checks.plan import Check, Checks
from sipe_bayes.calibration.problem import Problem
from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.checkpoint import Kept
from sipe_bayes.core.findings import Code, Finding, Findings, finding
from sipe_bayes.core.parameters import ParameterSpace
from sipe_bayes.core.thresholds import THRESHOLDS
from sipe_bayes.diagnostics.evaluate import fitted_residuals
from sipe_bayes.diagnostics.misfit.asked_windows import AskedWindows
from sipe_bayes.diagnostics.misfit.larger_model import LargerModel, larger_model
from sipe_bayes.diagnostics.misfit.missing_physics import MissingPhysics, missing_physics, spread_alone
from sipe_bayes.diagnostics.misfit.misspecification import misfit
from sipe_bayes.diagnostics.misfit.probed_logs import MISFIT, ProbedLogs
from sipe_bayes.diagnostics.misfit.put_in import PutIn
from sipe_bayes.diagnostics.misfit.tolerances import tolerance_findings, untold
from sipe_bayes.diagnostics.records import Misfit, Residual
from sipe_bayes.diagnostics.thinning import spread_windows
from sipe_bayes.inference.base import Estimator
from sipe_bayes.inference.laplace.estimator import Laplace
from sipe_bayes.inference.laplace.windows.followed import followed_windows
from sipe_bayes.inference.laplace.windows.growing_windows import Doubt, grows
from sipe_bayes.inference.laplace.windows.state import WindowState
from sipe_bayes.inference.random_effects import LogEstimate
from sipe_bayes.inference.recorded import Tell
from sipe_bayes.likelihood.quadratic_prior import QuadraticPrior
from sipe_bayes.likelihood.settings import StateSpace
from sipe_bayes.likelihood.windows import Windows
from sipe_bayes.posterior import Particles, Posterior


@dataclass(frozen=True)
class _Missing:
    """A ``MissingPhysics`` as it is kept: draws (M, N) of theta with their weights (M,)."""

    theta: FloatArray
    weights: FloatArray
    causes: tuple[str, ...]
    explained: bool


@dataclass(frozen=True)
class _WithCauses:
    """Draws (M, N) of a ``LargerModel``'s theta with their weights (M,), and the causes in it."""

    theta: FloatArray
    weights: FloatArray
    causes: tuple[PutIn, ...]


@dataclass(frozen=True)
class Lacking:
    """What the residuals say.

    Args:
        misfit: what they look like; None where that was not asked, or cannot be told.
        missing: theta with what the model lacks, or may lack, to first order.
        larger: theta with what it lacks put into it; None where that was not asked, or leaves more than noise.
        residuals: of each log and channel; none with a ``StateSpace``, whose process noise takes what the model lacks.
        findings: of what they cannot tell, and of numbers that no motion tells.
    """

    misfit: Misfit | None
    missing: _Missing | None
    larger: _WithCauses | None
    residuals: tuple[Residual, ...]
    findings: tuple[Finding, ...]

    def further(self, space: ParameterSpace) -> Particles | None:
        """Theta with what the model lacks, or may lack."""
        given = self.larger or self.missing
        return None if given is None else Particles(given.theta, space, weights=given.weights)

    @property
    def put_in(self) -> tuple[PutIn, ...]:
        """What was put into the model."""
        return () if self.larger is None else self.larger.causes

    @property
    def causes(self) -> tuple[str, ...]:
        """For which ``further`` allows; none where they were put in."""
        return () if self.missing is None or self.larger is not None else self.missing.causes

    def physics(self, space: ParameterSpace) -> MissingPhysics | None:
        """What the model lacks, or may lack, to first order."""
        if self.missing is None:
            return None
        further = Particles(self.missing.theta, space, weights=self.missing.weights)
        return MissingPhysics(further, self.missing.causes, self.missing.explained)


NOTHING_ASKED = Lacking(None, None, None, (), ())


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
        seen = _probed(problem, method, fit, unknown, tell, kept)
        probed = None if seen is None else seen[1]
        chain = isinstance(problem.likelihood, StateSpace)
        residuals = [] if chain else fitted_residuals(fit.windows, fit.theta, fit.noise, fit.starts)
        looks = None if probed is None else misfit(probed, posterior.stddev.numpy(), method.seed, estimate=fit.theta)
        larger = None
        if seen is not None and looks is not None:
            larger = larger_model(*seen, looks, posterior, problem.prior, method.seed, problem.tolerances, tell, kept)
        tell("intervals with it")
        given = problem.prior, conflict or (looks is not None and looks.alarm), method.seed
        if probed is None:
            groups = groups_apart(method, posterior) if Findings(unknown).of(Code.MISFIT_NOT_ASKED) else []
            missing = spread_alone(groups, problem.prior, True, method.seed) if groups else spread_alone(alone, *given)
        else:
            missing = missing_physics(probed, posterior, *given, problem.tolerances)
        plain, put = None if missing is None else _plain(missing), None if larger is None else _put(larger)
        return Lacking(looks if larger is None else larger.looks, plain, put, tuple(residuals), tuple(unknown))

    return checks.of(Check.LACKING, Lacking, made)


def _plain(missing: MissingPhysics) -> _Missing:
    further = missing.further
    return _Missing(further.theta.numpy(), further.weights.numpy(), missing.causes, missing.explained)


def _put(larger: LargerModel) -> _WithCauses:
    return _WithCauses(larger.further.theta.numpy(), larger.further.weights.numpy(), larger.causes)


def _probed(
    problem: Problem, method: Estimator, fit: Fit, unknown: list[Finding], tell: Tell, kept: Kept
) -> tuple[AskedWindows, ProbedLogs] | None:
    """The logs as the checks of their residuals see them; unknown: gets findings of what they cannot tell."""
    if isinstance(problem.likelihood, StateSpace):
        return None
    left = float(np.max(fit.noise.sd / np.maximum(fit.windows.spread, np.finfo(float).tiny)))
    if left < THRESHOLDS.rounding:
        unknown.append(finding(Code.NOISE_FREE, share=left))
        return None
    try:
        asked = asked_windows(method, fit, problem.prior)
        if asked is None:
            unknown.append(finding(Code.MISFIT_NOT_ASKED))
            return None
        probed = asked.probed(tell, kept)
        unknown.extend(_left_out(fit.windows, asked, probed.windows))
        unknown.extend(tolerance_findings(probed, untold(probed, problem.tolerances)))
    except ValueError as error:  # LinAlgError is one
        unknown.append(finding(Code.CHECKS_SKIPPED, checks=Check.LACKING.value, reason=error))
        return None
    return asked, probed


def _left_out(every: Windows, asked: AskedWindows, probed: Windows) -> Iterator[Finding]:
    """Of how many windows it was asked."""
    followed, looks = asked.windows.num_windows, asked.among
    if looks < every.num_windows or probed.num_windows < followed:
        yield finding(Code.CHECKS_THINNED, asked=min(looks, probed.num_windows), windows=every.num_windows)
    if followed < THRESHOLDS.asked * looks:
        yield finding(Code.WINDOWS_NOT_FOLLOWED, followed=followed, windows=looks)


def groups_apart(method: Estimator, posterior: Posterior) -> list[LogEstimate]:
    """What groups of windows say that were fitted apart, where their scatter is the posterior; else none.

    Args:
        method: after the fit.
        posterior: of it, which is that of their mean.
    """
    search = method.state.search if isinstance(method, Laplace) and method.state is not None else None
    if not isinstance(search, WindowState) or not Findings(method.findings).of(Code.SCATTER, Code.WINDOWS_LOST):
        return []
    information = np.diag(1 / (len(search.estimates) * np.maximum(posterior.stddev.numpy(), 1e-12) ** 2))
    return [LogEstimate(f"group {k}", theta, information) for k, theta in enumerate(search.estimates)]


def asked_windows(method: Estimator, fit: Fit, believed: Posterior) -> AskedWindows | None:
    """The windows whose residuals are asked what the model lacks.

    Args:
        method: that fitted them.
        fit: all windows.
        believed: prior of the fit.

    Returns:
        Through impacts those that the model follows, as the fit has them; of other methods some windows are looked at,
        spread evenly. None where they are too few, or where the model slips.
    """
    prior = QuadraticPrior.of(believed)
    if not grows(fit.windows):
        windows = fit.windows.part(fit.some)
        return AskedWindows(windows, fit.theta, fit.starts[fit.some], fit.noise, prior, fit.lin)
    if isinstance(method, Laplace):
        at = method.followed
        return None if at is None else AskedWindows.at(at, fit.windows, prior)
    if fit.windows.contacts.slips:
        return None
    some = spread_windows(fit.windows, MISFIT.steps)
    windows = fit.windows.part(some)
    look = followed_windows(windows, fit.theta, fit.starts[some], fit.noise, prior)
    return None if isinstance(look, Doubt) else AskedWindows.at(look.at, windows, prior, look.lin)
