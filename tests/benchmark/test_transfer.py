"""Sim2sim transfer: its cells, killed and resumed runs, what is refused, and what the report makes of returns."""

import io
import json
import random
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner, Result

import sipe_bayes as sipe_package
from sipe_bayes.benchmark.cells import Cell
from sipe_bayes.benchmark.measure import POLICIES, _netcdf
from sipe_bayes.benchmark.records import Record, file_name, posterior_path, record_path
from sipe_bayes.benchmark.transfer import figures as transfer_figures
from sipe_bayes.benchmark.transfer import measure as transfer_measure
from sipe_bayes.benchmark.transfer import study as transfer
from sipe_bayes.benchmark.transfer.figures import bars, curves
from sipe_bayes.benchmark.transfer.report import table
from sipe_bayes.benchmark.transfer.rows import WORDS, Contrast, by_quality, contrasts, in_order, label, relative, rows
from sipe_bayes.benchmark.transfer.run import believed, load, qualities, stale, summary
from sipe_bayes.benchmark.transfer.study import (
    SETTING,
    SUITES,
    TransferRecord,
    demonstrations_of,
    estimate_of,
    select,
    settings,
    trained_as,
    varied,
)
from sipe_bayes.cli.app import app
from sipe_bayes.envs.registry import TASKS, make_task
from sipe_bayes.posterior import Dirac, Particles, Posterior, prior
from sipe_bayes.simulation.simulator import Simulator

SMALL = ["--suite", "quick", "--training", "600", "--budget", "60", "--steps", "20"]
TWO = ["--select", "pendulum/truth", "--select", "pendulum/laplace"]
TIMES = ("seconds", "cpu_seconds", "command")
CELL = Cell("Pendulum", "laplace", SETTING, "in_distribution", 0, budget=60, steps=20, training=600)


def sipe(*arguments: str) -> Result:
    return CliRunner().invoke(app, ["transfer", *arguments])


def measured(folder: Path, *arguments: str) -> Result:
    return sipe("run", *SMALL, *arguments, "--executor", "inline", "--out", str(folder))


def what_counts(folder: Path) -> dict[str, Any]:
    """Records without what they took, and the bytes of the agents."""
    found: dict[str, Any] = {}
    for record in load(folder):
        plain = {k: v for k, v in asdict(record).items() if k not in TIMES}
        agents = sorted((folder / POLICIES / file_name(record.id)).rglob("*.safetensors"))
        found[record.id] = plain, {path.name: path.read_bytes() for path in agents}
    return found


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("transfer") / "out"
    found = measured(folder, *TWO)
    assert found.exit_code == 0, found.output
    return folder


# Cells


def test_cells() -> None:
    study = select("study")
    assert len({cell.id for cell in study}) == len(study)
    assert {c.estimator for c in study} == {
        *("truth", "prior", "default", "regression", "bayesopt", "maml", "simopt", "adr", "bayessim", "npe", "laplace")
    }
    assert {c.variant for c in study} == {"default", "in_distribution"}
    assert {c.seed for c in study} == {0, 1, 2}
    assert min(c.training for c in study) >= 150_000
    assert not [c for c in study if (c.estimator, c.variant) == ("default", "default")]
    assert {(c.estimator, c.values) for c in study if c.values} == {
        *(("bayessim", (("point", "mean"),)), ("bayessim", (("particles", 10),)))
    }
    assert set(SUITES) == {"quick", "study", "nine", "all"}
    assert {c.task for c in select("all")} == set(TASKS)


def test_the_estimates_are_the_benchmarks() -> None:
    assert estimate_of(CELL) == replace(Cell("Pendulum", "laplace"), budget=60, steps=20)
    assert estimate_of(replace(CELL, estimator="truth")) is None


@pytest.mark.parametrize("task", list(TASKS))
def test_every_task_has_an_agent_that_learns_within_its_training(task: str) -> None:
    """Half of a training at least is learnt from, in a buffer that holds all of it."""
    for training in (400, 20_000, 150_000):
        chosen = settings(make_task(task), training)
        assert chosen.start_steps <= training / 2
        assert chosen.capacity // chosen.lanes > make_task(task).episode_steps
        assert chosen.capacity >= training


@pytest.mark.parametrize("task", ["FetchPush", "FetchPickAndPlace"])
def test_what_an_agent_is_shown_is_from_where_it_trains(task: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """At each variant's truth, and over the prior, scripts succeed often enough."""
    monkeypatch.setattr(transfer, "_DEMONSTRATIONS", 3)
    made = make_task(task)
    simulator = Simulator(made, 1)
    truths = [Dirac(made.theta(variant), made.space) for variant in ("default", "in_distribution")]
    shown = [demonstrations_of(replace(CELL, task=task), simulator, p) for p in (*truths, prior(made.space))]
    assert [None if found is None else len(found) for found in shown] == [3, 3, 3]
    assert shown[0] is not None
    assert shown[1] is not None
    assert not np.array_equal(shown[0].states, shown[1].states)
    assert settings(made, 150_000).demonstrated


@pytest.mark.parametrize("task", ["FetchSlide", "Pendulum", "HalfCheetahLinks"])
def test_nothing_is_shown_where_no_script_fits(task: str) -> None:
    made = make_task(task)
    assert demonstrations_of(replace(CELL, task=task), Simulator(made, 1), prior(made.space)) is None
    assert not settings(made, 150_000).demonstrated


def test_variations_are_in_the_id_and_not_of_the_truth() -> None:
    first, second = varied([replace(CELL, estimator="truth"), CELL], wider=2.0, action_delay=1, observation_noise=None)
    assert first.id == "Pendulum/truth/transfer/in_distribution/seed0"
    assert second.id == "Pendulum/laplace/transfer,wider=2.0,action_delay=1/in_distribution/seed0"
    assert estimate_of(second) == estimate_of(CELL)


def test_variations_come_once() -> None:
    """A suite that holds some already; the default model and the baseline stay what they are, but for noise and delay."""
    points = varied(select("study", ["fetch_push/*/transfer*/in_distribution/seed0"]), point="mean")
    ids = [cell.id for cell in points]
    assert len(set(ids)) == len(ids)
    assert [i for i in ids if "bayessim" in i] == ["FetchPush/bayessim/transfer,point=mean/in_distribution/seed0"]
    for name in ("default", "prior"):
        (reference,) = varied([replace(CELL, estimator=name)], wider=2.0, point="mean", action_delay=1)
        assert reference.values == (("action_delay", 1),)
    (fewer,) = varied(varied([CELL], particles=10), particles=5)
    assert fewer.values == (("particles", 5),)


def test_cells_that_ask_for_the_same_training() -> None:
    """The prior has no variant, and the default model is the truth of its own."""
    study = select("study")
    twins = {cell.id: trained_as(cell).id for cell in study if trained_as(cell) != cell}
    assert len(twins) == 2 * 3 * 3
    assert twins["FetchPush/prior/transfer/in_distribution/seed1"] == "FetchPush/prior/transfer/default/seed1"
    assert twins["FetchPush/default/transfer/in_distribution/seed1"] == "FetchPush/truth/transfer/default/seed1"


# Runs


def test_the_same_training_is_made_once(tmp_path: Path) -> None:
    """Two targets, one agent of the prior: it is trained for the first and read for the second."""
    chosen = ["--suite", "all", "--select", "pendulum/prior/transfer/*/seed0"]
    arguments = [*chosen, *SMALL[2:], "--executor", "inline", "--out", str(tmp_path)]
    found = sipe("run", *arguments)
    assert found.exit_code == 0, found.output
    default, inside = sorted(load(tmp_path), key=lambda r: r.variant)
    assert [row["own_return"] for row in default.curve] == [row["own_return"] for row in inside.curve]
    assert default.checksums["randomization"] == inside.checksums["randomization"]
    assert default.evaluation["mean"] != inside.evaluation["mean"]
    assert inside.cpu_seconds is None
    (folder,) = (tmp_path / POLICIES).iterdir()
    assert folder.name == file_name(default.id)
    assert not (folder / "checkpoint").exists()


def test_records(undisturbed: Path) -> None:
    """The policy is kept by its own randomisation alone; estimates are the benchmark's records."""
    found = {r.estimator: r for r in load(undisturbed)}
    assert set(found) == {"truth", "laplace"}
    for record in found.values():
        assert TransferRecord.read(record_path(undisturbed / "transfer", record.id)) == record
        assert [row["step"] for row in record.curve] == [200, 400, 600]
        assert record.kept == 600  # the second half's only one; ``rl.train.choose`` is tested by itself
        assert record.evaluation["episodes"] == record.random["episodes"] == 50
        assert record.converged is False
        assert not (undisturbed / POLICIES / file_name(record.id) / "checkpoint").exists()
    assert found["truth"].mean == found["truth"].truth
    assert found["truth"].sd == [0.0] * 3
    direct = Record.read(record_path(undisturbed, "Pendulum/laplace/direct/in_distribution/seed0"))
    np.testing.assert_allclose(found["laplace"].mean, direct.mean, atol=4 * max(direct.sd) / np.sqrt(2000) + 1e-12)
    again = measured(undisturbed, *TWO)
    assert again.output == "2 cells, 2 of them there already; 0 estimates to make first\n"


def test_agents_of_an_estimate_that_was_measured_anew_are_named(undisturbed: Path, tmp_path: Path) -> None:
    for path in (undisturbed / "transfer" / "records", undisturbed / "records"):
        shutil.copytree(path, tmp_path / path.relative_to(undisturbed))
    shutil.copy(undisturbed / "transfer" / "plan.json", tmp_path / "transfer" / "plan.json")
    assert summary(tmp_path)["stale"] == {}
    space = make_task("Pendulum").space
    posterior_path(tmp_path, "Pendulum/laplace/direct/in_distribution/seed0").write_bytes(_netcdf(prior(space), 0))
    assert summary(tmp_path)["stale"] == {
        "Pendulum/laplace/transfer/in_distribution/seed0": "its estimate was measured anew"
    }
    assert "its estimate was measured anew" in sipe("status", str(tmp_path)).output
    record_path(tmp_path, "Pendulum/laplace/direct/in_distribution/seed0").unlink()  # as another status advises
    assert summary(tmp_path)["stale"] == {}


def test_status_and_report(undisturbed: Path, tmp_path: Path) -> None:
    found = summary(undisturbed)
    assert (found["cells"], found["done"], found["failed"], found["missing"]) == (2, 2, {}, [])
    assert "2 cells, 2 done, 0 failed, 0 missing" in sipe("status", str(undisturbed)).output
    made = sipe("report", str(undisturbed), "--out", str(tmp_path))
    assert made.exit_code == 0, made.output
    assert {p.name for p in tmp_path.iterdir()} == {"transfer.md", "transfer.csv", "bars.png", "curves.png"}


def test_killed_twice_and_resumed(undisturbed: Path, tmp_path: Path) -> None:
    """SIGKILL in the middle of each of the two trainings; what results is what an undisturbed run gives, to the last bit."""
    out, rng = tmp_path / "out", random.Random(7)
    command = [
        sys.executable,
        "-m",
        "sipe_bayes.cli.app",
        "transfer",
        "run",
        *SMALL,
        *TWO,
        "--executor",
        "inline",
        "--out",
        str(out),
    ]
    for done in (0, 1):
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL)
        until = time.monotonic() + 120
        while process.poll() is None and time.monotonic() < until:
            if len(list(out.glob("policies/*/checkpoint/state.safetensors"))) and _records(out) == done:
                break
            time.sleep(0.01)
        time.sleep(rng.uniform(0, 0.2))
        process.send_signal(signal.SIGKILL)
        assert process.wait() == -signal.SIGKILL
        assert _records(out) == done
    assert measured(out, *TWO).exit_code == 0
    assert what_counts(out) == what_counts(undisturbed)


def _records(out: Path) -> int:
    return len(list(out.glob("transfer/records/P*.json")))


# What is refused


def estimated(folder: Path, posterior: Posterior, **changes: Any) -> None:
    """The record of CELL's estimate."""
    estimate = estimate_of(CELL)
    assert estimate is not None
    plain = (estimate.id, estimate.task, estimate.estimator, estimate.setting, estimate.variant, estimate.seed)
    Record(*plain, budget=60, steps=20, **{"status": "done", **changes}).write(folder)
    posterior_path(folder, estimate.id).write_bytes(_netcdf(posterior, 0))


def test_a_posterior_over_other_parameters_is_refused_by_name(tmp_path: Path) -> None:
    estimated(tmp_path, prior(make_task("CartPole").space))
    done = transfer_measure.run(CELL, tmp_path, "")
    assert done.failed
    assert (
        "is a posterior over pole_mass, pole_length, cart_friction, and Pendulum has mass, length, damping" in done.line
    )


def test_a_failed_or_missing_estimate_is_named(tmp_path: Path) -> None:
    assert "no such estimate" in transfer_measure.run(CELL, tmp_path, "").line
    estimated(
        tmp_path, prior(make_task("Pendulum").space), status="failed", traceback="Traceback\nArithmeticError: no middle"
    )
    line = transfer_measure.run(CELL, tmp_path, "").line
    assert "laplace/direct/in_distribution/seed0 failed (ArithmeticError: no middle)" in line


def test_variations_reach_the_training(tmp_path: Path) -> None:
    space = make_task("Pendulum").space
    estimated(tmp_path, Dirac([0.2, 0.3, 0.4], space))
    (cell,) = varied([CELL], wider=2.0, observation_noise=0.1, action_delay=2)
    drawn = transfer_measure.randomization(cell, tmp_path)
    assert (drawn.observation_noise, drawn.action_delay) == (0.1, 2)
    np.testing.assert_allclose(drawn.posterior.mean, [0.2, 0.3, 0.4], atol=1e-12)  # a point has nothing to widen
    narrow = Particles(0.4 + 0.05 * np.random.default_rng(0).random((500, 3)), space)
    estimated(tmp_path, narrow)
    whole = transfer_measure.randomization(CELL, tmp_path).posterior
    np.testing.assert_allclose(whole.stddev, narrow.stddev, rtol=0.1)
    wide = transfer_measure.randomization(cell, tmp_path).posterior
    np.testing.assert_allclose(wide.stddev, 2 * whole.stddev, rtol=0.02)
    point, few = (
        transfer_measure.randomization(varied([CELL], **{name: value})[0], tmp_path).posterior
        for name, value in (("point", "mean"), ("particles", 10))
    )
    np.testing.assert_allclose(point.sample((3,)), np.tile(whole.mean, (3, 1)))
    drawn = few.sample((200,))
    assert len(np.unique(drawn, axis=0)) == 10
    assert np.all((drawn.numpy() >= 0.4) & (drawn.numpy() <= 0.45))


def test_draws_outside_the_bounds_are_refused_by_name(tmp_path: Path) -> None:
    """They come from an estimate within other bounds; at the bound they would pile up."""
    space = make_task("Pendulum").space
    wider = sipe_package.ParameterSpace([replace(p, high=2 * p.high) if p.name == "length" else p for p in space])
    estimated(tmp_path, Dirac([0.5, 0.9, 0.5], wider))
    done = transfer_measure.run(CELL, tmp_path, "")
    assert done.failed
    assert "draws of length outside the bounds that Pendulum has now" in done.line


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--suite", "studies"], ["--suite studies", "quick, study, nine, all"]),
        (["--select", "pendulum/truht"], ["pendulum/truht", "sipe transfer cells quick"]),
        (["--training", "0"], ["--training 0"]),
        (["--point", "--particles", "3"], ["--particles 3", "does not go with --point"]),
        (["--wider", "0.5"], ["--wider 0.5", "at least 1"]),
        (["--observation-noise", "-1"], ["--observation-noise -1"]),
        (["--executor", "slurm"], ["pool, ray or inline"]),
        (["--out", "/dev/null"], ["is a file"]),
    ],
)
def test_bad_input_is_one_line(arguments: list[str], words: list[str], tmp_path: Path) -> None:
    given = ["--suite", "quick"] if "--suite" not in arguments else []
    out = ["--out", str(tmp_path)] if "--out" not in arguments else []
    refused(sipe("run", *given, *arguments, *out), *words)


def refused(found: Result, *words: str) -> None:
    assert found.exit_code == 2, found.output
    assert found.stderr.count("\n") == 1, found.stderr
    for word in words:
        assert word in found.stderr


def test_results_of_another_kind_are_left_alone(undisturbed: Path, tmp_path: Path) -> None:
    """Trained for longer, and by an agent that learns faster."""
    first = load(undisturbed)[0]
    replace(first, training=601).write(tmp_path / "transfer")
    refused(measured(tmp_path, *TWO), "with training 601 and not 600", "choose another folder")
    replace(first, agent={**first.agent, "learning_rate": 1e-2}).write(tmp_path / "transfer")
    refused(measured(tmp_path, *TWO), "with agent learning_rate 0.01 and not learning_rate 0.001", "choose another")
    refused(sipe("status", str(tmp_path / "nowhere")), "no transfer was started")
    refused(sipe("report", str(tmp_path / "nowhere")), "holds no transfer")


# What the report makes of returns


def record(name: str, seed: int, earned: float, task: str = "HalfCheetahLinks", **changes: Any) -> TransferRecord:
    cell = Cell(task, name, SETTING, "in_distribution", seed)
    plain = (cell.id, task, name, SETTING, "in_distribution", seed)
    evaluation = {"episodes": 50, "mean": earned, "sd": 1.0, "success_rate": None}
    curve = [{"step": s, "own_return": 0.0, "target_return": earned * s, "target_success": None} for s in (1, 2)]
    more: dict[str, Any] = {
        "evaluation": evaluation,
        "random": {"mean": 100.0},
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
    given.append(replace(record("npe", 0, 0.0), status="failed", evaluation={}))
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
    """Where returns are negative the paper's percentage means nothing and is left out; without an oracle there is none at all."""
    given = [record("truth", 0, -200.0, random={"mean": -1200.0}), record("adr", 0, -700.0, random={"mean": -1200.0})]
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
    """With noise and delay against the prior that has them, too; a point of a delayed posterior against that posterior."""
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
    """Four randomisations in the same order of quality and return have a correlation of one, and of 24 orders two are as far from zero
    (p is within .01 of that, 3.6 sds of its permutations); with a second target in the opposite order the mean is zero. The oracle,
    variations and what is not scored do not count."""
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


def test_the_report_scores_what_was_drawn_from(undisturbed: Path) -> None:
    """The truth's CRPS is zero, the estimate's that of the benchmark's cell, whose draws the record keeps; another number of threads
    does not make a mean stale."""
    records = load(undisturbed)
    found = qualities(records, believed(records, undisturbed))
    by_name = {r.estimator: found[r.id] for r in records}
    direct = Record.read(record_path(undisturbed, "Pendulum/laplace/direct/in_distribution/seed0"))
    assert by_name["truth"] == 0
    assert by_name["laplace"] == pytest.approx(float(np.mean(direct.scores["crps"])), rel=0.1, abs=1e-9)
    rounded = [replace(r, mean=[m + 1e-13 for m in r.mean], checksums={}) for r in records]
    assert stale(believed(rounded, undisturbed)) == {}


def test_the_studys_figures_tell_every_randomisation_apart() -> None:
    """Each has its own look and one entry of the legend, also the default model, which the first group lacks."""
    given = [replace(record(c.estimator, c.seed, 400.0 + 100 * c.seed + len(c.estimator), c.task), variant=c.variant, id=c.id, setting=c.id.split("/")[2])
             for c in select("study")]  # fmt: skip
    found = rows(given)
    names = [n for n in in_order({row.name for row in found}) if n != "truth"]
    assert len(names) == 12
    said = [text.get_text() for text in curves(given).legends[0].get_texts()]
    assert said == ["truth (oracle)", *(WORDS.get(n, n) for n in names)]
    looks = [transfer_figures._look(name, names) for name in ["truth", *names]]
    assert len({(look.colour, look.line) for look in looks}) == 13
    for panel in bars(found).axes:
        task, variant = panel.get_title().replace("in distribution", "in_distribution").split(", ")
        there = [row.name for row in found if row.group == (task, variant) and row.name != "truth"]
        assert [text.get_text() for text in panel.get_yticklabels()] == [WORDS.get(n, n) for n in there]


def test_long_names_keep_to_the_figure() -> None:
    """A single panel with three variations at once."""
    long = "wider=2.0,observation_noise=0.01,action_delay=2"
    given = [replace(record(name, 0, 500.0), id=f"{name},{v}", setting=",".join([SETTING, *([v] if v else [])]))
             for name in ("truth", "prior", "laplace", "regression") for v in (("", long) if name != "truth" else ("",))]  # fmt: skip
    for figure in (curves(given), bars(rows(given))):
        figure.savefig(io.BytesIO())
        width = figure.bbox.width
        boxes = [t.get_window_extent() for legend in figure.legends for t in legend.get_texts()]
        boxes += [t.get_window_extent() for axes in figure.axes for t in axes.get_yticklabels()]
        assert all(box.x0 >= 0 and box.x1 <= width for box in boxes)


def test_the_example_runs(tmp_path: Path) -> None:
    """In small: log, posterior, agents under five randomisations, returns in the target, a picture."""
    example = Path(__file__).parents[2] / "examples" / "transfer" / "transfer.py"
    command = [sys.executable, str(example), "--seeds", "1", "--steps", "600", "--out", str(tmp_path)]
    subprocess.run(command, check=True, capture_output=True, timeout=300)
    found = json.loads((tmp_path / "transfer.json").read_text(encoding="utf-8"))
    assert [agent["name"] for agent in found["agents"]] == ["truth", "posterior", "point", "prior", "model as it is"]
    assert all(-2500 < agent["return"] < 0 and len(agent["curve"]) > 3 for agent in found["agents"])
    assert (tmp_path / "transfer.png").read_bytes().startswith(b"\x89PNG")
