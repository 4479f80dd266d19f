"""What all figures share: colours, sizes, axes, labels, legends, and a figure's bytes.

One colour means one thing everywhere (Okabe and Ito's palette, which colour-blind readers can tell apart):
measured black, posterior blue, prior grey, the model as given dashed orange, held-out logs green.
"""

from __future__ import annotations

import functools
import io
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import ParamSpec, TypeVar

import matplotlib.style
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import Formatter, LogLocator, MaxNLocator, NullFormatter
from matplotlib.typing import LineStyleType

P = ParamSpec("P")
R = TypeVar("R")
T = TypeVar("T")

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
_RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
_RC = {
    "font.size": 9,
    "axes.titlesize": 9,
    "axes.labelsize": 9,
    "xtick.labelsize": 8,
    "ytick.labelsize": 8,
    "legend.fontsize": 8.5,
    "legend.frameon": False,
    "figure.titlesize": 11,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": "#555555",
    "xtick.color": "#333333",
    "ytick.color": "#333333",
    "text.parse_math": False,
    "figure.constrained_layout.h_pad": 0.05,
    "figure.constrained_layout.w_pad": 0.06,
}


def styled(draw: Callable[P, R]) -> Callable[P, R]:
    """Run ``draw`` under this file's style, whatever the user's own; the user's is back afterwards.

    Args:
        draw: the function that makes a figure.
    """

    @functools.wraps(draw)
    def wrapper(*args: P.args, **kwargs: P.kwargs) -> R:
        with matplotlib.style.context(["default", _RC]):
            return draw(*args, **kwargs)

    return wrapper


@styled
def png(figure: Figure) -> bytes:
    """The figure as a PNG file.

    Args:
        figure: what is drawn.

    Returns:
        The file's bytes, the same for the same figure.
    """
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=STYLE.dpi, metadata={"Software": None})
    return buffer.getvalue()


class _Plain(Formatter):
    """Tick labels with as many decimals as the ticks need, "2.5e-5" outside 0.001 .. 100,000, never an offset."""

    def __call__(self, x: float, pos: int | None = None) -> str:
        return f"{x:g}"

    def format_ticks(self, values: Sequence[float]) -> list[str]:
        """One label for each of the values."""
        at = np.asarray(values, dtype=float)
        if not len(at):
            return []
        largest = float(np.abs(at).max())
        step = float(np.diff(at).min()) if len(at) > 1 else largest
        step = step if step > 0 else 1.0
        exponent = int(np.floor(np.log10(largest))) if largest > 0 else 0
        if -3 <= exponent < 5:
            decimals = self._decimals(step)
            return [f"{v:.{decimals}f}" for v in at]
        decimals = self._decimals(step / 10.0**exponent)
        return ["0" if v == 0 else f"{v / 10.0**exponent:.{decimals}f}e{exponent}" for v in at]

    @staticmethod
    def _decimals(step: float) -> int:
        return next((d for d in range(12) if abs(round(step, d) / step - 1) < 1e-6), 12)


def _compact(x: float) -> str:
    """``x`` with few letters: 0.05, 2e-5."""
    mantissa, exponent = f"{x:.3e}".split("e")
    return f"{x:g}" if -3 <= int(exponent) < 5 else f"{float(mantissa):g}e{int(exponent)}"


def ticks(axis: Axis, count: int) -> None:
    """At most about ``count`` ticks with plain labels on an axis, linear or logarithmic.

    Args:
        axis: of a panel.
        count: how many.
    """
    if axis.get_scale() == "log":
        low, high = np.log10(axis.get_view_interval())
        subs = (1.0,) if high - low > 1.5 else (1.0, 3.0) if high - low > 1 else (1.0, 2.0, 5.0)
        axis.set_major_locator(LogLocator(base=10, subs=subs, numticks=count))
        axis.set_major_formatter(lambda x, _: _compact(x))
        axis.set_minor_formatter(NullFormatter())
        return
    axis.set_major_locator(MaxNLocator(count, steps=[1, 2, 2.5, 5, 10], min_n_ticks=2))
    axis.set_major_formatter(_Plain())


def unit_text(unit: str) -> str:
    """``unit`` for the eye: "kg m^2" with a raised 2, nothing for the unit "1"."""
    return "" if unit == "1" else re.sub(r"\^(-?\d+)", lambda power: power[1].translate(_RAISED), unit)


def with_unit(name: str, unit: str, separator: str = " ") -> str:
    """``name [unit]``, the name alone where there is no unit.

    Args:
        name: of a quantity.
        unit: its unit; empty for none.
        separator: what stands before the bracket.
    """
    text = unit_text(unit)
    return f"{name}{separator}[{text}]" if text else name


def shortened(text: str, length: int) -> str:
    """``text``, its middle left out when it is longer than ``length``."""
    if len(text) <= length:
        return text
    half = (length - 1) // 2
    return f"{text[:half]}…{text[-half:]}"


def equal_parts(rows: Sequence[T], size: int) -> list[Sequence[T]]:
    """Rows in order, cut into parts.

    Args:
        rows: what is cut.
        size: the longest that a part may be.

    Returns:
        Parts of nearly equal length; none for no rows.
    """
    count = -(-len(rows) // size)
    return [rows[len(rows) * k // count : len(rows) * (k + 1) // count] for k in range(count)]


def new_figure(height: float, width: float = STYLE.width) -> Figure:
    """An empty figure on white, laid out by constraints.

    Args:
        height: inches.
        width: inches.
    """
    return Figure(figsize=(width, height), layout="constrained", facecolor="white")


def panel_grid(count: int, row: float, margin: float) -> tuple[Figure, list[Axes], int]:
    """A figure of ``count`` panels in two or three columns.

    Args:
        count: panels.
        row: inches of a row.
        margin: inches of what stands above and below.

    Returns:
        The figure, its panels row by row, and the number of columns.
    """
    columns = min(3, max(2, count))
    rows = -(-count // columns)
    figure = new_figure(row * rows + margin)
    grid = figure.add_gridspec(rows, columns)
    return figure, [figure.add_subplot(grid[k // columns, k % columns]) for k in range(count)], columns


def column_of_panels(count: int, row: float, margin: float) -> tuple[Figure, list[Axes]]:
    """A figure of ``count`` panels, one below the other, that share their horizontal axis.

    Args:
        count: panels.
        row: inches of a row.
        margin: inches of what stands above and below.
    """
    figure = new_figure(row * count + margin)
    return figure, list(figure.subplots(count, 1, squeeze=False, sharex=True)[:, 0])


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
