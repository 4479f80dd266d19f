"""What single checks of a calibration found, as plain data: errors, signals, residuals, ridges."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class ChannelScore:
    """Root-mean-square error of one channel of one log over open-loop windows from measured starts, at the posterior
    mode and with the model as given."""

    log: str
    channel: str
    unit: str
    rmse: float
    rmse_default: float


@dataclass(frozen=True)
class Comparison:
    """Whether the held-out errors are smaller than those of the model as given. ratio: how many times, as the geometric mean over
    logs and channels; low, high: its 95 % interval; p: of a ratio as far from 1 where the models predict alike; both from a paired
    t-test over ``pieces`` of the logs. starts: the share of the calibrated model's error that the measured starts of windows made, where that is
    nearly all and each model's own best starts took their place."""

    ratio: float
    low: float
    high: float
    p: float
    pieces: int
    starts: float | None = None

    @property
    def verdict(self) -> str:
        """``better``, ``not better`` or ``worse``, at the 5 % level."""
        return "not better" if self.p > 0.05 else "better" if self.ratio > 1 else "worse"

    def to_dict(self) -> dict[str, Any]:
        return {"verdict": self.verdict, **asdict(self)}


@dataclass(frozen=True)
class Signal:
    """One channel of one log for drawing. All arrays (T+1,); NaN where there is nothing.

    mode: prediction at the posterior mode; low, high: 5 % and 95 % of the predictions over posterior draws, without
    measurement noise; default: the model as given. Every window of the log starts anew at ``window_starts`` (s).
    """

    log: str
    use: str
    channel: str
    unit: str
    time: FloatArray
    measured: FloatArray
    mode: FloatArray
    low: FloatArray
    high: FloatArray
    default: FloatArray
    window_starts: FloatArray


@dataclass(frozen=True)
class Residual:
    """Residual (T+1,) of one fitted channel of one training log with the windows' starts at their estimates, in the
    channel's unit; whitened: the same after the noise model, which should be white with sd 1."""

    log: str
    channel: str
    unit: str
    time: FloatArray
    residual: FloatArray
    whitened: FloatArray


@dataclass(frozen=True)
class Ridge:
    """A direction that the data leave open, in words, and the members of it by name."""

    text: str
    parameters: tuple[str, ...]
