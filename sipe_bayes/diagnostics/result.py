"""What a calibration found, as plain data: the command prints it, the report draws it."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from sipe_bayes.diagnostics.misspecification import Misfit
from sipe_bayes.diagnostics.prior_predictive import OutsidePrior
from sipe_bayes.diagnostics.records import ChannelScore, Comparison, Residual, Ridge, Signal
from sipe_bayes.posterior import Posterior


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
