"""What might stand in a kept piece's place: pieces that promise about as much once all else that is kept is there.

A round chooses while all that is kept later is still missing: one that then fell behind, or was not fitted at all,
because others promised a little more, may be the right one. So each kept piece is left out once more, what is left is
asked anew what it lacks, and the evidence of the whole structures decides.
"""

from __future__ import annotations

from collections.abc import Sequence

from sipe_bayes.structure.state import Offer


def rivals(
    offers: Sequence[Offer], without: Sequence[str], whole: Sequence[str], share: float, most: int
) -> list[Offer]:
    """The rivals of a kept piece, the best ``most`` of them, best first.

    Args:
        offers: all that was promised in the search.
        without: labels of the structure without the piece.
        whole: labels of the structure with it.
        share: of the piece's own promise there, by which a rival's may fall behind.
        most: rivals.
    """
    there = {offer.label: offer for offer in offers if set(offer.at) == set(without)}  # the last of each
    own = max((offer.gain for label, offer in there.items() if label in whole), default=0.0)
    close = [o for label, o in there.items() if label not in whole and o.gain > 0 and o.gain >= (1 - share) * own]
    return sorted(close, key=lambda offer: -offer.gain)[:most]


def behind(one: float | None, other: float | None) -> float:
    """By how many nats a score is behind another; by none where either is missing."""
    return 0.0 if one is None or other is None else other - one
