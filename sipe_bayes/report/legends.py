"""What legends hold, and how curves are told apart."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from matplotlib.artist import Artist
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.typing import LineStyleType

from sipe_bayes.report.colours import CHAINS, MARKERS, PRIOR, STYLE


def line_handle(
    colour: str,
    label: str,
    ls: LineStyleType = "-",
    lw: float | None = None,
    marker: str = "",
    ms: float | None = None,
    mew: float | None = None,
) -> Line2D:
    """A legend's entry for a line or, without a line style, for its marks.

    Args:
        colour: of the line.
        label: its words.
        ls: line style, "none" for marks alone.
        lw: line width, points.
        marker: Matplotlib's letter.
        ms: size of a mark, points.
        mew: width of its edge, points.
    """
    return Line2D(
        [], [], color=colour, label=label, linestyle=ls, linewidth=lw, marker=marker, markersize=ms, markeredgewidth=mew
    )


@dataclass(frozen=True)
class Look:
    """How a curve is drawn: colour, line style, and a marker, empty for none."""

    colour: str
    line: LineStyleType
    marker: str = ""

    def handle(self, label: str, lw: float | None = None, ms: float = 4.0) -> Line2D:
        """Its entry in a legend.

        Args:
            label: its words.
            lw: line width, points.
            ms: size of a mark, points.
        """
        return line_handle(self.colour, label, self.line, lw, self.marker, ms)


def look(index: int) -> Look:
    """Of the curve with this place in the order."""
    line: LineStyleType = "-" if index // len(CHAINS) % 2 == 0 else (0, (4, 1.5))
    return Look(CHAINS[index % len(CHAINS)], line, MARKERS[index % len(MARKERS)])


def shade_handle(colour: str, label: str, alpha: float = STYLE.interval) -> Patch:
    """A legend's entry for a shade.

    Args:
        colour: of the shade.
        label: its words.
        alpha: its opacity.
    """
    return Patch(color=colour, alpha=alpha, lw=0, label=label)


PRIOR_HANDLE = Patch(facecolor=PRIOR, alpha=STYLE.prior, edgecolor=PRIOR, label="prior")


def legend_above(figure: Figure, handles: Sequence[Artist], columns: int) -> None:
    """The figure's legend, above all panels.

    Args:
        figure: where it goes.
        handles: its entries.
        columns: entries side by side.
    """
    figure.legend(handles=list(handles), loc="outside upper center", ncols=columns)
