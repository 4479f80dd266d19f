"""The posterior through impacts: that of the windows that the model follows, where nothing speaks against it.

Around their own optimum (``followed``) these windows change as smoothly as their slopes say, so that its curvature says
how well theta is known. It stands in the place of the scatter of groups of windows (``growing_windows``), which is that
of the wrong valleys in which their searches end, and far wider; unless few windows are followed, they ask for different
values where the model lacks something (``followed.agreement``), the search for their optimum has not come to an end,
diverges or has no budget left, or they tell less than the scatter does. Which of these it is, is a ``Doubt``. Where the
model does not follow the windows at all, a finding blocks: what misses alike is off alike, and scatters little.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sipe_bayes.core.findings import Code, finding
from sipe_bayes.inference.laplace.strategy import SearchProblem
from sipe_bayes.inference.laplace.windows.energy import updated_noise
from sipe_bayes.inference.laplace.windows.followed import FollowedLook, agreement, followed_at, onward, regrown
from sipe_bayes.inference.laplace.windows.growing_windows import Doubt, scatter_finding
from sipe_bayes.inference.laplace.windows.optimum import Ending, sandwiches, summarised
from sipe_bayes.inference.laplace.windows.state import WindowOptimum, WindowState
from sipe_bayes.likelihood.restricted import eliminate_starts
from sipe_bayes.likelihood.settings import BudgetExhausted
from sipe_bayes.likelihood.windows import Windows


def followed_step(problem: SearchProblem, windows: Windows, state: WindowState) -> WindowState:
    """A choice of windows and a step towards their optimum; at the last one, the search with what came of it.

    Where the budget ends, that of the groups stands.

    Args:
        problem: what is searched.
        windows: all of them.
        state: whose only optimum has the scatter of groups.
    """
    try:
        return _step(problem, windows, state)
    except BudgetExhausted:
        if not state.optima[0].scatters:
            raise
        windows.short = True
        return replace(state, done=True)


def _step(problem: SearchProblem, windows: Windows, state: WindowState) -> WindowState:
    here, prior = state.here, problem.quadratic_prior
    tuning, growing = problem.options.tuning.followed, problem.options.tuning.growing
    look = followed_at(windows, here.theta, here.starts, here.noise, prior, tuning)
    on = here.iteration + 1 < tuning.rounds
    if look is Doubt.LOST and not here.iteration and on:
        every = np.arange(windows.num_windows)
        again = regrown(windows, every, here.theta, here.starts, here.noise, tuning, growing)
        if again is not None:
            return replace(state, here=replace(here, starts=again, iteration=1))
    step = None if isinstance(look, Doubt) or not on else onward(windows, look, prior, tuning, growing)
    if not isinstance(look, Doubt) and step is not None:
        theta, starts = step
        moved = replace(here, theta=theta, starts=starts, noise=look.at.noise, iteration=here.iteration + 1)
        return replace(state, here=moved)
    (whole,) = state.optima
    end, doubt = whole, look if isinstance(look, Doubt) else None
    if not isinstance(look, Doubt):
        own = followed_optimum(problem, windows, whole, look)
        doubt = doubted(problem, windows, own, whole, look)
        end = own if doubt is None else replace(whole, followed=look.at)
    if doubt is Doubt.LOST:
        end = replace(whole, finding=finding(Code.WINDOWS_LOST))
    elif doubt is not None and whole.scatters:
        end = replace(end, finding=scatter_finding(np.stack(state.estimates), growing, doubt))
    return replace(state, optima=(end,), done=True)


def followed_optimum(
    problem: SearchProblem, windows: Windows, whole: WindowOptimum, look: FollowedLook
) -> WindowOptimum:
    """The optimum of the windows that are followed; noise, starts and their slope are those of all windows there.

    Args:
        problem: what is searched.
        windows: all of them.
        whole: the optimum of all.
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
        begin=whole.theta,
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
    own = replace(own, sd=noise.sd, tau=noise.tau, starts=at.starts, slope=slope, followed=at, trims=True)
    left = windows.num_windows - len(at.kept)
    return replace(
        own, finding=finding(Code.WINDOWS_LEFT_OUT, left=left, windows=windows.num_windows) if left else None
    )


def doubted(
    problem: SearchProblem, windows: Windows, own: WindowOptimum, whole: WindowOptimum, look: FollowedLook
) -> Doubt | None:
    """What speaks against the optimum of the windows that are followed; None where nothing does.

    Args:
        problem: what is searched.
        windows: all of them.
        own: that optimum.
        whole: the optimum of all windows, with the scatter of groups where they scatter.
        look: what is followed.
    """
    tuning, left = problem.options.tuning, np.clip(own.mean, 0, 1) - own.theta
    if sandwiches(windows):
        return Doubt.SANDWICH
    if len(look.at.kept) < tuning.followed.most * windows.num_windows:
        return Doubt.FEW
    if 0.5 * float(left @ np.linalg.solve(own.covariance, left)) > tuning.windows.most_drift:
        return Doubt.UNSETTLED
    if agreement(look, tuning.growing.groups) < tuning.followed.apart:
        return Doubt.APART
    wider = np.linalg.slogdet(own.covariance)[1] > np.linalg.slogdet(whole.covariance)[1]
    return Doubt.WIDER if whole.scatters and wider else None  # a curvature of all windows is narrow for no reason
