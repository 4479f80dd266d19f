"""Causes put into the model: windows through impacts fitted again with the physics that their residuals ask for.

To first order missing physics moves theta the right way, and through impacts about half as far as it takes
(``misfit.causes``): what it does to a joint decides when that strikes, and from there on nothing is linear. So the few
pieces that the evidence keeps become parameters of the model, and the windows that the larger model follows, with
their optimum, are looked for from where the linear model points (``laplace.windows.followed``). Of pieces that stood in
for each other the simulation then tells which it is: the others' sizes end at nothing. What is left is asked again, and
what it looks like put in beside, ``rounds`` times at most.

Where the larger model follows most windows, about as many as the plain one, groups of them agree, and its residuals
pass for noise, theta is that of the larger model, widened as of any model that seems right
(``misfit.library_discrepancy``). Else nothing is said here, and what is known to first order stands
(``misfit.missing_physics``). Nor is it where no cause is seen by ``seen`` sds: what is that small looks like several
things, whose sizes no simulation tells.

This is a step of forward selection (N. Draper, H. Smith, "Applied Regression Analysis", 1966, chapter 6), several at
once, for the score tests of ``misfit.misspecification``. It does not compare rivals by their evidence, as ``sipe
discover`` does where motion is smooth: of two pieces that these logs do not tell apart, one may stand for both.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.checkpoint import NOTHING_KEPT, Kept
from sipe_bayes.core.options import Options, option
from sipe_bayes.diagnostics.misfit.asked_windows import AskedWindows
from sipe_bayes.diagnostics.misfit.causes import Causes
from sipe_bayes.diagnostics.misfit.missing_physics import missing_physics
from sipe_bayes.diagnostics.misfit.misspecification import misfit
from sipe_bayes.diagnostics.misfit.probed_logs import ProbedLogs
from sipe_bayes.diagnostics.misfit.put_in import PutIn
from sipe_bayes.diagnostics.misfit.tolerances import EXACT, Tolerances
from sipe_bayes.diagnostics.records import Misfit
from sipe_bayes.envs.mjcf import MjcfEnvironment
from sipe_bayes.inference.laplace.options import GrowingTuning, WindowTuning
from sipe_bayes.inference.laplace.windows.followed import FOLLOWED, agreement, followed_windows
from sipe_bayes.inference.laplace.windows.growing_windows import Doubt
from sipe_bayes.inference.laplace.windows.state import Followed
from sipe_bayes.inference.recorded import Tell, silent
from sipe_bayes.likelihood.quadratic_prior import QuadraticPrior
from sipe_bayes.likelihood.windows import Windows
from sipe_bayes.posterior import GaussianMixture, Particles, Posterior
from sipe_bayes.simulation.simulator import Simulator
from sipe_bayes.structure.extension import Placed, extended
from sipe_bayes.structure.fitted import beside
from sipe_bayes.structure.internal_starts import carried_starts, mapped_starts
from sipe_bayes.structure.probes import Probe

_INSIDE = 1e-3  # of the cube, from its faces: where parameters of extensions begin


@dataclass(frozen=True)
class LargerModelOptions(Options):
    """When causes are put in, and count as there."""

    rounds: int = option(2, "in which what is left is put in, too", least=1)
    seen: float = option(
        5.0, "from none, to first order, that the best cause has: else nothing is put in", "sds", above=0
    )
    clear: float = option(3.0, "from none, from which a cause that was put in is there", "sds", above=0)
    rival: float = option(0.5, "of what the best cause explains, from which others are put in beside it", above=0)
    most: int = option(6, "that are put in at once", least=1)
    share: float = option(0.8, "of the windows that the plain model follows, that it has to follow", above=0)
    agree: float = option(0.05, "chance that groups of windows ask for as different values, at least", above=0)
    steps: int = option(12, "towards the optimum of the windows that are followed: there are more unknowns", least=1)


_OPTIONS = LargerModelOptions()


@dataclass(frozen=True)
class LargerModel:
    """Theta of a model with causes in it that leaves nothing but noise.

    Args:
        further: theta of the plain model's N parameters.
        causes: that are there, with their sizes, the surest first.
        looks: what the plain model's residuals look like: these causes, and where theta is with them.
    """

    further: Particles
    causes: tuple[PutIn, ...]
    looks: Misfit


@dataclass(frozen=True)
class _Fitted:
    """Where a larger model follows windows, and the chance that groups of them ask for as different values."""

    at: Followed
    agreement: float


@dataclass(frozen=True)
class _Larger:
    """A model with causes in it.

    Args:
        probes: those, by what they are seen.
        asked: the windows that it follows.
        prior: of the N + P parameters.
        agreement: chance that groups of the windows ask for as different values.
    """

    probes: tuple[Probe, ...]
    asked: AskedWindows
    prior: Posterior
    agreement: float


def larger_model(
    asked: AskedWindows,
    probed: ProbedLogs,
    looks: Misfit,
    posterior: Posterior,
    prior: Posterior,
    seed: int = 0,
    tolerances: Tolerances = EXACT,
    tell: Tell = silent,
    kept: Kept = NOTHING_KEPT,
    options: LargerModelOptions = _OPTIONS,
) -> LargerModel | None:
    """Put causes in; each round costs what choosing the followed windows and probing them does.

    Args:
        asked: windows through impacts.
        probed: they, linearised.
        looks: what their residuals look like.
        posterior: of theta (N,), as fitted.
        prior: of theta (N,).
        seed: of the draws.
        tolerances: of numbers that no machine has exactly.
        tell: called with what is being done.
        kept: keeps what each round simulated.
        options: of the search.

    Returns:
        None where nothing is missing, no larger model leaves nothing but noise, or windows do not go through impacts.
    """
    if not looks.alarm or asked.chosen is None or _squares(probed).max(initial=0.0) < options.seen**2:
        return None
    try:
        return _searched(asked, probed, looks, posterior, prior, seed, tolerances, tell, kept, options)
    except ValueError:  # LinAlgError is one, and what a larger model raises that diverges
        return None


def _searched(
    asked: AskedWindows,
    probed: ProbedLogs,
    looks: Misfit,
    posterior: Posterior,
    prior: Posterior,
    seed: int,
    tolerances: Tolerances,
    tell: Tell,
    kept: Kept,
    options: LargerModelOptions,
) -> LargerModel | None:
    larger, logs = _Larger((), asked, prior, 1.0), probed
    for number in range(options.rounds):
        within = kept.under(f"larger-{number}")
        tell(f"putting in what the residuals look like, round {number + 1} of at most {options.rounds}")
        grown = _grown(larger, logs, prior, within, options)
        if grown is None:
            return None
        larger, logs = grown, grown.asked.probed(tell, within)
        own = _normal(logs, larger.prior)
        seen = misfit(logs, own.stddev.numpy(), seed, estimate=logs.theta)
        if not seen.alarm:
            break
    else:
        return None
    if not _stands(larger, logs, own, asked, options):
        return None
    causes = tuple(_there(larger, logs, own, options))
    if not causes:
        return None
    missing = missing_physics(logs, own, larger.prior, False, seed, tolerances)
    n, further = len(prior.space), _draws(own, seed) if missing is None else missing.further
    there = Particles(further.theta.numpy()[:, :n], prior.space, weights=further.weights.numpy())
    return LargerModel(there, causes, _looks(looks, posterior, probed, logs, causes))


def _looks(
    looks: Misfit, posterior: Posterior, before: ProbedLogs, after: ProbedLogs, causes: Sequence[PutIn]
) -> Misfit:
    """What the residuals look like, by name of the causes that were put in."""
    explained = np.clip(1 - (after.noise.sd / before.noise.sd) ** 2, 0, 1)
    given = ~np.isnan(before.windows.fixed_sd)  # noise that is no estimate says nothing
    share = {
        name: looks.share.get(name, 0.0) if fixed else own
        for name, own, fixed in zip(before.windows.fitted, explained.tolist(), given.tolist(), strict=True)
    }
    names, n = posterior.space.names, len(posterior.space)
    moved = (after.theta[:n] - posterior.mode.numpy()) / np.maximum(posterior.stddev.numpy(), 1e-12)
    cause, remedy = " and ".join(c.cause for c in causes), " and ".join(c.remedy for c in causes)
    shift = dict(zip(names, moved.tolist(), strict=True))
    return replace(looks, cause=cause, remedy=remedy, share=share, shift=shift, alike=1, searchable=False)


def _grown(
    larger: _Larger, logs: ProbedLogs, prior: Posterior, kept: Kept, options: LargerModelOptions
) -> _Larger | None:
    """With what the evidence keeps put in beside; None where that is nothing, or too few windows are followed then."""
    environment = logs.windows.simulator.environment
    if larger.asked.chosen is None or not isinstance(environment, MjcfEnvironment):
        return None
    causes = Causes.of(logs)
    put, theta = _placed(logs, causes, environment, options)
    if not put:
        return None
    every, before = larger.asked.chosen
    simulator = Simulator(extended(environment, _extensions(put)), logs.windows.simulator.num_threads)
    windows = Windows(every.settings, simulator, every.trajectories, every)
    windows.budget = every.budget - every.rollouts
    believed = beside(prior, simulator.space)
    quadratic = QuadraticPrior.of(believed)

    def made(kept: Kept) -> tuple[_Fitted, ...]:
        starts = mapped_starts(every.simulator.model, simulator.model, before.starts)[None]
        starts = carried_starts(every.simulator.model, windows, theta[None], starts)[0]
        noise, tuning = logs.beside_scatter(before.noise), replace(FOLLOWED, rounds=1 + options.steps)
        look = followed_windows(windows, theta, starts, noise, quadratic, tuning)
        return () if isinstance(look, Doubt) else (_Fitted(look.at, agreement(look, GrowingTuning().groups)),)

    fitted = next(iter(kept.of("fitted", tuple[_Fitted, ...], made)), None)
    every.rollouts += windows.rollouts
    if fitted is None:
        return None
    asked = AskedWindows.at(fitted.at, windows, quadratic)
    return _Larger((*larger.probes, *put), asked, believed, fitted.agreement)


def _placed(
    logs: ProbedLogs, causes: Causes, environment: MjcfEnvironment, options: LargerModelOptions
) -> tuple[list[Probe], FloatArray]:
    """A probe of each extension that a model can have together, and theta (N + P,) with them.

    The surest causes first, then those that explain about as much as the best, each by itself.
    """
    n, sizes = logs.windows.num_theta, causes.sizes(logs)
    sure = np.argsort(-np.abs(causes.step[n:]) / np.sqrt(np.diag(causes.covariance)))
    square = _squares(logs)
    rivals = [k for k in np.argsort(-square).tolist() if square[k] >= options.rival * square.max() > 0]
    first: list[Probe] = []
    for k in dict.fromkeys([*causes.kept[sure].tolist(), *rivals]):
        probe = logs.probes[k]
        known = any(probe.placed is one for one in _extensions(first))
        if not _can_be_put_in(probe) or known or len(first) >= options.most:
            continue
        if _can_have(environment, _extensions([*first, probe])):
            first.append(probe)
    theta = np.clip(logs.theta + causes.step[:n] + logs.traded(sizes), 0, 1)
    return first, np.concatenate([theta, *(_begun(one, logs, sizes) for one in _extensions(first))])


def _begun(placed: Placed, logs: ProbedLogs, sizes: FloatArray) -> FloatArray:
    """Theta (P,) of an extension whose columns have these sizes (K,): they add up, of shapes it is the mean."""
    mine = [k for k, probe in enumerate(logs.probes) if probe.placed is placed]
    tried = np.array([logs.probes[k].tried for k in mine])
    share = np.array([sizes[k] / logs.probes[k].size for k in mine])
    if any(logs.probes[k].trade for k in mine):
        share = np.sqrt(np.maximum(share, 0.0))
    sized = np.array([parameter.default is not None for parameter in placed.parameters])
    weight = np.abs(share) if share.any() else np.ones(len(mine))
    theta = np.where(sized, placed.plain + share @ (tried - placed.plain), weight @ tried / weight.sum())
    return np.clip(theta, _INSIDE, 1 - _INSIDE)


def _squares(logs: ProbedLogs) -> FloatArray:
    """Score statistics (K,) of the probes by themselves; zero of those that cannot be put in."""
    seen, able = logs.at_scatter.seen, [_can_be_put_in(probe) for probe in logs.probes]
    return np.where(able, seen.score**2 / seen.information, 0.0)


def _can_be_put_in(probe: Probe) -> bool:
    """Not shorter physics steps, which are no parameter, nor what one log has by itself."""
    return probe.placed is not None and not probe.by_log


def _extensions(probes: Sequence[Probe]) -> list[Placed]:
    return [probe.placed for probe in probes if probe.placed is not None]


def _can_have(environment: MjcfEnvironment, placed: Sequence[Placed]) -> bool:
    """Whether no two of them write the same number."""
    try:
        extended(environment, placed)
    except ValueError:
        return False
    return True


def _normal(logs: ProbedLogs, prior: Posterior) -> GaussianMixture:
    """Of theta (N + P,) where the logs are linearised."""
    n = logs.windows.num_theta
    precision = logs.arrow.precision[:n, :n] + logs.inner
    mean = logs.theta + np.linalg.solve(precision, logs.arrow.gradient[:n] + logs.pull)
    return GaussianMixture(torch.zeros(1), mean[None], np.linalg.inv(precision)[None], prior.space)


def _draws(own: GaussianMixture, seed: int) -> Particles:
    return Particles(own.sample((4000,), generator=torch.Generator().manual_seed(seed)), own.space)


def _stands(
    larger: _Larger, logs: ProbedLogs, own: GaussianMixture, asked: AskedWindows, options: LargerModelOptions
) -> bool:
    """Whether it is at the optimum of most windows, of about as many as the plain model follows, and groups agree."""
    n, followed = len(asked.theta), larger.asked.windows.num_windows
    left, covariance = (own.mode.numpy() - logs.theta)[:n], own.covariances[0].numpy()[:n, :n]
    settled = 0.5 * float(left @ np.linalg.solve(covariance, left)) <= WindowTuning().most_drift
    many = followed >= max(FOLLOWED.most * larger.asked.among, options.share * asked.windows.num_windows)
    return settled and many and larger.agreement >= options.agree


def _there(larger: _Larger, logs: ProbedLogs, own: GaussianMixture, options: LargerModelOptions) -> list[PutIn]:
    """Causes whose parameters are told from the plain model's, by the one that is told best, the surest first."""
    extensions = _extensions(larger.probes)
    n = logs.windows.num_theta - sum(len(one.parameters) for one in extensions)
    sd = own.stddev.numpy()
    out: list[tuple[float, PutIn]] = []
    for one, probe in zip(extensions, larger.probes, strict=True):
        mine = np.arange(n, n + len(one.parameters))
        n += len(one.parameters)
        sizes = [parameter.default is not None for parameter in one.parameters]  # of others the plain model has none
        away = np.where(sizes, np.abs(logs.theta[mine] - one.plain) / sd[mine], 0.0)
        k = int(away.argmax())
        if away[k] < options.clear:
            continue
        parameter, theta = one.parameters[k], float(logs.theta[mine[k]])
        value, low, high = (float(parameter.value(x)) for x in (theta, theta - sd[mine[k]], theta + sd[mine[k]]))
        remedy = probe.remedy if one.edit is None else f"add {one.sentence} to the model"
        cause = PutIn(one.sentence, parameter.name, value, (high - low) / 2, parameter.unit, remedy)
        out.append((float(away[k]), cause))
    return [cause for _, cause in sorted(out, key=lambda pair: -pair[0])]
