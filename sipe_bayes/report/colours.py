"""Colours, lines and sizes that all figures share.

One colour means one thing everywhere (Okabe and Ito's palette, which colour-blind readers can tell apart):
measured black, posterior blue, prior grey, the model as given dashed orange, held-out logs green.
"""

from __future__ import annotations

from dataclasses import dataclass

from matplotlib.typing import LineStyleType

MEASURED, POSTERIOR, PRIOR, DEFAULT, HOLDOUT = "#000000", "#0072B2", "#999999", "#D55E00", "#00805F"
CHAINS = ("#0072B2", "#E69F00", "#009E73", "#CC79A7", "#56B4E9", "#D55E00")
MARKERS = ("o", "s", "^", "D", "v", "P")


@dataclass(frozen=True)
class Style:
    """Sizes that figures share: of pages in inches, of lines in points, of shades as opacity.

    Args:
        width: of a page; a report shows it about 960 pixels wide.
        dpi: dots to an inch of a PNG.
        prior: opacity of the prior.
        interval: opacity of the posterior's interval.
        curve: width of an estimate's line.
        reference: width of a line that it is held against.
        truth: width of the truth's line.
        points: draws of a posterior behind its densities.
        grid: points at which a density is drawn.
    """

    width: float = 9.6
    dpi: int = 130
    prior: float = 0.35
    interval: float = 0.3
    curve: float = 1.4
    reference: float = 1.2
    truth: float = 1.6
    points: int = 8000
    grid: int = 400


STYLE = Style()
DASHED: LineStyleType = (0, (3, 2))
DOTTED: LineStyleType = (0, (1, 1.4))
