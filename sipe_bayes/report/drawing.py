"""What all figures share: style, axes, panels, and a figure's bytes."""

from __future__ import annotations

import base64
import functools
import gc
import io
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import ParamSpec, TypeVar

import matplotlib.style
import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.gridspec import GridSpec
from matplotlib.ticker import Formatter, LogLocator, MaxNLocator, NullFormatter
from matplotlib.transforms import ScaledTranslation
from PIL import Image

from sipe_bayes.report.colours import STYLE

P = ParamSpec("P")
R = TypeVar("R")
T = TypeVar("T")

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
    """Run ``draw`` under this file's style, whatever the user's own; the user's is back afterwards."""

    @functools.wraps(draw)
    def wrapper(*args: P.args, **kwargs: P.kwargs) -> R:
        with matplotlib.style.context(["default", _RC]), warnings.catch_warnings():
            warnings.filterwarnings("ignore", r"Glyph \d+", UserWarning)  # a name of the user's in another script
            return draw(*args, **kwargs)

    return wrapper


@styled
def png(figure: Figure) -> bytes:
    """The figure as a PNG file in 256 colours, a third of the size of all.

    It is drawn once: ``Figure.savefig`` draws every artist twice where a layout is by constraints.

    Returns:
        The file's bytes, the same for the same figure.
    """
    canvas, buffer = FigureCanvasAgg(figure), io.BytesIO()
    canvas.draw()
    colours = Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB")
    colours.quantize(256, method=Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE).save(buffer, "PNG")
    return buffer.getvalue()


@contextmanager
def uncollected() -> Iterator[None]:
    """Without Python's search for cycles of garbage, which takes a third of the time in which figures are made."""
    before = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if before:
            gc.enable()


def inside_page(image: bytes) -> str:
    """A PNG file as the source of an image that the page itself holds."""
    return "data:image/png;base64," + base64.b64encode(image).decode("ascii")


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
    """At most about ``count`` ticks with plain labels on an axis, linear or logarithmic."""
    if axis.get_scale() == "log":
        low, high = np.log10(axis.get_view_interval())
        subs = (1.0,) if high - low > 1.5 else (1.0, 3.0) if high - low > 1 else (1.0, 2.0, 5.0)
        axis.set_major_locator(LogLocator(base=10, subs=subs, numticks=count))
        axis.set_major_formatter(lambda x, _: _compact(x))
        axis.set_minor_formatter(NullFormatter())
        return
    axis.set_major_locator(MaxNLocator(count, steps=[1, 2, 2.5, 5, 10], min_n_ticks=2))
    axis.set_major_formatter(_Plain())


def equal_parts(rows: Sequence[T], size: int) -> list[Sequence[T]]:
    """Rows in order, cut into parts.

    Returns:
        Parts of nearly equal length; none for no rows.
    """
    count = -(-len(rows) // size)
    return [rows[len(rows) * k // count : len(rows) * (k + 1) // count] for k in range(count)]


class Drawing(Figure):
    """A figure that a notebook shows, without pyplot."""

    def _repr_png_(self) -> bytes:
        return png(self)


def new_figure(height: float, width: float = STYLE.width) -> Drawing:
    """An empty figure on white, laid out by constraints.

    Args:
        height: inches.
        width: inches.
    """
    return Drawing(figsize=(width, height), dpi=STYLE.dpi, layout="constrained", facecolor="white")


def fixed_grid(figure: Figure, heights: Sequence[float], widths: Sequence[float], gap: float = 0.25) -> GridSpec:
    """Cells in margins of fixed inches, and such a gap between rows: a third of the time that constraints take."""
    figure.set_layout_engine("none")
    (width, height), rows = figure.get_size_inches(), len(heights)
    ends = {"left": 0.85 / width, "right": 1 - 0.08 / width, "bottom": 0.7 / height, "top": 1 - 0.45 / height}
    between = {"hspace": gap * rows / (height - 1.15 - (rows - 1) * gap), "wspace": 1.3 / width}
    return figure.add_gridspec(rows, len(widths), height_ratios=heights, width_ratios=widths, **ends, **between)


def label_y(ax: Axes, text: str) -> None:
    """Label a vertical axis in the margin of a ``fixed_grid``."""
    ax.set_ylabel(text)
    assert ax.figure is not None
    margin = ScaledTranslation(-0.62, 0, ax.figure.dpi_scale_trans)
    ax.yaxis.set_label_coords(0, 0.5, transform=ax.transAxes + margin)


def laid_out(figure: Figure, plain: Sequence[Axes]) -> None:
    """Lay the figure out for good, axes without labels as if they had no ticks either, which take most of the time."""
    for ax in plain:
        ax.set_axis_off()
    if engine := figure.get_layout_engine():
        engine.execute(figure)
    figure.set_layout_engine("none")
    for ax in plain:
        ax.set_axis_on()


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


def outer_labels(axes: Sequence[Axes], columns: int, xlabel: str, ylabel: str = "") -> None:
    """Label the axes of a grid of panels at its left and at its lower end alone."""
    for k, ax in enumerate(axes):
        ax.set_ylabel(ylabel if k % columns == 0 else "")
        ax.set_xlabel(xlabel if k + columns >= len(axes) else "")
