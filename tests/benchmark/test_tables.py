"""The benchmark's tables and findings: numbers against plain sums, sentences that hold outside noise."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from sipe_bayes.benchmark import findings, report_contents, tables
from sipe_bayes.benchmark.cells import suite
from sipe_bayes.benchmark.records import Record
from sipe_bayes.benchmark.run_log import Run, Took, by_suite
from tests.problems.benchmark_records import NAMES, TRUTHS, every, make, near


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
    records = [
        make(estimator=e, seed=s, variant="default", at=near(error, s))
        for e, error in (("adr", 0.0), ("simopt", 0.2))
        for s in range(3)
    ]
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
    records = [
        make(estimator=n, seed=s, at=TRUTHS["in_distribution"] + e[s] * away)
        for n, e in errors.items()
        for s in range(3)
    ]
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
        "adr: mean accuracy with learned rewards less that with state differences is 0.022 ± 0.001, "
        "a gain outside noise" in said
    )
    assert "positive on 2 of 2" in said
    (same,) = findings.pair_findings(left, left, labels)
    assert "0.000 ± 0.000, not told from none" in same


def test_rows_that_do_not_compare_are_named() -> None:
    assert findings.unequal([make(seed=0), make(seed=1)]) == ""
    said = findings.unequal([make(seed=0), make(seed=1, budget=100), make("FetchPush", steps=20), make("FetchPush")])
    assert (
        said == "The rows do not compare: budgets differ (100, 1,000 rollouts) and "
        "trajectories differ in length on FetchPush."
    )


def test_search_is_held_against_the_defaults() -> None:
    """Two combinations tie for the best, and both are far ahead of the defaults."""
    errors = {4: 0.05, 6: 0.05, 10: 0.3}
    mine = [
        make("FetchPush", "adr", s, "sweep", at=near(e, s), label=f"sweep,particles={n}", values={"particles": n})
        for n, e in errors.items()
        for s in range(3)
    ]
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
        said == "1.5 h on 2 cores, cells that were measured again included (direct 1.0 h, policy 30.0 min); "
        "CPU use 95% while simulating"
    )


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
