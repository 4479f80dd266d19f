"""What a search over structures has to say: the set that the logs support, and the posterior stacked over it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.parameters import ParameterSpace
from sipe_bayes.posterior import GaussianMixture
from sipe_bayes.simulation.simulator import Simulator
from sipe_bayes.structure.comparison import difference, stack
from sipe_bayes.structure.extension import Placed
from sipe_bayes.structure.fitted import FittedStructure
from sipe_bayes.structure.search import StructureSearch
from sipe_bayes.structure.state import DiscoverState, Offer

_NEGLIGIBLE = 1e-3  # weight below which a structure is left out of the average


@dataclass(frozen=True)
class StructureRow:
    """A line of the table.

    Args:
        sentences: what the structure has beyond the plain model; empty for it.
        labels: of its extensions.
        evidence: nats over the plain model.
        gain: log predictive density of held-out pieces over the plain model's, in nats.
        error: standard error of the gain.
        behind: nats by which it predicts worse than the first structure of the set that the logs support.
        behind_error: standard error of that.
        tied: whether it is of that set: structures that the logs do not tell apart.
        weight: in the stacked predictions; zero outside the set that the logs support.
        rollouts: that its fit took.
        refused: whether it is not written out, since its errors on held-out logs are larger.
    """

    sentences: tuple[str, ...]
    labels: tuple[str, ...]
    evidence: float
    gain: float
    error: float
    behind: float
    behind_error: float
    tied: bool
    weight: float
    rollouts: int
    refused: bool = False


@dataclass(frozen=True)
class Structures:
    """Structures that were fitted, the plain model first.

    Args:
        search: that fitted them.
        state: where it ended.
        refused: labels of structures that are not written out, since their errors on held-out logs are larger.
    """

    search: StructureSearch
    state: DiscoverState
    refused: tuple[tuple[str, ...], ...] = ()

    @property
    def fitted(self) -> tuple[FittedStructure, ...]:
        """All of them."""
        return self.state.fitted

    @property
    def rollouts(self) -> int:
        """Of all fits."""
        return self.state.rollouts

    @property
    def settled(self) -> bool:
        """Whether every fit that matters came to rest and the budget was enough."""
        return self.state.done and self.state.cut is None and all(one.settled for one in self.supported)

    @property
    def so_far(self) -> str:
        """What a search that is interrupted has, with the values of what it keeps; nothing before its first fit."""
        if not self.fitted:
            return ""
        count = f"{len(self.fitted)} structures fitted" if len(self.fitted) > 1 else "the model as it is fitted"
        self.search.place(self.state)
        here = self.best
        if not here.labels:
            return f"{count}, no extension is supported so far"
        sizes = []
        own = [parameter for piece in self.placed(here) for parameter in piece.parameters]
        for parameter, theta in zip(own, here.theta[len(here.theta) - len(own) :], strict=True):
            sizes.append(f"{parameter.targets[0]} {float(parameter.value(theta)):.3g} {parameter.unit}".rstrip())
        kept = " + ".join(here.labels) + (f" ({', '.join(sizes)})" if sizes else "")
        return f"{count}, the best so far {kept}, {difference(here, self.plain).nats:.0f} nats over the model as it was"

    @cached_property
    def supported(self) -> tuple[FittedStructure, ...]:
        """The set that the logs support: structures that they do not tell apart, the simplest one first."""
        return tuple(self.search.supported(self.state, self.refused))

    @cached_property
    def weights(self) -> FloatArray:
        """Stacking weights (S,) of the fitted structures; zero outside the set that the logs support."""
        stacked = dict(zip(map(id, self.supported), stack(self.supported).tolist(), strict=True))
        return np.array([stacked.get(id(one), 0.0) for one in self.fitted])

    @property
    def best(self) -> FittedStructure:
        """The simplest structure of the set, of native MJCF elements where these do as well."""
        return self.supported[0]

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
        """Sum of the weights of the structures with each extension that was tried, largest first."""
        labels = {label for one in self.fitted for label in one.labels}
        sums = {
            label: float(sum(p for p, o in zip(self.weights, self.fitted, strict=True) if label in o.labels))
            for label in labels
        }
        return dict(sorted(sums.items(), key=lambda item: (-item[1], item[0])))

    def offers(self, at: Sequence[str] = ()) -> list[Offer]:
        """Predicted gains beside a structure, best first."""
        return sorted((o for o in self.state.offers if set(o.at) == set(at)), key=lambda o: -o.gain)

    def table(self) -> list[StructureRow]:
        """All that was fitted: the set that the logs support, then by what they predict."""
        rows, order = [], {one.labels: k for k, one in enumerate(self.supported)}
        for weight, one in zip(self.weights.tolist(), self.fitted, strict=True):
            sentences, evidence = tuple(x.sentence for x in self.placed(one)), one.evidence - self.plain.evidence
            scores = (evidence, *difference(one, self.plain), *difference(self.best, one), one.labels in order, weight)
            rows.append(StructureRow(sentences, one.labels, *scores, one.rollouts, one.labels in self.refused))
        return sorted(rows, key=lambda row: (order.get(row.labels, len(order)), -row.gain))

    @property
    def posterior(self) -> GaussianMixture:
        """Of the user's parameters, stacked over the structures."""
        space = self.search.fitting.prior.space
        return self._stacked(space, [(p, one, 0) for p, one in self._weighed()])

    def posterior_of_piece(self, label: str) -> GaussianMixture:
        """Of the parameters of an extension of the best structure, stacked over the structures that have it."""
        having = []
        for p, one in self._weighed():
            if label in one.labels:
                before = sum(len(self.search.placed[o].parameters) for o in one.labels[: one.labels.index(label)])
                having.append((p, one, len(self.search.fitting.prior.space) + before))
        return self._stacked(ParameterSpace(self.search.placed[label].parameters), having)

    def _weighed(self) -> list[tuple[float, FittedStructure]]:
        """Structures of the set, with their weights."""
        pairs = zip(self.weights.tolist(), self.fitted, strict=True)
        return [(p, one) for p, one in pairs if p > _NEGLIGIBLE]

    @staticmethod
    def _stacked(space: ParameterSpace, parts: Sequence[tuple[float, FittedStructure, int]]) -> GaussianMixture:
        """The mixture of the normals that structures have for the parameters of a space, each from an index on."""
        own = [(one, slice(first, first + len(space))) for _, one, first in parts]
        means = np.stack([one.mean[at] for one, at in own])
        covariances = np.stack([one.spanned[at, at] for one, at in own])
        # a draw is to come from a structure with its weight, however much of its normal the cube cuts off
        return GaussianMixture(np.log([p for p, _, _ in parts]), means, covariances, space).of_masses()

    def posterior_of(self, one: FittedStructure) -> GaussianMixture:
        """Of all parameters of one structure, the extensions' behind the user's."""
        return GaussianMixture(np.zeros(1), one.mean[None], one.spanned[None], self.simulator(one).space)
