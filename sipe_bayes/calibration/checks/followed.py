"""Before a fit takes minutes: which columns no simulation follows, whatever the unknowns."""

from __future__ import annotations

from sipe_bayes.calibration.init.fits import fit
from sipe_bayes.calibration.init.trials import Trial
from sipe_bayes.calibration.init.windows import FEW
from sipe_bayes.calibration.problem import Problem
from sipe_bayes.core.findings import Code, Finding, finding

_SHARE = 0.1  # of the time in which the motion goes to and fro: what short windows miss, no start explains
_ROUNDS = 6  # of the fit, where the model as given misses a column


def not_followed(problem: Problem) -> tuple[Finding, ...]:
    """One for each fitted column that moves, and that windows follow hardly better than a straight line does.

    First with the model as given, then with its unknowns fitted in a few steps: seconds, where the fit takes minutes.

    Args:
        problem: a configuration read and bound.
    """
    trial = Trial(problem.environment, list(problem.train), FEW, _SHARE)
    lost = trial.unfollowed(trial.given, trial.theta)
    if lost:
        left = fit(trial, trial.given, (0,), _ROUNDS)
        lost = trial.unfollowed(trial.given, left.theta)
    channels = problem.environment.channels
    fitted = problem.likelihood.fit or channels
    names = {channels[k]: by for k, by in lost.items() if channels[k] in fitted}
    return tuple(finding(Code.COLUMN_NOT_FOLLOWED, channel=name, times=by) for name, by in names.items())
