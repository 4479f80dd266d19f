"""What a search decided by a hair: pieces that did about as well as the kept one in the round that chose between them.

A round compares pieces while all that is kept later is still missing, so a close one need not be the right one. In the
whole structure each is put in the other's place once, and the evidence of the whole decides.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.structure.fitted import FittedStructure


@dataclass(frozen=True)
class Rival:
    """A kept piece with another in its place.

    Args:
        labels: of the structure with the other one.
        kept: label that it takes the place of.
        theta: (P,) of the other one's parameters, where its round had them.
    """

    labels: tuple[str, ...]
    kept: str
    theta: FloatArray


def rivals(
    fitted: Sequence[FittedStructure],
    present: Sequence[str],
    total: Callable[[FittedStructure], float],
    share: float,
    most: int,
) -> Iterator[Rival]:
    """The rivals of each piece of a structure, the best ``most`` of them for each.

    Args:
        fitted: every structure of the search.
        present: labels of the structure, in the order in which they were kept.
        total: log posterior of a structure up to a constant.
        share: of the kept piece's gain by which another may fall behind.
        most: rivals of one piece.
    """
    known = {frozenset(one.labels): one for one in fitted}
    for k, kept in enumerate(present):
        before = frozenset(present[:k])
        here, chosen = known.get(before), known.get(before | {kept})
        if here is None or chosen is None:
            continue
        least = total(here) + (1 - share) * (total(chosen) - total(here))
        mates = [one for one in fitted if len(one.labels) == k + 1 and before < set(one.labels)]
        close = [one for one in mates if not set(one.labels) - before <= set(present) and total(one) > least]
        for one in sorted(close, key=total, reverse=True)[:most]:
            (label,) = set(one.labels) - before
            labels = tuple(label if x == kept else x for x in present)
            yield Rival(labels, kept, one.theta[len(here.theta) :])
