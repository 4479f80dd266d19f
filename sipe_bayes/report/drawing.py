"""What all figures share: colours, style, axes, labels, and a figure's bytes.

One colour means one thing everywhere (Okabe and Ito's palette, which colour-blind readers can tell apart):
measured black, posterior blue, prior grey, the model as given dashed orange, held-out logs green.
"""

from __future__ import annotations

import functools
import io
import itertools
import re
from collections.abc import Callable, Iterator, Sequence
from typing import Any, ParamSpec, TypeVar

import matplotlib.style
import numpy as np
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import Formatter, LogLocator, MaxNLocator, NullFormatter

P = ParamSpec("P")
R = TypeVar("R")

MEASURED, POSTERIOR, PRIOR, DEFAULT, HOLDOUT = "#000000", "#0072B2", "#999999", "#D55E00", "#00805F"
CHAINS = ("#0072B2", "#E69F00", "#009E73", "#CC79A7", "#56B4E9", "#D55E00")
WIDTH = 9.6  # inches; a report shows it about 960 pixels wide
DPI = 130
_RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
_STYLE: dict[str, Any] = {
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


def _styled(draw: Callable[P, R]) -> Callable[P, R]:
    """Run ``draw`` under this file's style, whatever the user's own; the user's is back afterwards."""

    @functools.wraps(draw)
    def wrapper(*args: P.args, **kwargs: P.kwargs) -> R:
        with matplotlib.style.context(["default", _STYLE]):
            return draw(*args, **kwargs)

    return wrapper


@_styled
def png(figure: Figure) -> bytes:
    """The figure as a PNG file; the same bytes for the same figure."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=DPI, metadata={"Software": None})
    return buffer.getvalue()


class _Plain(Formatter):
    """Tick labels with as many decimals as the ticks need, "2.5e-5" outside 0.001 .. 100,000, never an
    offset."""

    def __call__(self, x: float, pos: int | None = None) -> str:
        return f"{x:g}"

    def format_ticks(self, values: Any) -> list[str]:
        values = np.asarray(values, dtype=float)
        if not len(values):
            return []
        largest = float(np.abs(values).max())
        step = float(np.diff(values).min()) if len(values) > 1 else largest
        step = step if step > 0 else 1.0
        exponent = int(np.floor(np.log10(largest))) if largest > 0 else 0
        if -3 <= exponent < 5:
            decimals = self._decimals(step)
            return [f"{v:.{decimals}f}" for v in values]
        decimals = self._decimals(step / 10.0**exponent)
        return ["0" if v == 0 else f"{v / 10.0**exponent:.{decimals}f}e{exponent}" for v in values]

    @staticmethod
    def _decimals(step: float) -> int:
        return next((d for d in range(12) if abs(round(step, d) / step - 1) < 1e-6), 12)


def _compact(x: float) -> str:
    """``x`` with few letters: 0.05, 2e-5."""
    mantissa, exponent = f"{x:.3e}".split("e")
    return f"{x:g}" if -3 <= int(exponent) < 5 else f"{float(mantissa):g}e{int(exponent)}"


def _ticks(axis: Axis, count: int) -> None:
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


def _label(name: str, unit: str) -> str:
    return f"{name} [{unit_text(unit)}]" if unit else name


def _short(text: str, length: int) -> str:
    """``text``, its middle left out when it is longer than ``length``."""
    if len(text) <= length:
        return text
    half = (length - 1) // 2
    return f"{text[:half]}…{text[-half:]}"


def _parts(rows: Sequence[Any], size: int) -> Iterator[Sequence[Any]]:
    """Rows in parts of nearly equal length, none longer than ``size``."""
    count = -(-len(rows) // size)
    edges = np.linspace(0, len(rows), count + 1).round().astype(int)
    return (rows[a:b] for a, b in itertools.pairwise(edges))


def _figure(height: float, width: float = WIDTH) -> Figure:
    return Figure(figsize=(width, height), layout="constrained", facecolor="white")


def _line(colour: str, label: str, **style: Any) -> Line2D:
    return Line2D([], [], color=colour, label=label, **style)
