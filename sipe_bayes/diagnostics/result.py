"""What a calibration found, as plain data: the command prints it, the report draws it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field

from sipe_bayes.core import view
from sipe_bayes.core.findings import Code, Finding, Findings
from sipe_bayes.core.html import Page, html_table
from sipe_bayes.diagnostics import records
from sipe_bayes.diagnostics.prior_predictive import OutsidePrior
from sipe_bayes.posterior import Particles, Posterior

FLAGS = (Code.NO_EFFECT, Code.DEAD_RANGE, Code.NOT_DETERMINED, Code.MODE_AT_BOUND, Code.LOGS_DISAGREE, Code.MISFIT)
"""Diagnostics that result.json names beside each parameter that they are about."""


@dataclass(frozen=True)
class ParameterSummary:
    """One parameter's marginal in its unit.

    ``q05`` is the bound where the mode sits on a physical one. ``contraction`` is 1 - sd / prior sd. A ``nuisance``
    holds for one log alone. ``further`` (2,) are the ends of the discrepancy-aware 90 % interval, where logs differ
    that of a further log. ``known``: whether the prior alone determines it well, and the logs do not say otherwise.
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

    Args:
        train, holdout: errors on the training and on the held-out logs.
        findings: what the estimator, the checks and the readers noticed, in the order in which it is told;
            ``warnings``, ``doubts`` and ``flags`` are views of it.
        bands, comparison: of the held-out logs and errors; None without any.
        misfit: what the residuals look like; None where they could not be looked at.
        outside: of each training log, whether the prior gives such a one.
        noise: of each fitted channel.
        further: theta with what the model lacks or may lack to first order, of which the parameters' ``further`` are
            the intervals; None where nothing can be said. ``causes`` are what it allows for.
        mixing: of Markov chains, numbers by name: ``rhat``, ``ess``, ``acceptance``, ...; none of other methods.
        run: configuration, versions, seed and checksums, as JSON has them.
        checked: False as long as the checks of the fit have not been made.
    """

    name: str
    estimator: str
    posterior: Posterior
    prior: Posterior
    parameters: list[ParameterSummary]
    train: list[records.ChannelScore]
    holdout: list[records.ChannelScore]
    findings: tuple[Finding, ...] = ()
    signals: list[records.Signal] = field(default_factory=list)
    residuals: list[records.Residual] = field(default_factory=list)
    ridges: list[records.Ridge] = field(default_factory=list)
    bands: records.BandCoverage | None = None
    comparison: records.Comparison | None = None
    misfit: records.Misfit | None = None
    outside: list[OutsidePrior] = field(default_factory=list)
    noise: dict[str, records.ChannelNoise] = field(default_factory=dict)
    causes: tuple[str, ...] = ()
    further: Particles | None = None
    mixing: Mapping[str, float] = field(default_factory=dict)
    logs: list[records.LogReport] = field(default_factory=list)
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

    def flags(self, name: str) -> tuple[str, ...]:
        """Codes among ``FLAGS`` of what was noticed about a parameter; ``nuisance`` if it holds for one log alone."""
        codes = {item.code for item in Findings(self.findings).about(name)}
        nuisance = any(p.nuisance for p in self.parameters if p.name == name)
        return (*(str(code) for code in FLAGS if code in codes), *["nuisance"] * nuisance)

    def to_dict(self) -> dict[str, object]:
        """The object that ``--json`` prints and result.json holds."""
        names = "train holdout comparison bands misfit causes ridges findings warnings doubts noise logs rollouts out"
        return {
            **{name: records.plain(getattr(self, name)) for name in (*names.split(), "checked")},
            "parameters": [{**asdict(p), "flags": list(self.flags(p.name))} for p in self.parameters],
            "outside_prior": records.plain(self.outside),
            "mixing": dict(self.mixing) or None,
            "seconds": round(self.seconds, 3),
        }
