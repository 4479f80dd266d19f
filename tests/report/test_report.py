"""The figures and the report: what they show, what they say, and that they stand on their own."""

import dataclasses
import math
import re
import warnings
from html.parser import HTMLParser
from itertools import pairwise
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import pytest
import torch

from sipe_bayes.core import files
from sipe_bayes.core.findings import Code, Finding, Findings, Severity
from sipe_bayes.core.parameters import Parameter, ParameterSpace
from sipe_bayes.diagnostics.misspecification import Misfit
from sipe_bayes.diagnostics.prior_predictive import OutsidePrior
from sipe_bayes.diagnostics.records import (
    ChannelNoise,
    ChannelScore,
    Comparison,
    LogReport,
    Mixing,
    Residual,
    Ridge,
    Signal,
)
from sipe_bayes.diagnostics.result import Calibration, ParameterSummary
from sipe_bayes.posterior import Dirac, GaussianMixture, Particles, Posterior, prior
from sipe_bayes.report import calibration_plots as plots
from sipe_bayes.report import page as report
from sipe_bayes.report import verdicts as judged
from sipe_bayes.report.words import significant

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


@pytest.fixture(autouse=True)
def strict() -> Any:
    """Matplotlib's layout warnings are failures, and nobody's style is left changed."""
    before = dict(matplotlib.rcParams)
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        yield
    assert dict(matplotlib.rcParams) == before


@pytest.fixture(scope="module")
def calibration() -> Calibration:
    return make_calibration()


@pytest.fixture(scope="module")
def images(calibration: Calibration) -> list[report.Picture]:
    return report.pictures(calibration)


@pytest.fixture(scope="module")
def page(calibration: Calibration, images: list[report.Picture]) -> str:
    return report.render(calibration, images)


class Page(HTMLParser):
    """Text, tags and attributes of a page; raises on tags that do not nest."""

    void = frozenset({"meta", "img", "br"})

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: list[str] = []
        self.attributes: list[tuple[str, str, str | None]] = []
        self.words: list[str] = []
        self.feed(text)
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
        if self.open[-1:] != ["style"]:
            self.words.append(data)

    @property
    def text(self) -> str:
        return " ".join(" ".join(self.words).split())


# The numbers behind the pictures


@pytest.mark.parametrize("centre", [0.0, 0.01, 0.5, 1.0])
def test_density_integrates_to_one_within_the_bounds(centre: float) -> None:
    theta = np.abs(np.random.default_rng(0).normal(centre, 0.02, 4000))
    theta = np.where(theta > 1, 2 - theta, theta)
    grid = np.linspace(0, 1, 801)
    mass = np.trapezoid(plots.density(theta, grid), grid)
    assert mass == pytest.approx(1, abs=0.01)
    assert (plots.density(theta, np.array([-0.001, 1.001])) == 0).all()


def test_density_is_not_rounded_off_at_a_bound() -> None:
    theta = np.random.default_rng(0).uniform(size=8000)
    height = plots.density(theta, np.array([0.0, 0.5, 1.0]))
    assert height == pytest.approx(1, abs=0.12)


def test_density_does_not_depend_on_repeated_draws() -> None:
    theta, grid = np.random.default_rng(0).normal(0.5, 0.1, 200), np.linspace(0, 1, 50)
    assert plots.density(np.repeat(theta, 40), grid) == pytest.approx(plots.density(theta, grid), rel=0.02)


def test_autocorrelation_of_an_autoregression_with_a_gap() -> None:
    rng = np.random.default_rng(0)
    series = np.zeros(20_000)
    for t in range(1, len(series)):
        series[t] = 0.8 * series[t - 1] + rng.normal()
    series[5000:9000] = np.nan
    found = plots.autocorrelation(series, 4)
    assert found == pytest.approx(0.8 ** np.arange(5), abs=0.04)  # standard error about 0.015


def test_autocorrelation_matches_the_plain_sum() -> None:
    series = np.random.default_rng(1).normal(size=60)
    series[10:13] = np.nan
    z = series - np.nanmean(series)
    plain = np.array([np.nanmean(z[: len(z) - k] * z[k:]) for k in range(8)])
    assert plots.autocorrelation(series, 7) == pytest.approx(plain / plain[0])


@pytest.mark.parametrize(
    ("value", "sd", "text"),
    [
        (0.69751, 0.00301, "0.6975"),
        (0.00301, 0.00301, "0.0030"),
        (123.456, 7.0, "123.5"),
        (123456.0, 2300.0, "123500"),
        (-0.0001, 0.5, "0.00"),
        (3.213e-5, 1.1e-6, "3.21e-5"),
        (0.0999, 0.0996, "0.10"),
        (9.80665, 0.0, "9.807"),
        (math.nan, 1.0, "–"),
    ],
)
def test_significant_digits_follow_the_uncertainty(value: float, sd: float, text: str) -> None:
    assert significant(value, sd) == text


# Figures


def test_marginals_have_one_panel_per_parameter_nuisance_last(monkeypatch: pytest.MonkeyPatch) -> None:
    found = make_calibration(7)
    found.parameters[0] = dataclasses.replace(found.parameters[0], nuisance=True)
    (figure,) = plots.marginals(found)
    assert [ax.get_title() for ax in figure.axes] == [f"p{i}" for i in (1, 2, 3, 4, 5, 6, 0)]
    monkeypatch.setattr(plots, "_PANELS", 3)
    assert [len(f.axes) for f in plots.marginals(found)] == [2, 3, 2]


def test_marginals_stay_within_the_bounds(calibration: Calibration) -> None:
    (figure,) = plots.marginals(calibration)
    for ax in figure.axes:
        low, high = ax.get_xlim()
        assert 1.0 <= low < high <= 2.0
    at_bound = figure.axes[0].lines[0]
    x, y = np.asarray(at_bound.get_xdata()), np.asarray(at_bound.get_ydata())
    assert x[0] == 1.0
    assert y[0] > 0.9 * y.max()  # a kernel that leaks past the bound would halve it


def test_a_wide_log_scale_is_drawn_as_one() -> None:
    space = ParameterSpace([Parameter("friction", 1e-6, 1e-2, 1e-4, "N", scale="log"), Parameter("mass", 0, 1, 0.5)])
    posterior = GaussianMixture(torch.zeros(1), torch.full((1, 2), 0.5), 0.04 * torch.eye(2)[None], space)
    found = dataclasses.replace(
        make_calibration(2), posterior=posterior, prior=prior(space), parameters=summaries(posterior)
    )
    (figure,) = plots.marginals(found)
    assert [ax.get_xscale() for ax in figure.axes] == ["log", "linear"]
    plots.png(figure)


def test_pairs_show_every_pair_and_the_correlation(calibration: Calibration) -> None:
    (figure,) = plots.pairs(calibration)
    assert len(figure.axes) == 9
    texts = [text.get_text() for ax in figure.axes for text in ax.texts]
    assert texts[-1] == "-0.98"
    assert len(texts) == 3
    (two,) = plots.pairs(calibration, ["p2", "p0"])
    assert [ax.get_xlabel() for ax in two.axes[2:]] == ["p2\n[kg m²]", "p0\n[kg m²]"]
    assert plots.pairs(make_calibration(2), ["p1"]) == []


def test_pairs_choose_the_ridge_among_many() -> None:
    found = dataclasses.replace(make_calibration(12), ridges=[])
    theta = plots.draws(found.posterior)
    assert {"p10", "p11"} < set(plots.pair_names(found, theta))
    assert len(plots.pair_names(found, theta)) == plots.MAX_PAIRS
    found.ridges.append(ridge("p3"))
    assert "p3" in plots.pair_names(found, theta)


def test_labels_of_pairs_do_not_overlap() -> None:
    names = tuple(f"a_rather_long_parameter_name_{i}[pd__system_identification]" for i in range(8))
    (figure,) = plots.pairs(make_calibration(names=names))
    figure.draw_without_rendering()
    boxes = [ax.xaxis.label.get_window_extent() for ax in figure.axes[-8:]]
    assert all(left.x1 <= right.x0 for left, right in pairwise(boxes))
    labels = {ax.get_xlabel() for ax in figure.axes[-8:]}
    assert len(labels) == 8  # shortened, but still told apart
    boxes = [ax.yaxis.label.get_window_extent() for ax in figure.axes[8::8]]
    assert all(below.y1 <= above.y0 for above, below in pairwise(boxes))


@pytest.mark.parametrize(("channels", "panels"), [(2, [4]), (8, [8, 8])])
def test_signals_have_an_error_panel_for_each_channel(channels: int, panels: list[int]) -> None:
    figures = plots.signals(make_calibration(channels=channels), "holdout_0")
    assert [len(f.axes) for f in figures] == panels
    assert "held-out" in figures[0].get_suptitle()
    assert "training" in plots.signals(make_calibration(), "train_0")[0].get_suptitle()


def test_signals_break_the_line_between_windows(calibration: Calibration) -> None:
    (figure,) = plots.signals(calibration, "train_0")
    mode = next(line for line in figure.axes[0].lines if line.get_color() == plots.POSTERIOR)
    assert np.isnan(np.asarray(mode.get_ydata())).sum() == 3  # four windows


def test_a_long_log_gets_a_close_up_of_its_worst_stretch() -> None:
    long = signal("train_0", "train", "angle_0", steps=3000)
    long.measured[2000:2100] += 1
    found = dataclasses.replace(make_calibration(), signals=[long])
    (figure,) = plots.signals(found, "train_0")
    assert len(figure.axes) == 4
    low, high = figure.axes[2].get_xlim()
    assert low < 20.1 < 20.9 < high < 25
    plots.png(figure)


def test_a_default_that_runs_away_does_not_flatten_the_signal() -> None:
    wild = signal("train_0", "train", "angle_0")
    wild.default[:] = 1e6
    (figure,) = plots.signals(dataclasses.replace(make_calibration(), signals=[wild]), "train_0")
    assert figure.axes[0].get_ylim()[1] < 5


def test_signals_of_an_unknown_log(calibration: Calibration) -> None:
    with pytest.raises(ValueError, match=r"log: expected one of .*train_0.*got 'nothing'"):
        plots.signals(calibration, "nothing")


def test_residuals_have_one_row_per_log_and_channel() -> None:
    found = plots.residuals(make_calibration(logs=3, channels=3))
    assert [len(f.axes) for f in found] == [8, 10]
    titles = [ax.get_title(loc="left") for f in found for ax in f.axes]
    assert len([t for t in titles if "lags outside" in t]) == 9


def test_residuals_without_a_sample(calibration: Calibration) -> None:
    empty = np.full(201, np.nan)
    row = dataclasses.replace(calibration.residuals[0], residual=empty, whitened=empty)
    (figure,) = plots.residuals(dataclasses.replace(calibration, residuals=[row]))
    plots.png(figure)


def with_chains(calibration: Calibration, rhat: float) -> Calibration:
    theta = calibration.posterior.sample((400,), torch.Generator().manual_seed(0))
    posterior = Particles(theta, calibration.posterior.space, chains=4)
    names = posterior.space.names
    mixing = Mixing.of({"rhat": dict.fromkeys(names, rhat), "ess": [321.0] * len(names), "acceptance": 0.31}, names)
    return dataclasses.replace(calibration, posterior=posterior, mixing=mixing)


def test_chains_have_one_row_per_parameter(calibration: Calibration) -> None:
    assert plots.chains(calibration) == []
    (figure,) = plots.chains(with_chains(calibration, 1.003))
    assert [len(ax.lines) for ax in figure.axes] == [4, 4, 4]
    assert figure.axes[0].get_title(loc="left") == "p0, R-hat 1.003, effective draws 321"


def test_figures_are_the_same_bytes_each_time(calibration: Calibration) -> None:
    first, second = (plots.png(plots.residuals(calibration)[0]) for _ in range(2))
    assert first == second
    assert first.startswith(b"\x89PNG")


# Words


def parameter(contraction: float = 0.9, nuisance: bool = False) -> ParameterSummary:
    return ParameterSummary("mass", "kg", (), 1, 0.1, 0.9, 1, 1.1, 1, 1, contraction, nuisance)


def of_mass(*codes: Code) -> Findings:
    return Findings(noticed(code, "mass") for code in codes)


@pytest.mark.parametrize(
    ("summary", "codes", "tone", "words"),
    [
        (parameter(0.9), (), "good", "determined"),
        (parameter(0.5), (), "fair", "weakly determined"),
        (parameter(0.05), (Code.NOT_DETERMINED,), "bad", "not determined"),
        (parameter(0.99), (Code.MODE_AT_BOUND,), "bad", "at a bound"),
        (parameter(0.0), (Code.NO_EFFECT, Code.NOT_DETERMINED), "bad", "changes nothing, not determined"),
        (parameter(0.99), (Code.LOGS_DISAGREE,), "bad", "disagrees between logs"),
        (parameter(0.99), (Code.LOGS_DISAGREE_UNEXPLAINED,), "bad", "disagrees between logs"),
        (parameter(0.99), (Code.MISFIT_SHIFTS,), "bad", "model lacks something"),
        (parameter(0.99), (Code.MODE_AT_BOUND, Code.MISFIT), "bad", "at a bound, model lacks something"),
        (parameter(0.99), (Code.DEAD_RANGE,), "fair", "part of its range changes nothing"),
        (dataclasses.replace(parameter(1.0), sd=0.0), (), "fair", "a point without uncertainty"),
    ],
)
def test_verdict_on_a_parameter(summary: ParameterSummary, codes: tuple[Code, ...], tone: str, words: str) -> None:
    found = judged.parameter_verdict(summary, of_mass(*codes))
    assert found.tone == tone
    assert words in found.text
    other = judged.parameter_verdict(dataclasses.replace(summary, name="other"), of_mass(*codes))
    assert other == judged.parameter_verdict(summary, Findings())


def test_a_member_of_a_ridge_is_determined_only_with_the_others() -> None:
    def seen(contraction: float, *codes: Code, members: tuple[str, ...] = ("mass", "length")) -> judged.Verdict:
        findings = [noticed(Code.RIDGE_TO_RESOLVE, *members), *of_mass(*codes)]
        return judged.parameter_verdict(parameter(contraction), Findings(findings))

    for codes in ((), (Code.NOT_DETERMINED,)):
        found = seen(0.3, *codes)
        assert (found.tone, found.text) == ("fair", "only with length")
    assert seen(0.9).text == "determined"
    assert seen(0.3, Code.MODE_AT_BOUND).text == "at a bound"
    assert seen(0.0, Code.NO_EFFECT, Code.NOT_DETERMINED).tone == "bad"
    assert seen(0.3, Code.NOT_DETERMINED, members=("a", "b")).tone == "bad"


def scores(*pairs: tuple[float, float]) -> list[ChannelScore]:
    return [ChannelScore("log", f"c{i}", "rad", ours, default) for i, (ours, default) in enumerate(pairs)]


WORSE = Comparison(1 / 3.1, 1 / 3.7, 1 / 2.6, 1e-6, 10)
ALIKE = Comparison(1.1, 0.8, 1.5, 0.6, 10)


@pytest.mark.parametrize(
    ("rows", "comparison", "tone", "words"),
    [
        (
            scores((0.1, 0.31)),
            BETTER,
            "good",
            "better than the model you had: its error is 3.1 times smaller (95 % interval 2.6 to",
        ),
        (
            scores((0.31, 0.1)),
            WORSE,
            "bad",
            "WORSE than the model you had: its error is 3.1 times larger (95 % interval 2.6 to 3.7",
        ),
        (
            scores((0.1, 0.11)),
            ALIKE,
            "bad",
            "NOT shown that the calibrated model is better than the model you had: its error is 1.1 times smaller",
        ),
        (scores((0.1, 9.0), (0.3, 0.2)), BETTER, "fair", "but it is larger in log (c1)"),
        (scores((0.1, 0.102)), Comparison(1.02, 1.01, 1.03, 0.01, 10), "fair", "1.02 times smaller"),
        (scores((0.1, math.nan)), None, "fair", "cannot be compared"),
        (scores((math.nan, 0.1)), None, "bad", "no finite error in log (c0)"),
        ([], None, "fair", "No log was held out"),
    ],
)
def test_verdict_on_the_prediction(
    rows: list[ChannelScore], comparison: Comparison | None, tone: str, words: str
) -> None:
    found = judged.prediction(rows, comparison)
    assert found.tone == tone
    assert words in found.text
    assert (comparison is None) == ("t-test" not in found.text)


def test_a_calibration_that_does_not_help_says_so_first(calibration: Calibration) -> None:
    for comparison, first in ((WORSE, "WORSE"), (ALIKE, "NOT shown"), (BETTER, "may be trusted")):
        found = dataclasses.replace(calibration, comparison=comparison)
        assert first in judged.verdicts(found)[0].text
        page = Page(report.render(found, [])).text
        assert page.index(first) < page.index("90 % interval")


def test_what_the_model_lacks_is_among_the_first_sentences(calibration: Calibration) -> None:
    assert judged.lack(calibration) is None
    found = judged.lack(dataclasses.replace(calibration, misfit=LACKS))
    assert found is not None
    assert found.tone == "bad"
    assert "drag at hinge (40 % of the residual of angle_0, p = 0.005)" in found.text
    small = judged.lack(
        dataclasses.replace(calibration, misfit=dataclasses.replace(LACKS, share={"angle_0": 0.04}, shift={}))
    )
    assert small is not None
    assert small.tone == "fair"
    assert "something small" in small.text
    assert judged.lack(dataclasses.replace(calibration, misfit=dataclasses.replace(LACKS, p=0.2))) is None
    strange = dataclasses.replace(calibration, outside=[OutsidePrior(0.01, "train_0", "angle_0", 1.0)], misfit=LACKS)
    assert strange.to_dict()["outside_prior"][0]["log"] == "train_0"
    assert strange.to_dict()["misfit"]["matters"]


def test_headline_counts_without_nuisance_parameters() -> None:
    good, weak, nuisance = parameter(0.9), parameter(0.5), parameter(0.9, nuisance=True)

    def seen(*values: ParameterSummary) -> judged.Verdict:
        return judged.headline(values, Findings())

    words = "1 of 2 values may be trusted within their intervals: mass; the table says why not the others."
    assert seen(good, weak, nuisance).text == words
    assert seen(good, good).text == "All 2 values may be trusted within their intervals."
    assert seen(good).tone == "good"
    assert seen(weak, weak).tone == "bad"
    assert seen(nuisance).tone == "fair"
    doubts = Findings(doubt(text) for text in ("the chains have not mixed", "another", "a third"))
    for values in ([good, weak], [weak]):
        words = "the chains have not mixed; another; and 1 more, among the warnings"
        expected = judged.Verdict("bad", f"No value may be trusted within its interval yet: {words}.")
        assert judged.headline(values, doubts) == expected
    assert judged.parameter_verdict(good, Findings()).tone == "good"
    assert judged.parameter_verdict(good, doubts).tone == "fair"


def doubt(text: str, code: Code = Code.REMARK) -> Finding:
    return noticed(code, severity=Severity.BLOCKING, text=text)


def test_doubts_come_first_and_mixing_is_said_once(calibration: Calibration) -> None:
    unmixed = doubt("the chains have not mixed", Code.NOT_MIXED)
    found = dataclasses.replace(with_chains(calibration, 1.4), comparison=BETTER, findings=(unmixed,))
    texts = [v.text for v in judged.verdicts(found)]
    assert texts[0].endswith("yet: the chains have not mixed.")
    assert not any("NOT mixed" in text for text in texts)
    texts = [v.text for v in judged.verdicts(dataclasses.replace(found, findings=(doubt("another"),)))]
    assert any("NOT mixed" in text for text in texts)
    assert "but see the doubt above" in report.render(found, [])


# The page


def test_page_says_what_matters_first(page: str) -> None:
    text = Page(page).text
    first = text.index("2 of 3 values may be trusted within their intervals: p1 and p2;")
    second = text.index(
        "On held-out logs the calibrated model is better than the model you had: its error is 3.1 times smaller"
    )
    assert first < second < text.index("90 % interval") < text.index("1 warning") < text.index("Parameters in detail")
    assert second < text.index("at a bound") < text.index("1 warning")
    assert "Left out." not in text


def test_what_is_left_out_is_said(calibration: Calibration) -> None:
    text = Page(
        report.render(
            dataclasses.replace(
                calibration, findings=(noticed(Code.RESIDUALS_LEFT_OUT, text="Residuals: none here."),)
            ),
            [],
        )
    ).text
    assert "Left out. Residuals: none here." in text


def test_page_names_every_parameter_and_section(page: str, calibration: Calibration) -> None:
    text = Page(page).text
    for summary in calibration.parameters:
        assert f"{summary.name} [kg m²]" in text
        assert significant(summary.q05, summary.sd) in text
    for words in (
        "0.0123",
        "white",
        "the last two = 2 ± 0.1 kg is determined; p1 and p2 alone are not",
        "pendulum.xml",
        "0.4 to 0.6 s",
        "held out",
        "1,234",
    ):
        assert words in text


def test_page_stands_alone(page: str, images: list[report.Picture]) -> None:
    found = Page(page)
    assert not {"script", "link", "iframe", "object"} & set(found.tags)
    assert not re.search(r"https?://|url\(|@import", page)
    sources = [value for _, key, value in found.attributes if key == "src"]
    assert len(sources) == len(images) == 5
    assert all((value or "").startswith("data:image/png;base64,") for value in sources)
    anchors = {value for _, key, value in found.attributes if key == "id"}
    links = [value for _, key, value in found.attributes if key == "href"]
    assert links
    assert all((value or "").startswith("#") and (value or "")[1:] in anchors for value in links)


def test_page_escapes_every_word_from_outside() -> None:
    found = make_calibration(names=(EVIL, "b", "c"))
    found.ridges[0] = ridge("b", "c", combination=EVIL)
    found.noise[EVIL] = ChannelNoise(1.0, 0.5, EVIL)
    found.logs[0] = dataclasses.replace(found.logs[0], name=EVIL, findings=(noticed(Code.LOG_GAP, text=EVIL),))
    found.holdout[0] = dataclasses.replace(found.holdout[0], log=EVIL, channel=EVIL)
    findings = (*found.findings, noticed(Code.REMARK, text=EVIL))
    found = dataclasses.replace(found, name=EVIL, findings=findings, run={"config": {"name": EVIL}})
    image = report.Picture("marginals", "marginals.png", b"", f'"{EVIL}')
    page = Page(report.render(found, [image]))
    assert "script" not in page.tags
    assert page.text.count(EVIL) >= 9
    assert ("img", "alt", f'"{EVIL}') in page.attributes


def test_chains_that_have_not_mixed_come_first(calibration: Calibration) -> None:
    text = Page(report.render(with_chains(calibration, 1.4), [])).text
    assert text.index("The chains have NOT mixed (R-hat 1.40 in p0)") < text.index("Prediction error")
    assert "acceptance 0.31" in text
    text = Page(report.render(with_chains(calibration, 1.001), [])).text
    assert "The chains have mixed (largest R-hat 1.001)." in text


@pytest.mark.parametrize("rhat", [None, 1.2, [1.0, 1.2, 1.0]])
def test_mixing_in_every_shape(calibration: Calibration, rhat: Any) -> None:
    found = with_chains(calibration, 1.0)
    found = dataclasses.replace(found, mixing=Mixing.of({"rhat": rhat}, found.posterior.space.names))
    verdict = judged.mixing_verdict(found)
    assert (verdict is None) == (rhat is None)
    assert verdict is None or "1.20" in verdict.text
    Page(report.render(found, []))


def test_the_least_there_can_be(tmp_path: Path) -> None:
    space = ParameterSpace([Parameter("mass", 0.0, 1.0)])
    bare = Calibration(
        "bare",
        "laplace",
        Dirac([0.5], space),
        prior(space),
        [ParameterSummary("mass", "", (), 0.5, 0.0, 0.5, 0.5, 0.5, 0.5, None, 1.0)],
        train=[],
        holdout=[],
    )
    path = report.write_report(bare, tmp_path)
    text = Page(path.read_text(encoding="utf-8")).text
    assert "No log was held out" in text
    assert "warning" not in text
    assert [p.name for p in (tmp_path / "figures").iterdir()] == ["marginals.png"]


# Files


def test_report_and_figures_are_written(tmp_path: Path, images: list[report.Picture], monkeypatch: Any) -> None:
    monkeypatch.setattr(report, "pictures", lambda _: images)
    path = report.write_report(make_calibration(), tmp_path / "new" / "run")
    assert path == tmp_path / "new" / "run" / "report.html"
    assert {p.name for p in path.parent.iterdir()} == {"report.html", "figures"}
    names = {p.name for p in (path.parent / "figures").iterdir()}
    assert names == {
        "marginals.png",
        "pairs.png",
        "residuals.png",
        "signals_1_holdout_0.png",
        "signals_2_train_0.png",
    }
    assert all(p.read_bytes().startswith(b"\x89PNG") for p in (path.parent / "figures").iterdir())


@pytest.mark.parametrize("part", ["render", "pictures"])
def test_a_failure_leaves_nothing(part: str, tmp_path: Path, images: list[report.Picture], monkeypatch: Any) -> None:
    def fail(*_: Any) -> Any:
        raise RuntimeError("no ink")

    monkeypatch.setattr(report, "pictures", lambda _: images)
    monkeypatch.setattr(report, part, fail)
    with pytest.raises(RuntimeError, match="no ink"):
        report.write_report(make_calibration(), tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_an_interrupted_write_keeps_the_old_report(
    tmp_path: Path, images: list[report.Picture], monkeypatch: Any
) -> None:
    (tmp_path / "report.html").write_text("old")
    replace = files.os.replace

    def interrupted(source: Any, target: Any) -> None:
        if Path(target).name == "report.html":
            raise OSError("disk full")
        replace(source, target)

    monkeypatch.setattr(report, "pictures", lambda _: images)
    monkeypatch.setattr(files.os, "replace", interrupted)
    with pytest.raises(OSError, match="disk full"):
        report.write_report(make_calibration(), tmp_path)
    assert (tmp_path / "report.html").read_text() == "old"
    assert {p.name for p in tmp_path.iterdir()} == {"report.html", "figures"}
