"""A fit is never lost: a fault in each later step in turn, a time limit, and an interruption right after the fit."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure

from sipe_bayes.calibration.checks.plan import Check
from sipe_bayes.calibration.run import run
from sipe_bayes.core.findings import Code, Findings, Guard
from sipe_bayes.posterior import load_posterior
from sipe_bayes.report import calibration_plots, page
from tests.problems.swings import call, strict_json, swing, write_case

SUMMARY = "marginals of the posterior"
FIGURES = ["marginals", "pairs", "signals_1_rest", "signals_2_log", "residuals", "chains"]
FILES = [
    *("posterior", "draws of the posterior", "identified model", "randomization", "moving picture"),
    *(f"figure {name}" for name in FIGURES),
    *("page of the report", *(f"file {name}.png" for name in FIGURES[:-1])),
]
CHECKS = [
    *(
        "forecast",
        "scale of the forces",
        "summary of each parameter",
        "what is kept of checks",
        "the most probable value",
        "samples left out",
        "states of the fit",
    ),
    *(check.value for check in Check),
    *("agreement of the logs", "intervals with what the model lacks", "summaries with what the model lacks", "ridges"),
    *("noise of the channels", "coverage of the bands", "signals"),
    *("samples left out of each log", "alarms", "unmeasured starts"),
    *("diagnostics of the estimator", "rigid bodies", "diagnostics of the checks", "drifting noise", "uneven targets"),
    *("disagreement", "ridges to resolve", "bounds and contraction", "errors that grew"),
    *("logs as read", "process noise"),
]


DRAWN = [*(check.value for check in Check), "signals", "ridges"]
"""Steps without which figures have less to draw: there figures are drawn as ever, which takes most of a run's time."""


def draw_blank(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(page, "png", lambda figure: b"")
    for name in ("marginals", "pairs", "signals", "residuals"):
        monkeypatch.setattr(calibration_plots, name, lambda *_: [Figure()])


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a calibration that nobody disturbed, with its configuration one above."""
    config = write_case(tmp_path_factory.mktemp("whole"), swing())
    assert call(config, "--out", config.parent / "out").exit_code == 0
    return config.parent / "out"


def again(whole: Path, folder: Path) -> tuple[Any, dict[str, Any]]:
    """The same command in a copy of the folder, and its result."""
    shutil.copytree(whole, folder)
    for file in ("result.json", "report.html", "posterior.safetensors"):
        (folder / file).unlink()
    ended = call(whole.parent / "config.toml", "--out", folder)
    return ended, strict_json((folder / "result.json").read_text())


def break_step(monkeypatch: pytest.MonkeyPatch, broken: str) -> list[str]:
    """Let the step of a name raise; the names of all steps that run."""
    own, names = Guard.run, []

    def fail() -> Any:
        raise np.linalg.LinAlgError("a fault for the test")

    def step(self: Guard, name: str, make: Callable[[], Any], **settings: Any) -> Any:
        names.append(name)
        return own(self, name, fail if name == broken else make, **settings)

    monkeypatch.setattr(Guard, "run", step)
    return names


def test_every_step_is_listed(whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A step that is added is broken by the tests below too."""
    names = break_step(monkeypatch, "")
    ended, result = again(whole, tmp_path / "out")
    assert set(names) == {SUMMARY, *CHECKS, *FILES, "report"}
    assert ended.exit_code == 0
    assert result["checked"]
    assert not {"internal_error", "checks_skipped"} & {item["code"] for item in result["findings"]}


@pytest.mark.parametrize("step", [SUMMARY, *CHECKS, *FILES])
def test_a_fault_loses_one_step(step: str, whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    if step not in DRAWN:
        draw_blank(monkeypatch)
    break_step(monkeypatch, step)
    ended, result = again(whole, tmp_path / "out")
    errors = [item["text"] for item in result["findings"] if item["code"] == "internal_error"]
    assert errors, result["findings"]
    assert all(f"The check {step!r} ended" in text and "LinAlgError: a fault for the test" in text for text in errors)
    assert result["checked"]
    undisturbed = strict_json((whole / "result.json").read_text())
    assert ended.exit_code == (3 if step == SUMMARY else 0), ended.output
    if step == SUMMARY:
        assert np.shape(result["theta_covariance"]) == (2, 2)
    else:
        assert [p["mode"] for p in result["parameters"]] == [p["mode"] for p in undisturbed["parameters"]]
    written = {path.name for path in (tmp_path / "out").iterdir()}
    assert {"report.html", "run.json"} <= written
    if not step.startswith("file"):  # the page is there before its files
        assert step in (tmp_path / "out" / "report.html").read_text().replace("&#39;", "'")
    if step != "posterior":
        saved = load_posterior(tmp_path / "out" / "posterior")
        assert (saved.mean == load_posterior(whole / "posterior").mean).all()


def test_a_fault_in_a_function_of_a_check(whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Not in the guard: the prior's simulations, made anew; checks that are kept stay."""

    def fail(*_: Any, **__: Any) -> Any:
        raise ZeroDivisionError

    monkeypatch.setattr("sipe_bayes.calibration.checks.predictions.outside_prior", fail)
    shutil.copytree(whole, tmp_path / "copy")
    (tmp_path / "copy" / "checks" / "prior.safetensors").unlink()
    ended = call(whole.parent / "config.toml", "--out", tmp_path / "copy")
    result = strict_json((tmp_path / "copy" / "result.json").read_text())
    (error,) = (item for item in result["findings"] if item["code"] == "internal_error")
    assert ended.exit_code == 0
    assert Check.PRIOR.value in error["text"]
    assert "test_guard.py:" in error["text"], "the line that raised it"
    assert result["outside_prior"] == []
    assert result["holdout"]


def test_a_fault_while_a_figure_is_rendered(whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The others are drawn."""

    def fail(*_: Any, **__: Any) -> Any:
        raise RuntimeError("no ink")

    monkeypatch.setattr("sipe_bayes.report.calibration_plots.pairs", fail)
    shutil.rmtree(whole / "figures")
    _, result = again(whole, tmp_path / "out")
    assert {p.stem for p in (tmp_path / "out" / "figures").iterdir()} == {*FIGURES[:-1]} - {"pairs"}
    assert [item["code"] for item in result["findings"]].count("internal_error") == 1


def test_what_needs_a_step_without_a_result_is_skipped(
    whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    draw_blank(monkeypatch)
    break_step(monkeypatch, Check.PREDICTIONS.value)
    _, result = again(whole, tmp_path / "out")
    (skipped,) = (item["text"] for item in result["findings"] if item["code"] == "checks_skipped")
    assert all(check.value in skipped for check in (Check.COMPARISON, Check.PRIOR, Check.BANDS))
    assert Check.RANGES.value not in skipped
    assert "The errors are unknown" in (tmp_path / "out" / "report.html").read_text()


def test_an_interruption_after_the_fit_leaves_posterior_and_result(
    whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is no internal error: the same command resumes."""

    def stop(*_: Any, **__: Any) -> Any:
        raise KeyboardInterrupt

    monkeypatch.setattr("sipe_bayes.calibration.run.most_probable", stop)
    ended, result = again(whole, tmp_path / "out")
    assert ended.exit_code == 130
    assert result["checked"] is False
    undisturbed = strict_json((whole / "result.json").read_text())
    assert [p["q05"] for p in result["parameters"]] == [p["q05"] for p in undisturbed["parameters"]]
    assert (tmp_path / "out" / "posterior.safetensors").read_bytes() == (whole / "posterior.safetensors").read_bytes()


@pytest.mark.parametrize("estimator", ["laplace", "cem"])
def test_a_time_limit_ends_with_the_best_estimate(
    estimator: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And without it the same call resumes, to the bits of a run without a limit."""
    draw_blank(monkeypatch)
    config = write_case(tmp_path, swing())
    settings: dict[str, Any] = {"estimator": estimator, "budget": 400, "num_threads": 1}
    undisturbed = run(config, out=tmp_path / "whole", **settings)
    early = run(config, out=tmp_path / "out", time_limit=1e-9, **settings)
    assert early.rollouts < undisturbed.rollouts
    assert (early.checked, undisturbed.checked) == (False, True)
    assert len(early.parameters) == 2
    findings = Findings(early.findings)
    assert "1e-09 s" in findings.of(Code.TIME_LIMIT)[0].text
    assert all(check.value in findings.of(Code.CHECKS_SKIPPED)[0].text for check in Check)
    assert {"report.html", "result.json", "posterior.nc"} <= {p.name for p in (tmp_path / "out").iterdir()}
    resumed = run(config, out=tmp_path / "out", **settings)
    assert not Findings(resumed.findings).of(Code.TIME_LIMIT, Code.CHECKS_SKIPPED)
    texts = [(tmp_path / k / "posterior.safetensors").read_bytes() for k in ("out", "whole")]
    assert texts[0] == texts[1]
    plain = [{**one.to_dict(), "seconds": 0, "out": ""} for one in (resumed, undisturbed)]
    assert plain[0] == plain[1]
