"""The report: what it says, in which order, that it stands on its own and appears whole or not at all."""

import dataclasses
import re
import warnings
from pathlib import Path
from typing import Any

import matplotlib
import pytest

from sipe_bayes.core import files
from sipe_bayes.core.finding_advice import ADVICE
from sipe_bayes.core.findings import Code, Guard, Severity
from sipe_bayes.core.parameters import Parameter, ParameterSpace
from sipe_bayes.diagnostics.records import ChannelNoise
from sipe_bayes.diagnostics.result import Calibration, ParameterSummary
from sipe_bayes.posterior import Dirac, prior
from sipe_bayes.report import page as report
from sipe_bayes.report import verdicts as judged
from sipe_bayes.report.drawing import new_figure, png
from sipe_bayes.report.words import significant
from tests.problems.calibrations import EVIL, Page, make_calibration, noticed, ridge, with_chains


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
    return report.pictures(calibration, Guard())


@pytest.fixture(scope="module")
def page(calibration: Calibration, images: list[report.Picture]) -> str:
    return report.render(calibration, images)


def test_page_says_what_matters_first(page: str) -> None:
    text = Page(page).text
    first = text.index("2 of 3 values may be trusted within their intervals: p1 and p2;")
    second = text.index(
        "On held-out logs the calibrated model is better than the model you had: its error is 3.1 times smaller"
    )
    order = (
        "90 % interval",
        "What was noticed",
        "Prediction error",
        "measured against simulated",
        "Parameters in detail",
    )
    assert first < second < text.index(order[0])
    assert [text.index(words) for words in order] == sorted(text.index(words) for words in order)
    assert second < text.index("at a bound") < text.index("What was noticed")
    assert "Left out." not in text


def test_the_table_of_logs_counts_wild_samples(calibration: Calibration) -> None:
    log = dataclasses.replace(calibration.logs[0], wild={"angle_0": 3})
    text = Page(report.render(dataclasses.replace(calibration, logs=[log]), [])).text
    assert text.index("left out as wild") < text.index("angle_0 3")


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
    assert not {"link", "iframe", "object"} & set(found.tags)
    assert not re.search(r"https?://|url\(|@import", page.replace("/*! https://github.com/leeoniya/uPlot", ""))
    sources = [value for _, key, value in found.attributes if key == "src"]
    assert len(sources) == len(images) == 5
    assert all((value or "").startswith("data:image/png;base64,") for value in sources)
    anchors = {value for _, key, value in found.attributes if key == "id"}
    links = [value for _, key, value in found.attributes if key == "href"]
    assert all((value or "").startswith("#") and (value or "")[1:] in anchors for value in links)


def test_page_escapes_every_word_from_outside() -> None:
    found = make_calibration(names=(EVIL, "b", "c"))
    found.ridges[0] = ridge("b", "c", combination=EVIL)
    found.noise[EVIL] = ChannelNoise(1.0, 0.5, EVIL)
    found.logs[0] = dataclasses.replace(found.logs[0], name=EVIL, findings=(noticed(Code.LOG_GAP, text=EVIL),))
    found.holdout[0] = dataclasses.replace(found.holdout[0], log=EVIL, channel=EVIL)
    findings = (*found.findings, noticed(Code.NOT_EXPORTED, text=EVIL))
    found = dataclasses.replace(found, name=EVIL, findings=findings, run={"config": {"name": EVIL}})
    image = report.Picture("marginals", "marginals.png", png(new_figure(1)), f'"{EVIL}')
    page = Page(report.render(found, [image]))
    assert page.tags.count("script") == 2  # the numbers, and what draws them
    assert page.text.count(EVIL) >= 9
    assert ("img", "alt", f'"{EVIL}') in page.attributes


def test_chains_that_have_not_mixed_come_first(calibration: Calibration) -> None:
    text = Page(report.render(with_chains(calibration, 1.4), [])).text
    assert text.index("The chains have NOT mixed (R-hat 1.40)") < text.index("Prediction error")
    assert "acceptance 0.31" in text
    text = Page(report.render(with_chains(calibration, 1.001), [])).text
    assert "The chains have mixed (largest R-hat 1.001)." in text


@pytest.mark.parametrize("rhat", [None, 1.2])
def test_mixing_with_and_without_a_measure(calibration: Calibration, rhat: float | None) -> None:
    found = with_chains(calibration, 1.0)
    found = dataclasses.replace(found, mixing={} if rhat is None else {"rhat": rhat})
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


def test_findings_of_one_kind_stand_together_with_what_to_do(calibration: Calibration) -> None:
    many = tuple(noticed(Code.DEAD_RANGE, f"p{k}", text=f"dead range {k}") for k in range(200))
    found = dataclasses.replace(calibration, findings=(*many, noticed(Code.NO_EFFECT, "x", text="nothing of x")))
    page = Page(report.render(found, []))
    assert page.text.count("and 199 more like it") == 1
    assert all(item.text in page.text for item in found.findings)
    assert page.text.count(ADVICE[Code.DEAD_RANGE].replace("`", "")) == 1
    assert ADVICE[Code.NO_EFFECT].replace("`", "") in page.text


def test_notes_are_in_the_page_once(calibration: Calibration) -> None:
    """What the numbers rest on; notes of a log stand with it, others where the part is that they are about."""
    notes = [
        noticed(Code.MISFIT_NOT_ASKED, severity=Severity.NOTE, text="nothing was asked"),
        noticed(Code.RESIDUALS_LEFT_OUT, severity=Severity.NOTE, text="residuals of no meaning"),
    ]
    of_log = dataclasses.replace(
        noticed(Code.LOG_CLOCK, severity=Severity.NOTE, text="a clock that jumps"), log="log 1"
    )
    page = Page(report.render(dataclasses.replace(calibration, findings=(*notes, of_log)), []))
    assert "What the numbers rest on: 2 notes" in page.text
    assert ADVICE[Code.MISFIT_NOT_ASKED].replace("`", "") in page.text
    assert [page.text.count(item.text) for item in notes] == [1, 1]
    assert page.text.count(of_log.text) == 0  # the table of logs has it from the report of that log
    bare = Page(report.render(dataclasses.replace(calibration, findings=()), []))
    assert "What the numbers rest on" not in bare.text


# Files


def test_report_and_figures_are_written(tmp_path: Path, images: list[report.Picture], monkeypatch: Any) -> None:
    monkeypatch.setattr(report, "pictures", lambda *_: images)
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


def test_a_page_that_fails_is_replaced_by_estimates_and_diagnostics(
    tmp_path: Path, images: list[report.Picture], monkeypatch: Any
) -> None:
    def fail(*_: Any) -> Any:
        raise RuntimeError("no ink")

    monkeypatch.setattr(report, "pictures", lambda *_: images)
    monkeypatch.setattr(report, "render", fail)
    text = report.write_report(make_calibration(), tmp_path).read_text(encoding="utf-8")
    assert "RuntimeError: no ink" in text
    assert all(f"<td>{p.name}</td>" in text for p in make_calibration().parameters)
    assert {p.name for p in (tmp_path / "figures").iterdir()} == {image.file for image in images}


def test_an_interrupted_write_keeps_the_old_report(
    tmp_path: Path, images: list[report.Picture], monkeypatch: Any
) -> None:
    (tmp_path / "report.html").write_text("old")
    replace = files.os.replace

    def interrupted(source: Any, target: Any) -> None:
        if Path(target).name == "report.html":
            raise OSError("disk full")
        replace(source, target)

    monkeypatch.setattr(report, "pictures", lambda *_: images)
    monkeypatch.setattr(files.os, "replace", interrupted)
    with pytest.raises(OSError, match="disk full"):
        report.write_report(make_calibration(), tmp_path)
    assert (tmp_path / "report.html").read_text() == "old"
    assert {p.name for p in tmp_path.iterdir()} == {"report.html", "figures"}
