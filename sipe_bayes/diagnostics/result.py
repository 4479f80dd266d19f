"""What a calibration found, as plain data: the command prints it, the report draws it."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from sipe_bayes.diagnostics.misspecification import Misfit
    from sipe_bayes.diagnostics.prior_predictive import OutsidePrior
    from sipe_bayes.posterior import Posterior

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class ParameterSummary:
    """One parameter's marginal in its unit. contraction = 1 - sd / prior sd; flags are single words: ``at_bound``,
    ``no_effect``, ``dead_range``, ``not_determined``, ``disagrees``, ``misfit`` (what the model lacks moves it), ``nuisance``."""

    name: str
    unit: str
    targets: tuple[str, ...]
    mean: float
    sd: float
    q05: float
    q50: float
    q95: float
    mode: float
    default: float | None
    contraction: float
    flags: tuple[str, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        return {**asdict(self), "targets": list(self.targets), "flags": list(self.flags)}


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


def _finite(value: Any) -> Any:
    """JSON knows neither infinity nor NaN."""
    return None if isinstance(value, float) and not np.isfinite(value) else value


@dataclass
class Calibration:
    """The outcome of ``sipe calibrate``. doubts: the warnings for which no interval is to be trusted; comparison: of the held-out errors, None without any; misfit: None where the residuals could
    not be looked at; outside: one for each training log; noise: channel -> {"sd", "tau" (s), "unit"}; mixing: {"rhat", "ess", ...}
    of mcmc or None; logs: what was read and what was done to it; left_out: sentences about parts that do not apply; run:
    configuration, versions, seed, checksums."""

    name: str
    estimator: str
    posterior: Posterior
    prior: Posterior
    parameters: list[ParameterSummary]
    train: list[ChannelScore]
    holdout: list[ChannelScore]
    warnings: list[str]
    doubts: list[str] = field(default_factory=list)
    signals: list[Signal] = field(default_factory=list)
    residuals: list[Residual] = field(default_factory=list)
    ridges: list[Ridge] = field(default_factory=list)
    comparison: Comparison | None = None
    misfit: Misfit | None = None
    outside: list[OutsidePrior] = field(default_factory=list)
    left_out: list[str] = field(default_factory=list)
    noise: dict[str, dict[str, Any]] = field(default_factory=dict)
    mixing: dict[str, Any] | None = None
    logs: list[dict[str, Any]] = field(default_factory=list)
    run: dict[str, Any] = field(default_factory=dict)
    rollouts: int = 0
    seconds: float = 0.0
    out: str = ""

    def to_dict(self) -> dict[str, Any]:
        """The object that ``--json`` prints."""
        return {
            "parameters": [p.to_dict() for p in self.parameters],
            "holdout": [asdict(s) for s in self.holdout],
            "train": [asdict(s) for s in self.train],
            "comparison": None if self.comparison is None else self.comparison.to_dict(),
            "misfit": None if self.misfit is None else {**asdict(self.misfit), "matters": self.misfit.matters},
            "outside_prior": [asdict(o) for o in self.outside],
            "ridges": [asdict(r) for r in self.ridges],
            "warnings": list(self.warnings),
            "doubts": list(self.doubts),
            "left_out": list(self.left_out),
            "noise": self.noise,
            "logs": self.logs,
            "mixing": None if self.mixing is None else {k: _finite(v) for k, v in self.mixing.items()},
            "rollouts": self.rollouts,
            "seconds": round(self.seconds, 3),
            "out": self.out,
        }
