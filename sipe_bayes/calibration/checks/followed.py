"""Before a fit takes minutes: which columns no simulation follows, whatever the unknowns."""

from __future__ import annotations

from sipe_bayes.calibration.init.fits import fit
from sipe_bayes.calibration.init.trials import Trial
from sipe_bayes.calibration.init.windows import FEW
from sipe_bayes.calibration.problem import Problem

_SHARE = 0.1  # of the time in which the motion goes to and fro: what short windows miss, no start explains
_ROUNDS = 6  # of the fit, where the model as given misses a column


def not_followed(problem: Problem) -> list[str]:
    """One line for each column that moves, and that windows follow hardly better than a straight line does.

    First with the model as given, then with its unknowns fitted in a few steps: seconds, where the fit takes minutes.

    Args:
        problem: a configuration read and bound.
    """
    trial = Trial(problem.environment, list(problem.train), FEW, _SHARE)
    lost = trial.unfollowed(trial.given, trial.theta)
    if lost:
        left = fit(trial, trial.given, (0,), _ROUNDS)
        lost = trial.unfollowed(trial.given, left.theta)
    return [
        f"nothing that is simulated follows {problem.environment.channels[k]!r}: short windows miss {by:.2g} times "
        "what going on straight does; look at its zero, unit and sign; sipe init tries them"
        for k, by in lost.items()
    ]
