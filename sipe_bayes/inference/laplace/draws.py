"""Draws in the place of segments' normals: where one is not the posterior, or where several optima share it.

Each optimum's normal is probed two sds along each parameter's direction (``importance.is_normal``), where starts are
estimated only if it leaves one open, and that of a single one looked beyond (``inference.stretches``). Where all
stand and nothing lies beyond, they are the posterior, shared by their evidence. Optima with hardly any mass are left
out of this, and several are not asked about where starts are estimated, which follow one optimum alone; nor is any
through impacts.

The first batches come from each optimum's normal, widened, and from a normal along each stretch; the later ones from
normals with the moments of what was drawn around an optimum (``importance.draw``).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sipe_bayes.inference import importance
from sipe_bayes.inference.importance import Draws
from sipe_bayes.inference.laplace.optimum import WindowOptimum
from sipe_bayes.inference.laplace.strategy import Optimum, SearchProblem, mixture
from sipe_bayes.inference.laplace.target import WindowFit, WindowTarget
from sipe_bayes.inference.stretches import Stretch, look_size, proposals, stretches
from sipe_bayes.likelihood import BudgetExhausted
from sipe_bayes.likelihood.windows import Windows

_OPEN = 0.5  # an sd, of the range, from which the slope at the optimum is nought: elsewhere it may be steep


@dataclass(frozen=True)
class Probe:
    """What is known of the posterior around the optima of a search that has ended.

    Args:
        draws: those that take the normals' place; None where these stand or nothing was asked.
        given: batches of them whose proposals the draws did not make.
        judged: whether the budget sufficed for what was asked.
        stands: whether the normals were seen to be the posterior.
    """

    draws: Draws | None = None
    given: int = 0
    judged: bool = True
    stands: bool = False


def sharing(kept: Sequence[Optimum], problem: SearchProblem) -> list[Optimum]:
    """The optima, best first, that have a share of the mass; kept: the distinct ones, best first."""
    least = kept[0].evidence + np.log(problem.options.tuning.stretches.unseen)
    return [one for one in kept if one.evidence >= least]


def draw_size(problem: SearchProblem, windows: Windows, kept: Sequence[Optimum]) -> int:
    """Simulations of the logs that one more batch of draws takes, with a linearisation and the optima's values."""
    values = importance.batch_size(len(problem.space), problem.options.tuning.importance) + len(sharing(kept, problem))
    return (2 if windows.num_start else 1) * values + windows.num_start + 1


def target_at(problem: SearchProblem, windows: Windows, optimum: Optimum) -> WindowTarget:
    """The log posterior, with starts that follow theta from an optimum."""
    assert isinstance(optimum, WindowOptimum)
    return WindowTarget(problem.prior, windows, WindowFit.at(windows, optimum))


def probed(problem: SearchProblem, windows: Windows, kept: Sequence[Optimum]) -> Probe:
    """Ask whether the optima's normals are the posterior, and draw first batches where they are not.

    kept: the distinct ones, best first.
    """
    best, tuning, n = kept[0], problem.options.tuning.importance, len(problem.space)
    if not tuning.wanted:
        return Probe()
    if windows.settings.noise == "sandwich" or windows.impacts:
        return Probe()
    shared = sharing(kept, problem)
    if len(shared) > 1 and windows.num_start:
        return Probe()
    sds = np.sqrt([np.diag(one.covariance) for one in shared])
    probes = len(shared) * importance.probe_size(n) if not windows.num_start or sds.max() > _OPEN else 0
    look = (2 if windows.num_start else 1) * look_size(n, near=False) if len(shared) == 1 else 0
    if not windows.has_room(windows.num_start + probes + look):
        return Probe(judged=False)
    target = target_at(problem, windows, best)
    if target.silent:
        return Probe()
    stands = not probes or all(
        importance.is_normal(target, one.theta, one.mean, one.covariance, tuning) for one in shared
    )
    beyond: list[Stretch] = []
    if len(shared) == 1:
        try:
            beyond = stretches(target, best.theta, best.mean, best.covariance, problem.options.tuning.stretches, False)
        except BudgetExhausted:
            windows.short = True
            return Probe(judged=False)
    if stands and not beyond:
        return Probe(stands=True)
    if len(shared) > 1:
        first = [(one.mean, tuning.width(n) ** 2 * one.covariance) for one in shared]
    else:
        first = [(best.mean, tuning.first_wider**2 * best.covariance), *proposals(beyond, best.covariance)]
    draws = Draws.none(n)
    for mean, covariance in first:
        if not windows.has_room(draw_size(problem, windows, kept)):
            break
        share = tuning.share if draws.batches else tuning.first_share
        draws = importance.drawn_from(draws, target, mean, covariance, share, problem.prior, problem.seed, tuning)
    return Probe(draws, draws.batches, judged=draws.batches == len(first))


def more(problem: SearchProblem, windows: Windows, kept: Sequence[Optimum], draws: Draws) -> tuple[Draws, bool]:
    """One more batch, and whether a draw is so much better than all optima that these are none."""
    shared, tuning = sharing(kept, problem), problem.options.tuning.importance
    normals, target = mixture(shared, problem.space), target_at(problem, windows, kept[0])
    draws = importance.draw(draws, target, normals, problem.prior, problem.seed, tuning)
    highest = target(np.stack([one.theta for one in shared])).max()
    return draws, bool(draws.values.max() > highest + tuning.elsewhere)
