"""Sim2sim transfer: its cells, killed and resumed runs, and what is refused."""

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
from sipe_bayes.benchmark.measure import netcdf
from sipe_bayes.benchmark.measurement import POLICIES
from sipe_bayes.benchmark.records import Record, file_name, posterior_path, record_path
from sipe_bayes.benchmark.transfer import study as transfer
from sipe_bayes.benchmark.transfer.measure import AGENTS, randomization
from sipe_bayes.benchmark.transfer.status import Sources, summary
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
    for record in TransferRecord.all_in(folder):
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
    monkeypatch.setattr(transfer, "SIZES", transfer.Sizes(demonstrations=3))
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
    """A suite that holds some already; default model and baseline stay what they are, but for noise and delay."""
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
    default, inside = sorted(TransferRecord.all_in(tmp_path), key=lambda r: r.variant)
    assert [point.own_return for point in default.curve] == [point.own_return for point in inside.curve]
    assert default.checksums["randomization"] == inside.checksums["randomization"]
    assert default.earned.mean != inside.earned.mean
    assert inside.cpu_seconds is None
    (folder,) = (tmp_path / POLICIES).iterdir()
    assert folder.name == file_name(default.id)
    assert not (folder / "checkpoint").exists()


def test_records(undisturbed: Path) -> None:
    """The policy is kept by its own randomisation alone; estimates are the benchmark's records."""
    found = {r.estimator: r for r in TransferRecord.all_in(undisturbed)}
    assert set(found) == {"truth", "laplace"}
    for record in found.values():
        assert TransferRecord.read(record_path(undisturbed / "transfer", record.id)) == record
        assert [point.step for point in record.curve] == [200, 400, 600]
        assert record.kept == 600  # the second half's only one; ``rl.train.choose`` is tested by itself
        assert record.earned.episodes == record.earned_at_random.episodes == 50
        assert record.converged is False
        assert not (undisturbed / POLICIES / file_name(record.id) / "checkpoint").exists()
    assert found["truth"].mean == found["truth"].truth
    assert found["truth"].sd == [0.0] * 3
    direct = Record.read(record_path(undisturbed, "Pendulum/laplace/direct/in_distribution/seed0"))
    np.testing.assert_allclose(found["laplace"].mean, direct.mean, atol=4 * max(direct.sd) / np.sqrt(2000) + 1e-12)
    again = measured(undisturbed, *TWO)
    assert again.output.splitlines()[0] == "2 cells, 2 of them there already; 0 estimates to make first"


def test_agents_of_an_estimate_that_was_measured_anew_are_named(undisturbed: Path, tmp_path: Path) -> None:
    for path in (undisturbed / "transfer" / "records", undisturbed / "records"):
        shutil.copytree(path, tmp_path / path.relative_to(undisturbed))
    shutil.copy(undisturbed / "transfer" / "plan.json", tmp_path / "transfer" / "plan.json")
    assert summary(tmp_path).stale == {}
    space = make_task("Pendulum").space
    posterior_path(tmp_path, "Pendulum/laplace/direct/in_distribution/seed0").write_bytes(netcdf(prior(space), 0))
    assert summary(tmp_path).stale == {
        "Pendulum/laplace/transfer/in_distribution/seed0": "its estimate was measured anew"
    }
    assert "its estimate was measured anew" in sipe("status", str(tmp_path)).output
    record_path(tmp_path, "Pendulum/laplace/direct/in_distribution/seed0").unlink()  # as another status advises
    assert summary(tmp_path).stale == {}


def test_status_and_report(undisturbed: Path, tmp_path: Path) -> None:
    found = summary(undisturbed)
    assert (found.cells, found.done, found.failed, found.missing) == (2, 2, {}, [])
    assert "2 cells, 2 done, 0 failed, 0 missing" in sipe("status", str(undisturbed)).output
    made = sipe("report", str(undisturbed), "--out", str(tmp_path))
    assert made.exit_code == 0, made.output
    assert {p.name for p in tmp_path.iterdir()} == {"transfer.md", "transfer.csv", "bars.png", "curves.png"}


def test_killed_twice_and_resumed(undisturbed: Path, tmp_path: Path) -> None:
    """SIGKILL in the middle of each of the two trainings.

    What results is what an undisturbed run gives, to the last bit.
    """
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
    posterior_path(folder, estimate.id).write_bytes(netcdf(posterior, 0))


def test_a_posterior_over_other_parameters_is_refused_by_name(tmp_path: Path) -> None:
    estimated(tmp_path, prior(make_task("CartPole").space))
    done = AGENTS.run(CELL, tmp_path, "")
    assert done.failed
    assert (
        "is a posterior over pole_mass, pole_length, cart_friction, and Pendulum has mass, length, damping" in done.line
    )


def test_a_failed_or_missing_estimate_is_named(tmp_path: Path) -> None:
    assert "no such estimate" in AGENTS.run(CELL, tmp_path, "").line
    estimated(
        tmp_path, prior(make_task("Pendulum").space), status="failed", traceback="Traceback\nArithmeticError: no middle"
    )
    line = AGENTS.run(CELL, tmp_path, "").line
    assert "laplace/direct/in_distribution/seed0 failed (ArithmeticError: no middle)" in line


def test_an_estimate_whose_draws_are_not_there_is_measured_again(undisturbed: Path, tmp_path: Path) -> None:
    """As in a copy of results that leaves the posteriors out."""
    shutil.copytree(undisturbed, tmp_path / "out")
    draws = posterior_path(tmp_path / "out", "Pendulum/laplace/direct/in_distribution/seed0")
    kept = draws.read_bytes()
    draws.unlink()
    assert "0 estimates to make first" in measured(tmp_path / "out", *TWO).output  # nobody asks for them
    record_path(tmp_path / "out" / "transfer", "Pendulum/laplace/transfer/in_distribution/seed0").unlink()
    again = measured(tmp_path / "out", *TWO)
    assert again.exit_code == 0, again.output
    assert "1 estimates to make first" in again.output
    assert draws.read_bytes() == kept
    assert what_counts(tmp_path / "out") == what_counts(undisturbed)


def test_variations_reach_the_training(tmp_path: Path) -> None:
    space = make_task("Pendulum").space
    estimated(tmp_path, Dirac([0.2, 0.3, 0.4], space))
    (cell,) = varied([CELL], wider=2.0, observation_noise=0.1, action_delay=2)
    drawn = randomization(cell, tmp_path)
    assert (drawn.observation_noise, drawn.action_delay) == (0.1, 2)
    np.testing.assert_allclose(drawn.posterior.mean, [0.2, 0.3, 0.4], atol=1e-12)  # a point has nothing to widen
    narrow = Particles(0.4 + 0.05 * np.random.default_rng(0).random((500, 3)), space)
    estimated(tmp_path, narrow)
    whole = randomization(CELL, tmp_path).posterior
    np.testing.assert_allclose(whole.stddev, narrow.stddev, rtol=0.1)
    wide = randomization(cell, tmp_path).posterior
    np.testing.assert_allclose(wide.stddev, 2 * whole.stddev, rtol=0.02)
    point, few = (
        randomization(varied([CELL], **{name: value})[0], tmp_path).posterior
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
    done = AGENTS.run(CELL, tmp_path, "")
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
    first = TransferRecord.all_in(undisturbed)[0]
    replace(first, training=601).write(tmp_path / "transfer")
    refused(measured(tmp_path, *TWO), "with training 601 and not 600", "choose another folder")
    replace(first, agent={**first.agent, "learning_rate": 1e-2}).write(tmp_path / "transfer")
    refused(measured(tmp_path, *TWO), "with agent learning_rate 0.01 and not learning_rate 0.001", "choose another")
    refused(sipe("status", str(tmp_path / "nowhere")), "no transfer was started")
    refused(sipe("report", str(tmp_path / "nowhere")), "holds no transfer")


def test_the_report_scores_what_was_drawn_from(undisturbed: Path) -> None:
    """The truth's CRPS is zero, the estimate's that of the benchmark's cell, whose draws the record keeps.

    Another number of threads does not make a mean stale.
    """
    records = TransferRecord.all_in(undisturbed)
    found = Sources.of(records, undisturbed).crps(records)
    by_name = {r.estimator: found[r.id] for r in records}
    direct = Record.read(record_path(undisturbed, "Pendulum/laplace/direct/in_distribution/seed0"))
    assert by_name["truth"] == 0
    assert by_name["laplace"] == pytest.approx(direct.scored.mean_crps, rel=0.1, abs=1e-9)
    rounded = [replace(r, mean=[m + 1e-13 for m in r.mean], checksums={}) for r in records]
    assert Sources.of(rounded, undisturbed).stale == {}


def test_the_example_runs(tmp_path: Path) -> None:
    """In small: log, posterior, agents under five randomisations, returns in the target, a picture."""
    example = Path(__file__).parents[2] / "examples" / "transfer" / "transfer.py"
    command = [sys.executable, str(example), "--seeds", "1", "--steps", "600", "--out", str(tmp_path)]
    subprocess.run(command, check=True, capture_output=True, timeout=300)
    found = json.loads((tmp_path / "transfer.json").read_text(encoding="utf-8"))
    assert [agent["name"] for agent in found["agents"]] == ["truth", "posterior", "point", "prior", "model as it is"]
    assert all(-2500 < agent["return"] < 0 and len(agent["curve"]) > 3 for agent in found["agents"])
    assert (tmp_path / "transfer.png").read_bytes().startswith(b"\x89PNG")
