"""Calibrations as the report gets them, and its page as a reader sees it."""

import dataclasses
from html.parser import HTMLParser

import numpy as np
import torch

from sipe_bayes.core.findings import Code, Finding, Severity
from sipe_bayes.core.parameters import Parameter, ParameterSpace
from sipe_bayes.diagnostics.records import (
    ChannelNoise,
    ChannelScore,
    Comparison,
    LogReport,
    Misfit,
    Residual,
    Ridge,
    Signal,
)
from sipe_bayes.diagnostics.result import Calibration, ParameterSummary
from sipe_bayes.posterior import GaussianMixture, Particles, Posterior, prior

BETTER = Comparison(3.1, 2.6, 3.7, 1e-6, 10)
LACKS = Misfit(
    0.005, "drag at hinge", "put it in", "train_0", "angle_0", 0, 1, {"angle_0": 0.4}, {"p1": 3.0, "p2": 0.1}
)
EVIL = "<script>alert('x')</script>"


def make_posterior(space: ParameterSpace) -> GaussianMixture:
    """Means spread over the range, the first at its lower bound; the last two correlate by -0.98."""
    n = len(space)
    mean, sd = np.linspace(0.0, 0.7, n), np.full(n, 0.03)
    correlation = np.eye(n)
    correlation[-1, -2] = correlation[-2, -1] = -0.98
    covariance = correlation * np.outer(sd, sd)
    return GaussianMixture(torch.zeros(1), torch.tensor(mean)[None], torch.tensor(covariance)[None], space)


def noticed(code: Code, *names: str, severity: Severity = Severity.CAUTION, text: str = "") -> Finding:
    return Finding(code, severity, text or f"{code}: {', '.join(names)}", names)


def ridge(*names: str, combination: str = "a b") -> Ridge:
    return Ridge(names, combination, 2.0, 0.1, "kg", names)


def summaries(posterior: Posterior) -> list[ParameterSummary]:
    values = posterior.values(4000, torch.Generator().manual_seed(0))
    before = prior(posterior.space).values(4000, torch.Generator().manual_seed(0)).std(0)
    mode = posterior.space.values(posterior.mode.numpy())
    return [
        ParameterSummary(
            name=p.name,
            unit=p.unit,
            targets=p.targets,
            mean=float(v.mean()),
            sd=float(v.std()),
            q05=float(np.quantile(v, 0.05)),
            q50=float(np.median(v)),
            q95=float(np.quantile(v, 0.95)),
            mode=float(m),
            default=p.default,
            contraction=float(1 - v.std() / b),
        )
        for p, v, m, b in zip(posterior.space, values.T, mode, before, strict=True)
    ]


def signal(log: str, use: str, channel: str, steps: int = 200, window: int = 50) -> Signal:
    time = np.arange(steps + 1) * 0.01
    measured = np.sin(3 * time)
    measured[40:60] = np.nan
    mode = np.sin(3 * time) + 0.01
    return Signal(log, use, channel, "rad", time, measured, mode, mode - 0.05, mode + 0.05, mode * 3, time[:-1:window])


def make_calibration(size: int = 3, logs: int = 1, channels: int = 1, names: tuple[str, ...] = ()) -> Calibration:
    names = names or tuple(f"p{i}" for i in range(size))
    space = ParameterSpace(
        Parameter(n, 1.0, 2.0, 1.5, "kg m^2", targets=(f"body:{i}.mass",)) for i, n in enumerate(names)
    )
    posterior = make_posterior(space)
    keys = [(f"{use}_{k}", use) for use in ("train", "holdout") for k in range(logs)]
    signals = [signal(log, use, f"angle_{c}") for log, use in keys for c in range(channels)]
    rng = np.random.default_rng(0)
    residuals = [
        Residual(s.log, s.channel, s.unit, s.time, rng.normal(size=201), rng.normal(size=201))
        for s in signals
        if s.use == "train"
    ]
    scores = {
        use: [ChannelScore(s.log, s.channel, s.unit, 0.02, 0.062) for s in signals if s.use == use]
        for use in ("train", "holdout")
    }
    return Calibration(
        name="pendulum",
        estimator="laplace",
        posterior=posterior,
        prior=prior(space),
        parameters=summaries(posterior),
        train=scores["train"],
        holdout=scores["holdout"],
        findings=(noticed(Code.MODE_AT_BOUND, names[0]),),
        signals=signals,
        residuals=residuals,
        comparison=BETTER,
        ridges=[ridge(*names[-2:], combination="the last two")],
        noise={"angle_0": ChannelNoise(0.0123, 0.0, "rad")},
        logs=[LogReport(log, "", "", 100.0, 2.0, 201, 0.0, False, ((0.4, 0.6),)) for log, _ in keys],
        run={"config": {"model": "pendulum.xml"}, "seed": 0},
        rollouts=1234,
        seconds=5.6,
    )


def with_chains(calibration: Calibration, rhat: float) -> Calibration:
    theta = calibration.posterior.sample((400,), torch.Generator().manual_seed(0))
    posterior = Particles(theta, calibration.posterior.space, chains=4)
    mixing = {"rhat": rhat, "ess": 321.0, "acceptance": 0.31}
    return dataclasses.replace(calibration, posterior=posterior, mixing=mixing)


class Page(HTMLParser):
    """Text, tags and attributes of a page; raises on tags that do not nest."""

    void = frozenset({"meta", "img", "br"})

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: list[str] = []
        self.attributes: list[tuple[str, str, str | None]] = []
        self.words: list[str] = []
        self.feed(text.replace("<wbr>", ""))
        self.close()
        assert not self.open, f"left open: {self.open}"

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.attributes += [(tag, key, value) for key, value in attrs]
        if tag not in self.void:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open, f"</{tag}> closes nothing"
        assert self.open.pop() == tag, f"</{tag}> closes another tag"

    def handle_data(self, data: str) -> None:
        if self.open[-1:] not in (["style"], ["script"]):
            self.words.append(data)

    @property
    def text(self) -> str:
        return " ".join(" ".join(self.words).split())
