"""What single checks of a calibration say, as plain data: errors, signals, residuals, ridges, noise, logs."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields, is_dataclass

import numpy as np
import scipy.stats

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.findings import Code, Finding, finding, p_text
from sipe_bayes.core.thresholds import THRESHOLDS


@dataclass(frozen=True)
class ChannelScore:
    """RMSE of one channel of one log in its unit, over open-loop windows from measured starts: of the posterior mode.

    ``rmse_default`` is that of the nominal model.
    """

    log: str
    channel: str
    unit: str
    rmse: float
    rmse_default: float


def improvement(scores: Iterable[ChannelScore]) -> float:
    """How many times smaller the error became: geometric mean over logs and channels; NaN when none compares."""
    ratios = [r for s in scores if s.rmse > 0 and s.rmse_default > 0 and math.isfinite(r := s.rmse_default / s.rmse)]
    return float(scipy.stats.gmean(ratios)) if ratios else math.nan


@dataclass(frozen=True)
class BandCoverage:
    """The share of the samples of held-out logs that the 90 % bands hold, and its standard error by ``pieces``.

    ``half``: channel -> median half width of its band, and its unit.
    """

    share: float
    error: float
    pieces: int
    half: dict[str, tuple[float, str]]


@dataclass(frozen=True)
class Comparison:
    """How many times smaller (``ratio``) the held-out errors are than those of the model as given.

    The geometric mean over logs and channels with its 95 % interval, and the ``p`` of one as far from 1 where the
    models predict alike, by a paired t-test over pieces of the logs. ``starts`` is the share of the calibrated model's
    error that measured starts made, where each model's best starts took their place.
    """

    ratio: float
    low: float
    high: float
    p: float
    pieces: int
    starts: float | None = None

    @property
    def verdict(self) -> str:
        """``better``, ``not better`` or ``worse``."""
        return "not better" if self.p > THRESHOLDS.comparison else "better" if self.ratio > 1 else "worse"

    @property
    def falls_behind(self) -> bool:
        """Whether the errors are larger by more than about one standard error: p is below that of one of a normal."""
        return self.ratio < 1 and self.p < 2 * float(scipy.stats.norm.sf(1))


@dataclass(frozen=True)
class Signal:
    """One channel of one log, for its ``use`` (``train`` or ``holdout``); arrays (T+1,), NaN for nothing; time in s.

    Predictions are those of the posterior ``mode`` and of the nominal model (``default``), ``low`` and ``high`` the
    ends of the 90 % band of what a sensor reads; ``window_starts`` (W,), in s, is where windows begin.
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
    """Residual (T+1,) of one fitted channel of one training log, with initial states at their estimates; time in s.

    ``whitened`` (T+1,) is that after the noise model, which should be white with sd 1.
    """

    log: str
    channel: str
    unit: str
    time: FloatArray
    residual: FloatArray
    whitened: FloatArray


@dataclass(frozen=True)
class Ridge:
    """A combination of parameters, a sum or product as a formula, that the data determine while they leave some open.

    ``value``, its sd (``width``) and its ``unit`` are the combination's; ``unknown`` are those not determined alone.
    """

    parameters: tuple[str, ...]
    combination: str
    value: float
    width: float
    unit: str
    unknown: tuple[str, ...]

    @property
    def finding(self) -> Finding:
        """The diagnostic, with the remedy."""
        unit = f" {self.unit}" if self.unit not in ("", "1") else ""
        *others, last = self.unknown
        alone = f"{', '.join(others)} and {last} alone are" if others else f"{last} alone is"
        return finding(Code.RIDGE, **(vars(self) | {"unit": unit, "alone": alone}))

    @property
    def text(self) -> str:
        """In words."""
        return self.finding.text


@dataclass(frozen=True)
class Misfit:
    """What the residuals look like: the cause that fits them best, and what to do about it, in words.

    Args:
        p: of residuals as odd as these under a right model with autoregressive noise; at least ``floor``.
        log, channel: where it shows most, from ``start`` to ``stop``, in s.
        share: of each channel's residual variance that the cause explains; of whitened residuals that follow one
            another what those before foretell, of noise that is larger for a while what that tenth has too many.
        shift: by how many posterior sds each parameter's estimate would move if the model had the cause; or empty.
        alike: how many causes the cause's words name, which explain about as much.
    """

    p: float
    cause: str
    remedy: str
    log: str
    channel: str
    start: float
    stop: float
    share: dict[str, float] = field(default_factory=dict)
    shift: dict[str, float] = field(default_factory=dict)
    floor: float = 0.0
    alike: int = 1

    @property
    def alarm(self) -> bool:
        """Whether the residuals are not noise."""
        return self.p <= THRESHOLDS.misfit

    @property
    def p_text(self) -> str:
        """Its p in a sentence."""
        return p_text(self.p, self.floor)

    @property
    def moved(self) -> list[str]:
        """The parameters that would move far."""
        return [name for name, sds in self.shift.items() if abs(sds) > THRESHOLDS.far_shift]

    @property
    def is_small(self) -> bool:
        """Whether the cause explains little of every channel's residual."""
        return max(self.share.values(), default=0.0) < THRESHOLDS.small_misfit

    @property
    def matters(self) -> bool:
        """Whether there is an alarm, and its cause explains much or moves a parameter."""
        return self.alarm and (not self.is_small or bool(self.moved))

    @property
    def finding(self) -> Finding:
        """The diagnostic; about all parameters where the cause explains much: under a wrong name others move."""
        moved = ", ".join(f"{name} by {self.shift[name]:+.2g} sd" for name in self.moved)
        which = "it" if self.alike == 1 else "the first of them"
        move = f"with {which} in the model the estimate would move, {moved}"
        values = {
            "parameters": self.moved if self.is_small else (),
            "p": self.p_text,
            "percent": float(f"{100 * self.share[self.channel]:.2g}"),
            "effect": move if moved else "do not trust the intervals' width",
            "far": THRESHOLDS.far_shift,
        }
        return finding(Code.MISFIT if self.matters else Code.SMALL_MISFIT, **(vars(self) | values))


@dataclass(frozen=True)
class ChannelNoise:
    """Sensor noise of one channel: sd in its unit, and correlation time ``tau`` in s, 0 where it is white.

    ``tau_at_limit``: whether ``tau`` is the longest that the logs can tell, their length: it may be longer.
    """

    sd: float
    tau: float
    unit: str = ""
    tau_at_limit: bool = False


@dataclass(frozen=True)
class LogReport:
    """What a log held and what was done to it; ``findings`` say it in words.

    Args:
        rate_hz: of the control grid, which has T+1 ``samples``.
        jitter_s: largest distance of a sample period from the median one, or, over dropped rows, from a multiple of it.
        gaps: (start, stop) in s from the trajectory's first sample, without a measurement for longer than ``max_gap``.
        missing, wild: samples of each channel that are masked, or left out since no smooth motion explains them.
        clipped: samples of each channel and command (``actuator:NAME``) in runs at its extreme value.
    """

    name: str
    file: str
    sha256: str
    rate_hz: float
    duration_s: float
    samples: int
    jitter_s: float
    resampled: bool
    gaps: tuple[tuple[float, float], ...] = ()
    missing: Mapping[str, int] = field(default_factory=dict)
    wild: Mapping[str, int] = field(default_factory=dict)
    clipped: Mapping[str, int] = field(default_factory=dict)
    findings: tuple[Finding, ...] = ()

    @property
    def notes(self) -> tuple[str, ...]:
        """The texts of the findings."""
        return tuple(item.text for item in self.findings)

    @property
    def suspect(self) -> bool:
        """Whether the log is not simply as it was recorded, so that the user should read the notes."""
        return bool(self.gaps or self.resampled or any(self.missing.values()) or any(self.clipped.values()))


_DERIVED = {Comparison: ("verdict",), Misfit: ("alarm", "matters"), Ridge: ("text",), LogReport: ("notes",)}


def plain(value: object) -> object:
    """Records, in collections too, as JSON has them: their fields, what is derived from them, and no array."""
    if isinstance(value, Finding):
        return value.to_dict()
    if isinstance(value, Mapping):
        return {key: plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if not is_dataclass(value):
        return value
    names = [f.name for f in fields(value) if not isinstance(getattr(value, f.name), np.ndarray)]
    return {name: plain(getattr(value, name)) for name in (*names, *_DERIVED.get(type(value), ()))}
