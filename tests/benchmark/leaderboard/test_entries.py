"""Entries of others: what is refused, what a failure counts, what an exact posterior scores, and how a run goes on."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from sipe_bayes.benchmark.leaderboard.calibrate import Calibrate
from sipe_bayes.benchmark.leaderboard.entry import ENTRY, Entry, EntryError, answers_path
from sipe_bayes.benchmark.leaderboard.registry import TASKS, chosen
from sipe_bayes.benchmark.leaderboard.report import write
from sipe_bayes.benchmark.leaderboard.run import DRAWS, Estimate, OwnMethod, run_entry
from sipe_bayes.benchmark.leaderboard.scoring import made, scored
from sipe_bayes.benchmark.leaderboard.task import Case, Kind, Problem, Task
from sipe_bayes.cli.app import app

EXACT = [task for task in TASKS.values() if task.kind is Kind.EXACT]
LINEAR = "gaussian_linear"


def entry(method: str = "exact") -> Entry:
    return Entry(method, "python exact.py", [0], {"numpy": np.__version__}, "draws of the <exact> posterior")


def exact(task: Task, problem: Problem, case: Case) -> Estimate:
    assert case.reference is not None
    return Estimate(problem.space.values(case.reference[:DRAWS]), 3)


def quiet(line: str) -> None:
    pass


@pytest.fixture(scope="module")
def honest(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("entries") / "exact"
    run_entry(entry(), folder, EXACT, exact, quiet)
    return folder


def test_an_exact_posterior_scores_what_theory_says(honest: Path) -> None:
    """Its CRPS is in expectation half the distance of two draws; coverage 90 %. False alarms: 1e-4 a task."""
    for name, score in scored(honest).tasks.items():
        problem = made(name)
        expected = []
        for case in problem.cases:
            assert case.reference is not None
            one, other = case.reference[:1000], case.reference[1000:]
            expected.append(0.5 * np.abs(one - other).mean(0).sum())
        got = np.array([log.crps for log in score.logs])
        off = (got - expected).mean() / (got.std(ddof=1) / np.sqrt(len(got)))
        assert abs(off) < 4.9, (name, off, got.mean(), np.mean(expected))  # t of 19 degrees
        assert score.coverage is not None
        known = sum(log.known for log in score.logs)
        assert abs(score.coverage - 0.9) < 4 * np.sqrt(0.09 / known) + 1 / known, (name, score.coverage)
        assert score.failed == 0


def test_knowing_nothing_is_no_skill(tmp_path: Path) -> None:
    run_entry(entry("prior"), tmp_path, [TASKS["two_moons"]], OwnMethod("prior", 0), quiet)
    score = scored(tmp_path).tasks["two_moons"]
    assert score.skill is not None
    assert abs(score.skill) < 0.02
    assert score.rollouts == 0


def test_a_point_is_scored_as_one(tmp_path: Path) -> None:
    """Its CRPS is its error, and it has no intervals."""

    def middle(task: Task, problem: Problem, case: Case) -> Estimate:
        return Estimate(problem.space.values(np.full((1, len(problem.space)), 0.5)), 0)

    run_entry(entry(), tmp_path, chosen(["two_moons"]), middle, quiet)
    score, problem = scored(tmp_path).tasks["two_moons"], made("two_moons")
    assert (score.coverage, score.interval) == (None, None)
    got = [log.crps for log in score.logs]
    assert got == pytest.approx([np.abs(case.truth - 0.5).sum() for case in problem.cases], abs=1e-5)


def test_held_out_logs_are_predicted_with_what_the_entry_says(tmp_path: Path) -> None:
    """By default with the mean: of draws about it that is as good as itself; the model as given has a ratio of one."""
    problem = made("simple_pendulum")
    given = problem.space.values(np.clip(problem.space.default_theta, 0, 1))
    other = problem.space.values(np.repeat([[0.35], [0.25]], len(problem.space), axis=1))
    ratios = []
    for name, predicts in (("mean", None), ("same", other.mean(0)), ("given", given)):
        estimate = Estimate(other, 0, predicts)
        run_entry(entry(name), tmp_path / name, chosen(["simple_pendulum"]), lambda *_, e=estimate: e, quiet)
        ratios.append(scored(tmp_path / name).tasks["simple_pendulum"].heldout)
    assert ratios[0] == pytest.approx(ratios[1], rel=1e-4)
    assert ratios[0] != pytest.approx(1.0, rel=0.1)
    assert ratios[2] == pytest.approx(1.0, rel=1e-4)


def test_a_failure_counts_as_the_prior(tmp_path: Path, honest: Path) -> None:
    def half(task: Task, problem: Problem, case: Case) -> Estimate:
        if problem.cases.index(case) % 2:
            raise RuntimeError("the solver\ngave up")
        return exact(task, problem, case)

    run_entry(entry(), tmp_path, chosen([LINEAR]), half, quiet)
    score, whole = scored(tmp_path).tasks[LINEAR], scored(honest).tasks[LINEAR]
    assert score.failed == len(score.logs) // 2
    assert score.skill is not None
    assert whole.skill is not None
    assert 0 < score.skill < whole.skill
    for log in score.logs[1::2]:
        assert (log.skill, log.covered, log.failure) == (0.0, 0, "gave up")


def test_a_log_without_an_answer_counts_as_failed(tmp_path: Path, honest: Path) -> None:
    folder = tmp_path / "e"
    shutil.copytree(honest, folder)
    change(folder, LINEAR, lambda plain: plain["logs"].pop("x 3"))
    assert scored(folder).tasks[LINEAR].failed == 1


# What is refused


def change(folder: Path, task: str, edit: Callable[[dict[str, Any]], object]) -> None:
    path = answers_path(folder, task) if task else folder / ENTRY
    plain = json.loads(path.read_text())
    edit(plain)
    path.write_text(json.dumps(plain))


def rows(edit: Callable[[list[list[float]]], object]) -> Callable[[dict[str, Any]], object]:
    return lambda plain: edit(plain["logs"]["x 0"]["values"])


def every(edit: Callable[[Problem, Case], list[list[float]]], task: str = LINEAR) -> Callable[[dict[str, Any]], None]:
    def all_logs(plain: dict[str, Any]) -> None:
        for case in made(task).cases:
            plain["logs"][case.name]["values"] = edit(made(task), case)

    return all_logs


def near(problem: Problem, case: Case) -> list[list[float]]:
    """Draws about the truth, a hundredth as wide as the posterior."""
    noise = np.random.default_rng(0).normal(0, 0.002, (50, len(case.truth)))
    values: list[list[float]] = problem.space.values(np.clip(case.truth + noise, 0, 1)).tolist()
    return values


def truth(count: int) -> Callable[[Problem, Case], list[list[float]]]:
    return lambda problem, case: problem.space.values(np.tile(case.truth, (count, 1))).tolist()


WRONG: dict[str, tuple[str, Callable[[dict[str, Any]], object], str]] = {
    "a column too few": (LINEAR, rows(lambda v: [row.pop() for row in v]), "200 rows of 9 numbers"),
    "a ragged row": (LINEAR, rows(lambda v: v[3].append(0.0)), "rows of 10, 11 numbers"),
    "flat": (LINEAR, lambda plain: plain["logs"]["x 0"].update(values=[0.1] * 10), "values"),
    "too many": (LINEAR, rows(lambda v: v.extend(v * 10)), "at most 2000"),
    "NaN": (LINEAR, rows(lambda v: v[3].__setitem__(2, np.nan)), "NaN"),
    "infinity": (LINEAR, rows(lambda v: v[3].__setitem__(2, np.inf)), "infinity"),
    "a word": (LINEAR, rows(lambda v: v[3].__setitem__(2, "high")), "number"),
    "outside the prior": (LINEAR, rows(lambda v: v[3].__setitem__(2, 5.0)), "theta_3 outside the prior's bounds"),
    "NaN to predict with": (LINEAR, lambda plain: plain["logs"]["x 0"].update(predicts=[np.nan] * 10), "predicts: NaN"),
    "too few to predict with": (
        LINEAR,
        lambda plain: plain["logs"]["x 0"].update(predicts=[0.0]),
        "predicts of 1 rows",
    ),
    "nothing": (LINEAR, rows(lambda v: v.clear()), "neither"),
    "both": (LINEAR, lambda plain: plain["logs"]["x 0"].update(failure="no"), "both"),
    "less than no time": (LINEAR, lambda plain: plain["logs"]["x 0"].update(cpu_seconds=-1.0), "below zero"),
    "another log": (LINEAR, lambda plain: plain["logs"].update({"x 99": plain["logs"]["x 0"]}), "'x 99'"),
    "another order": (LINEAR, lambda plain: plain["parameters"].reverse(), "in order"),
    "another definition": (LINEAR, lambda plain: plain.update(definition="0" * 12), "this version of the task"),
    "another version of a task": (LINEAR, lambda plain: plain.update(version="v0"), "this version of the task"),
    "another version": ("", lambda plain: plain.update(version="v2"), "made for version 'v2'"),
    "another format": ("", lambda plain: plain.update(format="mine"), "format 'mine'"),
    "no name": ("", lambda plain: plain.update(method=" "), "method is empty"),
    "an unknown key": ("", lambda plain: plain.update(code="import os"), "unknown key 'code'"),
    "the truth as a point": (LINEAR, every(truth(1)), "truths"),
    "the truth as draws without width": (LINEAR, every(truth(20)), "no width|truths"),
    "draws near the truth": (LINEAR, every(near), "nearer to the truths than the exact posteriors"),
}


@pytest.mark.parametrize("name", WRONG)
def test_what_is_wrong_is_one_line(name: str, honest: Path, tmp_path: Path) -> None:
    task, edit, words = WRONG[name]
    folder = tmp_path / "e"
    (folder / "tasks").mkdir(parents=True)
    for path in (honest / ENTRY, answers_path(honest, LINEAR)):
        shutil.copy(path, folder / path.relative_to(honest))
    change(folder, task, edit)
    with pytest.raises(EntryError, match=words) as error:
        scored(folder)
    assert "\n" not in str(error.value)
    assert str(folder) in str(error.value)
    result = CliRunner().invoke(app, ["leaderboard", "submit-check", str(folder)])
    assert result.exit_code == 2


def test_no_task_of_that_name(honest: Path, tmp_path: Path) -> None:
    folder = tmp_path / "e"
    shutil.copytree(honest, folder)
    answers_path(folder, LINEAR).rename(answers_path(folder, "gaussian_linea"))
    with pytest.raises(EntryError, match="did you mean"):
        scored(folder)
    with pytest.raises(ValueError, match="did you mean"):
        chosen(["two_moon"])


# A run


def test_an_interrupted_run_goes_on(tmp_path: Path) -> None:
    calls: list[str] = []

    def stops(task: Task, problem: Problem, case: Case) -> Estimate:
        if len(calls) == 7:
            calls.append("stop")
            raise KeyboardInterrupt
        calls.append(case.name)
        return exact(task, problem, case)

    with pytest.raises(KeyboardInterrupt):
        run_entry(entry(), tmp_path / "a", chosen([LINEAR]), stops, quiet)
    run_entry(entry(), tmp_path / "a", chosen([LINEAR]), stops, quiet)
    run_entry(entry(), tmp_path / "a", chosen([LINEAR]), stops, quiet)
    assert len(calls) == len(made(LINEAR).cases) + 1
    run_entry(entry(), tmp_path / "b", chosen([LINEAR]), exact, quiet)
    texts = []
    for folder in (tmp_path / "a", tmp_path / "b"):
        plain = json.loads(answers_path(folder, LINEAR).read_text())
        for answer in plain["logs"].values():
            answer.pop("cpu_seconds")
        texts.append(plain)
    assert texts[0] == texts[1]
    with pytest.raises(EntryError, match="another folder"):
        run_entry(entry("other"), tmp_path / "a", chosen([LINEAR]), exact, quiet)


def test_the_page_has_a_record_behind_every_cell(honest: Path, tmp_path: Path) -> None:
    evil = tmp_path / "evil"
    shutil.copytree(honest, evil)
    change(evil, "", lambda plain: plain.update(method="<script>alert(1)</script>"))
    pages = [path.read_text() for path in write([honest, evil], tmp_path / "page")]
    for page in pages:
        assert "<script>alert" not in page
        for anchor in set(page.split('href="#')[1:]):
            assert f'id="{anchor.split(chr(34))[0]}"' in page
        assert not re.search(r"(?:src|href)=.http", page), "nothing is fetched"
    cells = pages[0].count('<td class="n"><a href="#r')
    assert cells == 2 * len(EXACT)
    with pytest.raises(EntryError, match="another name"):
        write([honest, honest], tmp_path / "page")


def test_calibrate_is_laplace_where_there_is_no_model_to_extend() -> None:
    task, problem = TASKS[LINEAR], made(LINEAR)
    one, other = (method(task, problem, problem.cases[0]) for method in (Calibrate(0), OwnMethod("laplace", 0)))
    assert one.rollouts == other.rollouts
    np.testing.assert_array_equal(one.values, other.values)


def test_what_is_run_prints_little_and_goes_on(tmp_path: Path) -> None:
    out = str(tmp_path / "laplace")
    words = ["leaderboard", "run", "laplace", "--out", out, "--tasks", "two_moons"]
    result = CliRunner().invoke(app, words)
    assert (result.exit_code, len(result.output.splitlines())) == (0, 2), result.output
    assert "20 failed: ValueError: likelihood" in result.output, "a function that makes its own noise has none"
    again = CliRunner().invoke(app, words).output
    assert "20 logs (0 now)" in again
    checked = CliRunner().invoke(app, ["leaderboard", "submit-check", out])
    assert checked.exit_code == 0
    assert "1 of 20 tasks, 20 logs failed; accepted" in checked.output
    assert CliRunner().invoke(app, ["leaderboard", "run", "laplac", "--out", out]).exit_code == 2
