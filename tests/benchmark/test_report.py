"""The benchmark's figures and reports: what is drawn, pages in a browser and through pdflatex."""

from __future__ import annotations

import dataclasses
import json
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from sipe_bayes.benchmark import figures, findings, report_contents, report_html, report_latex
from sipe_bayes.benchmark.records import Look, RecordError, plan
from sipe_bayes.cli.benchmark import report
from tests.problems.benchmark_records import EVIL, TRUTHS, every, make, near

BROWSER = shutil.which("chromium") or shutil.which("google-chrome")
PDFLATEX = shutil.which("pdflatex")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("results")
    for record in every():
        record.write(out)
    plan(
        out,
        [
            "Door/adr/direct/in_distribution/seed0",
            "Door/bayessim/direct/in_distribution/seed0",
            "Relocate/bayessim/direct/in_distribution/seed1",
        ],
    )
    return out


@pytest.fixture(scope="module")
def found(folder: Path) -> report_contents.Contents:
    return report_contents.contents(folder)


@pytest.fixture(scope="module")
def written(folder: Path, found: report_contents.Contents) -> Path:
    paths, note = report_latex.write_reports(found, folder / "report")
    assert [p.name for p in paths] == ["report.html", "report.tex", *(["report.pdf"] if PDFLATEX else [])], note
    return folder / "report"


def test_what_stands_beside_from_another_setting_does_not_compete(found: report_contents.Contents) -> None:
    """Laplace of the direct setting is in the table of policies, and neither its best nor said to be."""
    section = next(s for s in found.sections if s.anchor == "policy-in_distribution")
    accuracy = next(t for t in section.tables if t.measure.name == "accuracy")
    assert "laplace, direct" in dict(accuracy.rows)
    assert not any(e.best for name, row in accuracy.rows for e in row if e and name != "adr")
    assert any(sentence.startswith("Best accuracy over all environments: adr") for sentence in section.sentences)


# Figures


def test_the_reference_is_dotted_on_every_figure(found: report_contents.Contents) -> None:
    """laplace, wherever it has no curve of its own; the prior mean is dashed everywhere."""
    pictures = [p for s in found.sections for p in s.pictures]
    assert len(pictures) > 8
    for picture in pictures:
        (legend,) = picture.figure.legends
        names = [text.get_text() for text in legend.get_texts()]
        assert "prior mean" in names, picture.name
        own = "laplace" in picture.caption.split(": ")[1]
        assert own or {"laplace", "laplace, direct"} & set(names), (picture.name, names)


def test_every_seed_and_the_truth_are_drawn() -> None:
    runs = [make(seed=s, at=near(0.1, s)) for s in range(3)]
    error = figures.error_per_parameter(runs).axes[0]
    dots = [line.get_ydata() for line in error.lines if line.get_marker() == "."]
    np.testing.assert_allclose(dots, [2 * [0.1 * (1 + 0.1 * s)] for s in range(3)])
    posterior = figures.posterior_against_truth(runs).axes[0]
    ticks = [seg[0, 1] for c in posterior.collections if len(c.get_segments()) == 2 for seg in c.get_segments()]  # type: ignore[attr-defined]
    assert set(TRUTHS["in_distribution"]) <= set(np.round(ticks, 9))
    with pytest.raises(ValueError, match="one task, setting and variant"):
        figures.error_per_parameter([*runs, make("FetchPush")])


def test_accuracy_against_rollouts_prefers_whole_runs() -> None:
    on_the_way = figures.accuracy_against_rollouts([make()])
    np.testing.assert_allclose(on_the_way.axes[0].lines[0].get_xdata(), [100, 1000])
    runs = [make(setting="rollouts", label=f"rollouts={n}", budget=n, at=near(10 / n, 0)) for n in (50, 200)]
    line = figures.accuracy_against_rollouts([*runs, make()]).axes[0].lines[0]
    np.testing.assert_allclose(line.get_xdata(), [50, 200])
    np.testing.assert_allclose(line.get_ydata(), [0.8 + 0.0, 0.95], atol=0.03)


def test_histories_of_seeds_on_other_grids_are_carried_on() -> None:
    rows = [[(100, 0.5), (300, 0.7)], [(200, 0.9)]]
    runs = [make(seed=s, history=[Look(n, a) for n, a in row]) for s, row in enumerate(rows)]
    line = figures.accuracy_against_rollouts(runs).axes[0].lines[0]
    np.testing.assert_allclose(line.get_xdata(), [100, 200, 300])
    np.testing.assert_allclose(line.get_ydata(), [0.5, 0.7, 0.8])


# Reports


def test_contents_say_what_was_run_and_what_is_missing(found: report_contents.Contents) -> None:
    assert "1 failed, 2 of 3 planned are missing" in found.headline
    assert found.missing == [("direct, in distribution", "bayessim", 2, "Relocate, Door")]
    assert found.failed[0][0] == "Door/npe/direct/in_distribution/seed0"
    facts = dict(found.facts)
    assert facts["versions"] == "mujoco 4.0.0"
    assert "toy" in facts["estimators"]
    assert facts["CPU time"].startswith(f"{3 * len(every()) / 60:.1f} min for the methods")
    assert facts["trajectories"] == "50 control steps; by excitation"
    longer = [dataclasses.replace(r, steps=200) if r.task == "Door" else r for r in every()]
    assert (
        dict(findings.facts(longer, []))["trajectories"]
        == "50 (FetchPush, Relocate); 200 (Door) control steps; by excitation"
    )
    titles = [section.title for section in found.sections]
    assert titles[0] == "Direct estimation, in distribution"
    assert {
        "Policy against demonstrations",
        "Learned rewards against state differences",
        "Gradient steps of MAML",
    } <= set(titles)
    ablation = next(s for s in found.sections if s.anchor == "gradient-steps")
    assert "with 2 gradient steps less that with 0 gradient steps is 0.210" in ablation.sentences[0]
    sweep = next(s for s in found.sections if s.anchor == "sweep")
    assert "would choose particles = 4" in sweep.sentences[0]
    outside = next(s for s in found.sections if s.anchor.endswith("out_of_distribution"))
    assert [t.measure.name for t in outside.tables] == ["CRPS", "energy score", "noticed", "CPU seconds"]


def test_page_stands_alone_and_escapes(written: Path) -> None:
    page = (written / "report.html").read_text(encoding="utf-8")
    assert not re.search(r"https?://|@import|url\(", page)
    assert page.count("<script") == 1
    assert "alert(1)&lt;/script&gt;" in page
    assert page.count('src="data:image/png;base64,') == page.count("<img")
    for words in (
        "Planned, and not run",
        "mujoco 4.0.0",
        "toy",
        "prior mean",
        "Learned rewards against state differences",
    ):
        assert words in page


_PROBE = """<script>addEventListener("load", () => {
const table = document.querySelector("table.scores"), said = {};
const values = () => [...table.tBodies[0].rows].map(r => Number(r.cells[1].dataset.value));
const button = table.tHead.rows[0].cells[1].querySelector("button");
said.given = values(); button.click(); said.descending = values(); button.click(); said.ascending = values();
said.drawn = [...document.images].filter(i => i.complete && i.naturalWidth > 0).length;
said.images = document.images.length;
said.wide = document.documentElement.scrollWidth - document.documentElement.clientWidth; said.width = innerWidth;
parent.postMessage(JSON.stringify(said), "*"); });</script>"""
_WINDOW = """<iframe src="page.html" style="width: {width}px; height: 900px; border: 0"></iframe><pre></pre>
<script>addEventListener("message", e => document.querySelector("pre").textContent = e.data);</script>"""


def browser(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    command = [str(BROWSER), "--headless", "--no-sandbox", "--disable-gpu", "--enable-logging=stderr",
               f"--user-data-dir={folder / 'profile'}", "--virtual-time-budget=5000", *arguments]  # fmt: skip
    return subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)


@pytest.mark.skipif(BROWSER is None, reason="needs Chromium")
@pytest.mark.parametrize("width", [360, 1200])
def test_page_in_a_browser(written: Path, tmp_path: Path, width: int) -> None:
    """On a phone and on a desk.

    Figures are drawn, tables sort, nothing is wider than the window, and the console stays empty. The page is in a
    frame, since Chromium's own window has at least 500 pixels.
    """
    page = (written / "report.html").read_text(encoding="utf-8")
    (tmp_path / "page.html").write_text(page.replace("</body>", _PROBE + "</body>"), encoding="utf-8")
    (tmp_path / "window.html").write_text(_WINDOW.format(width=width), encoding="utf-8")
    done = browser(tmp_path, "--dump-dom", (tmp_path / "window.html").as_uri())
    assert "CONSOLE" not in done.stderr, [line for line in done.stderr.splitlines() if "CONSOLE" in line]
    found = re.search(r"<pre>(\{.*\})</pre>", done.stdout)
    assert found is not None, done.stdout[-500:]
    said = json.loads(found[1])
    assert said["ascending"] == sorted(said["given"]) != said["given"]
    assert said["descending"] == sorted(said["given"], reverse=True)
    assert said["images"] == said["drawn"] > 5
    assert said["width"] == width
    assert said["wide"] <= 0


@pytest.mark.skipif(BROWSER is None, reason="needs Chromium")
def test_page_prints(written: Path, tmp_path: Path) -> None:
    """With every figure, also those that a reader opens when wanted: fewer of them are printed where they stay shut."""
    page, images = written / "report.html", {}
    shut = tmp_path / "shut.html"
    shut.write_text(
        page.read_text(encoding="utf-8").replace("details::details-content", "details::none"), encoding="utf-8"
    )
    for path in (page, shut):
        browser(tmp_path, f"--print-to-pdf={tmp_path / 'page.pdf'}", path.as_uri())
        printed = (tmp_path / "page.pdf").read_bytes()
        assert printed.startswith(b"%PDF")
        images[path] = printed.count(b"/Subtype /Image")
    assert images[page] > images[shut] > 5, images


@pytest.mark.skipif(PDFLATEX is None, reason="needs pdflatex")
def test_document_compiles(written: Path) -> None:
    assert (written / "report.pdf").read_bytes().startswith(b"%PDF")
    source = (written / "report.tex").read_text(encoding="utf-8")
    drawn = set(re.findall(r"\{figures/([^}]+)\}", source))
    assert drawn == {p.stem for p in (written / "figures").iterdir()}
    assert r"\toprule" in source
    assert r"\textbf{0.99" in source


@pytest.mark.parametrize("text", [EVIL, "--out", "a\nb", "\\", "{}"])
def test_no_letter_reaches_latex_unescaped(text: str) -> None:
    assert not re.search(
        r"(?<!\\)[&%$#_{}~^]", re.sub(r"\\[a-z]+\{\}|-\{\}|\$-\$|\$\\pm\$", "", report_latex.escaped(text))
    )
    assert report_latex.escaped(text).isascii()


def test_without_pdflatex_the_source_remains(written: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shutil, "which", lambda _: None)
    assert "pdflatex is not installed" in report_latex.compile_pdf(written)


@pytest.mark.skipif(PDFLATEX is None, reason="needs pdflatex")
def test_what_latex_refuses_is_said(tmp_path: Path) -> None:
    (tmp_path / "report.tex").write_text(r"\documentclass{article}\begin{document}\nonsense\end{document}")
    assert "Undefined control sequence" in report_latex.compile_pdf(tmp_path)
    assert [p.name for p in tmp_path.iterdir()] == ["report.tex"]


def test_the_least_there_can_be(tmp_path: Path) -> None:
    make().write(tmp_path)
    found = report_contents.contents(tmp_path)
    assert "no plan" in found.headline
    page, document = report_html.render(found), report_latex.render(found)
    assert "none was run" in page
    assert "what is missing is not known" in document


def test_command(folder: Path, tmp_path: Path) -> None:
    app = typer.Typer()
    app.command()(report)
    with pytest.raises(RecordError, match="holds no records"):
        report_contents.contents(tmp_path)
    refused = CliRunner().invoke(app, [str(tmp_path)])
    assert refused.exit_code == 2
    assert len(refused.stderr.splitlines()) == 1
    (tmp_path / "file").write_text("")
    refused = CliRunner().invoke(app, [str(folder), "--out", str(tmp_path / "file")])
    assert refused.exit_code == 2
    assert "choose another name" in refused.stderr
