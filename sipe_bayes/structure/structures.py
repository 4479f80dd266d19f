"""What a search over structures has to say: a distribution over structures, and the posterior averaged over it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.parameters import ParameterSpace
from sipe_bayes.posterior import GaussianMixture
from sipe_bayes.simulation.simulator import Simulator
from sipe_bayes.structure.columns import Column
from sipe_bayes.structure.extension import Placed
from sipe_bayes.structure.fitted import FittedStructure
from sipe_bayes.structure.search import StructureSearch
from sipe_bayes.structure.state import DiscoverState, Offer, Phase

_NEGLIGIBLE = 1e-3  # probability below which a structure is left out of the average


@dataclass(frozen=True)
class StructureRow:
    """A line of the table.

    Args:
        sentences: what the structure has beyond the plain model; empty for it.
        labels: of its extensions.
        evidence: nats over the plain model.
        held_out: nats of held-out pieces over the plain model; None where there are no pieces.
        probability: of the structure, given the logs.
        rollouts: that its fit took.
        yardstick: whether it has a force without a name, and is no candidate itself.
    """

    sentences: tuple[str, ...]
    labels: tuple[str, ...]
    evidence: float
    held_out: float | None
    probability: float
    rollouts: int
    yardstick: bool


@dataclass(frozen=True)
class Structures:
    """Structures that were fitted, the plain model first.

    Args:
        search: that fitted them.
        state: where it ended.
    """

    search: StructureSearch
    state: DiscoverState

    @property
    def fitted(self) -> tuple[FittedStructure, ...]:
        """All of them."""
        return self.state.fitted

    @property
    def columns(self) -> tuple[Column, ...]:
        """Of the logs that were multiplied, since then the plain model fits far better; all fits are to these logs."""
        return self.state.columns

    @property
    def rollouts(self) -> int:
        """Of all fits."""
        return self.state.rollouts

    @property
    def settled(self) -> bool:
        """Whether every fit that matters came to rest and the budget was enough, but for the yardstick."""
        enough = self.state.done and self.state.cut in (None, Phase.RESIDUAL)
        return enough and all(one.settled for p, one in zip(self.probabilities, self.fitted, strict=True) if p)

    @property
    def so_far(self) -> str:
        """What a search that is interrupted has, with the values of what it keeps; nothing before its first fit."""
        if not self.fitted:
            return ""
        count = f"{len(self.fitted)} structures fitted" if len(self.fitted) > 1 else "the model as it is fitted"
        if not self.state.present:
            return f"{count}, nothing kept so far"
        here, sizes, placed = self.state.here, [], self.search.placed
        known = all(label in placed for label in here.labels)  # not before a search that goes on has begun
        own = [parameter for piece in self.placed(here) for parameter in piece.parameters] if known else []
        for parameter, theta in zip(own, here.theta[len(here.theta) - len(own) :], strict=True):
            sizes.append(f"{parameter.targets[0]} {float(parameter.value(theta)):.3g} {parameter.unit}".rstrip())
        kept = " + ".join(here.labels) + (f" ({', '.join(sizes)})" if sizes else "")
        return f"{count}, kept so far {kept}, {here.evidence - self.plain.evidence:.0f} nats over the model as it was"

    @cached_property
    def probabilities(self) -> FloatArray:
        """(S,) of the fitted structures; zero where held-out pieces speak against one, or a piece has no name."""
        totals = np.array([self.search.total(one) if self._counts(one) else -np.inf for one in self.fitted])
        weight = np.exp(totals - totals.max())
        return weight / weight.sum()

    def _counts(self, one: FittedStructure) -> bool:
        """Whether a structure of named pieces foretells held-out pieces better than every smaller one tried.

        And whether no held-out log speaks against it, and the budget did not end in its fit.
        """
        cut_off = self.state.cut is not None and one is self.fitted[-1] is not self.plain and not one.settled
        if self._is_yardstick(one) or self.state.is_refused(one.labels) or cut_off:
            return False
        smaller = [o for o in self.fitted if set(o.labels) < set(one.labels)]
        return all(self.search.foretells(one, other) for other in smaller)

    def _is_yardstick(self, one: FittedStructure) -> bool:
        return any(self.search.placed[label].extension.last_resort for label in one.labels)

    @property
    def best(self) -> FittedStructure:
        """The most probable structure."""
        return self.fitted[int(self.probabilities.argmax())]

    @property
    def plain(self) -> FittedStructure:
        """The model as it was."""
        return self.fitted[0]

    def placed(self, one: FittedStructure) -> list[Placed]:
        """The extensions of a structure."""
        return self.search.structure(one.labels)

    def simulator(self, one: FittedStructure) -> Simulator:
        """Of a structure."""
        return self.search.fitting.simulator(self.placed(one))

    def inclusion(self) -> dict[str, float]:
        """Probability of each extension that was tried, most probable first."""
        labels = {label for one in self.fitted for label in one.labels}
        sums = {
            label: float(sum(p for p, o in zip(self.probabilities, self.fitted, strict=True) if label in o.labels))
            for label in labels
        }
        return dict(sorted(sums.items(), key=lambda item: (-item[1], item[0])))

    def offers(self, at: Sequence[str] = ()) -> list[Offer]:
        """What was promised at a structure, best first."""
        return sorted((o for o in self.state.offers if set(o.at) == set(at)), key=lambda o: -o.gain)

    def table(self) -> list[StructureRow]:
        """All that was fitted, most probable first."""
        plain, rows = self.plain, []
        for p, one in zip(self.probabilities.tolist(), self.fitted, strict=True):
            held_out = None
            if one.held_out is not None and plain.held_out is not None:
                held_out = one.held_out - plain.held_out
            sentences = tuple(x.sentence for x in self.placed(one))
            gain = one.evidence - plain.evidence
            rows.append(StructureRow(sentences, one.labels, gain, held_out, p, one.rollouts, self._is_yardstick(one)))
        return sorted(rows, key=lambda row: (-row.probability, -row.evidence))

    @property
    def named_share(self) -> float | None:
        """Of the evidence that a force without a name could explain beside the best structure, what named pieces do.

        None where no such force was fitted.
        """
        for one in self.fitted:
            if self._is_yardstick(one):
                whole = max(one.evidence, self.best.evidence) - self.plain.evidence
                return (self.best.evidence - self.plain.evidence) / whole if whole > 0 else None
        return None

    @property
    def posterior(self) -> GaussianMixture:
        """Of the user's parameters, averaged over the structures."""
        space = self.search.fitting.prior.space
        return self._averaged(space, [(p, one, 0) for p, one in self._weighed()])

    def posterior_of_piece(self, label: str) -> GaussianMixture:
        """Of the parameters of an extension of the best structure, averaged over the structures that have it."""
        having = []
        for p, one in self._weighed():
            if label in one.labels:
                before = sum(len(self.search.placed[o].parameters) for o in one.labels[: one.labels.index(label)])
                having.append((p, one, len(self.search.fitting.prior.space) + before))
        return self._averaged(ParameterSpace(self.search.placed[label].parameters), having)

    def _weighed(self) -> list[tuple[float, FittedStructure]]:
        """Structures that count, with their probabilities."""
        pairs = zip(self.probabilities.tolist(), self.fitted, strict=True)
        return [(p, one) for p, one in pairs if p > _NEGLIGIBLE]

    @staticmethod
    def _averaged(space: ParameterSpace, parts: Sequence[tuple[float, FittedStructure, int]]) -> GaussianMixture:
        """The mixture of the normals that structures have for the parameters of a space, each from an index on."""
        own = [(one, slice(first, first + len(space))) for _, one, first in parts]
        means = np.stack([one.mean[at] for one, at in own])
        covariances = np.stack([one.spanned[at, at] for one, at in own])
        # a draw is to come from a structure with its probability, however much of its normal the cube cuts off
        return GaussianMixture(np.log([p for p, _, _ in parts]), means, covariances, space).of_masses()

    def posterior_of(self, one: FittedStructure) -> GaussianMixture:
        """Of all parameters of one structure, the extensions' behind the user's."""
        return GaussianMixture(np.zeros(1), one.mean[None], one.spanned[None], self.simulator(one).space)
