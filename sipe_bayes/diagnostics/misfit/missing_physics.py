r"""Intervals for a model that lacks something, or may: what further logs would ask for, what the library might explain.

A wrong model's parameters make up for what it lacks, so that their plain intervals are a fraction of their distance
from the truth. Two things tell how far they may be off. Logs, or pieces of one, that were moved differently ask for
different values (``inference.random_effects``): that holds what differs between them, and misses what all share. And
the library of extensions says to first order what missing physics would have done to every sample. In the linear model

.. math:: r = J_\theta \delta + E b + J_x x + \varepsilon, \qquad b_k \sim \mathcal N(0, 1 / \alpha_k),

of ``misfit.probed_logs``, the evidence keeps few columns of E (``misfit.causes``). Their posterior, means and
covariance, moves and widens what each log asks for.

Where the corrected residuals pass for noise, the logs are corrected. Else physics are missing that the library does not
hold, or that are not small: what the logs ask for and what they do when corrected are then mixed in equal parts. The
few columns that were taken may stand in for others. So half of the interval is that of the posterior with a
discrepancy that the library spans (``misfit.library_discrepancy``). It is widened by the gains and the
centres of mass that no motion tells (``misfit.tolerances``).

Where nothing is seen to be missing, no further log is asked for: the posterior is widened by that discrepancy, and by
what physics steps do, which no machine takes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sipe_bayes.core.arrays import FloatArray, IntArray
from sipe_bayes.diagnostics.agreement import linear_estimates, parts_of
from sipe_bayes.diagnostics.misfit.causes import CAUSES, CauseOptions, Causes
from sipe_bayes.diagnostics.misfit.library_discrepancy import library_discrepancy
from sipe_bayes.diagnostics.misfit.probed_logs import ProbedLogs
from sipe_bayes.diagnostics.misfit.tolerances import EXACT, Tolerances, named, untold, widened
from sipe_bayes.inference.random_effects import LogEstimate, random_effects
from sipe_bayes.likelihood import Linearisation, Noise
from sipe_bayes.posterior import Particles, Posterior


@dataclass(frozen=True)
class MissingPhysics:
    """Theta with what the model lacks, or may lack.

    Args:
        further: theta, of a further log where something is missing.
        causes: that the evidence keeps, to first order, in words; else those that may move theta most.
        explained: whether the residuals pass for noise with them.
    """

    further: Particles
    causes: tuple[str, ...]
    explained: bool


def missing_physics(
    logs: ProbedLogs,
    posterior: Posterior,
    prior: Posterior,
    doubted: bool,
    seed: int = 0,
    tolerances: Tolerances = EXACT,
    options: CauseOptions = CAUSES,
) -> MissingPhysics | None:
    """The interval for a model that lacks something, or may; no simulation beside what ``logs`` took.

    Args:
        logs: linearised at the estimate.
        posterior: of theta, as fitted.
        prior: of theta.
        doubted: whether the residuals or the logs' disagreement show that something is missing.
        seed: of the draws.
        tolerances: of numbers that no machine has exactly.
        options: of the search for causes.

    Returns:
        None where nothing can be said: no extension has an effect, or in doubt there is but a single log of one window.
    """
    parts, hidden = parts_of(logs.windows), library_discrepancy(logs, seed, tolerances=EXACT if doubted else tolerances)
    if not doubted:
        return None if hidden is None else MissingPhysics(hidden.widened(posterior, seed), hidden.causes, True)
    if len(parts) < 2:
        return None
    numbers = untold(logs, tolerances)
    causes = Causes.of(logs, options)
    nothing = np.zeros(len(logs.probes))
    explained = bool(len(causes.kept)) and causes.explain(logs, seed)
    if not explained:
        further = random_effects(_estimates(logs, parts, logs.noise, logs.memory, nothing), prior, seed).new_log
    if len(causes.kept):
        estimates = _estimates(logs, parts, causes.noise, causes.memory, causes.sizes(logs))
        corrected = random_effects(estimates, prior, seed).new_log
        corrected = causes.widened(logs, corrected, np.random.default_rng(seed))
        further = corrected if explained else _mixed(further, corrected)
    causes_named = tuple(dict.fromkeys(logs.probes[k].name for k in causes.kept))
    if hidden is not None:
        further, causes_named = _mixed(further, hidden.widened(posterior, seed)), causes_named or hidden.causes
    return MissingPhysics(widened(further, numbers, seed), causes_named + named(logs, numbers), explained)


def spread_alone(alone: Sequence[LogEstimate], prior: Posterior, doubted: bool, seed: int = 0) -> MissingPhysics | None:
    """What a further log would ask for where nothing can be probed; None of one log, or without a doubt."""
    asked = doubted and len(alone) > 1
    return MissingPhysics(random_effects(alone, prior, seed).new_log, (), False) if asked else None


def _estimates(
    logs: ProbedLogs, parts: Sequence[tuple[str, IntArray]], noise: Noise, memory: FloatArray, sizes: FloatArray
) -> list[LogEstimate]:
    """What each part of the logs asks for, to first order, where the causes have these sizes (K,).

    noise: from which that of each part is searched; memory: (C,) of what it leaves.
    """
    n, count = logs.windows.num_theta, logs.count
    residual = logs.residual - logs.jacobian[..., n:count] @ sizes
    lin = Linearisation(residual, np.concatenate([logs.jacobian[..., :n], logs.jacobian[..., count:]], -1), True)
    return linear_estimates(logs.windows, logs.theta, logs.starts, noise, lin, parts, memory)


def _mixed(one: Particles, other: Particles) -> Particles:
    weights = np.concatenate([0.5 * p.weights.numpy() / p.weights.numpy().sum() for p in (one, other)])
    return Particles(np.concatenate([one.theta.numpy(), other.theta.numpy()]), one.space, weights=weights)
