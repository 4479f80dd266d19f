"""The benchmark's tables, figures and reports: numbers against plain sums, pages in a browser and through pdflatex."""

from __future__ import annotations

import dataclasses
import json
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer
from typer.testing import CliRunner

import sipe_bayes as sipe
from sipe_bayes.benchmark import figures, findings, report_contents, report_html, report_latex, tables
from sipe_bayes.benchmark.cells import suite
from sipe_bayes.benchmark.records import Look, Record, RecordError, plan
from sipe_bayes.benchmark.run_log import Run, Took, by_suite
from sipe_bayes.cli.benchmark import report
from sipe_bayes.diagnostics.scores import score
from sipe_bayes.posterior import Dirac, Posterior, prior

NAMES = ("mass_1", "friction_2")
SPACE = sipe.ParameterSpace([sipe.Parameter(name, 0.0, 1.0) for name in NAMES])
BOTH = ("in_distribution", "out_of_distribution")
TRUTHS = {"in_distribution": (0.25, 0.8), "default": (0.5, 0.5), "out_of_distribution": (-0.1, 1.1)}
EVIL = r"</table><script>alert(1)</script> 100 % & $x$ #1 \input{a} _b^c~ ½ é 中"
BROWSER = shutil.which("chromium") or shutil.which("google-chrome")
PDFLATEX = shutil.which("pdflatex")


def make(
    task: str = "Door", estimator: str = "adr", seed: int = 0, setting: str = "direct", variant: str = "in_distribution",
    at: Any = None, label: str = "", **other: Any,
) -> Record:  # fmt: skip
    """A record whose posterior is the point ``at``, the prior or its mean."""
    truth = np.array(TRUTHS[variant])
    posterior: Posterior = Dirac([0.5, 0.5] if at is None else at, SPACE)
    posterior = prior(SPACE) if estimator == "prior" else posterior
    made: dict[str, Any] = {
        "budget": 1000, "steps": 50, "status": "done", "seconds": 2.0, "cpu_seconds": 3.0, "rollouts": 1000,
        "names": list(NAMES), "truth": truth.tolist(), "mean": posterior.mean.tolist(), "sd": posterior.stddev.tolist(),
        "scores": score(posterior, truth), "determined": [True, False] if variant == "in_distribution" else None,
        "history": [Look(n, 0.6 + n / 1e4, 0.1) for n in (100, 1000)],
        "log": "excitation", "versions": {"mujoco": "4.0.0"}, "checksums": {"log": f"{task}{variant}{seed}", "source": "a"}, "command": "sipe benchmark run --suite quick",
    }  # fmt: skip
    cell = f"{task}/{estimator}/{label or setting}/{variant}/seed{seed}"
    return Record(cell, task, estimator, setting, variant, seed, **{**made, **other})


def near(error: float, seed: int, variant: str = "in_distribution") -> list[float]:
    """A point about ``error`` from the truth, a little different with every seed."""
    return list(np.clip(np.array(TRUTHS[variant]) + error * (1 + 0.1 * seed) * np.array([1, -1]), 0, 1))


def every() -> list[Record]:
    """A small run of everything: three tasks, three estimators and a toy one, both baselines."""
    errors = {"laplace": 0.001, "adr": 0.1, "simopt": 0.12, "toy": 0.3}
    tasks = ("Door", "FetchPush", "Relocate")
    records = [
        make(task, name, seed, variant=variant, at=near(error, seed, variant))
        for task in tasks for variant in BOTH for name, error in errors.items() for seed in range(3)
    ]  # fmt: skip
    records += [
        make(task, name, variant=variant) for task in tasks for variant in BOTH for name in ("prior", "prior_mean")
    ]
    records += [make(t, "adr", s, "learned_reward", at=near(0.2, s)) for t in tasks for s in range(2)]
    records += [make(t, "adr", s, "policy", at=near(0.2, s), converged=s != 1) for t in tasks for s in range(3)]
    records += [
        make("Door", "maml", s, "gradient_steps", at=near(0.3 / (1 + n), s), label=f"gradient_steps={n}", values={"gradient_steps": n})
        for n in range(3) for s in range(2)
    ]  # fmt: skip
    records += [
        make(t, "adr", s, "sweep", at=near(error, s), label=f"sweep,particles={n}", values={"particles": n})
        for t in ("FetchPush", "Relocate") for n, error in ((4, 0.05), (10, 0.2)) for s in range(3)
    ]  # fmt: skip
    failed = make(
        "Door", "npe", status="failed", traceback=f"Traceback\n  File\nValueError: {EVIL}", scores=None, mean=[], sd=[]
    )
    records[0] = dataclasses.replace(records[0], warnings=[f"mass_1 at a bound: {EVIL}"], command=EVIL)
    return [*records, failed]


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


# Tables


def test_entries_are_mean_and_standard_error_over_seeds() -> None:
    records = every()
    table = tables.score_table(
        [r for r in records if (r.setting, r.variant) == ("direct", "in_distribution")],
        "accuracy",
        tables.Context.of(records),
    )
    assert table is not None
    assert table.columns == ("FetchPush", "Relocate", "Door", tables.ALL)
    assert [name for name, _ in table.rows] == ["laplace", "simopt", "adr", "toy", "prior", "prior_mean"]
    entry = table.entry("adr", "Door")
    accuracy = [1 - 0.1 * (1 + 0.1 * s) for s in range(3)]
    assert entry is not None
    assert entry.mean == pytest.approx(np.mean(accuracy))
    assert entry.standard_error == pytest.approx(np.std(accuracy, ddof=1) / np.sqrt(3))
    assert [name for name, row in table.rows if row[2] is not None and row[2].best] == ["laplace"]


def test_skill_over_determined_parameters() -> None:
    records = [make(estimator="adr", at=[0.35, 0.8]), make(estimator="prior")]
    table = tables.score_table(records, "CRPS skill, determined", tables.Context.of(records))
    assert table is not None
    entry = table.entry("adr", "Door")
    assert entry is not None
    assert entry.mean == pytest.approx(1 - 0.1 / (0.25**2 - 0.25 + 1 / 3), rel=1e-3)  # the uniform prior's CRPS


def column(values: dict[str, list[float]]) -> str | None:
    return tables.best_of({name: tuple(v) for name, v in values.items()}, 1)


def test_the_best_is_set_apart_only_outside_noise() -> None:
    clear = {"a": [0.9, 0.91, 0.92], "b": [0.7, 0.71, 0.72]}
    assert column(clear) == "a"
    assert column({**clear, "c": [0.89, 0.92, 0.9]}) is None  # a close second
    assert column({"a": [0.9], "b": [0.1]}) is None  # one seed
    assert column({**clear, "prior_mean": [0.95]}) is None  # knowing nothing is better
    assert column({**clear, "prior_mean": [0.909]}) is None  # and it must be worse outside noise
    assert column({**clear, "prior_mean": [0.85]}) == "a"
    assert column({"a": [0.9, 0.9], "b": [0.8, 0.8]}) == "a"  # deterministic
    assert column({"a": [0.9, 0.9], "b": [0.9, 0.9]}) is None


def test_nothing_is_best_where_the_truth_is_the_centre() -> None:
    records = [make(estimator=e, seed=s, variant="default", at=near(error, s)) for e, error in (("adr", 0.0), ("simopt", 0.2)) for s in range(3)]  # fmt: skip
    apart = tables.score_table(records, "accuracy", tables.Context.of(records))
    inside = [dataclasses.replace(r, variant="in_distribution") for r in records]
    same = tables.score_table(inside, "accuracy", tables.Context.of(inside))
    assert apart is not None
    assert same is not None
    assert [sum(e.best for _, row in t.rows for e in row if e) for t in (apart, same)] == [0, 1]
    section = report_contents.setting_section("direct-default", "", records, tables.Context.of(records))
    assert len(section.sentences) == 2
    assert "nothing is set in bold" in section.sentences[0]
    assert section.sentences[1] == report_contents.RADARS


def test_what_stands_beside_from_another_setting_does_not_compete(found: report_contents.Contents) -> None:
    """laplace of the direct setting is in the table of policies, and neither its best nor said to be."""
    section = next(s for s in found.sections if s.anchor == "policy-in_distribution")
    accuracy = next(t for t in section.tables if t.measure.name == "accuracy")
    assert "laplace, direct" in dict(accuracy.rows)
    assert not any(e.best for name, row in accuracy.rows for e in row if e and name != "adr")
    assert any(sentence.startswith("Best accuracy over all environments: adr") for sentence in section.sentences)


def test_a_pair_without_a_common_seed_is_said() -> None:
    left = [make("Door", "adr", 0), make("FetchPush", "adr", 1)]
    right = [make("Door", "adr", 0, "policy"), make("FetchPush", "adr", 2, "policy")]
    (said,) = findings.pair_findings(left, [*right, make("FetchPush", "adr", 1, "policy")], ("one", "two"))
    assert said == "adr: no seed has every environment with one and with two; nothing is compared."


def test_against_a_constant() -> None:
    assert tables.against([0.6, 0.61, 0.62], 0.5) == 1
    assert tables.against([0.6, 0.61, 0.62], 0.7) == -1
    assert tables.against([0.3, 0.5, 0.9], 0.5) == 0
    assert tables.against([0.9], 0.5) == 0  # one seed tells nothing
    assert tables.against([0.6, 0.6], 0.5) == 1  # deterministic
    rng = np.random.default_rng(2)
    alarms = sum(tables.against(list(rng.normal(size=3)), 0.0) != 0 for _ in range(300))
    assert alarms <= 30, alarms  # expected 15; more than 30 in one of 5,000 such tests


def test_equal_estimators_seldom_have_a_best_one() -> None:
    """At most 5 %; two hundred columns of two equal estimators exceed 10 % by chance once in 300 at 5 %."""
    rng = np.random.default_rng(1)
    equal = sum(column({"a": list(rng.normal(size=3)), "b": list(rng.normal(size=3))}) is not None for _ in range(200))
    apart = sum(column({"a": list(5 + rng.normal(size=3)), "b": list(rng.normal(size=3))}) == "a" for _ in range(200))
    assert equal <= 20, equal
    assert apart >= 150, apart


def test_runs_whose_policy_solves_nothing_do_not_count() -> None:
    runs = [make(seed=s, setting="policy", converged=s > 0) for s in range(3)]
    kept, sentence = tables.counted(runs)
    assert [r.seed for r in kept] == [1, 2]
    assert "2 of 3 runs" in sentence
    kept, sentence = tables.counted([dataclasses.replace(r, converged=False) for r in runs])
    assert len(kept) == 3
    assert "none would count" in sentence
    assert tables.counted([make()])[1] == ""


def test_warnings_are_counted_without_names_and_numbers() -> None:
    runs = [make(seed=s, warnings=[f"{name} at a bound: sd 0.{s}"]) for s, name in enumerate(NAMES)]
    assert tables.warning_counts(runs) == [("adr", "at a bound: sd #", 2)]


def test_baselines_are_better_worse_or_not_told_apart() -> None:
    errors = {
        "good": (0.04, 0.05, 0.06),
        "bad": (0.44, 0.45, 0.45),
        "noisy": (0.1, 0.28, 0.45),
    }  # the prior mean's: 0.275
    away = np.array([1, -1])
    records = [make(estimator=n, seed=s, at=TRUTHS["in_distribution"] + e[s] * away) for n, e in errors.items() for s in range(3)]  # fmt: skip
    records += [make(estimator="prior_mean"), make(estimator="prior")]
    context = tables.Context.of(records)
    (table,) = [t for t in [tables.score_table(records, "accuracy", context)] if t]
    said = findings.table_findings([table])[1]
    assert said.startswith("Better in accuracy than the prior mean: good; worse: bad; not told apart: noisy"), said


def test_gain_of_a_setting_is_paired_by_environment_and_seed() -> None:
    """Two environments that differ far more than the two settings do."""
    base = {"Door": 0.4, "FetchPush": 0.05}
    left = [make(t, "adr", s, at=near(b, s)) for t, b in base.items() for s in range(3)]
    right = [make(t, "adr", s, "learned_reward", at=near(b - 0.02, s)) for t, b in base.items() for s in range(3)]
    labels = ("state differences", "learned rewards")
    (said,) = findings.pair_findings(left, right, labels)
    assert (
        "adr: mean accuracy with learned rewards less that with state differences is 0.022 ± 0.001, a gain outside noise"
        in said
    )
    assert "positive on 2 of 2" in said
    (same,) = findings.pair_findings(left, left, labels)
    assert "0.000 ± 0.000, not told from none" in same


def test_rows_that_do_not_compare_are_named() -> None:
    assert findings.unequal([make(seed=0), make(seed=1)]) == ""
    said = findings.unequal([make(seed=0), make(seed=1, budget=100), make("FetchPush", steps=20), make("FetchPush")])
    assert (
        said
        == "The rows do not compare: budgets differ (100, 1,000 rollouts) and trajectories differ in length on FetchPush."
    )


def test_search_is_held_against_the_defaults() -> None:
    """Two combinations tie for the best, and both are far ahead of the defaults."""
    errors = {4: 0.05, 6: 0.05, 10: 0.3}
    mine = [make("FetchPush", "adr", s, "sweep", at=near(e, s), label=f"sweep,particles={n}", values={"particles": n}) for n, e in errors.items() for s in range(3)]  # fmt: skip
    mine.append(make("FetchPush", "prior_mean"))
    rows = findings.sweep_rows(mine)
    assert [(row.estimator, row.default) for row in rows] == [
        ("adr", False),
        ("adr", False),
        ("adr", True),
        ("prior_mean, direct", False),
    ]
    (said,) = findings.sweep_findings([row for row in rows if row.values])
    assert "the best of 3, and not the defaults, particles = 10" in said
    assert "they differ outside noise" in said


def test_wall_time_is_summed_by_suite() -> None:
    run = Run("", workers=2, units=3, seconds=1800.0, cpu_seconds=3000.0, simulating=Took(100.0, 190.0))
    commands = [f"sipe benchmark run --suite {name} --out x" for name in ("direct", "direct", "policy")]
    runs = [dataclasses.replace(run, command=command) for command in commands]
    assert dataclasses.asdict(by_suite(runs)["direct"]) == {
        "seconds": 3600.0, "cpu_seconds": 6000.0, "workers": 2, "simulating_seconds": 200.0,
        "cpu_use": pytest.approx(6000 / 7200), "cpu_use_simulating": pytest.approx(0.95),
    }  # fmt: skip
    assert by_suite([dataclasses.replace(run, command="sipe benchmark run --out x")]).keys() == {"paper"}
    assert by_suite([dataclasses.replace(run, command="sipe simulate Door")]).keys() == {"sipe simulate"}
    said = dict(findings.facts([make()], runs))["wall time"]
    assert (
        said
        == "1.5 h on 2 cores, cells that were measured again included (direct 1.0 h, policy 30.0 min); CPU use 95% while simulating"
    )


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
said.drawn = [...document.images].filter(i => i.complete && i.naturalWidth > 0).length; said.images = document.images.length;
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
    """On a phone and on a desk: figures are drawn, tables sort, nothing is wider than the window, and the console stays empty. The page
    is in a frame, since Chromium's own window has at least 500 pixels."""
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


def test_commands_are_told_once() -> None:
    """Whatever they selected."""
    runs = [
        make(command=f"sipe benchmark run --suite direct --select '{part}/*' --select Door --out x")
        for part in ("a", "b")
    ]
    assert (
        dict(findings.facts(runs, []))["commands"] == "sipe benchmark run --suite direct --out x, in parts by --select"
    )
    assert dict(findings.facts([make()], []))["commands"] == "sipe benchmark run --suite quick"


def test_options_in_another_order_are_the_same_command() -> None:
    runs = [
        make(command=f"sipe benchmark run {options}")
        for options in ("--suite direct --out x", "--out x --suite direct")
    ]
    assert dict(findings.facts(runs, []))["commands"] == "sipe benchmark run --suite direct --out x"


def test_only_suites_that_were_asked_for_are_counted() -> None:
    """And of theirs only cells with the suite's own budget and length."""
    cell = next(c for c in suite("quick") if c.estimator == "prior")
    asked = make(cell.task, "prior", cell.seed, budget=cell.budget, steps=cell.horizon, variant=cell.variant)
    assert asked.id == cell.id
    total = len(suite("quick"))
    assert dict(findings.facts([asked], []))["suites"] == f"quick 1 of {total}, each in its own sizes"
    other = dataclasses.replace(asked, budget=cell.budget + 1, command="sipe benchmark run --suite direct --out x")
    assert dict(findings.facts([other], []))["suites"] == "direct 0 of 810, each in its own sizes"


def test_what_is_not_known_of_old_records_is_counted() -> None:
    untimed = make(checksums={"log": "a"}, cpu_seconds=None)
    said = dict(findings.facts([make(), make("Relocate"), untimed], []))
    assert said["states of the code"] == "a (2 cells), not kept (1 cells)"
    assert "; 1 cells" in said["CPU time"]


def test_one_seed_is_no_test() -> None:
    records = [make("Door", name, scores=make().scores) for name in ("adr", "simopt")]
    made = [
        t
        for n in ("accuracy", "CRPS skill")
        if (t := tables.score_table(records, n, tables.Context.of(records))) is not None
    ]
    said = findings.table_findings(made)
    assert len(said) == 2
    assert all(s.endswith("one seed tells no more.") for s in said), said


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


def test_shared_simulations_are_counted_once() -> None:
    """Two estimators of one bank, and one of another seed's: 60 s + 90 s."""
    one = Record(
        "a",
        "Pendulum",
        "npe",
        "direct",
        "default",
        0,
        100,
        20,
        "done",
        cpu_seconds=1.0,
        simulation_cpu_seconds=60.0,
        checksums={"log": "x"},
    )
    records = [
        one,
        dataclasses.replace(one, id="b", estimator="bayessim"),
        dataclasses.replace(one, seed=1, simulation_cpu_seconds=90.0),
    ]
    assert dict(findings.facts(records, []))["CPU time"].endswith("2.5 min for shared simulations")
