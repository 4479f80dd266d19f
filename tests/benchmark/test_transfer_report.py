"""Sim2sim transfer: what the report makes of returns."""

import io
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from sipe_bayes.benchmark.cells import Cell
from sipe_bayes.benchmark.transfer import figures as transfer_figures
from sipe_bayes.benchmark.transfer.figures import bars, curves
from sipe_bayes.benchmark.transfer.report import table
from sipe_bayes.benchmark.transfer.rows import WORDS, Contrast, by_quality, contrasts, in_order, label, relative, rows
from sipe_bayes.benchmark.transfer.study import SETTING, Point, TransferRecord, select
from sipe_bayes.rl.evaluation import Evaluation

# What the report makes of returns


def evaluated(mean: float) -> Evaluation:
    return Evaluation(episodes=50, seed=0, mean=mean, sd=1.0, standard_error=0.1)


def record(name: str, seed: int, earned: float, task: str = "HalfCheetahLinks", **changes: Any) -> TransferRecord:
    cell = Cell(task, name, SETTING, "in_distribution", seed)
    plain = (cell.id, task, name, SETTING, "in_distribution", seed)
    curve = [Point(step=s, own_return=0.0, target_return=earned * s) for s in (1, 2)]
    more: dict[str, Any] = {
        "evaluation": evaluated(earned),
        "random": evaluated(100.0),
        "curve": curve,
        "seconds": 1.0,
        "sd": [0.1, 0.1],
        **changes,
    }
    return TransferRecord(*plain, budget=60, steps=20, status="done", **more)


def test_percentages_and_their_bootstrap() -> None:
    """Of two seeds a resample has the mean of either alone in one case of four, so the interval ends there."""
    found = relative(np.array([300.0, 700.0]), np.array([1100.0, 1100.0]), 100.0)
    assert found is not None
    assert found[0] == pytest.approx(40.0)
    assert found[1] == pytest.approx((20.0, 60.0))
    assert relative(np.array([300.0]), np.array([500.0]), 100.0) == (50.0, None)
    paired = relative(np.array([200.0, 500.0]), np.array([400.0, 1000.0]), 0.0)
    assert paired is not None
    assert paired[1] == pytest.approx((50.0, 50.0)), "a seed's agent and oracle are drawn together"


def test_no_percentage_where_an_oracle_fails() -> None:
    """A resample of that seed alone would divide by nothing."""
    mine = np.array([-12.0, -12.0, -12.0])
    assert relative(mine, np.array([-10.0, -10.0, -49.0]), -46.0) is None
    assert relative(mine, np.array([-10.0, -10.0, -44.0]), -46.0) is None
    assert relative(mine, np.array([-10.0, -10.0, -30.0]), -46.0) is not None
    assert relative(np.array([]), np.array([]), -46.0) is None


def test_rows_and_table() -> None:
    oracle = [record("truth", k, 1100.0) for k in range(3)]
    given = [*oracle, *(record("adr", k, 600.0 + 100 * k) for k in range(2)), record("prior", 0, 350.0)]
    adr_wider = record("adr", 0, 1100.0, values={"wider": 2.0})
    given.append(replace(adr_wider, setting="transfer,wider=2.0"))
    given.append(replace(record("npe", 0, 0.0), status="failed", evaluation=None))
    found = {row.name: row for row in rows(given)}
    assert list(found) == ["truth", "prior", "adr", "adr, wider=2.0"]
    assert found["truth"].percent == (100, (100, 100))
    assert found["adr, wider=2.0"].percent == (100, None)
    assert found["prior"].percent == (25, None)
    assert found["adr"].percent == (55, (50, 60))
    assert found["adr"].by_seed == {0: 50, 1: 60}
    assert found["adr"].paper is not None
    assert found["adr"].paper[0] == pytest.approx(100 * 650 / 1100)
    (one,) = contrasts(list(found.values()))  # others lack a seed of the two
    target = ("HalfCheetahLinks", "in_distribution")
    assert one == Contrast("adr, wider=2.0", "prior", [75.0], {target: [75.0]})
    assert label(given[-2]) == "adr, wider=2.0"
    text = table(rows(given), given)
    assert "| adr | 0.10 |  | 2 | 650.0 ± 50.0 | 55 (50 to 60) | 59 (55 to 64) |" in text
    assert "| adr, wider=2.0 | prior (uniform) | 75.0 | 75.0 |" in text
    assert {t.get_text() for t in curves(given).legends[0].get_texts()} >= {"truth (oracle)", "prior (uniform)", "adr"}
    (panel,) = bars(rows(given)).axes
    assert [t.get_text() for t in panel.get_yticklabels()] == ["prior (uniform)", "adr", "adr, wider=2.0"]
    assert [p.get_width() for p in panel.patches[1:]] == [25, 55, 100]  # behind them the oracle's shade
    assert sorted(x for line in panel.lines if line.get_marker() == "o" for x in line.get_xdata()) == [25, 50, 60, 100]
    points = [replace(r, sd=[0.0, 0.0]) for r in given]
    assert "| adr, wider=2.0 (a point: not widened) |" in table(rows(points), points)
    assert "5 agents" not in text
    assert "7 agents, 0.0 h of CPU, but for 7 that" in text
    assert "The oracle's seeds earn 100, 100, 100 % of their mean." in text


def test_negative_returns_and_a_missing_oracle() -> None:
    """Where returns are negative the paper's percentage means nothing and is left out.

    Without an oracle there is none at all.
    """
    given = [record("truth", 0, -200.0, random=evaluated(-1200.0)), record("adr", 0, -700.0, random=evaluated(-1200.0))]
    found = rows(given)
    assert [(row.percent, row.paper) for row in found] == [((100.0, None), None), ((50.0, None), None)]
    (alone,) = rows([record("adr", 0, 700.0)])
    assert (alone.percent, alone.paper, alone.by_seed) == (None, None, {})
    assert "for the oracle is lacking: run also `--select HalfCheetahLinks/truth`" in table(
        [alone], [record("adr", 0, 700.0)]
    )
    assert "no target has an oracle" in bars([alone]).texts[0].get_text()
    failing = [record("truth", k, earned) for k, earned in enumerate((100.0, 1100.0))]
    assert "for an oracle fails" in table(rows(failing), failing)


def test_contrasts_are_paired_by_seed_over_targets() -> None:
    """The two targets differ far more than the two randomisations."""
    given = []
    for task, level in (("HalfCheetahLinks", 1100.0), ("FetchPush", 300.0)):
        for seed in range(3):
            given += [record("truth", seed, level, task), record("prior", seed, 100 + 0.2 * (level - 100), task)]
            given.append(record("adr", seed, 100 + (0.5 + 0.01 * seed) * (level - 100), task))
    found = rows(given)
    (one,) = contrasts(found)
    assert (one.name, one.other) == ("adr", "prior")
    for gains in (one.gains, *one.by_target.values()):
        np.testing.assert_allclose(gains, [30, 31, 32])
    assert len(one.by_target) == 2
    text = table(found, given)
    assert "| adr | prior (uniform) | 31.0 ± 0.6 better | 31.0 ± 0.6 better | 31.0 ± 0.6 better |" in text
    assert "The 3 tests are not corrected" in text


def test_variations_are_held_against_what_they_vary() -> None:
    """With noise and delay against the prior that has them too; a point of a delayed posterior against that one."""
    names = (
        "truth",
        "prior",
        "prior,action_delay=2",
        "adr",
        "adr,action_delay=2",
        "adr,point=mean,action_delay=2",
        "adr,wider=2.0",
    )
    given = []
    for earned, name in enumerate(names):
        plain, *variations = name.split(",")
        one = record(plain, 0, 1000.0 + earned)
        given.append(replace(one, id=name, setting=",".join([SETTING, *variations])))
    assert [(c.name, c.other) for c in contrasts(rows(given))] == [
        ("prior, action_delay=2", "prior"),
        ("adr", "prior"),
        ("adr, action_delay=2", "prior, action_delay=2"),
        ("adr, action_delay=2", "adr"),
        ("adr, point=mean, action_delay=2", "prior, action_delay=2"),
        ("adr, point=mean, action_delay=2", "adr, action_delay=2"),
        ("adr, wider=2.0", "prior"),
        ("adr, wider=2.0", "adr"),
    ]


def test_whether_better_posteriors_train_better_policies() -> None:
    """Four randomisations in the same order of quality and return have a correlation of one.

    Of 24 orders two are as far from zero (p is within .01 of that, 3.6 sds of its permutations); with a second target
    in the opposite order the mean is zero. The oracle, variations and what is not scored do not count.
    """
    given, crps = [], {}
    for task, sign in (("HalfCheetahLinks", 1), ("FetchPush", -1)):
        for k, name in enumerate(("prior", "adr", "npe", "laplace")):
            one = record(name, 0, 1100.0 - 50 * k, task)
            given.append(one)
            crps[one.id] = 0.2 + 0.1 * sign * k
        oracle = record("truth", 0, 500.0, task)
        given.append(oracle)
        crps[oracle.id] = 0.0
    noisy = replace(record("cem", 0, 2000.0), setting=f"{SETTING},action_delay=2")
    found = by_quality(rows([*given[:5], noisy, record("maml", 0, 3000.0)], {**crps, noisy.id: 0.9}))
    assert found is not None
    assert found[0] == pytest.approx({("HalfCheetahLinks", "in_distribution"): 1.0})
    assert found[1] == pytest.approx(2 / 24, abs=0.01)
    opposed = by_quality(rows(given, crps))
    assert opposed is not None
    assert opposed[1] == 1
    assert "by permutations within the targets) | 0.00 |" in table(rows(given, crps), given)
    assert by_quality(rows(given)) is None


def test_the_studys_figures_tell_every_randomisation_apart() -> None:
    """Each has its own look and one entry of the legend, also the default model, which the first group lacks."""
    given = []
    for cell in select("study"):
        one = record(cell.estimator, cell.seed, 400.0 + 100 * cell.seed + len(cell.estimator), cell.task)
        given.append(replace(one, variant=cell.variant, id=cell.id, setting=cell.id.split("/")[2]))
    found = rows(given)
    names = [n for n in in_order({row.name for row in found}) if n != "truth"]
    assert len(names) == 12
    said = [text.get_text() for text in curves(given).legends[0].get_texts()]
    assert said == ["truth (oracle)", *(WORDS.get(n, n) for n in names)]
    looks = [transfer_figures.look_of(name, names) for name in ["truth", *names]]
    assert len({(look.colour, look.line) for look in looks}) == 13
    for panel in bars(found).axes:
        task, variant = panel.get_title().replace("in distribution", "in_distribution").split(", ")
        there = [row.name for row in found if row.group == (task, variant) and row.name != "truth"]
        assert [text.get_text() for text in panel.get_yticklabels()] == [WORDS.get(n, n) for n in there]


def test_long_names_keep_to_the_figure() -> None:
    """A single panel with three variations at once."""
    long = "wider=2.0,observation_noise=0.01,action_delay=2"
    given = [
        replace(record(name, 0, 500.0), id=f"{name},{v}", setting=",".join([SETTING, *([v] if v else [])]))
        for name in ("truth", "prior", "laplace", "regression")
        for v in (("", long) if name != "truth" else ("",))
    ]
    for figure in (curves(given), bars(rows(given))):
        figure.savefig(io.BytesIO())
        width = figure.bbox.width
        boxes = [t.get_window_extent() for legend in figure.legends for t in legend.get_texts()]
        boxes += [t.get_window_extent() for axes in figure.axes for t in axes.get_yticklabels()]
        assert all(box.x0 >= 0 and box.x1 <= width for box in boxes)
