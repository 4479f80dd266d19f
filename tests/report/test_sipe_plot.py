"""The SiPE plot: its numbers against the definitions, its looks against overlap and colour blindness."""

from __future__ import annotations

import io
import itertools
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgb
from rich.console import Console

import sipe_bayes as sipe
from sipe_bayes.benchmark import cells
from sipe_bayes.diagnostics.scores import Scores, crps, score
from sipe_bayes.posterior import Dirac, prior
from sipe_bayes.report import sipe_plot as plot

SPACE = sipe.ParameterSpace([sipe.Parameter(f"p{k}", 0.0, 1.0) for k in range(3)])
TRUTH = np.array([0.2, 0.7, 0.9])
ENVIRONMENTS = list(cells.NINE)


def dirac(*theta: float) -> Scores:
    return score(Dirac(list(theta), SPACE), TRUTH)


def some(
    estimators: int = 2, environments: list[str] = ENVIRONMENTS, seeds: int = 2
) -> dict[str, dict[str, list[Scores]]]:
    rng = np.random.default_rng(0)
    results = {
        f"e{k}": {e: [dirac(*rng.uniform(size=3)) for _ in range(seeds)] for e in environments}
        for k in range(estimators)
    }
    return {**results, "prior_mean": {e: [dirac(0.5, 0.5, 0.5)] for e in environments}}


def drawn(ax: Any) -> list[Any]:
    """The lines that go round all spokes."""
    return [line for line in ax.lines if len(line.get_xdata()) < 100]


# Numbers


def test_skill_and_accuracy_follow_their_definitions() -> None:
    scores = score(Dirac([0.3, 0.7, 0.5], SPACE), TRUTH)
    before = float(crps(prior(SPACE), TRUTH).mean())
    errors = {"mean": (0.1 + 0.4) / 3, "min": 0.4, "max": 0.0}
    for mode in plot.MODES:
        assert plot.measured(scores, "accuracy", mode) == pytest.approx(1 - errors[mode])
        assert plot.measured(scores, "CRPS skill", mode) == pytest.approx(1 - errors[mode] / before)


def test_the_truth_has_skill_one_and_the_prior_none() -> None:
    for mode in plot.MODES:
        assert plot.measured(dirac(*TRUTH), "CRPS skill", mode) == 1.0
    assert plot.measured(score(prior(SPACE), TRUTH), "CRPS skill", "mean") == pytest.approx(0, abs=1e-9)


def test_curves_are_means_over_seeds_and_gaps_stay_gaps() -> None:
    results = some(1, ["Door", "FetchPush", "Relocate"])
    del results["e0"]["Door"]
    accuracy, _ = plot.sipe_plot(results).axes
    order = plot.environments(results)
    assert order == ["FetchPush", "Relocate", "Door"]  # the benchmark's
    for line, mode in zip(drawn(accuracy), plot.MODES, strict=False):
        over = {"mean": np.mean, "min": min, "max": max}[mode]
        wanted = [np.mean([over(s.accuracy) for s in results["e0"].get(e, [])] or np.nan) for e in order]
        np.testing.assert_allclose(line.get_ydata(), [*wanted, wanted[0]])
    np.testing.assert_allclose(drawn(accuracy)[3].get_ydata(), 4 * [1 - np.abs(TRUTH - 0.5).mean()])  # prior mean


def test_one_mode_has_a_curve_per_estimator() -> None:
    results = some(4)
    for ax in plot.sipe_plot(results, "min").axes:
        assert len(drawn(ax)) == 5
    lines = drawn(plot.sipe_plot(results, "min").axes[0])
    np.testing.assert_allclose(
        lines[2].get_ydata()[:-1], plot.over_seeds(results["e2"], ENVIRONMENTS, "accuracy", "min")
    )


@pytest.mark.parametrize("names", [["Door"], ["FetchPush", "Door"]])
def test_with_too_few_spokes_for_a_line_nothing_lies_on_anything(names: list[str]) -> None:
    """Estimators of the same accuracy stand side by side, at it, and the prior mean is an arc across them."""
    results = some(1, names)
    results = {"e0": results["e0"], "e1": results["e0"], "prior_mean": results["prior_mean"]}
    accuracy, _ = plot.sipe_plot(results, "mean").axes
    points = [line for line in drawn(accuracy) if len(line.get_xdata()) == 1]
    arcs = [line for line in drawn(accuracy) if len(line.get_xdata()) > 1]
    assert (len(points), len(arcs)) == (2 * len(names), len(names))
    for k, name in enumerate(n for n in ENVIRONMENTS if n in names):
        two = [points[k], points[k + len(names)]]
        value = np.mean([s.mean_accuracy for s in results["e0"][name]])
        np.testing.assert_allclose([line.get_ydata()[0] for line in two], value)
        places = sorted(float(line.get_xdata()[0]) for line in two)
        assert places[1] - places[0] > 0.1
        assert arcs[k].get_xdata().min() < places[0] < places[1] < arcs[k].get_xdata().max()
        np.testing.assert_allclose(arcs[k].get_ydata(), 1 - np.abs(TRUTH - 0.5).mean())


def test_two_settings_share_the_environments_that_both_have() -> None:
    first, second = some(2), some(1, ["Door", "FetchPush", "Relocate", "HumanoidLinks"])
    figure = plot.settings_plot(first, second, ("demonstrations", "policy"))
    assert len(figure.axes) == 2  # one estimator has both
    assert [t.get_text().replace("\n", "") for t in figure.axes[0].get_xticklabels()] == plot.environments(second)
    assert [t.get_text() for t in figure.legends[0].get_texts()] == ["demonstrations", "policy", "prior mean"]


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: plot.sipe_plot({}), "run some cells"),
        (lambda: plot.sipe_plot({"prior_mean": some()["prior_mean"]}), "run some cells"),
        (lambda: plot.sipe_plot(some(), "median"), "one of mean, min, max"),  # type: ignore[arg-type]
        (lambda: plot.sipe_plot(some(7), "mean"), "7 estimators on one radar"),
        (lambda: plot.settings_plot(some(1), {}, ("a", "b")), "run the cells of both"),
    ],
)
def test_refusals(call: Any, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        call()


# Looks


@pytest.mark.parametrize("count", [1, 3, 9])
def test_spoke_labels_neither_overlap_nor_leave_the_figure(count: int) -> None:
    figure = plot.sipe_plot(some(3, ENVIRONMENTS[-count:]))
    FigureCanvasAgg(figure).draw()
    boxes = [t.get_window_extent() for ax in figure.axes for t in (*ax.get_xticklabels(), ax.title)]
    assert not [(a, b) for a, b in itertools.combinations(boxes, 2) if a.overlaps(b)]
    assert all(b.x0 >= 0 and b.y0 >= 0 and b.x1 <= figure.bbox.x1 and b.y1 <= figure.bbox.y1 for b in boxes)


# G. Machado, M. Oliveira, L. Fernandes 2009, "A Physiologically-based Model for Simulation of Color Vision Deficiency"
# (https://doi.org/10.1109/TVCG.2009.113), severity 1, on linear RGB.
DEFICIENCIES = {
    "protanopia": [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]],
    "deuteranopia": [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]],
}

LOST = {"protanopia": ["#2ca02c", "#ff7f0e"], "deuteranopia": ["#2ca02c", "#d62728"]}


def lab(colour: str, matrix: Any) -> np.ndarray:
    """CIE L*a*b* of a colour as seen with a deficiency."""
    rgb = np.array(to_rgb(colour))
    linear = np.clip(matrix @ np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4), 0, 1)
    xyz = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]]) @ linear
    f = np.cbrt(np.maximum(xyz / [0.9505, 1.0, 1.089], 0.008856))
    return np.array([116 * f[1] - 16, 500 * (f[0] - f[1]), 200 * (f[1] - f[2])])


def nearest(colours: list[str], matrix: Any) -> float:
    return min(float(np.linalg.norm(lab(a, matrix) - lab(b, matrix))) for a, b in itertools.combinations(colours, 2))


@pytest.mark.parametrize("deficiency", DEFICIENCIES)
def test_curves_are_told_apart_without_red_or_green(deficiency: str) -> None:
    matrix = np.array(DEFICIENCIES[deficiency])
    assert nearest(LOST[deficiency], matrix) < 10  # Matplotlib's own green and orange, or red, are lost
    for results, mode in ((some(1), None), (some(6), "mean")):
        lines = drawn(plot.sipe_plot(results, mode).axes[0])  # type: ignore[arg-type]
        colours = [line.get_color() for line in lines[:-1]]
        assert nearest(colours, matrix) > (45 if mode is None else 15)
        assert len({line.get_marker() for line in lines[:-1]}) == len(colours)  # and in print without colour


def test_no_style_is_left_behind() -> None:
    before = dict(matplotlib.rcParams)
    plot.sipe_plot(some())
    assert dict(matplotlib.rcParams) == before


def test_the_baselines_are_those_of_the_cells() -> None:
    assert set(plot.BASELINES) == set(cells.BASELINES)


# sipe.show_results

POINT = Dirac([0.3, 0.7, 0.9], SPACE)


def test_several_environments_are_shown_as_the_sipe_plot(tmp_path: Path) -> None:
    console = Console(file=io.StringIO(), width=80)
    truth = {"Door": TRUTH, "FetchPush": TRUTH, "Relocate": TRUTH}
    estimates = {name: Dirac([0.3, 0.7, 0.9], SPACE) for name in truth}
    figure = sipe.show_results(estimates, truth, tmp_path / "sipe.png", console)
    assert [ax.name for ax in figure.axes] == ["polar", "polar"]
    assert (tmp_path / "sipe.png").stat().st_size > 5000
    text = console.file.getvalue()  # type: ignore[attr-defined]
    assert text.count("0.967") == 3
    assert text.count("prior mean") == 3
    both = {"one": estimates, "two": {name: [p, p] for name, p in estimates.items()}}
    assert len(sipe.show_results(both, truth, console=console).axes) == 4


def test_estimates_without_their_truth_or_half_nested() -> None:
    estimates = {"Door": Dirac([0.3, 0.7, 0.9], SPACE)}
    with pytest.raises(ValueError, match=r"with Door, got NoneType; sipe\.make_task"):
        sipe.show_results(estimates)
    with pytest.raises(ValueError, match=r"'Door'.*expected environment"):
        sipe.show_results({"adr": estimates, **estimates}, {"Door": TRUTH})  # type: ignore[dict-item]


@pytest.mark.parametrize(
    ("given", "words"),
    [
        (("results",), r"posterior: expected a Posterior.*got 'results'; sipe\.load_posterior"),
        (({"Door": "results"}, {"Door": TRUTH}), r"estimates\['Door'\]: expected a Posterior.*got 'results'"),
        (({"Door": None}, {"Door": TRUTH}), r"estimates\['Door'\]: expected a Posterior.*got None"),
        (
            ({"Door": POINT}, {"Door": [9.81, 1.0, 1.0]}),
            r"truth\['Door'\] \[9\.81, 1\.0, 1\.0\]: expected theta.*space\.normalise",
        ),
        ((POINT, [0.5]), r"truth: expected 3 parameters.*space\.normalise"),
        ((POINT, [9.81, 1.0, 1.0]), r"truth \[9\.81"),
        ((POINT, None, "a.pdf"), r"path 'a\.pdf': the figure is saved as PNG"),
    ],
)
def test_what_cannot_be_shown_is_named(given: Any, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        sipe.show_results(*given)
