r"""The search over structures: what fits best is extended, round by round; then extensions are left out one by one.

**Steps** (``StructureSearch.step``)::

    PLAIN   the model as it is; fitted again, and the search repeated, where an extension gains far more than predicted
      v
    RANK    score tests of all extensions, beside each structure of the beam
      |  something has a predicted gain        nothing has
      v                                           v
    FIT     the best few, one a step           PRUNE   the least needed extension of the best structure left out
      |  some are clearly better                  v
      +--> RANK, with these as the beam         DONE
         none is: PRUNE
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
from sipe_bayes.structure.comparison import choose_ties, difference, parts_of, rank
from sipe_bayes.structure.extension import Extension, Placed, members, placements
from sipe_bayes.structure.fitted import FittedStructure, Fitting
from sipe_bayes.structure.machine import machine_of
from sipe_bayes.structure.registry import EXTENSIONS, get_extension
from sipe_bayes.structure.state import BUDGET, DiscoverState, Labels, Offer, Phase


class StructureSearch:
    """A search over structures with some extensions, of ``budget`` rollouts, step by step.

    ``sites`` are the joints, actuators and channels at which extensions may be placed, by default all; ``placed`` are
    these extensions by label, once the plain model is fitted. ``ended`` says what ends a search that is cut short: its
    "budget", its "time", or that it was "interrupted".
    """

    width = 3  # structures that are fitted in a round; in the first up to twice as many
    beam = 2  # structures that a round extends
    most = 5  # extensions of a structure
    least_gain = 5.0  # predicted nats from which an extension is fitted: below eight it is never clear of its error
    plain_share = 0.5  # of the budget, for the model as it is at most

    def __init__(
        self,
        fitting: Fitting,
        extensions: Sequence[Extension],
        sites: Sequence[str] | None = None,
        budget: int = BUDGET,
        progress: Progress | None = None,
    ) -> None:
        self.fitting, self.extensions, self.sites = fitting, tuple(extensions), sites
        self.budget, self.progress, self.ended = budget, progress, "budget"
        self.placed: dict[str, Placed] = {}
        self._rollouts, self._fit_rollouts, self._doing = 0, 0, ""  # before the present fit, of it, and what it is for
        self._longest = 0.0  # seconds of a fit of a structure that is not slow
        self._linear: dict[tuple[Labels, bytes], AugmentedModel] = {}  # by labels and optimum

    def step(self, state: DiscoverState) -> DiscoverState:
        """One fit or one ranking further."""
        state = self.place(state)
        self._rollouts, self._fit_rollouts, self._doing = state.rollouts, 0, state.describe(len(self.placed))
        self._tell("")
        if state.phase is not Phase.PLAIN:
            needed = self._longest * self._slowness(state.queue[0]) if state.phase is Phase.FIT else 0.0
            late = time.monotonic() + needed > self.fitting.ends
            if late or state.rollouts >= self.budget:
                self.ended = "time" if late else self.ended
                return replace(state, phase=Phase.DONE, cut=state.phase)
        steps = {Phase.PLAIN: self._plain, Phase.RANK: self._rank, Phase.FIT: self._fit, Phase.PRUNE: self._prune}
        state = steps[state.phase](state)
        if state.cut is None:
            return state
        self.ended = "time" if self.fitting.is_late else self.ended
        return replace(state, phase=Phase.DONE)

    def place(self, state: DiscoverState) -> DiscoverState:
        """Place the extensions, once the plain model is fitted; the state says by which motion."""
        if state.fitted and state.placed_at is None:
            state = replace(state, placed_at=(state.fitted[0].theta, state.fitted[0].starts))
        if state.placed_at is not None and not self.placed:
            machine = machine_of(self.fitting.windows(self.fitting.simulator([])), *state.placed_at)
            every = [piece for extension in self.extensions for piece in placements(extension, machine)]
            if self.fitting.spans:
                every = [piece for piece in every if all(p.log is None for p in piece.parameters)]
            if self.sites is not None:
                every = [piece for piece in every if set(members(piece.site)) <= set(self.sites)]
            self.placed = {piece.label: piece for piece in every}
        return state

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
        return self.sites is not None or not usual <= {extension.name for extension in self.extensions}

    def structure(self, labels: Sequence[str]) -> list[Placed]:
        """The extensions of a structure."""
        return [self.placed[label] for label in labels]

    def linear_model(
        self, one: FittedStructure, tell: Tell = silent, windows: BoundLikelihood | None = None
    ) -> AugmentedModel:
        """Of a structure beside all extensions that may be tried beside it; made once.

        Raises:
            DivergesError: where its simulation does.
        """
        key, pieces = (one.labels, one.theta.tobytes()), self.structure(one.labels)
        if key in self._linear:
            return self._linear[key]
        simulator, lin = self.fitting.simulator(pieces), None
        whole = windows = self.fitting.windows(simulator) if windows is None else windows
        if self._slowness(one.labels) > 1:  # its residuals, beside what columns do without it
            (residual,), _ = windows.residuals(one.theta[None], one.starts[None])
            quick = self.fitting.windows(self.fitting.simulator([p for p in pieces if p.extension.slow == 1]))
            quick.rollouts, quick.budget, quick.deadline = windows.rollouts, windows.budget, windows.deadline
            lin = replace(quick.linearise(one.theta, one.starts), residual=residual)
            whole.rollouts = quick.rollouts
            windows, lin = (quick, lin) if lin.valid else (whole, None)
        taken = {target for piece in pieces for target in _writes(piece)}
        rest = [piece for piece in self.placed.values() if not taken & _writes(piece)]
        prior = QuadraticPrior.of(self.fitting.prior_of(simulator))
        try:
            model = AugmentedModel(windows, one.theta, one.noise, one.starts, prior, lin, tell=tell, placed=rest)
        finally:
            whole.rollouts = windows.rollouts
        self._linear[key] = model
        return model

    def supported(self, state: DiscoverState, refused: Sequence[Labels] = ()) -> list[FittedStructure]:
        """The set that the logs support: ties, the simplest one first, of native elements where these do as well.

        refused: labels of structures that are not to be in it.
        """

        def simple(one: FittedStructure) -> tuple[int, bool, float]:
            native = all(piece.extension.native for piece in self.structure(one.labels))
            return len(one.labels), not native, -rank(one)[1]

        return sorted(choose_ties([one for one in self._counted(state) if one.labels not in refused]), key=simple)

    def _counted(self, state: DiscoverState) -> list[FittedStructure]:
        """Those fitted to the end that predict held-out logs not worse than the plain model by a standard error."""
        held, counted = len(self.fitting.trajectories), []
        for one in state.fitted:
            loss = difference(state.fitted[0], one, since=held)
            if one.labels != state.cut_off and loss.nats <= loss.error:
                counted.append(one)
        return counted

    def _plain(self, state: DiscoverState) -> DiscoverState:
        """The nominal model fitted, without a time limit."""
        budget = min(self.fitting.enough([]), int(self.plain_share * self.budget))
        plain = replace(self.fitting, ends=math.inf).fit([], None, max(budget, 1), self._tell)
        return replace(state, fitted=(plain,), phase=Phase.RANK)

    def _rank(self, state: DiscoverState) -> DiscoverState:
        """Predicted gains beside one structure of the beam; or which structures are to be fitted."""
        for labels in state.beam:
            here = state.of(labels)
            if here is not None and labels not in state.ranked and len(labels) < self.most:
                return self._ranked(state, here)
        queue = self._queue(state)
        return replace(state, queue=queue, phase=Phase.FIT if queue else Phase.PRUNE)

    def _ranked(self, state: DiscoverState, here: FittedStructure) -> DiscoverState:
        """The state with predicted gains beside a structure, best first; cut where the budget ends."""
        windows = self.fitting.windows(self.fitting.simulator(self.structure(here.labels)))
        windows.budget, ranked, cut = max(self.budget - state.rollouts, 0), list[Candidate](), None
        try:
            ranked = rank_candidates(self.linear_model(here, lambda what: self._tell(what, windows.rollouts), windows))
        except BudgetExhausted:
            cut = state.phase
        except (DivergesError, np.linalg.LinAlgError):  # nothing can be predicted
            pass
        offers = tuple(Offer(here.labels, c.placed.label, c.gain, c.theta, c.others) for c in ranked)
        ranks = state.rank_rollouts + windows.rollouts
        done = (*state.ranked, here.labels) if cut is None else state.ranked
        return replace(state, offers=state.offers + offers, ranked=done, rank_rollouts=ranks, cut=cut)

    def _queue(self, state: DiscoverState) -> tuple[Labels, ...]:
        """The structures with the largest predicted gains, beside what their part gains already; no tried ones.

        Beside the model as it is, as many again with a quarter of the best one's: far from the truth these are
        rough.
        """
        queue, at = dict[frozenset[str], tuple[float, Labels]](), {one.labels: rank(one)[1] for one in state.fitted}
        for labels in state.beam:
            last = {offer.label: offer for offer in state.offers if offer.at == labels}
            for offer in last.values():
                grown = (*labels, offer.label)
                if offer.gain > self.least_gain and not state.is_tried(grown):
                    queue.setdefault(frozenset(grown), (at[labels] - at[()] + offer.gain, grown))
        ranked = sorted(queue.values(), key=lambda item: -item[0])
        close = [item for item in ranked[self.width : 2 * self.width] if item[0] >= ranked[0][0] / 4]
        chosen = ranked[: self.width] + (close if state.beam == ((),) else [])
        return tuple(sorted((grown for _, grown in chosen), key=self._slowness))  # slow ones where time is left

    def _slowness(self, labels: Sequence[str]) -> int:
        """How many times as long as another one's a simulation of a structure takes."""
        return max((piece.extension.slow for piece in self.structure(labels)), default=1)

    def _fit(self, state: DiscoverState) -> DiscoverState:
        """The next structure of the queue fitted; behind the last one, the beam of the next round."""
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
        if state.cut is not None or plain.evidence < before.evidence + self.least_gain:
            return state
        self.placed, spent = {}, sum(other.rollouts for other in state.fitted[1:])
        anew = DiscoverState(Phase.RANK, (plain,), pruned=((),), budget=state.budget)
        return replace(anew, rank_rollouts=state.rank_rollouts, failed_rollouts=state.failed_rollouts + spent)

    def _next_beam(self, state: DiscoverState) -> tuple[Labels, ...]:
        """Labels of the best new structures that are clearly better than what they contain, and not clearly behind.

        For a single extension one standard error is enough: an effect may be clear only beside another.
        """

        def is_better(one: FittedStructure, part: FittedStructure) -> bool:
            gain = difference(one, part)
            return gain.nats > (1.0 if len(one.labels) == 1 else 2.0) * gain.error

        best = max(state.fitted, key=rank)
        new = [one for one in state.fitted if one.labels not in state.ranked and not difference(best, one).clear]
        better = [one for one in new if all(is_better(one, part) for part in parts_of(one.labels, state.fitted))]
        return tuple(one.labels for one in sorted(better, key=rank, reverse=True)[: self.beam])

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

    def _without(self, state: DiscoverState, one: FittedStructure, labels: Labels) -> DiscoverState:
        """With a structure that has only those ``labels`` of another one, fitted from where that one ended.

        Of two fits of a structure the better one stays, in the place of the first.
        """
        own = one.columns(self.structure(one.labels))
        left_out = np.concatenate([own[label] for label in one.labels if label not in labels])
        before, after = state.of(labels), self._fitted(state, labels, np.delete(one.theta, left_out), one)
        if before is not None:  # a failure says nothing then
            fitted = state.fitted
            if len(after.fitted) > len(fitted):
                again = after.fitted[-1]
                best = again if again.evidence > before.evidence and again.settled >= before.settled else before
                best = replace(best, labels=before.labels, rollouts=before.rollouts + again.rollouts)
                fitted = tuple(best if other is before else other for other in fitted)
            after = replace(after, fitted=fitted, failed=state.failed, cut_off=None)
        return replace(after, pruned=(*state.pruned, labels))

    def _fitted(
        self, state: DiscoverState, labels: Labels, initial: FloatArray, begin: FittedStructure | None
    ) -> DiscoverState:
        """With the fit of a structure from ``initial`` (N + P,) and the initial states of ``begin``, or its failure.

        A fit that was cut short below its own part failed: its evidence is on the way.
        """
        left, one, began = max(self.budget - state.rollouts, 0), None, time.monotonic()
        self._rollouts, self._fit_rollouts = state.rollouts, 0
        part = max(parts_of(labels, state.fitted), key=lambda other: other.evidence, default=None)
        short = False  # whether the budget or the time may have ended the fit
        try:
            most = self.fitting.enough(self.structure(labels))
            short = left < most
            one = self.fitting.fit(self.structure(labels), initial, max(min(most, left), 1), self._tell, begin, part)
            short = not one.settled and (short or self.fitting.is_late)
            self._longest = max(self._longest, (time.monotonic() - began) / self._slowness(labels))
        except (BudgetTooSmall, np.linalg.LinAlgError, ValueError) as error:
            short = isinstance(error, BudgetTooSmall) and (short or self.fitting.is_late)
        cut = state.phase if short else None
        if one is None or (not one.settled and part is not None and part.evidence > one.evidence):
            spent = state.failed_rollouts + (self._fit_rollouts if one is None else one.rollouts)
            return replace(state, failed=(*state.failed, labels), failed_rollouts=spent, cut=cut)
        return replace(state, fitted=(*state.fitted, one), cut=cut, cut_off=labels if short else None)


def _writes(piece: Placed) -> set[str]:
    """The targets of an extension's parameters, and its label."""
    return {piece.label, *(target for parameter in piece.parameters for target in parameter.targets)}
