"""The figures: what they draw, that they always show prior and baseline, and that they take every family."""

from __future__ import annotations

from typing import Any

import matplotlib
import numpy as np
import pytest
from matplotlib.figure import Figure

import sipe_bayes as sipe
from sipe_bayes.core.parameters import Parameter, ParameterSpace
from sipe_bayes.diagnostics.coverage import check_calibration
from sipe_bayes.posterior import Dirac, GaussianMixture, IndependentPrior, Particles, Posterior, uniform
from sipe_bayes.report import check_plots, posterior_plots
from sipe_bayes.report.drawing import png

SPACE = ParameterSpace(
    [
        Parameter("rod_mass", 0.5, 1.5, 1.0, "kg"),
        Parameter("damping", 0.01, 1.0, unit="N m s/rad", scale="log"),
        Parameter("offset", -1.0, 1.0),
    ]
)
RNG = np.random.default_rng(0)
FAMILIES: dict[str, Posterior] = {
    "mixture": GaussianMixture([0.0], [[0.4, 0.6, 0.5]], [0.03**2 * np.eye(3)], SPACE),
    "particles": Particles(RNG.beta(3, 3, (50, 3)), SPACE, RNG.random(50)),
    "point": Dirac([0.2, 0.0, 1.0], SPACE),
    "prior": IndependentPrior([0.5] * 3, [np.inf, 0.1, 0.2], SPACE),
}
TRUTHS: tuple[Any, ...] = (None, [0.4, 0.6, 0.5], [-0.2, 1.1, 0.5])


def labels(figure: Figure) -> set[str]:
    found = [text.get_text() for legend in figure.legends for text in legend.get_texts()]
    return {label.split(" (")[0] for label in found}


@pytest.mark.parametrize("name", FAMILIES)
@pytest.mark.parametrize("truth", TRUTHS, ids=["unknown", "inside", "outside"])
def test_marginals_and_pairs_show_prior_and_baseline(name: str, truth: Any) -> None:
    style = dict(matplotlib.rcParams)
    for draw in (posterior_plots.marginals, posterior_plots.pairs):
        figure = draw(FAMILIES[name], truth=truth)
        assert {"prior", "model as given"} <= labels(figure)
        assert ("truth" in labels(figure)) == (truth is not None)
        assert len(png(figure)) > 5000
    assert dict(matplotlib.rcParams) == style


def test_marginals_are_in_the_parameters_units() -> None:
    figure = posterior_plots.marginals(FAMILIES["mixture"], truth=[0.4, 0.6, 0.5])
    assert [ax.get_title() for ax in figure.axes] == list(SPACE.names)
    assert [ax.get_xlabel() for ax in figure.axes] == ["kg", "N m s/rad", "no unit"]
    low, high = figure.axes[0].get_xlim()
    assert low < 0.9 < high
    assert any(line.get_xdata()[0] == pytest.approx(0.9) for line in figure.axes[0].lines)  # type: ignore[index]


def test_a_point_is_drawn_within_the_whole_range() -> None:
    assert posterior_plots.marginals(FAMILIES["point"]).axes[0].get_xlim() == pytest.approx((0.5, 1.5))


def test_pairs_of_many_parameters_shows_eight() -> None:
    space = ParameterSpace(Parameter(f"p{j}") for j in range(10))
    assert len(posterior_plots.pairs(uniform(space)).axes) == 64
    assert len(posterior_plots.pairs(uniform(space), names=["p9", "p1"]).axes) == 4


def test_particle_paths() -> None:
    figure = posterior_plots.particle_paths(RNG.random((5, 20, 3)), SPACE, truth=[0.4, 0.6, 1.2])
    assert {"mean of the particles", "prior", "model as given", "truth"} <= labels(figure)
    mean = figure.axes[0].lines[20].get_ydata()
    assert np.shape(mean) == (5,)
    assert figure.axes[2].get_ylim()[1] > SPACE[2].value(1.2)


def test_learning_curves_tell_methods_apart_without_colour() -> None:
    curves = {f"method {k}": ([10, 100, 1000], RNG.random((4, 3)) + 0.1) for k in range(8)}
    figure = posterior_plots.learning_curve(curves, {"prior": 0.17, "prior mean": 0.25})
    assert {"prior", "prior mean", *curves} == labels(figure)
    drawn = [(line.get_marker(), str(line.get_linestyle())) for line in figure.axes[0].lines[:8]]
    assert len(set(drawn)) == 8
    low = {"m": ([10, 100], [[0.1, 0.001]])}
    assert posterior_plots.learning_curve(low, {"prior": 0.2}).axes[0].get_yscale() == "log"


def test_calibration_figures_say_what_the_check_says() -> None:
    truths = RNG.random((30, 3))
    check = check_calibration([Dirac(t, SPACE) for t in np.clip(truths + 0.05, 0, 1)], truths)
    ranks, curve = check_plots.rank_check(check), check_plots.coverage_curve(check)
    assert [ax.get_title() for ax in ranks.axes] == [f"{name}: {check.verdict(name)}" for name in SPACE.names]
    np.testing.assert_array_equal(curve.axes[0].lines[0].get_ydata(), check.intervals[0].curve)
    for figure in (ranks, curve):
        assert "exactly calibrated" in labels(figure)
        assert len(png(figure)) > 5000


def test_posterior_predictive_holds_the_log_that_it_knows() -> None:
    """Draws within 1e-3 of the truth predict its log; the prior's band is wider everywhere on average."""
    env = sipe.make("Pendulum")
    env.set_parameters(np.array([0.4, 0.6, 0.3]))
    with pytest.warns(UserWarning, match="an excitation policy"):
        log = sipe.demonstrations(env, count=1, steps=50)[0]
    assert log.states is not None
    posterior = GaussianMixture([0.0], [env.theta], [1e-6 * np.eye(3)], env.task.space)
    found = check_plots.predictive(env.simulator, posterior, log, log.states[0], count=20)
    assert np.abs(found.posterior[1] - log.observations).max() < 0.05
    width = np.ptp(found.prior[[0, 2]], axis=0).mean() / np.ptp(found.posterior[[0, 2]], axis=0).mean()
    assert width > 20
    figure = check_plots.posterior_predictive(found)
    assert {"log", "prior, 90 %", "model as given"} <= labels(figure)
    assert len(figure.axes) == 3
    assert len(check_plots.posterior_predictive(found, ["cos_angle"]).axes) == 1
    with pytest.raises(ValueError, match="expected some of"):
        check_plots.posterior_predictive(found, ["angle"])


def test_wrong_input() -> None:
    posterior = FAMILIES["mixture"]
    table: list[tuple[Any, str]] = [
        (lambda: posterior_plots.pairs(posterior, names=["rod_mass"]), "2 to 8 parameters"),
        (lambda: posterior_plots.marginals(posterior, truth=[0.5]), "expected 3 parameters"),
        (lambda: posterior_plots.particle_paths(np.zeros((5, 3)), SPACE), "iterations, particles, 3"),
        (lambda: posterior_plots.learning_curve({}, {"prior": 1.0}), "at least one of each"),
        (lambda: posterior_plots.learning_curve({"m": ([1, 2], [1.0])}, {"prior": 1.0}), "expected scores"),
    ]
    for call, words in table:
        with pytest.raises(ValueError, match=words):
            call()
