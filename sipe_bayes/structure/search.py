r"""The search over structures: what fits best is extended, round by round; then extensions are left out one by one.

**Steps** (``StructureSearch``), one of them a call of ``step``::

    PLAIN   the model as it is; fitted again, and the search repeated, where an extension gains far more than predicted
      v
    RANK    score tests of all extensions, beside each structure of the beam
      |  something has a predicted gain        nothing has
      v                                           v
    FIT     the best few, one a step           PRUNE   the least needed extension of the best structure left out
      |  some are clearly better                  v
      +--> RANK, with these as the beam         DONE
         none is: PRUNE

**Judgement** is ``comparison``'s alone: a structure is extended where it predicts pieces that it has not seen clearly
better than all that it contains, and is not clearly behind the best one. For a single extension one standard error is
enough: an effect may be clear only beside another. An extension is fitted from a predicted gain of five nats on: one
that gains less than eight in the end is never clear of its own standard error.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.budget import BudgetExhausted, BudgetTooSmall
from sipe_bayes.core.telling import Tell, silent
from sipe_bayes.inference.recorded import Progress
from sipe_bayes.likelihood import BoundLikelihood, QuadraticPrior
from sipe_bayes.structure.augmented import AugmentedModel, DivergesError
from sipe_bayes.structure.candidates import Candidate, rank_candidates
from sipe_bayes.structure.comparison import choose_ties, difference, rank
from sipe_bayes.structure.extension import Extension, Placed, members, placements
from sipe_bayes.structure.fitted import FittedStructure, Fitting
from sipe_bayes.structure.machine import Machine, machine_of
from sipe_bayes.structure.registry import EXTENSIONS, get_extension
from sipe_bayes.structure.state import BUDGET, DiscoverOptions, DiscoverState, Offer, Phase


class StructureSearch:
    """A search over structures, step by step.

    Args:
        fitting: what structures are fitted to.
        extensions: that may be used.
        joints: names of joints, actuators and channels at which they may be placed; default all.
        options: of the search.
        budget: rollouts at most.
        progress: called along the way.
    """

    def __init__(
        self,
        fitting: Fitting,
        extensions: Sequence[Extension],
        joints: Sequence[str] | None = None,
        options: DiscoverOptions | None = None,
        budget: int = BUDGET,
        progress: Progress | None = None,
    ) -> None:
        self.fitting = fitting
        self.extensions, self.joints = tuple(extensions), joints
        self.options, self.budget, self.progress = options or DiscoverOptions(), budget, progress
        self._rollouts, self._fit_rollouts, self._doing = 0, 0, ""  # before the present fit, of it, and what it is for
        self.ended = "budget"  # what ends a search that is cut short: that, "time", or "interrupted"
        self._longest = 0.0  # seconds of a fit of a structure that is not slow
        self._machine: Machine | None = None
        self._placed: dict[str, Placed] = {}
        self._linear: dict[tuple[tuple[str, ...], bytes], AugmentedModel] = {}  # by labels and optimum

    def step(self, state: DiscoverState) -> DiscoverState:
        """One fit or one ranking further."""
        if state.fitted and state.placed_at is None:
            state = replace(state, placed_at=(state.fitted[0].theta, state.fitted[0].starts))
        self.place(state)
        self._rollouts, self._fit_rollouts = state.rollouts, 0
        self._doing = state.describe(len(self._placed))
        self._tell("")
        late = self.is_late or self._ends_late(state)
        if state.phase is not Phase.PLAIN and state.fitted and (late or state.rollouts >= self.budget):
            self.ended = "time" if late else self.ended
            return replace(state, phase=Phase.DONE, cut=state.cut if state.done else state.phase)
        state = {
            Phase.PLAIN: self._plain,
            Phase.RANK: self._rank,
            Phase.FIT: self._fit,
            Phase.PRUNE: self._prune,
            Phase.DONE: lambda state: state,
        }[state.phase](state)
        if state.cut is None:
            return state
        self.ended = "time" if self.is_late else self.ended
        return replace(state, phase=Phase.DONE)

    @property
    def is_late(self) -> bool:
        """Whether the time limit has passed."""
        return self.fitting.is_late

    def _ends_late(self, state: DiscoverState) -> bool:
        """Whether the next fit would end after the time limit, if it takes as long as the longest one until now."""
        if state.phase is not Phase.FIT:
            return False
        return time.monotonic() + self._longest * self._slowness(state.queue[0]) > self.fitting.ends

    def _tell(self, what: str, rollouts: int = 0, _: int = 0) -> None:
        """How far the present step is, after some rollouts of a fit of its own; fewer are those of its next fit."""
        if rollouts < self._fit_rollouts:
            self._rollouts += self._fit_rollouts
        self._fit_rollouts = rollouts
        if self.progress is not None:
            self.progress(f"{self._doing}{what and ': '}{what}", self._rollouts + rollouts, self.budget)

    @property
    def is_restricted(self) -> bool:
        """Whether some of the usual extensions may not be tried, or not everywhere."""
        usual = {name for name in EXTENSIONS if not get_extension(name).by_name}
        return self.joints is not None or not usual <= {extension.name for extension in self.extensions}

    def linear_model(
        self, one: FittedStructure, tell: Tell = silent, windows: BoundLikelihood | None = None
    ) -> AugmentedModel:
        """Of a structure beside all extensions that may be tried beside it; made once.

        Raises:
            DivergesError: where its simulation does.
        """
        key, own = (one.labels, one.theta.tobytes()), self.structure(one.labels)
        if key not in self._linear:
            simulator, lin = self.fitting.simulator(own), None
            whole = windows = self.fitting.windows(simulator) if windows is None else windows
            if self._slowness(one.labels) > 1:  # its residuals, beside what columns do without it
                (residual,), _ = windows.residuals(one.theta[None], one.starts[None])
                quick = self.fitting.windows(self.fitting.simulator([p for p in own if p.extension.slow == 1]))
                quick.rollouts, quick.budget, quick.deadline = windows.rollouts, windows.budget, windows.deadline
                lin = replace(quick.linearise(one.theta, one.starts), residual=residual)
                whole.rollouts = quick.rollouts
                windows, lin = (quick, lin) if lin.valid else (whole, None)
            taken = {*one.labels, *(t for p in own for q in p.parameters for t in q.targets)}
            every = self._placed.values()
            rest = [p for p in every if not taken & {p.label, *(t for q in p.parameters for t in q.targets)}]
            prior = QuadraticPrior.of(self.fitting.prior_of(simulator))
            at = one.theta, one.noise, one.starts, prior
            try:
                self._linear[key] = AugmentedModel(windows, *at, lin, tell=tell, placed=rest)
            finally:
                whole.rollouts = windows.rollouts
        return self._linear[key]

    @property
    def placed(self) -> dict[str, Placed]:
        """The extensions wherever the machine has a place for them, after the first step."""
        return self._placed

    def supported(self, state: DiscoverState, refused: Sequence[tuple[str, ...]] = ()) -> list[FittedStructure]:
        """The set that the logs support: ties, the simplest one first, of native elements where these do as well.

        refused: labels of structures that are not to be in it.
        """

        def simple(one: FittedStructure) -> tuple[int, bool, float]:
            native = all(self._placed[label].extension.native for label in one.labels)
            return len(one.labels), not native, -rank(one)[1]

        return sorted(choose_ties([one for one in self._counted(state) if one.labels not in refused]), key=simple)

    def _counted(self, state: DiscoverState) -> list[FittedStructure]:
        """Those fitted to the end that predict held-out logs not worse than the plain model by a standard error."""
        held = len(self.fitting.trajectories)
        worse = [(gain := difference(state.fitted[0], one, held)).nats > gain.error for one in state.fitted]
        return [one for one, bad in zip(state.fitted, worse, strict=True) if one.labels != state.cut_off and not bad]

    def enough(self, labels: Sequence[str]) -> int:
        """Rollouts that the fit of a structure may have."""
        return max(self.options.fit_budget, self.fitting.enough(self.structure(labels)))

    def structure(self, labels: Sequence[str]) -> list[Placed]:
        """The extensions of a structure."""
        return [self._placed[label] for label in labels]

    def place(self, state: DiscoverState) -> None:
        """Place the extensions, once the plain model is fitted."""
        if self._placed or not state.fitted:
            return
        windows = self.fitting.windows(self.fitting.simulator([]))
        self._machine = machine_of(windows, *(state.placed_at or (state.fitted[0].theta, state.fitted[0].starts)))
        every = (p for e in self.extensions for p in placements(e, self._machine))
        if self.fitting.spans:
            every = (p for p in every if all(parameter.log is None for parameter in p.parameters))
        allowed = None if self.joints is None else set(self.joints)
        self._placed = {p.label: p for p in every if allowed is None or allowed.issuperset(members(p.site))}

    def _plain(self, state: DiscoverState) -> DiscoverState:
        """The nominal model fitted."""
        budget = min(self.enough([]), int(self.options.plain_share * self.budget))
        plain = replace(self.fitting, ends=math.inf).fit([], None, max(budget, 1), self._tell)
        return replace(state, fitted=(plain,), phase=Phase.RANK)

    def _rank(self, state: DiscoverState) -> DiscoverState:
        """Predicted gains beside one structure of the beam; or which structures are to be fitted."""
        for labels in state.beam:
            if labels not in state.ranked and len(labels) < self.options.most:
                here = state.of(labels)
                assert here is not None
                return self._ranked(state, here)
        queue = self._queue(state)
        return replace(state, queue=queue, phase=Phase.FIT if queue else Phase.PRUNE)

    def _queue(self, state: DiscoverState) -> tuple[tuple[str, ...], ...]:
        """The structures with the largest predicted gains, beside what their part gains already; no tried ones.

        Beside the model as it is, as many again with a quarter of the best one's: far from the truth these are
        rough.
        """
        options, plain, queue = self.options, state.fitted[0], dict[frozenset[str], tuple[float, tuple[str, ...]]]()
        for labels in state.beam:
            here = state.of(labels)
            before = 0.0 if here is None else rank(here)[1] - rank(plain)[1]
            own = {offer.label: offer for offer in state.offers if offer.at == labels}  # the last of each
            for offer in own.values():
                grown = (*labels, offer.label)
                if offer.gain > options.least_gain and not state.is_tried(grown):
                    queue.setdefault(frozenset(grown), (before + offer.gain, grown))
        ranked = sorted(queue.values(), key=lambda item: -item[0])
        best = ranked[0][0] if ranked else 0.0
        most = 2 * options.width if state.beam == ((),) else options.width
        close = [(gain, grown) for gain, grown in ranked[options.width : most] if gain >= best / 4]
        chosen = [grown for _, grown in ranked[: options.width] + close]
        return tuple(sorted(chosen, key=self._slowness))  # more is known where the time ends within a round

    def _slowness(self, labels: Sequence[str]) -> int:
        """How many times as long as another one's a simulation of a structure takes."""
        return max((one.extension.slow for one in self.structure(labels)), default=1)

    def _ranked(self, state: DiscoverState, here: FittedStructure) -> DiscoverState:
        """The state with predicted gains beside a structure, best first; cut where the budget ends."""
        windows = self.fitting.windows(self.fitting.simulator(self.structure(here.labels)))
        windows.budget, ranked, cut = max(self.budget - state.rollouts, 0), list[Candidate](), None
        try:
            ranked = rank_candidates(self.linear_model(here, lambda what: self._tell(what, windows.rollouts), windows))
        except BudgetExhausted:
            cut = state.phase
        except (DivergesError, np.linalg.LinAlgError):  # nothing can be predicted
            ranked = []
        offers = tuple(Offer(here.labels, c.placed.label, c.gain, c.theta, c.others) for c in ranked)
        ranks = state.rank_rollouts + windows.rollouts
        done = (*state.ranked, here.labels) if cut is None else state.ranked
        return replace(state, offers=state.offers + offers, ranked=done, rank_rollouts=ranks, cut=cut)

    def _fit(self, state: DiscoverState) -> DiscoverState:
        labels, *rest = state.queue
        offer = next(o for o in reversed(state.offers) if (*o.at, o.label) == labels)
        state = self._fitted(state, labels, np.concatenate([offer.others, offer.theta]), state.of(offer.at))
        if state.cut is not None:
            return state
        state = replace(state, queue=tuple(rest))
        one, plain = state.of(labels), state.fitted[0]
        if one and not offer.at and () not in state.pruned and one.evidence - plain.evidence > 2 * offer.gain:
            state = self._replaced(state, one)
            if state.cut is not None or not state.ranked:
                return state
        if rest:
            return state
        beam = self._next_beam(state)
        return replace(state, beam=beam, phase=Phase.RANK) if beam else replace(state, phase=Phase.PRUNE)

    def _replaced(self, state: DiscoverState, one: FittedStructure) -> DiscoverState:
        """Re-estimate the plain model from the optimum of a structure that gains far more than predicted.

        Such a gain is that of another local optimum. If the plain model reaches it, the search is repeated from there.
        """
        before, state = state.fitted[0], self._without(state, one, ())
        plain = state.fitted[0]
        if state.cut is not None or plain.evidence < before.evidence + self.options.least_gain:
            return state
        self._placed, spent = {}, sum(other.rollouts for other in state.fitted[1:])
        anew = DiscoverState(Phase.RANK, (plain,), pruned=((),), budget=state.budget)
        return replace(anew, rank_rollouts=state.rank_rollouts, failed_rollouts=state.failed_rollouts + spent)

    def _next_beam(self, state: DiscoverState) -> tuple[tuple[str, ...], ...]:
        """Labels of the best new structures that are clearly better than what they contain, and not clearly behind."""
        best = max(state.fitted, key=rank)
        new = [one for one in state.fitted if one.labels not in state.ranked and not difference(best, one).clear]
        better = [
            one
            for one in new
            if all(_is_better(one, part) for part in state.fitted if set(part.labels) < set(one.labels))
        ]
        return tuple(one.labels for one in sorted(better, key=rank, reverse=True)[: self.options.beam])

    def _prune(self, state: DiscoverState) -> DiscoverState:
        """The best structure without the extension that it needs least, from where it ended; until one is needed."""
        best = max(self._counted(state), key=rank)
        needs = dict.fromkeys(best.labels, 0.0)
        if len(best.labels) > 1:
            needs, spent = self.fitting.needs(self.structure(best.labels), best)
            state = replace(state, rank_rollouts=state.rank_rollouts + spent)
        for left_out in sorted(best.labels, key=lambda label: needs[label]):
            labels = tuple(label for label in best.labels if label != left_out)
            if labels not in state.pruned and labels not in state.failed:
                return self._without(state, best, labels)
            without = state.of(labels)
            if without is not None and difference(best, without).clear and needs[left_out]:
                break
        return replace(state, phase=Phase.DONE)

    def _without(self, state: DiscoverState, one: FittedStructure, labels: tuple[str, ...]) -> DiscoverState:
        """With a structure that has only those ``labels`` of another one, fitted from where that one ended."""
        keep = [i for i, label in enumerate(self._owners(one)) if label in (None, *labels)]
        before, failed = state.of(labels), state.failed
        state = self._fitted(state, labels, one.theta[keep], one)
        if before is not None:  # a failure says nothing then
            state = replace(state, fitted=_merged(state.fitted, before), failed=failed, cut_off=None)
        return replace(state, pruned=(*state.pruned, labels))

    def _owners(self, one: FittedStructure) -> list[str | None]:
        """Whose each parameter of a structure is: None for the user's own."""
        count = len(one.theta) - sum(len(self._placed[label].parameters) for label in one.labels)
        own: list[str | None] = [None] * count
        return own + [label for label in one.labels for _ in self._placed[label].parameters]

    def _fitted(
        self, state: DiscoverState, labels: tuple[str, ...], initial: FloatArray, begin: FittedStructure | None
    ) -> DiscoverState:
        left, cut, began = max(self.budget - state.rollouts, 0), None, time.monotonic()
        self._rollouts, self._fit_rollouts = state.rollouts, 0
        parts = [other for other in state.fitted if set(other.labels) < set(labels)]
        part = max(parts, key=lambda other: other.evidence, default=None)
        try:
            most = self.enough(labels)
            cut = state.phase if left < most else None
            budget = max(min(most, left), 1)
            one = self.fitting.fit(self.structure(labels), initial, budget, self._tell, begin, part)
            cut = state.phase if self.is_late else cut
            self._longest = max(self._longest, (time.monotonic() - began) / self._slowness(labels))
        except (BudgetTooSmall, np.linalg.LinAlgError, ValueError) as error:
            spent = state.failed_rollouts + self._fit_rollouts
            cut = (state.phase if self.is_late else cut) if isinstance(error, BudgetTooSmall) else None
            return replace(state, failed=(*state.failed, labels), failed_rollouts=spent, cut=cut)
        if one.settled:
            return replace(state, fitted=(*state.fitted, one))
        if state.surpasses(one):  # on the way, with the noise of a stage that is not the last
            spent = state.failed_rollouts + one.rollouts
            return replace(state, failed=(*state.failed, labels), failed_rollouts=spent, cut=cut)
        cut_off = None if cut is None else labels
        return replace(state, fitted=(*state.fitted, one), cut=cut, cut_off=cut_off)


def _is_better(one: FittedStructure, part: FittedStructure) -> bool:
    """Whether a structure is clearly better than its part; for a single extension one standard error is enough."""
    gain = difference(one, part)
    return gain.clear or (len(one.labels) == 1 and gain.nats > gain.error)


def _merged(fitted: tuple[FittedStructure, ...], before: FittedStructure) -> tuple[FittedStructure, ...]:
    """With the better one of two fits of a structure, the later of which comes last, in the place of the first."""
    *rest, again = fitted
    if again is before or set(again.labels) != set(before.labels):
        return fitted
    better = again if again.evidence > before.evidence and again.settled >= before.settled else before
    better = replace(better, labels=before.labels, rollouts=before.rollouts + again.rollouts)
    return tuple(better if one is before else one for one in rest)
