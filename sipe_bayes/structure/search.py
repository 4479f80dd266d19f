r"""The search over structures: what promises most is fitted, the best is kept, again; then each kept piece is left out.

**Steps** (``StructureSearch``), one of them a call of ``step``::

    PLAIN   the model as it is
      v
    COLUMNS where much is left: signs and units of the logs' columns
      v
    RANK    score tests of all extensions at the present structure (``candidates``)
      |  something promises more than it costs          nothing does
      v                                                      v
    STEPS   shorter physics steps; if better, RANK            |
      v                                                      v
    FIT     the best few, one a step ------------------>  PRUNE   each kept piece left out once
      |  the best of them is better                           v
      v                                                    SWAP   what promises as much, in a kept one's place
    AGAIN   the present structure, from where the             v
      |     best one ended: still better, it is kept       RESIDUAL  a force without a name, as the yardstick
      +--> RANK                                               v
                                                           DONE

**Judgement.** A structure S of K extensions out of n has

.. math:: \log p(S \mid y) = \log p(y \mid S) - K (\log n + c) + const,

shorter physics steps paying ``step_gain``, and it counts only where the log score of held-out pieces has become better
with it as well, and where the logs that no fit has seen do not speak against it. Structures that are about equally good
are not decided between: ``Structures.posterior`` averages over them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.inference.recorded import Progress
from sipe_bayes.likelihood import BudgetExhausted, BudgetTooSmall, QuadraticPrior
from sipe_bayes.structure.candidates import Candidate, candidates, first
from sipe_bayes.structure.columns import Column, channels_of, choices, is_explained, log_jacobian, moving, unexplained
from sipe_bayes.structure.extension import Extension, Placed, members, placements
from sipe_bayes.structure.fitted import FittedStructure, Fitting
from sipe_bayes.structure.machine import Machine, machine_of
from sipe_bayes.structure.physics_step import StepLadder, shorter_steps
from sipe_bayes.structure.rivals import behind, rivals
from sipe_bayes.structure.state import BUDGET, DiscoverOptions, DiscoverState, Judgement, Offer, Phase


class StructureSearch:
    """A search over structures, step by step.

    Args:
        fitting: what structures are fitted to.
        extensions: that may be used.
        joints: names of joints, actuators and channels at which they may be placed; default all.
        options: of the search.
        budget: rollouts at most.
        progress: called along the way.
        finer: whether shorter physics steps are tried beside the extensions.
    """

    def __init__(
        self,
        fitting: Fitting,
        extensions: Sequence[Extension],
        joints: Sequence[str] | None = None,
        options: DiscoverOptions | None = None,
        budget: int = BUDGET,
        progress: Progress | None = None,
        finer: bool = False,
    ) -> None:
        self.given = self.fitting = fitting
        self.extensions, self.joints, self.finer = tuple(extensions), joints, finer
        self.options, self.budget, self.progress = options or DiscoverOptions(), budget, progress
        self._rollouts, self._fit_rollouts, self._doing = 0, 0, ""  # before the present fit, of it, and what it is for
        self._machine: Machine | None = None
        self._placed: dict[str, Placed] = {}
        self._ladder = StepLadder()

    def step(self, state: DiscoverState) -> DiscoverState:
        """One fit or one ranking further."""
        self.place(state)
        self._rollouts, self._fit_rollouts = state.rollouts, 0
        self._doing = state.describe(len(self._ladder.pieces(self._placed)))
        self._tell("")
        if state.phase is not Phase.PLAIN and state.rollouts >= self.budget:
            return replace(state, phase=Phase.DONE, cut=state.cut if state.done else state.phase)
        state = {
            Phase.PLAIN: self._plain,
            Phase.COLUMNS: self._columns,
            Phase.RANK: self._rank,
            Phase.STEPS: self._shorter_steps,
            Phase.FIT: self._fit,
            Phase.AGAIN: self._again,
            Phase.PRUNE: self._prune,
            Phase.SWAP: self._swap,
            Phase.RESIDUAL: self._residual,
            Phase.DONE: lambda state: state,
        }[state.phase](state)
        return state if state.cut is None else replace(state, phase=Phase.DONE)

    def _tell(self, what: str, rollouts: int = 0, _: int = 0) -> None:
        """How far the present step is, after some rollouts of a fit of its own; fewer are those of its next fit."""
        if rollouts < self._fit_rollouts:
            self._rollouts += self._fit_rollouts
        self._fit_rollouts = rollouts
        if self.progress is not None:
            self.progress(f"{self._doing}{what and ': '}{what}", self._rollouts + rollouts, self.budget)

    @property
    def placed(self) -> dict[str, Placed]:
        """The extensions wherever the machine has a place for them, after the first step."""
        return self._placed

    @cached_property
    def cost(self) -> float:
        """Nats that an extension has to gain because there were so many to choose from."""
        named = [p for p in self._placed.values() if not p.extension.last_resort]
        return math.log(max(len(self._ladder.pieces([p.label for p in named])), 1)) + self.options.sparsity

    def total(self, one: FittedStructure) -> float:
        """Log posterior of a structure up to a constant."""
        pieces, rung = self._ladder.pieces(one.labels), self._ladder.rung(one.labels)
        return one.evidence - self.cost * len(pieces) - self.options.step_gain * rung

    def price(self, label: str) -> float:
        """Nats that a piece has to gain."""
        return self.options.step_gain * self._ladder.rung([label]) or self.cost

    def foretells(self, one: FittedStructure, other: FittedStructure) -> bool:
        """Whether held-out pieces speak for a structure rather than a smaller one, or not against finer steps."""
        if one.held_out is None or other.held_out is None:
            return True
        alike = set(self._ladder.pieces(one.labels)) == set(self._ladder.pieces(other.labels))
        return one.held_out > other.held_out - self.options.against * alike

    def better(self, one: FittedStructure, other: FittedStructure) -> bool:
        """Whether both scores speak for a structure rather than for a smaller one."""
        return self.total(one) > self.total(other) and self.foretells(one, other)

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
        self.fitting = self.given.corrected(state.columns)
        plain = state.fitted[0]
        windows = self.fitting.windows(self.fitting.simulator([]))
        self._machine = machine_of(windows, plain.theta, plain.starts)
        every = (p for e in self.extensions for p in placements(e, self._machine))
        allowed = None if self.joints is None else set(self.joints)
        self._placed = {p.label: p for p in every if allowed is None or allowed.issuperset(members(p.site))}
        steps = {p.label: p for p in shorter_steps(windows)} if self.finer else {}
        self._ladder, self._placed = StepLadder(tuple(steps)), self._placed | steps

    def _plain(self, state: DiscoverState) -> DiscoverState:
        """The plain model, where it can be fitted at all."""
        plain, _ = self._try([], min(self.enough([]), int(self.options.plain_share * self.budget)))
        return replace(state, fitted=() if plain is None else (plain,), phase=Phase.COLUMNS)

    def _columns(self, state: DiscoverState) -> DiscoverState:
        """The column whose factor makes the plain model fit far better, if any does."""
        given, plain, options = self.given, state.fitted[0] if state.fitted else None, self.options
        state, share = replace(state, phase=Phase.RANK), dict.fromkeys(given.environment.channels, 0.0)
        windows, channels = given.windows(given.simulator([])), channels_of(given.environment)
        shown = moving(windows)
        if plain is not None:
            left = unexplained(windows, plain.sd, shown)
            if max(left.values(), default=0.0) < options.gross:
                return state
            rests = set(np.array(windows.fitted)[~shown].tolist())
            share = {name: left.get(name, 0.0) for name in share if name not in rests}
        columns, tried, spent, number = choices(channels, share), [], 0, 0
        # without a plain model there is nothing else to spend the budget on
        most = self.budget if plain is None else options.column_share * (self.budget - plain.rollouts)
        while number < len(columns) and spent + options.column_budget <= most:
            column, number = columns[number], number + 1
            doing = replace(state, phase=Phase.COLUMNS).describe(0)
            self._doing = f"{doing}, {number} of {len(columns)}"
            one, rollouts = self._try([column], options.column_budget)
            spent += rollouts
            own = channels[column.name, column.command]
            if one is not None and (not plain or is_explained(windows, one.sd, shown, column, own, options.gross)):
                tried.append((one.evidence + log_jacobian(windows, column), column, one))
        if plain is None and not tried:
            given.fit([], None, self.enough([]))  # raises what keeps the plain model from being fitted
        best = max(tried, key=lambda item: item[0], default=None)
        if best is None or (plain is not None and best[0] < plain.evidence + options.column_gain):
            return replace(state, column_rollouts=spent, untried=tuple(columns[number:]))
        self._placed = {}
        spent += (0 if plain is None else plain.rollouts) - best[2].rollouts
        # evidences are in the corrected logs' units from here on
        return replace(state, fitted=(best[2],), columns=(best[1],), column_rollouts=spent)

    def _try(self, columns: Sequence[Column], budget: int) -> tuple[FittedStructure | None, int]:
        """The plain model fitted to logs with columns multiplied, None where it cannot be; and the rollouts.

        Raises BudgetTooSmall for the logs as they are.
        """
        self._rollouts, self._fit_rollouts = self._rollouts + self._fit_rollouts, 0
        try:
            one = self.given.corrected(columns).fit([], None, max(budget, 1), self._tell)
        except (BudgetTooSmall, np.linalg.LinAlgError, ValueError) as error:
            if not columns and isinstance(error, BudgetTooSmall):
                raise
            return None, self._fit_rollouts  # as far as it told
        return one, one.rollouts

    def _rank(self, state: DiscoverState) -> DiscoverState:
        if len(self._ladder.pieces(state.present)) >= self.options.most:
            return replace(state, phase=Phase.PRUNE)
        state, ranked = self._ranked(state, state.here, last_resort=False)
        if state.cut is not None:
            return state
        promising = [c for c in ranked if c.gain > self.cost + self.options.least_gain]
        untried = [c for c in promising if not state.is_tried((*state.present, c.placed.label))]
        queue = tuple(c.placed.label for c in first(untried, self.options.width, self.options.tied))
        if not queue:
            return replace(state, phase=Phase.PRUNE)
        finer = self._ladder.finer(state.present)
        tried = finer is None or state.is_tried(finer)
        return replace(state, queue=queue, phase=Phase.FIT if tried else Phase.STEPS)

    def _shorter_steps(self, state: DiscoverState) -> DiscoverState:
        """The present structure in shorter physics steps, which may be all, if they promise half of what they must."""
        here, labels = state.here, self._ladder.finer(state.present) or ()
        price, least = self.options.step_gain, self.options.step_share * state.promised
        gain, rollouts = self.fitting.step_gain(self.structure(here.labels), self.structure(labels), here)
        state = replace(state, rank_rollouts=state.rank_rollouts + rollouts)
        fitted = self._fitted(state, labels, here.theta) if gain > 0.5 * max(price, least) else state
        one = fitted.of(labels)
        if one is None or not self.better(one, here) or one.evidence - here.evidence < least:
            return replace(fitted, phase=Phase.FIT)
        return replace(fitted, present=labels, queue=(), phase=Phase.RANK)

    def _ranked(
        self, state: DiscoverState, here: FittedStructure, last_resort: bool
    ) -> tuple[DiscoverState, list[Candidate]]:
        """What extensions promise beside a structure, best first, and the state with it; cut where little is left."""
        fitting, own = self.fitting, self.structure(here.labels)
        simulator = fitting.simulator(own)
        windows, prior = fitting.windows(simulator), QuadraticPrior.of(fitting.prior_of(simulator))
        taken = {*here.labels, *(t for p in own for q in p.parameters for t in q.targets)}
        rest = [p for p in self._placed.values() if p.extension.last_resort == last_resort and p.parameters]
        rest = [p for p in rest if not taken & {p.label, *(t for q in p.parameters for t in q.targets)}]
        windows.budget, ranked, cut = self._left(state), list[Candidate](), None
        try:
            if rest:
                at = here.theta, here.starts, here.noise, prior
                ranked = candidates(windows, *at, rest, lambda what: self._tell(what, windows.rollouts))
        except BudgetExhausted:
            cut = state.phase
        offers = tuple(Offer(here.labels, c.placed.label, c.gain, c.theta, c.others) for c in ranked)
        ranks = state.rank_rollouts + windows.rollouts
        done = (*state.ranked, here.labels) if cut is None and not last_resort else state.ranked
        return replace(state, offers=state.offers + offers, ranked=done, rank_rollouts=ranks, cut=cut), ranked

    def _left(self, state: DiscoverState) -> int:
        """Rollouts of the budget."""
        return max(self.budget - state.rollouts, 0)

    def _fit(self, state: DiscoverState) -> DiscoverState:
        label, *rest = state.queue
        offer = next(o for o in reversed(state.offers) if o.label == label and o.at == state.present)
        state = self._fitted(state, (*state.present, label), np.concatenate([offer.others, offer.theta]))
        if state.cut is not None:
            return state
        state = replace(state, queue=tuple(rest))
        return state if rest else self._settled(state)

    def _settled(self, state: DiscoverState) -> DiscoverState:
        """The round's best is looked at once more, or the search for more ends."""
        best = self._best_grown(state)
        onward = replace(state, phase=Phase.PRUNE)
        return onward if best is None else replace(state, larger=best.labels, phase=Phase.AGAIN)

    def _best_grown(self, state: DiscoverState) -> FittedStructure | None:
        """The best of those with one extension more, where it is better than the present structure."""
        here = state.here
        grown = [o for o in state.fitted if len(o.labels) == len(here.labels) + 1 and set(here.labels) < set(o.labels)]
        allowed = [one for one in grown if not state.is_refused(one.labels) and self.better(one, here)]
        return max(allowed, key=self.total, default=None)

    def _judged(self, state: DiscoverState, one: FittedStructure) -> DiscoverState:
        """With what the held-out logs say of a structure and of the present one, where there are such logs."""
        for each in (state.here, one) if self.fitting.holdout is not None else ():
            if state.judgement(each.labels) is None:
                own = self.structure(each.labels)
                most = self.enough(each.labels), self._left(state)
                log_score, rollouts = self.fitting.log_score(own, each, *most, self._tell)
                rollouts = self._fit_rollouts if log_score == -np.inf else rollouts
                state = replace(state, judged=(*state.judged, Judgement(each.labels, log_score, rollouts)))
        return state

    def _speaks_against(self, state: DiscoverState, one: FittedStructure) -> bool:
        """Whether held-out logs are foretold worse by a structure than by the present one."""
        here, other = state.judgement(state.present), state.judgement(one.labels)
        return bool(here and other and behind(other.log_score, here.log_score) > self.options.against)

    def _again(self, state: DiscoverState) -> DiscoverState:
        """The present structure from where the larger one ended, whose gain may be nothing but a better optimum."""
        here, larger = state.here, state.of(state.larger)
        assert larger is not None
        keep = [i for i, label in enumerate(self._owners(larger)) if label in (None, *here.labels)]
        refitted, fitted = self._fitted(state, here.labels, larger.theta[keep]), state.fitted
        if len(refitted.fitted) > len(fitted):
            *_, once_more = refitted.fitted
            better = once_more if once_more.evidence > here.evidence else here
            better = replace(better, rollouts=here.rollouts + once_more.rollouts)
            fitted = tuple(better if one is here else one for one in fitted)
        state = replace(refitted, fitted=fitted, failed=state.failed)
        best = self._best_grown(state)
        if best is not None and self._speaks_against(state := self._judged(state, best), best):
            return self._settled(replace(state, refused=(*state.refused, best.labels), larger=()))
        onward = Phase.PRUNE if best is None and state.here is here else Phase.RANK
        return replace(state, larger=(), phase=onward, present=state.present if best is None else best.labels)

    def _prune(self, state: DiscoverState) -> DiscoverState:
        """One smaller structure fitted, or all of them compared."""
        here = state.here
        if len(here.labels) < 2:
            return replace(state, phase=Phase.SWAP)
        smaller = [tuple(x for x in here.labels if x != label) for label in here.labels]
        for labels in smaller:
            if state.of(labels) is None and labels not in state.failed:
                keep = [i for i, label in enumerate(self._owners(here)) if label in (None, *labels)]
                return self._fitted(state, labels, here.theta[keep])
        known = [one for labels in smaller if (one := state.of(labels)) is not None]
        without = [one for one in known if not self.better(here, one)]
        if without:
            return replace(state, present=max(without, key=self.total).labels)
        return replace(state, phase=Phase.SWAP)

    def _swap(self, state: DiscoverState) -> DiscoverState:
        """What is left without one kept piece ranked, one structure with a rival fitted, or all of them compared."""
        here, options = state.here, self.options
        for kept in self._ladder.pieces(here.labels) if options.rivals else ():
            without = state.of([label for label in here.labels if label != kept])
            if without is None:
                continue
            if without.labels not in state.ranked:
                return self._ranked(state, without, last_resort=False)[0]
            for offer in rivals(state.offers, without.labels, here.labels, options.rival, options.rivals):
                labels = (*without.labels, offer.label)
                if state.of(labels) is None and labels not in state.failed:
                    return self._fitted(state, labels, np.concatenate([offer.others, offer.theta]))
        own, close = set(here.labels), [one for one in state.fitted if len(one.labels) == len(here.labels)]
        close = [one for one in close if len(own ^ set(one.labels)) == 2 and not state.is_refused(one.labels)]
        best = max((one for one in close if self.better(one, here)), key=self.total, default=None)
        if best is None:  # what pieces speak against does not count, whatever its evidence
            lost = [one.labels for one in close if behind(one.held_out, here.held_out) > options.against]
            return replace(state, phase=Phase.RESIDUAL, refused=(*state.refused, *lost))
        if self._speaks_against(state := self._judged(state, best), best):
            return replace(state, refused=(*state.refused, best.labels))
        return replace(state, present=best.labels, phase=Phase.PRUNE)

    def _residual(self, state: DiscoverState) -> DiscoverState:
        state, ranked = self._ranked(state, state.here, last_resort=True)
        if state.cut is not None:
            return state
        if ranked and ranked[0].gain > self.cost + self.options.least_gain:
            labels = (*state.present, ranked[0].placed.label)
            state = self._fitted(state, labels, np.concatenate([state.here.theta, ranked[0].theta]))
        return replace(state, phase=Phase.DONE)

    def _owners(self, one: FittedStructure) -> list[str | None]:
        """Whose each parameter of a structure is: None for the user's own."""
        count = len(one.theta) - sum(len(self._placed[label].parameters) for label in one.labels)
        own: list[str | None] = [None] * count
        return own + [label for label in one.labels for _ in self._placed[label].parameters]

    def _fitted(self, state: DiscoverState, labels: tuple[str, ...], initial: FloatArray) -> DiscoverState:
        left, cut = self._left(state), None
        self._rollouts, self._fit_rollouts = state.rollouts, 0
        try:
            most = self.enough(labels)
            cut = state.phase if left < most else None
            one = self.fitting.fit(self.structure(labels), initial, max(min(most, left), 1), self._tell)
        except (BudgetTooSmall, np.linalg.LinAlgError, ValueError) as error:
            spent = state.failed_rollouts + self._fit_rollouts
            cut = cut if isinstance(error, BudgetTooSmall) else None
            return replace(state, failed=(*state.failed, labels), failed_rollouts=spent, cut=cut)
        if one.settled:
            return replace(state, fitted=(*state.fitted, one))
        if state.surpasses(one):  # on the way, with the noise of a stage that is not the last
            spent = state.failed_rollouts + one.rollouts
            return replace(state, failed=(*state.failed, labels), failed_rollouts=spent, cut=cut)
        return replace(state, fitted=(*state.fitted, one), cut=cut)
