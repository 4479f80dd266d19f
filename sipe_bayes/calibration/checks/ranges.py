"""Where parameters change nothing."""

from __future__ import annotations

from sipe_bayes.calibration.checks.fitted import Fit
from sipe_bayes.calibration.checks.plan import Check, Checks
from sipe_bayes.core.checkpoint import Kept
from sipe_bayes.core.telling import Tell
from sipe_bayes.diagnostics.identifiability import dead_ranges


def ranges_that_change_nothing(fit: Fit, checks: Checks) -> dict[str, list[tuple[float, float]]]:
    """Parameter -> pieces of [0, 1] over which it changes nothing, the others as in the fit."""

    def made(tell: Tell, kept: Kept) -> dict[str, list[tuple[float, float]]]:
        return dead_ranges(fit.windows, fit.theta)

    return checks.of(Check.RANGES, dict[str, list[tuple[float, float]]], made)
