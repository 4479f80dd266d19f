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
from sipe_bayes.core.telling import Tell
from sipe_bayes.core.thresholds import THRESHOLDS
from sipe_bayes.diagnostics.evaluate import fitted_residuals
from sipe_bayes.diagnostics.misfit import misfit
from sipe_bayes.diagnostics.records import Misfit, Residual
from sipe_bayes.inference.base import Estimator
from sipe_bayes.likelihood import QuadraticPrior, StateSpace
from sipe_bayes.posterior import Particles, Posterior
from sipe_bayes.structure.augmented import AugmentedModel
from sipe_bayes.structure.discovery import FEWEST_APART
from sipe_bayes.structure.discrepancy import Discrepancy, LogEstimate, draw_differing, find_discrepancy

_NAMED = 3  # numbers whose error the logs do not show


@dataclass(frozen=True)
class Lacking:
    """What the residuals say.

    Args:
        misfit: what they look like; None where that was not asked, or cannot be told.
        theta: (M, N) draws with what the model lacks, or may lack, to first order; None where that cannot be told.
        causes: for which these allow, in words.
        residuals: of each log and channel; none with a ``StateSpace``, whose process noise takes what the model lacks.
        findings: of what they cannot tell, and of numbers that no motion tells.
    """

    misfit: Misfit | None
    theta: FloatArray | None
    causes: tuple[str, ...]
    residuals: tuple[Residual, ...]
    findings: tuple[Finding, ...]

    def further(self, space: ParameterSpace) -> Particles | None:
        """Theta with what the model lacks, or may lack."""
        return None if self.theta is None else Particles(self.theta, space)


NOTHING_ASKED = Lacking(None, None, (), (), ())


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
        found = _found(problem, fit, unknown, tell, kept)
        chain = isinstance(problem.likelihood, StateSpace)
        residuals = [] if chain else fitted_residuals(fit.windows, fit.theta, fit.noise, fit.starts)
        if found is None:
            differ = (
                draw_differing(posterior, alone, method.seed).theta.numpy() if conflict and len(alone) > 1 else None
            )
            return Lacking(None, differ, (), tuple(residuals), tuple(unknown))
        tell("comparing with noise alone")
        looks = misfit(found, posterior.stddev.numpy(), method.seed)
        further = found.draw(posterior, method.seed)
        return Lacking(looks, further.theta.numpy(), found.causes, tuple(residuals), tuple(unknown))

    return checks.of(Check.LACKING, Lacking, made)


def _found(problem: Problem, fit: Fit, unknown: list[Finding], tell: Tell, kept: Kept) -> Discrepancy | None:
    """What the model lacks to first order; unknown: gets findings of what the logs cannot tell."""
    if isinstance(problem.likelihood, StateSpace):
        return None
    left = float(np.max(fit.noise.sd / np.maximum(fit.windows.spread, np.finfo(float).tiny)))
    if left < THRESHOLDS.rounding:
        unknown.append(finding(Code.NOISE_FREE, share=left))
        return None
    some, lin = fit.some, fit.lin
    if fit.windows.impacts:
        some, lin = some[fit.windows.apart[some]], None
        if len(some) < FEWEST_APART:
            unknown.append(finding(Code.MISFIT_NOT_ASKED))
            return None
    windows, starts, prior = fit.windows.part(some), fit.starts[some], QuadraticPrior.of(problem.prior)
    try:
        logs = AugmentedModel(windows, fit.theta, fit.noise, starts, prior, lin, tell, kept)
        tell("which extensions explain the residuals")
        found = find_discrepancy(logs, problem.tolerances)
        unknown.extend(untold(found))
    except ValueError as error:  # LinAlgError is one
        unknown.append(finding(Code.CHECKS_SKIPPED, checks=Check.LACKING.value, reason=error))
        return None
    return found


def untold(found: Discrepancy) -> list[Finding]:
    """Of numbers with a tolerance that move a value by more than an sd of what the logs tell, the largest first."""
    logs = found.at.logs
    variance, space = np.diag(logs.seen.projected.covariance), logs.windows.simulator.space
    sd = np.sqrt(np.where(variance > 0, variance, np.inf))  # nothing moves what is held by its bound
    moving = [one for one in found.contributions() if one.moves(sd).any()]
    moving.sort(key=lambda one: -float(np.abs(one.shift / sd).max()))
    hangs, said = np.zeros(len(space), bool), []
    for one in moving[:_NAMED]:
        ends = space.values(np.clip([logs.theta - one.shift, logs.theta, logs.theta + one.shift], 0, 1))
        off, times = np.abs(np.diff(ends, axis=0)).max(0), np.abs(one.shift / sd)
        moved = [
            f"{space[j].name} by {off[j]:.2g} {space[j].unit}".rstrip() + f" ({times[j]:.0f} posterior sd)"
            for j in np.flatnonzero(one.moves(sd)).tolist()
        ]
        what = one.sentence[0].upper() + one.sentence[1:]
        said.append(f"{what} cannot be seen in these logs. It would bias {', '.join(moved)}.")
    for one in moving:
        if not one.probe.is_step:  # the interval allows for steps
            hangs |= one.moves(sd)
    if len(said) > 1 and not moving[0].probe.is_step:
        said[0] += " Measure that first: nothing else moves a value as far."
    names = [space[j].name for j in np.flatnonzero(hangs).tolist()]
    return [finding(Code.UNTOLD, parameters=names, moved=" ".join(said))] if said else []
