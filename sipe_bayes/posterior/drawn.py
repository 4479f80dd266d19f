"""A posterior's own figure."""

from __future__ import annotations

from typing import TYPE_CHECKING

from sipe_bayes.core import view

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from numpy.typing import ArrayLike


class Drawn:
    """What ``Posterior`` gives to be looked at."""

    def plot(self, truth: ArrayLike | None = None, pairs: bool = False) -> Figure:
        """Its marginals in their units over the prior, or draws of every pair of its first eight parameters.

        Args:
            truth: theta (N,), if it is known.
            pairs: draw pairs in place of marginals.

        Returns:
            A Matplotlib figure, which a notebook shows; ``figure.savefig(path)`` writes it.

        Raises:
            ValueError: for a truth of another shape, and for pairs of a single parameter.
        """
        drawing = view("posterior")
        figure: Figure = (drawing.pairs if pairs else drawing.marginals)(self, truth=truth)
        return figure
