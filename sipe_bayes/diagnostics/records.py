"""What single checks of a calibration say, as plain data: errors, signals, residuals, ridges, noise, mixing, logs."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from numbers import Real

import numpy as np

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.findings import Code, Finding, finding, p_text
from sipe_bayes.core.thresholds import THRESHOLDS


@dataclass(frozen=True)
class ChannelScore:
    """Root-mean-square errors of one channel of one log.

    They are over open-loop windows from measured starts, in the channel's unit.

    Args:
        log: its name.
        channel: its name.
        unit: of the errors.
        rmse: at the posterior mode.
        rmse_default: with the model as given.
    """

    log: str
    channel: str
    unit: str
    rmse: float
    rmse_default: float


def improvement(scores: Iterable[ChannelScore]) -> float:
    """How many times smaller the error became: geometric mean over logs and channels; NaN when none compares.

    0 where simulations of the calibrated model diverge.
    """
    ratios = [s.rmse_default / s.rmse for s in scores if s.rmse > 0 and s.rmse_default > 0]
    ratios = [r for r in ratios if math.isfinite(r)]
    with np.errstate(divide="ignore"):  # of a model that diverges
        return float(np.exp(np.mean(np.log(ratios)))) if ratios else math.nan


@dataclass(frozen=True)
class BandCoverage:
    """How much of held-out logs the 90 % bands hold.

    Args:
        share: of the samples, the mean over pieces of the logs.
        error: standard error by pieces.
        pieces: tenths of each log and channel.
        half: channel -> median half width of its band, and its unit.
    """

    share: float
    error: float
    pieces: int
    half: dict[str, tuple[float, str]]


@dataclass(frozen=True)
class Comparison:
    """Whether the held-out errors are smaller than those of the model as given.

    Args:
        ratio: how many times, as the geometric mean over logs and channels.
        low: lower end of its 95 % interval.
        high: upper end.
        p: of a ratio as far from 1 where the models predict alike; as the interval from a paired t-test.
        pieces: of the logs, over which the test goes.
        starts: share of the calibrated model's error that the measured starts of windows made, where that is nearly
            all and each model's own best starts took their place.
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

    def to_dict(self) -> dict[str, object]:
        """As JSON has it."""
        return {"verdict": self.verdict, **asdict(self)}


@dataclass(frozen=True)
class Signal:
    """One channel of one log for drawing; all arrays (T+1,), NaN where there is nothing.

    Args:
        log: its name.
        use: ``train`` or ``holdout``.
        channel: its name.
        unit: of all but time.
        time: s.
        measured: what the log holds.
        mode: prediction at the posterior mode.
        low: lower end of the 90 % band of what a sensor reads.
        high: its upper end.
        default: prediction of the model as given.
        window_starts: (W,) s, where every window of the log starts anew.
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
    """What the model leaves of one fitted channel of one training log, with the windows' starts at their estimates.

    Args:
        log: its name.
        channel: its name.
        unit: of the residual.
        time: (T+1,) s.
        residual: (T+1,).
        whitened: (T+1,), the residual after the noise model, which should be white with sd 1.
    """

    log: str
    channel: str
    unit: str
    time: FloatArray
    residual: FloatArray
    whitened: FloatArray


@dataclass(frozen=True)
class Ridge:
    """A combination of parameters that the data determine while they leave its members open.

    Args:
        parameters: the members.
        combination: a sum or product of them, as a formula.
        value: of the combination.
        width: its sd.
        unit: its unit.
        unknown: the members that are not determined alone.
    """

    parameters: tuple[str, ...]
    combination: str
    value: float
    width: float
    unit: str
    unknown: tuple[str, ...]

    def finding(self, code: Code = Code.RIDGE) -> Finding:
        """It as a finding.

        Args:
            code: ``RIDGE``, ``RIDGE_TO_RESOLVE`` with the remedy, or ``RIDGE_EXPECTED`` of a planned experiment.
        """
        unit = f" {self.unit}" if self.unit not in ("", "1") else ""
        *others, last = self.unknown
        alone = f"{', '.join(others)} and {last} alone are" if others else f"{last} alone is"
        return finding(
            code,
            parameters=self.parameters,
            combination=self.combination,
            value=self.value,
            width=self.width,
            unit=unit,
            alone=alone,
            ridge=self.text if code is Code.RIDGE_TO_RESOLVE else "",
        )

    @property
    def text(self) -> str:
        """In words."""
        return self.finding().text


@dataclass(frozen=True)
class Misfit:
    """What the residuals look like.

    Args:
        p: of residuals as odd as these under a right model with autoregressive noise.
        cause: what fits them best, in words.
        remedy: what to do about it.
        log: where it shows most.
        channel: where it shows most.
        start: s, from where it shows most.
        stop: s, to where.
        share: for each channel the share of the residual's variance that the cause explains. Where samples follow one
            another, of the whitened residual's that those before foretell; where noise is larger for a while, of its
            squares what that tenth of the time has too many.
        shift: for each parameter by how many posterior sds its estimate would move if the model had the cause; empty
            where that cannot be told.
        floor: the least p that the draws of the null can give.
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
    def matters(self) -> bool:
        """Whether there is an alarm and its cause is not small."""
        return self.alarm and (max(self.share.values()) >= THRESHOLDS.small_misfit or bool(self.moved))

    @property
    def finding(self) -> Finding:
        """It as a finding: about all parameters where it explains much, else about those that move.

        A cause that explains much may have the wrong name, and then other parameters move.
        """
        small = max(self.share.values(), default=0.0) < THRESHOLDS.small_misfit
        code = Code.MISFIT_SHIFTS if self.moved else Code.MISFIT if self.matters else Code.SMALL_MISFIT
        return finding(
            code if self.alarm else Code.NO_MISFIT,
            parameters=self.moved if self.matters and small else (),
            log=self.log,
            p=self.p_text,
            cause=self.cause,
            percent=float(f"{100 * self.share[self.channel]:.2g}"),
            channel=self.channel,
            start=self.start,
            stop=self.stop,
            moved=", ".join(f"{name} by {self.shift[name]:+.2g} sd" for name in self.moved),
            remedy=self.remedy,
            which="it" if self.alike == 1 else "the first of them",
            far=THRESHOLDS.far_shift,
        )

    @property
    def text(self) -> str:
        """In a sentence."""
        return self.finding.text


@dataclass(frozen=True)
class ChannelNoise:
    """Sensor noise of one channel.

    Args:
        sd: in ``unit``.
        tau: correlation time in s; 0 where it is white.
        unit: of the channel.
        tau_at_limit: whether ``tau`` is the longest that the logs can tell, their length: it may be longer.
    """

    sd: float
    tau: float
    unit: str = ""
    tau_at_limit: bool = False


@dataclass(frozen=True)
class Mixing:
    """How well Markov chains have mixed.

    Args:
        overall: numbers of the whole chain by name: ``rhat``, ``ess``, ``acceptance``, ``steps``, ...
        by_parameter: for each measure that is told by parameter, the number of each.
    """

    overall: Mapping[str, float] = field(default_factory=dict)
    by_parameter: Mapping[str, Mapping[str, float]] = field(default_factory=dict)

    @classmethod
    def of(cls, measured: Mapping[str, object], names: Sequence[str]) -> Mixing:
        """Read what an estimator's diagnostics hold.

        Args:
            measured: numbers, or by parameter mappings or sequences in the order of ``names``; all else is left out.
            names: of the parameters.
        """
        overall: dict[str, float] = {}
        each: dict[str, dict[str, float]] = {}
        for key, value in measured.items():
            if isinstance(value, Real):
                overall[key] = value if isinstance(value, int) else float(value)
            elif isinstance(value, Mapping):
                each[key] = {str(name): float(number) for name, number in value.items()}
            elif isinstance(value, Sequence | np.ndarray) and not isinstance(value, str) and len(value) == len(names):
                each[key] = dict(zip(names, map(float, value), strict=True))
        return cls(overall, each)

    @property
    def worst(self) -> tuple[float, str] | None:
        """Largest R-hat and the parameter that it is of, empty where that is not told; None without any."""
        each = self.by_parameter.get("rhat")
        if each:
            name = max(each, key=lambda n: each[n])
            return each[name], name
        return (self.overall["rhat"], "") if "rhat" in self.overall else None

    def to_dict(self) -> dict[str, object]:
        """As JSON has it; what is not finite is None."""
        return {
            **{k: v if np.isfinite(v) else None for k, v in self.overall.items()},
            **{k: dict(v) for k, v in self.by_parameter.items()},
        }


@dataclass(frozen=True)
class LogReport:
    """What a log held and what was done to it.

    Args:
        name: of the log.
        file: its path.
        sha256: of the file.
        rate_hz: of the control grid.
        duration_s: of the trajectory.
        samples: T+1.
        jitter_s: largest distance of a sample period from the median one, or, over dropped rows, from a multiple of it.
        resampled: whether samples were interpolated.
        gaps: (start, stop) in s from the trajectory's first sample, without a measurement for longer than ``max_gap``.
        missing: masked samples of each channel.
        wild: samples of each channel left out at reading or by the fit, since no smooth motion explains them.
        clipped: samples of each channel and command (``actuator:NAME``) in runs at its extreme value.
        findings: the same in words, with what the user should know.
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

    def to_dict(self) -> dict[str, object]:
        """As JSON has it."""
        plain = {k: v for k, v in asdict(self).items() if k != "findings"}
        return {**plain, "gaps": [list(gap) for gap in self.gaps], "notes": list(self.notes)}
