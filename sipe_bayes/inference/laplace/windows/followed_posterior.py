"""The posterior through impacts: that of the windows that the model follows, where nothing speaks against it.

Around their own optimum (``followed``) these windows change as smoothly as their slopes say, so that its curvature says
how well theta is known. It stands in the place of the scatter of groups of windows (``growing_windows``), which is that
of the wrong valleys in which their searches end, ten to a hundred times as wide; unless all groups lie to one side of
it, few windows are followed, the search for their optimum has not come to an end, or it tells less than the scatter.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import scipy.stats

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.findings import Code, finding
from sipe_bayes.inference.laplace.options import LaplaceTuning
from sipe_bayes.inference.laplace.strategy import SearchProblem
from sipe_bayes.inference.laplace.windows.energy import updated_noise
from sipe_bayes.inference.laplace.windows.followed import FollowedLook, followed_at, onward
from sipe_bayes.inference.laplace.windows.growing_windows import mean_of_groups
from sipe_bayes.inference.laplace.windows.optimum import Ending, summarised
from sipe_bayes.inference.laplace.windows.state import WindowOptimum, WindowState
from sipe_bayes.likelihood.restricted import eliminate_starts
from sipe_bayes.likelihood.windows import Windows


def followed_step(problem: SearchProblem, windows: Windows, state: WindowState) -> WindowState:
    """A choice of windows and a step towards their optimum; at the last one, the search with what came of it.

    Args:
        problem: what is searched.
        windows: all of them.
        state: whose only optimum has the scatter of groups.
    """
    here, prior, tuning = state.here, problem.quadratic_prior, problem.options.tuning.followed
    look = followed_at(windows, here.theta, here.starts, here.noise, prior, tuning)
    if look is None:
        return replace(state, done=True)
    step = onward(windows, look, prior, tuning) if here.iteration + 1 < tuning.rounds else None
    if step is not None:
        moved = replace(here, theta=step.theta, starts=step.starts, noise=look.at.noise, iteration=here.iteration + 1)
        return replace(state, here=moved)
    (scattered,) = state.optima
    optimum = replace(scattered, followed=look.at)
    own = followed_optimum(problem, windows, optimum, look)
    if stands(own, optimum, np.stack(state.estimates), windows.num_windows, problem):
        optimum = own
    return replace(state, optima=(optimum,), done=True)


def followed_optimum(
    problem: SearchProblem, windows: Windows, scattered: WindowOptimum, look: FollowedLook
) -> WindowOptimum:
    """The optimum of the windows that are followed; noise, starts and their slope are those of all windows there.

    Args:
        problem: what is searched.
        windows: all of them.
        scattered: the optimum of all.
        look: what is followed.
    """
    at, part = look.at, look.windows
    ending = Ending(
        at.theta,
        at.starts[at.kept],
        at.noise,
        part.moments(look.lin),
        look.lin.residual,
        look.lin.jacobian,
        begin=scattered.theta,
        steps=problem.options.tuning.followed.rounds,
        first_misfit=1.0,
        refused=0.0,
        tells=False,
        settled=True,
        cut_short=False,
        bettered=None,
    )
    own = summarised(problem, part, ending)
    moments, prior, coloured = windows.moments(look.every), problem.quadratic_prior, windows.settings.noise == "ar1"
    noise = updated_noise(windows, moments, at.noise, at.theta, at.starts, prior, coloured, False)
    pull = -windows.start_precision * at.starts
    slope = eliminate_starts(moments.normal(at.noise), moments.num_theta, windows.start_precision, pull).slope
    own = replace(own, sd=noise.sd, tau=noise.tau, starts=at.starts, slope=slope, followed=at)
    left = windows.num_windows - len(at.kept)
    return replace(
        own, finding=finding(Code.WINDOWS_LEFT_OUT, left=left, windows=windows.num_windows) if left else None
    )


def stands(
    own: WindowOptimum, scattered: WindowOptimum, estimates: FloatArray, among: int, problem: SearchProblem
) -> bool:
    """Whether the optimum of what is followed is the posterior.

    Args:
        own: that.
        scattered: the optimum of all windows, with the scatter of groups where they scatter.
        estimates: (G, N) of these.
        among: how many windows there are.
        problem: what is searched.
    """
    tuning, left = problem.options.tuning, own.mean - own.theta
    assert own.followed is not None
    if len(own.followed.kept) < tuning.followed.most * among:
        return False
    if 0.5 * float(left @ np.linalg.solve(own.covariance, left)) > tuning.windows.most_drift:
        return False
    wider = np.linalg.slogdet(own.covariance)[1] > np.linalg.slogdet(scattered.covariance)[1]
    if scattered.scatters and wider:  # a curvature of all windows is narrow for no reason
        return False
    return not contradicted(own, estimates, tuning)


def contradicted(own: WindowOptimum, estimates: FloatArray, tuning: LaplaceTuning) -> bool:
    """Whether groups' estimates (G, N) lie farther to one side of an optimum than they scatter, in any parameter.

    By Student's t of their mean, at ``tuning.followed.apart`` of all parameters together.
    """
    mean, covariance, freedom = mean_of_groups(estimates, tuning.growing)
    sd = np.sqrt(np.diag(covariance) + np.diag(own.covariance))
    most = scipy.stats.t.isf(0.5 * tuning.followed.apart / len(mean), freedom)
    return bool((np.abs(mean - own.mean) > most * sd).any())
