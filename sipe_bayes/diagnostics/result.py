"""What a calibration found, as plain data: the command prints it, the report draws it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field

from sipe_bayes.core import view
from sipe_bayes.core.findings import Code, Finding, Findings
from sipe_bayes.core.html import Page, html_table
from sipe_bayes.diagnostics.prior_predictive import OutsidePrior
from sipe_bayes.diagnostics.records import (
    BandCoverage,
    ChannelNoise,
    ChannelScore,
    Comparison,
    LogReport,
    Misfit,
    Mixing,
    Residual,
    Ridge,
    Signal,
)
from sipe_bayes.posterior import Particles, Posterior

FLAGS: Mapping[Code, str] = {
    Code.NO_EFFECT: "no_effect",
    Code.DEAD_RANGE: "dead_range",
    Code.NOT_DETERMINED: "not_determined",
    Code.MODE_AT_BOUND: "at_bound",
    Code.LOGS_DISAGREE: "disagrees",
    Code.LOGS_DISAGREE_UNEXPLAINED: "disagrees",
    Code.MISFIT: "misfit",
    Code.MISFIT_SHIFTS: "misfit",
}
"""Findings about single parameters, and the flag that result.json has for them."""
NUISANCE = "nuisance"
PROCESS_NOISE = (Code.PROCESS_NOISE, Code.PROCESS_NOISE_LARGE)


@dataclass(frozen=True)
class ParameterSummary:
    """One parameter's marginal in its unit.

    Args:
        name: of the parameter.
        unit: of all numbers but the contraction.
        targets: what it writes to.
        mean: of the posterior.
        sd: its standard deviation.
        q05: its 5 % quantile; the bound where the mode sits on a physical one.
        q50: its median.
        q95: its 95 % quantile.
        mode: the best point's value.
        default: of the model as given, if it has one.
        contraction: 1 - sd / prior sd.
        nuisance: whether it holds for one log alone.
        further: (2,) 5 and 95 % quantiles with what the model may lack; where the logs ask for different values or the
            model lacks something, of what a further log would ask for. None where neither can be said.
        known: whether the prior alone determines it well, and the logs do not say otherwise.
    """

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
    nuisance: bool = False
    further: tuple[float, float] | None = None
    known: bool = False


@dataclass(frozen=True)
class Calibration:
    """The outcome of ``sipe calibrate``.

    ``findings`` is the one list of what the estimator, the checks and the readers noticed; ``warnings``, ``doubts``,
    ``left_out`` and ``flags`` are views of it.

    Args:
        name: of the run.
        estimator: of the method.
        posterior: of the parameters.
        prior: that it started from.
        parameters: a summary of each.
        train: errors on the training logs.
        holdout: errors on the held-out logs.
        findings: what was noticed, in the order in which it is told.
        signals: what to draw of each log and channel.
        residuals: of each training log and fitted channel.
        ridges: combinations that are better known than their members.
        bands: how much of the held-out logs their bands hold; None without any.
        comparison: of the held-out errors with the model as given; None without any.
        misfit: what the residuals look like; None where they could not be looked at.
        outside: of each training log, whether the prior gives such a one.
        noise: of each fitted channel.
        causes: for which the parameters' ``further`` allow, to first order.
        further: theta with what the model lacks or may lack, of which the parameters' ``further`` are the intervals;
            None where nothing can be said.
        mixing: of Markov chains; None of other methods.
        logs: what was read and what was done to it.
        run: configuration, versions, seed and checksums, as JSON has them.
        rollouts: spent.
        seconds: taken.
        out: folder that holds the results.
        checked: False as long as the checks of the fit have not been made.
    """

    name: str
    estimator: str
    posterior: Posterior
    prior: Posterior
    parameters: list[ParameterSummary]
    train: list[ChannelScore]
    holdout: list[ChannelScore]
    findings: tuple[Finding, ...] = ()
    signals: list[Signal] = field(default_factory=list)
    residuals: list[Residual] = field(default_factory=list)
    ridges: list[Ridge] = field(default_factory=list)
    bands: BandCoverage | None = None
    comparison: Comparison | None = None
    misfit: Misfit | None = None
    outside: list[OutsidePrior] = field(default_factory=list)
    noise: dict[str, ChannelNoise] = field(default_factory=dict)
    causes: tuple[str, ...] = ()
    further: Particles | None = None
    mixing: Mixing | None = None
    logs: list[LogReport] = field(default_factory=list)
    run: dict[str, object] = field(default_factory=dict)
    rollouts: int = 0
    seconds: float = 0.0
    out: str = ""
    checked: bool = True

    def _repr_html_(self) -> str:
        rows = [
            (p.name, f"{p.mode:.4g}", f"{p.q05:.4g} to {p.q95:.4g}", p.unit, ", ".join(self.flags(p.name)))
            for p in self.parameters
        ]
        errors = [
            f"held out {s.log}, {s.channel}: {s.rmse:.3g} {s.unit}, as given {s.rmse_default:.3g}" for s in self.holdout
        ]
        headings = ("parameter", "value", "90 % interval", "unit", "flags")
        return html_table(f"{self.name}, {self.estimator}", headings, rows, [*errors, *self.warnings])

    def report(self) -> Page:
        """The page that `sipe calibrate` writes as report.html, without its moving picture; a notebook shows it."""
        page: Page = view("calibration").page(self)
        return page

    @property
    def warnings(self) -> list[str]:
        """The texts of all findings but notes."""
        return Findings(self.findings).warnings

    @property
    def doubts(self) -> list[str]:
        """The texts of the findings for which no interval is to be trusted."""
        return Findings(self.findings).doubts

    @property
    def left_out(self) -> list[str]:
        """Sentences about parts of the report that do not apply, and what there is in their place."""
        findings = Findings(self.findings)
        noise = " ".join(item.text for item in findings.of(*PROCESS_NOISE))
        return [item.text for item in findings.of(Code.RESIDUALS_LEFT_OUT)] + [noise] * bool(noise)

    def flags(self, name: str) -> tuple[str, ...]:
        """What was noticed about one parameter, in single words.

        Args:
            name: of the parameter.

        Returns:
            Of ``no_effect``, ``dead_range``, ``not_determined``, ``at_bound``, ``disagrees``, ``misfit`` (what the
            model lacks moves it) and ``nuisance`` (it holds for one log alone) those that apply.
        """
        codes = {item.code for item in Findings(self.findings).about(name)}
        nuisance = any(p.nuisance for p in self.parameters if p.name == name)
        return (*dict.fromkeys(flag for code, flag in FLAGS.items() if code in codes), *[NUISANCE] * nuisance)

    def to_dict(self) -> dict[str, object]:
        """The object that ``--json`` prints and result.json holds."""
        rows = []
        for p in self.parameters:
            row = {k: v for k, v in asdict(p).items() if k != NUISANCE}
            rows.append({**row, "targets": list(p.targets), "flags": list(self.flags(p.name))})
        return {
            "parameters": rows,
            "holdout": [asdict(s) for s in self.holdout],
            "train": [asdict(s) for s in self.train],
            "comparison": None if self.comparison is None else self.comparison.to_dict(),
            "bands": None if self.bands is None else asdict(self.bands),
            "misfit": None if self.misfit is None else {**asdict(self.misfit), "matters": self.misfit.matters},
            "causes": list(self.causes),
            "outside_prior": [asdict(o) for o in self.outside],
            "ridges": [{"text": r.text, **asdict(r)} for r in self.ridges],
            "findings": [item.to_dict() for item in self.findings],
            "warnings": self.warnings,
            "doubts": self.doubts,
            "left_out": self.left_out,
            "noise": {channel: asdict(noise) for channel, noise in self.noise.items()},
            "logs": [log.to_dict() for log in self.logs],
            "mixing": None if self.mixing is None else self.mixing.to_dict(),
            "rollouts": self.rollouts,
            "seconds": round(self.seconds, 3),
            "out": self.out,
            "checked": self.checked,
        }
