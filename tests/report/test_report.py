"""The figures of a calibration: the numbers behind them and what they show."""

import dataclasses
import warnings
from itertools import pairwise
from typing import Any

import matplotlib
import numpy as np
import pytest
import torch

from sipe_bayes.core.parameters import Parameter, ParameterSpace
from sipe_bayes.diagnostics.result import Calibration
from sipe_bayes.posterior import GaussianMixture, prior
from sipe_bayes.report import calibration_plots as plots
from sipe_bayes.report import panels
from sipe_bayes.report.colours import POSTERIOR
from sipe_bayes.report.drawing import png
from tests.problems.calibrations import make_calibration, ridge, signal, summaries, with_chains


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


# The numbers behind the pictures


@pytest.mark.parametrize("centre", [0.0, 0.01, 0.5, 1.0])
def test_density_integrates_to_one_within_the_bounds(centre: float) -> None:
    theta = np.abs(np.random.default_rng(0).normal(centre, 0.02, 4000))
    theta = np.where(theta > 1, 2 - theta, theta)
    grid = np.linspace(0, 1, 801)
    mass = np.trapezoid(panels.density(theta, grid), grid)
    assert mass == pytest.approx(1, abs=0.01)
    assert (panels.density(theta, np.array([-0.001, 1.001])) == 0).all()


def test_density_is_not_rounded_off_at_a_bound() -> None:
    theta = np.random.default_rng(0).uniform(size=8000)
    height = panels.density(theta, np.array([0.0, 0.5, 1.0]))
    assert height == pytest.approx(1, abs=0.12)


def test_density_does_not_depend_on_repeated_draws() -> None:
    theta, grid = np.random.default_rng(0).normal(0.5, 0.1, 200), np.linspace(0, 1, 50)
    assert panels.density(np.repeat(theta, 40), grid) == pytest.approx(panels.density(theta, grid), rel=0.02)


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


# Figures


def test_marginals_have_one_panel_per_parameter_nuisance_last(monkeypatch: pytest.MonkeyPatch) -> None:
    found = make_calibration(7)
    found.parameters[0] = dataclasses.replace(found.parameters[0], nuisance=True)
    (figure,) = plots.marginals(found)
    assert [ax.get_title() for ax in figure.axes] == [f"p{i}" for i in (1, 2, 3, 4, 5, 6, 0)]
    monkeypatch.setattr(plots, "SIZES", plots.Sizes(parameters=3))
    assert [len(f.axes) for f in plots.marginals(found)] == [2, 2, 3]


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
    png(figure)


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
    theta = panels.draws(found.posterior)
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
    mode = next(line for line in figure.axes[0].lines if line.get_color() == POSTERIOR)
    assert np.isnan(np.asarray(mode.get_ydata())).sum() == 3  # four windows


def test_a_long_log_gets_a_close_up_of_its_worst_stretch() -> None:
    long = signal("train_0", "train", "angle_0", steps=3000)
    long.measured[2000:2100] += 1
    found = dataclasses.replace(make_calibration(), signals=[long])
    (figure,) = plots.signals(found, "train_0")
    assert len(figure.axes) == 4
    low, high = figure.axes[2].get_xlim()
    assert low < 20.1 < 20.9 < high < 25
    png(figure)


def test_what_a_pixel_shows_of_a_very_long_log_is_drawn() -> None:
    """No more points than that, and a glitch of one sample among them."""
    long = signal("train_0", "train", "angle_0", steps=60_000)
    long.measured[12_345] = 7.0
    (figure,) = plots.signals(dataclasses.replace(make_calibration(), signals=[long]), "train_0")
    overview, _, closer, _ = figure.axes
    for ax in (overview, closer):
        lines = [line for line in ax.lines if len(line.get_xdata()) > 2]
        assert lines
        assert all(len(line.get_xdata()) <= 20_002 for line in lines)
        assert max(float(np.nanmax(line.get_ydata())) for line in lines) == 7.0


def test_names_in_other_scripts_warn_of_no_font() -> None:
    named = signal("訓練", "train", "関節")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        (figure,) = plots.signals(dataclasses.replace(make_calibration(), signals=[named]), "訓練")
        png(figure)


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
    png(figure)


def test_chains_have_one_row_per_parameter(calibration: Calibration) -> None:
    assert plots.chains(calibration) == []
    (figure,) = plots.chains(with_chains(calibration, 1.003))
    assert [len(ax.lines) for ax in figure.axes] == [4, 4, 4]
    assert figure.axes[0].get_title(loc="left") == "p0"


def test_figures_are_the_same_bytes_each_time(calibration: Calibration) -> None:
    first, second = (png(plots.residuals(calibration)[0]) for _ in range(2))
    assert first == second
    assert first.startswith(b"\x89PNG")
