"""Records and runs: measured once, killed and resumed, and what a folder's status says."""

import json
import random
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from sipe_bayes.benchmark import bank, measure, measurement, records, run_log
from sipe_bayes.benchmark.cells import Cell
from sipe_bayes.benchmark.log import recorded
from sipe_bayes.benchmark.measure import ESTIMATES
from sipe_bayes.benchmark.records import Look, Record, posterior_path, record_path
from sipe_bayes.benchmark.report_contents import contents
from sipe_bayes.benchmark.status import summary
from sipe_bayes.inference.registry import ESTIMATORS
from tests.problems.benchmarks import PENDULUM, PENDULUM_BANK, SMALL, measured, refused, sipe, what_counts


def test_records_round_trip_and_name_what_is_wrong(undisturbed: Path, tmp_path: Path) -> None:
    found = Record.all_in(undisturbed)
    assert len(found) == 6
    for record in found:
        assert Record.read(record.write(tmp_path)) == record
        assert record.done
        assert len(record.mean) == len(record.names) == len(record.determined or ())
        assert record.history[-1].mean_accuracy == record.scored.mean_accuracy
        assert record.versions["mujoco"]
        assert set(record.checksums) == {"model", "log", "source"}
    (tmp_path / "records" / "bad.json").write_text('{"id": "x", "budgets": 3}')
    with pytest.raises(records.RecordError, match=r"bad\.json: cannot be read as a record \(unknown entry 'budgets'\)"):
        Record.all_in(tmp_path)
    with pytest.raises(records.RecordError, match="holds no records"):
        Record.all_in(tmp_path / "nowhere")


def test_searches_have_a_history(tmp_path: Path) -> None:
    """Looks at a tenth, a quarter and half of the budget, which change nothing; then the result."""
    cell = replace(Cell("Pendulum", "adr"), budget=60, steps=20)
    looked_at, alone = ESTIMATES.run(cell, tmp_path, ""), _without_looks(cell, tmp_path)
    history, plain = (json.loads(done.files[1][1])["history"] for done in (looked_at, alone))
    assert [row["rollouts"] for row in history] == [10, 20, 30, 60]
    assert plain == history[-1:]
    assert looked_at.files[0] == alone.files[0]


def test_looks_are_written_as_csv_and_for_tensorboard(undisturbed: Path, tmp_path: Path) -> None:
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    looks = (Look(10, 0.5, 0.25), Look(20, 0.75, None))
    records = [replace(record, history=list(looks[: k + 1])) for k, record in enumerate(Record.all_in(undisturbed)[:2])]
    for record in records:
        record.write(tmp_path)
    for _ in range(2):
        table, logs = run_log.write_looks(tmp_path)
    head, *rows = (line.split(",") for line in table.read_text().splitlines())
    assert head[-3:] == ["rollouts", "mean_accuracy", "mean_crps"]
    assert [row[0] for row in rows] == [records[0].id, records[1].id, records[1].id]
    assert [row[-3:] for row in rows] == [["10", "0.5", "0.25"], ["10", "0.5", "0.25"], ["20", "0.75", ""]]
    (second,) = (path for path in logs.iterdir() if path.name == records[1].id.replace("/", "__"))
    events = EventAccumulator(str(second))
    events.Reload()
    named = [tag for tag in events.Tags()["scalars"] if tag.endswith("/mean_accuracy")]
    assert [(e.step, e.value) for e in events.Scalars(named[0])] == [(10, 0.5), (20, 0.75)]


def _without_looks(cell: Cell, folder: Path) -> Any:
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(measure, "SHARES", measure.Shares(looks=()))
        return ESTIMATES.run(cell, folder, "")


def test_estimate_is_that_of_fit(undisturbed: Path) -> None:
    import sipe_bayes as sipe_package

    log = recorded("Pendulum", "in_distribution", 0, 20)
    simulator = sipe_package.Simulator(sipe_package.make_task("Pendulum"), num_threads=1)
    for name in ("simopt", "regression"):
        posterior = sipe_package.get_estimator(simulator, name, budget=60, seed=0).fit(log.trajectories)
        (record,) = [r for r in Record.all_in(undisturbed) if r.estimator == name and r.seed == 0]
        assert record.mean == posterior.mean.tolist()


def test_finished_cells_never_run_again(undisturbed: Path) -> None:
    before = {p: (p.stat().st_mtime_ns, p.read_bytes()) for p in (undisturbed / "records").iterdir()}
    found = measured(undisturbed, *PENDULUM)
    there, looks = found.output.splitlines()
    assert there == "6 cells, 6 of them there already"
    assert (
        looks
        == f"how the estimates went: {undisturbed / 'looks.csv'}; tensorboard --logdir {undisturbed / 'tensorboard'}"
    )
    assert {p: (p.stat().st_mtime_ns, p.read_bytes()) for p in (undisturbed / "records").iterdir()} == before


def test_status(undisturbed: Path) -> None:
    found = summary(undisturbed)
    assert (found.cells, found.done, found.failed, found.missing) == (6, 6, {}, [])
    (took,) = found.runs
    assert run_log.Usage.of([took]).cpu_use == took.cpu_seconds / took.seconds > 0
    assert took.units == 7
    assert "6 cells, 6 done, 0 failed, 0 missing" in found.lines()[0]
    (cpu,) = [line for line in found.lines() if line.startswith("CPU time of these cells")]
    seconds = sum(record.cpu_seconds or 0 for record in Record.all_in(undisturbed))
    assert f"{run_log.duration(seconds)} for the methods (direct {run_log.duration(seconds)})" in cpu
    two = [replace(took, seconds=1800.0, cpu_seconds=3600.0), replace(took, seconds=5400.0, cpu_seconds=900.0)]
    twice = replace(found, runs=two, suites={}, all=run_log.Usage.of(two))
    assert twice.lines()[-1].startswith("all runs: 2.0 h, 1.2 h of CPU")
    many = [replace(took, command=f"run {k}") for k in range(5)]
    shown = replace(found, runs=many, suites={}, all=run_log.Usage.of(many)).lines()
    assert [line.rsplit(": ", 1)[1] for line in shown if "CPU use" in line and "run" in line][:3] == [
        "run 2",
        "run 3",
        "run 4",
    ]
    assert "and 2 runs before; --json has them all" in shown
    plain = json.loads(sipe("benchmark", "status", str(undisturbed), "--json").output)
    assert plain["done"] == 6
    assert plain["runs"][0]["cpu_use"] == took.cpu_seconds / took.seconds


def test_status_finds_cells_that_do_not_compare(undisturbed: Path, tmp_path: Path) -> None:
    """An agent that is trained anew gives other logs."""
    found = Record.all_in(undisturbed)
    for record in found:
        changed = {**record.checksums, "log": "other"} if record.estimator == "prior" else record.checksums
        replace(record, checksums=changed).write(tmp_path)
    records.plan(tmp_path, [record.id for record in found])
    assert summary(undisturbed).mixed == []
    assert summary(tmp_path).mixed == ["Pendulum/in_distribution/seed0"]


def test_killed_at_three_moments_and_resumed(undisturbed: Path, tmp_path: Path) -> None:
    """SIGKILL at random moments: with its plan there, when it simulates, after the first and the third record."""
    out, rng = tmp_path / "out", random.Random(6)
    command = [sys.executable, "-m", "sipe_bayes.cli.app", "benchmark", "run", *SMALL, *PENDULUM, "--out", str(out)]
    seen: dict[Path, int] = {}
    for least in (0, 1, 3):
        process = subprocess.Popen([*command, "--jobs", "1"], stdout=subprocess.DEVNULL)
        until = time.monotonic() + 300

        def begun(least: int = least) -> bool:
            return (out / records.PLAN).exists() and len(list(out.glob("records/P*.json"))) >= least

        while not begun() and time.monotonic() < until and process.poll() is None:
            time.sleep(0.01)
        time.sleep(rng.uniform(0, 0.3))
        process.send_signal(signal.SIGKILL)
        assert process.wait() == -signal.SIGKILL
        for path, written in seen.items():
            assert path.stat().st_mtime_ns == written, f"{path} was written twice"
        seen = {path: path.stat().st_mtime_ns for path in out.glob("records/P*.json")}
        assert all(Record.read(path).done for path in seen)
    assert 3 <= len(seen) < 6
    found = measured(out, *PENDULUM)
    assert found.exit_code == 0, found.output
    assert what_counts(out) == what_counts(undisturbed)
    assert all(path.stat().st_mtime_ns == written for path, written in seen.items())
    assert records.planned(out) == records.planned(undisturbed)
    assert bank.verify(PENDULUM_BANK, 60, out) == []
    assert 2 <= len(run_log.read_runs(out)) <= 4  # of those that wrote something


MIDDLE = '''"""A toy: the answer is the middle, whatever was recorded."""
from dataclasses import dataclass
import numpy as np
from sipe_bayes.inference.base import Estimator
from sipe_bayes.posterior import Dirac

@dataclass(frozen=True)
class Ended:
    done: bool

class Middle(Estimator[Ended]):
    """The middle; seed 1 fails."""
    name = "middle"
    state_type = Ended

    def start(self, trajectories):
        return Ended(False)

    def step(self, state, trajectories):
        if self.seed == 1:
            raise ArithmeticError("no middle")
        return Ended(True)

    def posterior(self, state, trajectories):
        return Dirac(np.full(len(self.space), 0.5), self.space)
'''


@pytest.fixture
def toy(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> None:
    """One file and one registry line."""
    folder = tmp_path_factory.mktemp("toy")
    (folder / "middle.py").write_text(MIDDLE)
    monkeypatch.syspath_prepend(str(folder))
    monkeypatch.setitem(ESTIMATORS, "middle", ("middle", "Middle"))


@pytest.mark.usefixtures("toy")
def test_new_estimator_takes_one_line_and_failures_are_recorded(tmp_path: Path) -> None:
    """Found in the CLI, the tables and the plots.

    Seed 1 fails; the others go on; it runs again when it is asked for, and then only it.
    """
    assert "Pendulum/middle/direct/default/seed2" in sipe("benchmark", "cells", "all").output.splitlines()
    chosen = ["--select", "pendulum/middle/direct/in_distribution"]
    found = measured(tmp_path, *chosen)
    assert found.exit_code == 1
    assert "1 cell failed" in found.stderr
    assert "seed1 failed: ArithmeticError: no middle" in found.stdout
    status = {r.seed: r.status for r in Record.all_in(tmp_path)}
    assert status == {0: "done", 1: "failed", 2: "done"}
    failed = Record.read(record_path(tmp_path, "Pendulum/middle/direct/in_distribution/seed1"))
    assert "in step" in (failed.traceback or "")
    assert not posterior_path(tmp_path, failed.id).exists()
    assert (
        "failed: Pendulum/middle/direct/in_distribution/seed1: ArithmeticError: no middle" in summary(tmp_path).lines()
    )
    before = measured(tmp_path, *chosen)
    assert (before.exit_code, before.stdout.splitlines()[0]) == (1, "3 cells, 3 of them there already, 1 failed")
    again = measured(tmp_path, *chosen, "--retry-failed")
    assert (again.exit_code, again.stdout.splitlines()[0]) == (1, "3 cells, 2 of them there already")
    assert "--retry-failed" in again.stderr
    assert measured(tmp_path, "--select", "pendulum/prior_mean/direct/in_distribution").exit_code == 0
    section = next(part for part in contents(tmp_path).sections if part.anchor == "direct-in_distribution")
    assert section.tables
    for table in section.tables:
        found_there, known = table.entry("middle", "Pendulum"), table.entry("prior_mean", "Pendulum")
        assert found_there is not None
        assert known is not None
        assert table.measure.name == "CPU seconds" or found_there.mean == pytest.approx(known.mean, rel=1e-12)
    legend = section.pictures[0].figure.legends[0].get_texts()
    assert [text.get_text() for text in legend] == ["middle", "prior mean"]


def test_policy_cell(tmp_path: Path) -> None:
    """Its checkpoint goes when the record is there; the policy stays."""
    found = measured(tmp_path, "--select", "pendulum/simopt/policy/*/seed0", "--training", "9000")
    assert found.exit_code == 0, found.output
    (record,) = Record.all_in(tmp_path)
    assert record.converged in (True, False)
    assert record.log == "policy"
    assert record.history[-1] == Look(record.rollouts, record.scored.mean_accuracy, record.scored.mean_crps)
    assert 0 < record.rollouts <= 60
    (folder,) = (tmp_path / measurement.POLICIES).iterdir()
    assert (folder / "policy.safetensors").exists()
    assert not (folder / "checkpoint").exists()
    refused(
        measured(tmp_path, "--select", "pendulum/simopt/policy/*/seed0", "--training", "9001"),
        "with training 9000 and not 9001",
        "choose another folder",
    )


def test_out_of_distribution(tmp_path: Path) -> None:
    assert measured(tmp_path, "--select", "pendulum/prior/direct/out_of_distribution/seed0").exit_code == 0
    (record,) = Record.all_in(tmp_path)
    assert record.determined is None
    assert all(x is False for x in record.scored.noticed)
