"""What a search over structures says about a problem's logs: before and after, what remains, what to believe."""

from __future__ import annotations

import functools
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from sipe_bayes.calibration.gathered import Marginals, no_rigid_bodies
from sipe_bayes.calibration.problem import Problem
from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.findings import Code, Finding, finding
from sipe_bayes.core.parameters import ParameterSpace
from sipe_bayes.core.telling import Tell, silent
from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.diagnostics import evaluate
from sipe_bayes.diagnostics.bands import predictive_bands
from sipe_bayes.diagnostics.discovery import Discovery, ModelErrors, Piece, Promise, Stage
from sipe_bayes.diagnostics.misfit import misfit
from sipe_bayes.diagnostics.records import Comparison, Signal
from sipe_bayes.diagnostics.result import ParameterSummary
from sipe_bayes.envs.unknowns import bounded_by_nature
from sipe_bayes.likelihood import BoundLikelihood, QuadraticPrior
from sipe_bayes.posterior import GaussianMixture, Particles
from sipe_bayes.posterior import prior as default_prior
from sipe_bayes.simulation.simulator import Simulator
from sipe_bayes.structure.augmented import AugmentedModel
from sipe_bayes.structure.comparison import difference, rank
from sipe_bayes.structure.discrepancy import Discrepancy, find_discrepancy
from sipe_bayes.structure.fitted import FittedStructure, Fitting
from sipe_bayes.structure.state import Phase
from sipe_bayes.structure.structures import Structures

_BEFORE = {
    Phase.PLAIN: "the model as it is was fitted to the end",
    Phase.RANK: "what the model may lack was ranked",
    Phase.FIT: "all extensions with a predicted gain were fitted",
    Phase.PRUNE: "extensions that the best structure may not need were left out",
}
"""What a search that was cut short did not come to, by what it was doing."""


def without_worse(problem: Problem, structures: Structures, tell: Tell = silent) -> Structures:
    """Without structures whose errors on held-out logs are larger than the plain model's, if they were to be written.

    Larger by more than one standard error, from the initial states that each model fits best.
    """
    while structures.best is not structures.plain:
        after, before = (_Model(problem, structures, one, tell) for one in (structures.best, structures.plain))
        comparison = _comparison(problem, before, after)
        if comparison is None or not comparison.falls_behind:
            break
        structures = replace(structures, refused=(*structures.refused, structures.best.labels))
    return structures


def summarise(
    problem: Problem, structures: Structures, name: str, seed: int, began: float, tell: Tell = silent
) -> Discovery:
    """Everything that is told of a search.

    Args:
        problem: whose logs were searched.
        structures: that were fitted.
        name: of the run.
        seed: of draws.
        began: when the search did, by ``time.monotonic``; the comparison may take longer than the search.
        tell: called with what is being done.
    """
    after = _Model(problem, structures, structures.best, tell)
    before = after
    if structures.best is not structures.plain:  # whose intervals are not asked for
        before = _Model(problem, structures, structures.plain, tell, asks_all=False)
    logs = ({} if problem.holdout is None else {"holdout": problem.holdout}) | {"train": problem.train}
    compared = [row for use, own in logs.items() for row in _errors(use, before, after, own)]
    stacked = Marginals.of(structures.posterior, problem.prior, seed)
    plain, left, space = before.stage(seed), after.stage(seed), after.simulator.space
    further = after.further(seed) if left.misfit is None or left.misfit.matters else None
    added = list[ParameterSummary]()
    for piece in structures.placed(structures.best):
        if piece.parameters:
            posterior = structures.posterior_of_piece(piece.label)
            marginals = Marginals.of(posterior, default_prior(posterior.space), seed)
            added += marginals.summaries(_part(further, posterior.space))
    return Discovery(
        name=name,
        rows=tuple(structures.table()),
        pieces=_pieces(structures),
        promises=_promises(structures),
        posterior=structures.posterior,
        prior=problem.prior,
        parameters=tuple(stacked.summaries(_part(further, problem.prior.space))),
        plain_parameters=tuple(before.summaries(seed)),
        added=tuple(added),
        best=dict(zip(space.names, space.values(after.one.theta).tolist(), strict=True)),
        errors=tuple(compared),
        comparison=_comparison(problem, before, after),
        before=plain,
        after=left,
        signals=tuple(_signals(before, after, logs, seed)),
        settled=structures.settled,
        best_settled=structures.best.settled,
        ended=structures.search.ended if structures.state.cut is not None else "",
        rollouts=structures.rollouts,
        seconds=time.monotonic() - began,
        findings=(
            *_cut_short(structures),
            *no_rigid_bodies(problem.environment, problem.prior, 0, prior=True),
            *_thinned(problem, structures),
        ),
    )


def _cut_short(structures: Structures) -> list[Finding]:
    """That the search was cut short, where it was, and which extensions it did not try, or not to the end."""
    state, search, names = structures.state, structures.search, list[str]()
    if state.cut is None:
        return []
    why, remedy = {
        "budget": (f"with its budget of {search.budget} rollouts", f"give --budget {2 * search.budget}"),
        "time": ("at its time limit", "give a longer --time-limit"),
        "interrupted": ("when it was interrupted", "run the same command"),
    }[search.ended]
    if state.cut is Phase.FIT:
        names = [" with ".join(search.placed[label].sentence for label in labels) for labels in state.queue]
    elif state.cut is not Phase.PRUNE:
        names = [p.sentence for p in search.placed.values() if p.label not in structures.best.labels]
    if len(names) > 3:
        names = [*names[:3], f"{len(names) - 3} more"]
    untried = f" (left open: {'; '.join(names)})" if names else ""
    return [finding(Code.STRUCTURES_CUT_SHORT, why=why, before=_BEFORE[state.cut], untried=untried, remedy=remedy)]


def _thinned(problem: Problem, structures: Structures) -> list[Finding]:
    """That the search has left out parts of long logs, where it has."""
    fitting = structures.search.fitting
    windows = fitting.windows(fitting.simulator([]))
    used, logs = float((windows.stride * windows.dt).sum()), problem.train
    all_of = float((logs.length * logs.dt).sum())
    return [finding(Code.SEARCHED_ON_PARTS, used=used, all=all_of)] if used < 0.99 * all_of else []


@dataclass(frozen=True)
class _Model:
    """A fitted structure bound to the problem's logs.

    asks_all: whether its residuals are compared with all extensions, not with those alone that were tried.
    """

    problem: Problem
    structures: Structures
    one: FittedStructure
    tell: Tell
    asks_all: bool = True

    @functools.cached_property
    def simulator(self) -> Simulator:
        """Of the structure."""
        return self.structures.simulator(self.one)

    @functools.cached_property
    def posterior(self) -> GaussianMixture:
        """Of all its parameters."""
        return self.structures.posterior_of(self.one)

    @property
    def fitting(self) -> Fitting:
        """What it was fitted to."""
        return self.structures.search.fitting

    def windows(self, logs: Trajectories, like: BoundLikelihood | None = None) -> BoundLikelihood:
        """By which logs are scored and drawn."""
        return BoundLikelihood(replace(self.problem.segments, fit=None), self.simulator, logs, like)

    def predicted(self, windows: BoundLikelihood) -> FloatArray:
        """Predictions (W, L, C) from measured starts."""
        theta = self.one.theta[None]
        return windows.predict(theta, evaluate.measured_starts(windows, theta))[0][0]

    def summaries(self, seed: int) -> list[ParameterSummary]:
        """All parameters of the structure."""
        natural = bounded_by_nature(self.simulator.model, self.simulator.space)
        return Marginals.of(self.posterior, self.fitting.prior_of(self.simulator), seed, natural).summaries()

    @functools.cached_property
    def found(self) -> Discrepancy | None:
        """What it lacks, or may lack, by the training logs; None where the simulation diverges."""
        search, one = self.structures.search, self.one
        try:
            if self.asks_all and search.is_restricted:
                windows = self.fitting.windows(self.simulator)
                prior = QuadraticPrior.of(self.fitting.prior_of(self.simulator))
                logs = AugmentedModel(windows, one.theta, one.noise, one.starts, prior, tell=self.tell)
            else:
                logs = search.linear_model(one, self.tell)
            return find_discrepancy(logs, self.problem.tolerances)
        except ValueError:  # LinAlgError is one
            return None

    def further(self, seed: int) -> Particles | None:
        """Of all parameters that a further log would ask for; None where that cannot be said."""
        try:
            return None if self.found is None else self.found.draw(self.posterior, seed)
        except ValueError:  # a finished search is not lost to its last check
            return None

    def stage(self, seed: int) -> Stage:
        """What it leaves of the training logs."""
        windows, one = self.fitting.windows(self.simulator), self.one
        residuals = evaluate.fitted_residuals(windows, one.theta, one.noise, one.starts)
        seen = None if self.found is None else misfit(self.found, self.posterior.stddev.numpy(), seed)
        return Stage(evaluate.channel_noise(windows, one.noise), seen, tuple(residuals))


def _errors(use: str, before: _Model, after: _Model, logs: Trajectories) -> list[ModelErrors]:
    """Of logs under the plain model and under the structure, from measured starts and from fitted ones."""
    extended = after.windows(logs)
    plain = before.windows(logs, extended)
    default = np.clip(plain.simulator.space.default_theta, 0, 1)
    old, given = evaluate.errors(plain, np.stack([before.one.theta, default]))
    (new,) = evaluate.errors(extended, after.one.theta[None])
    fits = (evaluate.errors_from_best_starts(w, m.one.theta) for w, m in ((plain, before), (extended, after)))
    kinds = (given, old, new, *fits)
    return [
        ModelErrors(log, use, *channel, *(float(rmse[k, c]) for rmse in kinds))
        for k, log in enumerate(logs.names)
        for c, channel in enumerate(zip(plain.fitted, evaluate.fitted_units(plain), strict=True))
        if not np.isnan(old[k, c])
    ]


def _signals(before: _Model, after: _Model, logs: Mapping[str, Trajectories], seed: int) -> list[Signal]:
    """Of the structure, with the calibrated plain model in place of the model as given; logs by their use."""
    windows = {use: after.windows(own) for use, own in logs.items()}
    plain = {use: before.windows(own, windows[use]) for use, own in logs.items()}
    predicted = {use: np.stack([after.predicted(windows[use]), before.predicted(plain[use])]) for use in logs}
    bands = predictive_bands(windows, predicted, after.one.theta, after.posterior, seed)
    return [line for use in logs for line in evaluate.signals(windows[use], use, predicted[use], bands[use])]


def _comparison(problem: Problem, before: _Model, after: _Model) -> Comparison | None:
    if problem.holdout is None or not after.one.labels:
        return None
    windows = after.windows(problem.holdout)
    reference = before.windows(problem.holdout, windows), before.one.theta
    return evaluate.compare_errors(windows, after.one.theta, reference, fit_starts=True)


def _pieces(structures: Structures) -> tuple[Piece, ...]:
    """The extensions with a name that were fitted, those of the structure that is written out first.

    The gain of each is what it adds to the rest of the best structure that has it.
    """
    pieces = []
    for label, weight in structures.inclusion().items():
        placed, kept = structures.search.placed[label], label in structures.best.labels
        one = max((one for one in structures.fitted if label in one.labels), key=rank)
        rest = structures.state.of([other for other in one.labels if other != label])
        gain, error = (None, None) if rest is None else difference(one, rest)
        tied = not kept and any(label in one.labels for one in structures.supported[1:])
        extension, names = placed.extension, tuple(p.name for p in placed.parameters)
        judged = weight, gain, error, kept, tied
        mjcf = extension.kind, extension.native, extension.nearest
        pieces.append(Piece(label, placed.sentence, extension.reference, *judged, *mjcf, names))
    return tuple(sorted(pieces, key=lambda piece: not piece.kept))


def _part(every: Particles | None, space: ParameterSpace) -> Particles | None:
    """The draws of a space's parameters alone."""
    if every is None:
        return None
    columns = [every.space.names.index(name) for name in space.names]
    return Particles(every.theta[:, columns], space, weights=every.weights)


def _promises(structures: Structures) -> tuple[Promise, ...]:
    tried = {label for one in structures.fitted for label in one.labels}
    failed = {label for labels in structures.state.failed for label in labels}
    names = {label: placed.sentence for label, placed in structures.search.placed.items()}
    return tuple(
        Promise(o.label, names[o.label], o.gain, o.label in tried, o.label in failed) for o in structures.offers()
    )
