"""Draws in the place of segments' normals: where one is not the posterior, or where several optima share it.

Each optimum's normal is probed two sds along each parameter's direction (``importance.is_normal``), where starts are
estimated only if it leaves one open; a single one is also looked beyond (``inference.stretches``). Where all stand and
nothing lies beyond, they are the posterior. Nothing is asked of optima with hardly any mass, of several where starts
are estimated, which follow one optimum alone, and through impacts.

The first batches come from each optimum's normal, widened, and from a normal along each stretch; the later ones from
normals with the moments of what was drawn around an optimum (``importance.draw``).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sipe_bayes.core.budget import BudgetExhausted
from sipe_bayes.inference import importance
from sipe_bayes.inference.importance import Draws
from sipe_bayes.inference.laplace.optimum import WindowOptimum
from sipe_bayes.inference.laplace.strategy import Optimum, SearchProblem, mixture
from sipe_bayes.inference.laplace.target import WindowFit, WindowTarget
from sipe_bayes.inference.stretches import look_size, proposals, stretches
from sipe_bayes.likelihood.windows import Windows


@dataclass(frozen=True)
class Look:
    """What is known of the posterior around the optima of a search that has ended.

    Args:
        draws: those that take the normals' place; None where these stand or nothing was asked.
        given: batches of them whose proposals the draws did not make.
        judged: whether the budget sufficed for what was asked.
    """

    draws: Draws | None = None
    given: int = 0
    judged: bool = True


def sharing(kept: Sequence[Optimum], problem: SearchProblem) -> list[Optimum]:
    """The optima, best first, that have a share of the mass; kept: the distinct ones, best first."""
    least = kept[0].evidence + np.log(problem.options.tuning.stretches.unseen)
    return [one for one in kept if one.evidence >= least]


def look_beyond(problem: SearchProblem, windows: Windows, kept: Sequence[Optimum]) -> Look:
    """Ask whether the optima's normals are the posterior, and draw first batches where they are not.

    kept: the distinct ones, best first.
    """
    tuning, shared = problem.options.tuning.importance, sharing(kept, problem)
    asked = tuning.wanted and windows.settings.noise != "sandwich" and not windows.impacts
    if not asked or (len(shared) > 1 and windows.num_start):
        return Look()
    n, cost, single = len(problem.space), 2 if windows.num_start else 1, len(shared) == 1
    # elsewhere the slope of starts at an optimum may be steep; from half of the range on it is none
    open_sd = max(np.sqrt(np.diag(one.covariance)).max() for one in shared) > 0.5
    probes = len(shared) * importance.probe_size(n) if not windows.num_start or open_sd else 0
    look = cost * look_size(n) if single else 0
    if not windows.has_room(windows.num_start + probes + look):
        return Look(judged=False)
    assert isinstance(kept[0], WindowOptimum)
    target = WindowTarget(problem.prior, windows, WindowFit.at(windows, kept[0]))
    if target.silent:
        return Look()
    stands = not probes or all(
        importance.is_normal(target, one.theta, one.mean, one.covariance, tuning) for one in shared
    )
    first = [(one.mean, tuning.width(n) ** 2 * one.covariance) for one in shared]
    if single:
        best = shared[0]
        try:
            beyond = stretches(target, best.theta, best.mean, best.covariance, problem.options.tuning.stretches)
        except BudgetExhausted:
            windows.short = True
            return Look(judged=False)
        first = [(best.mean, tuning.first_wider**2 * best.covariance), *proposals(beyond, best.covariance)]
        stands = stands and not beyond
    draws = Draws.none(n)
    for mean, covariance in () if stands else first:
        if not windows.has_room(draw_size(problem, windows, kept)):
            return Look(draws, draws.batches, judged=False)
        share = tuning.share if draws.batches else tuning.first_share
        draws = importance.drawn_from(draws, target, mean, covariance, share, problem.prior, problem.seed, tuning)
    return Look() if stands else Look(draws, draws.batches)


def draw_size(problem: SearchProblem, windows: Windows, kept: Sequence[Optimum]) -> int:
    """Simulations of the logs that one more batch of draws takes, with a linearisation and the optima's values."""
    values = importance.batch_size(len(problem.space), problem.options.tuning.importance) + len(sharing(kept, problem))
    return (2 if windows.num_start else 1) * values + windows.num_start + 1


def draw_more(problem: SearchProblem, windows: Windows, kept: Sequence[Optimum], draws: Draws) -> tuple[Draws, bool]:
    """One more batch, and whether a draw is so much better than all optima that these are none."""
    shared, tuning = sharing(kept, problem), problem.options.tuning.importance
    assert isinstance(kept[0], WindowOptimum)
    target = WindowTarget(problem.prior, windows, WindowFit.at(windows, kept[0]))
    draws = importance.draw(draws, target, mixture(shared, problem.space), problem.prior, problem.seed, tuning)
    highest = target(np.stack([one.theta for one in shared])).max()
    return draws, bool(draws.values.max() > highest + tuning.elsewhere)
