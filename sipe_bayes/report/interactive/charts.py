"""Signals of a page as charts that a reader zooms, hovers over and picks from.

uPlot 1.6.32 (https://github.com/leeoniya/uPlot, MIT) draws them; it lies in ``assets`` with its licence and goes into
the page itself, with the numbers, so that nothing is loaded from anywhere. A series is stored as its range and a code
of 16 bits for each sample; of the codes the differences are deflated.
"""

from __future__ import annotations

import base64
import hashlib
import json
import zlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.diagnostics.records import Signal
from sipe_bayes.report.colours import DEFAULT, MEASURED, POSTERIOR
from sipe_bayes.report.words import with_unit

_ASSETS = Path(__file__).parent / "assets"
_NUMBERS = 1_500_000  # that a page holds; about 2 MB
_NOTHING = 0xFFFF  # code of a NaN
_SERIES = ("measured", "default", "mode", "low", "high")


@dataclass(frozen=True)
class Charts:
    """What a page needs to draw signals.

    Args:
        data: JSON, free of angle brackets.
        script: uPlot and what drives it.
        style: uPlot's.
        thinned: of how many samples one is held; 1 for all.
    """

    data: str
    script: str
    style: str
    thinned: int

    @property
    def policy(self) -> str:
        """The one script that a content security policy is to let run."""
        digest = hashlib.sha256(self.script.encode()).digest()
        return f"'sha256-{base64.b64encode(digest).decode()}'"


def charts(signals: Sequence[Signal], logs: Iterable[str], mode: str, default: str) -> Charts | None:
    """Charts of logs in the given order; where there are too many samples for a page, of every second, third, ...

    Args:
        signals: of each log and channel.
        logs: names of those to be drawn.
        mode: what the signals' ``mode`` is called.
        default: what their ``default`` is called.

    Returns:
        None without signals.
    """
    by_log = {log: [s for s in signals if s.log == log] for log in logs}
    rows = {log: rows for log, rows in by_log.items() if rows}
    if not rows:
        return None
    total = sum(len(_SERIES) * len(s.time) for of in rows.values() for s in of)
    thinned = -(-total // _NUMBERS)
    codes: list[NDArray[np.uint16]] = []
    content = {
        "labels": {"measured": "measured", "mode": mode, "default": default, "low": "5 %", "high": "95 %"},
        "colours": {"measured": MEASURED, "mode": POSTERIOR, "default": DEFAULT},
        "logs": [_log(of, thinned, codes) for of in rows.values()],
        "codes": base64.b64encode(zlib.compress(np.concatenate(codes).astype("<u2").tobytes(), 9)).decode(),
    }
    data = json.dumps(content, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")
    script = "\n".join((_ASSETS / name).read_text(encoding="utf-8") for name in ("uPlot.iife.min.js", "charts.js"))
    return Charts(data, script, (_ASSETS / "uPlot.min.css").read_text(encoding="utf-8"), thinned)


def _log(signals: Sequence[Signal], every: int, codes: list[NDArray[np.uint16]]) -> dict[str, object]:
    """A log's entry; the codes of its series are appended."""
    first = signals[0]
    time = first.time[::every]
    starts = np.unique(np.searchsorted(time, first.window_starts - 1e-9))
    return {
        "name": first.log,
        "use": "held out" if first.use == "holdout" else "training",
        "start": float(time[0]),
        "step": float((time[-1] - time[0]) / max(len(time) - 1, 1)),
        "count": len(time),
        "windows": starts[starts < len(time)].tolist(),
        "channels": [
            {"name": s.channel, "label": with_unit(s.channel, s.unit), "error": with_unit("error", s.unit)}
            | {key: _coded(getattr(s, key)[::every], codes) for key in _SERIES}
            for s in signals
        ],
    }


def _coded(values: FloatArray, codes: list[NDArray[np.uint16]]) -> list[float]:
    """Lowest value and step of one series (T,), whose codes are appended."""
    known = np.isfinite(values)
    low, high = (float(values[known].min()), float(values[known].max())) if known.any() else (0.0, 0.0)
    step = (high - low) / (_NOTHING - 1) or 1.0
    coded = np.full(len(values), _NOTHING, np.int64)
    coded[known] = np.round((values[known] - low) / step)
    codes.append(np.diff(coded, prepend=0).astype(np.uint16))
    return [low, step]
