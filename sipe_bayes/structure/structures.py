"""What a search over structures has to say: the set that the logs support, and the posterior stacked over it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from sipe_bayes.core.arrays import FloatArray, IntArray
from sipe_bayes.core.parameters import ParameterSpace
from sipe_bayes.posterior import GaussianMixture
from sipe_bayes.simulation.simulator import Simulator
from sipe_bayes.structure.comparison import difference, stack
from sipe_bayes.structure.extension import Placed
from sipe_bayes.structure.fitted import FittedStructure
from sipe_bayes.structure.search import StructureSearch
from sipe_bayes.structure.state import DiscoverState, Offer


@dataclass(frozen=True)
class StructureRow:
    """A line of the table, in nats of log predictive density of held-out pieces where nothing else is said.

    Args:
        sentences: what the structure has beyond the plain model.
        labels: of its extensions.
        evidence: nats over the plain model's.
        gain: over the plain model, with its standard ``error``.
        behind: the first structure of the set that the logs support, with its standard ``behind_error``.
        tied: whether it is of that set: structures that the logs do not tell apart.
        weight: in the stacked predictions; zero outside the set.
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
    def plain(self) -> FittedStructure:
        """The model as it was."""
        return self.fitted[0]

    @property
    def best(self) -> FittedStructure:
        """The simplest structure of the set, of native MJCF elements where these do as well."""
        return self.supported[0]

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
        best, sizes = self.best, list[str]()
        if not best.labels:
            return f"{count}, no extension is supported so far"
        columns = best.columns(self.placed(best))
        for piece in self.placed(best):
            for parameter, theta in zip(piece.parameters, best.theta[columns[piece.label]], strict=True):
                sizes.append(f"{parameter.targets[0]} {float(parameter.value(theta)):.3g} {parameter.unit}".rstrip())
        kept = " + ".join(best.labels) + (f" ({', '.join(sizes)})" if sizes else "")
        return f"{count}, the best so far {kept}, {difference(best, self.plain).nats:.0f} nats over the model as it was"

    @cached_property
    def supported(self) -> tuple[FittedStructure, ...]:
        """The set that the logs support: structures that they do not tell apart, the simplest one first."""
        return tuple(self.search.supported(self.state, self.refused))

    @cached_property
    def weights(self) -> FloatArray:
        """Stacking weights (S,) of the fitted structures; zero outside the set that the logs support."""
        stacked = {one.labels: weight for one, weight in zip(self.supported, stack(self.supported), strict=True)}
        return np.array([stacked.get(one.labels, 0.0) for one in self.fitted])

    def placed(self, one: FittedStructure) -> list[Placed]:
        """The extensions of a structure."""
        return self.search.structure(one.labels)

    def simulator(self, one: FittedStructure) -> Simulator:
        """Of a structure."""
        return self.search.fitting.simulator(self.placed(one))

    def inclusion(self) -> dict[str, float]:
        """Sum of the weights of the structures with each extension that was tried, largest first."""
        sums = dict[str, float]()
        for weight, one in zip(self.weights.tolist(), self.fitted, strict=True):
            for label in one.labels:
                sums[label] = sums.get(label, 0.0) + weight
        return dict(sorted(sums.items(), key=lambda item: (-item[1], item[0])))

    def offers(self) -> list[Offer]:
        """Predicted gains beside the plain model, best first."""
        return sorted((offer for offer in self.state.offers if not offer.at), key=lambda offer: -offer.gain)

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
        return self._stacked(space, [np.arange(len(space))] * len(self.fitted))

    def posterior_of_piece(self, label: str) -> GaussianMixture:
        """Of the parameters of an extension of the best structure, stacked over the structures that have it."""
        space = ParameterSpace(self.search.placed[label].parameters)
        return self._stacked(space, [one.columns(self.placed(one)).get(label) for one in self.fitted])

    def _stacked(self, space: ParameterSpace, columns: Sequence[IntArray | None]) -> GaussianMixture:
        """The mixture of the normals of a space's parameters, which each structure has in these columns or has not."""
        every = zip(self.weights.tolist(), self.fitted, columns, strict=True)
        parts = [(weight, one, own) for weight, one, own in every if weight > 1e-3 and own is not None]
        means = np.stack([one.mean[own] for _, one, own in parts])
        covariances = np.stack([one.spanned[np.ix_(own, own)] for _, one, own in parts])
        # a draw is to come from a structure with its weight, however much of its normal the cube cuts off
        return GaussianMixture(np.log([weight for weight, _, _ in parts]), means, covariances, space).of_masses()

    def posterior_of(self, one: FittedStructure) -> GaussianMixture:
        """Of all parameters of one structure, the extensions' behind the user's."""
        return GaussianMixture(np.zeros(1), one.mean[None], one.spanned[None], self.simulator(one).space)
