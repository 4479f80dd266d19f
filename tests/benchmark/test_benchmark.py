"""The benchmark: what its cells are, and that a run may be killed, resumed, refused, and adds to nothing but its folder."""

import errno
import json
import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner, Result

from sipe_bayes.benchmark import bank, cells, measure, measurement, records, run, run_log
from sipe_bayes.benchmark.bank import Bank
from sipe_bayes.benchmark.cells import NINE, SUITES, Cell, matches, select, suite
from sipe_bayes.benchmark.executors.pool import Inline
from sipe_bayes.benchmark.log import recorded
from sipe_bayes.benchmark.measure import ESTIMATES
from sipe_bayes.benchmark.records import Look, Record, posterior_path, record_path
from sipe_bayes.benchmark.report_contents import contents
from sipe_bayes.benchmark.status import summary
from sipe_bayes.cli.app import app
from sipe_bayes.core import files
from sipe_bayes.inference.amortised.prior_sampling import PriorSampling
from sipe_bayes.inference.registry import ESTIMATORS, estimator_class
from tests.problems.benchmarks import TIMES, what_counts

SMALL = ["--suite", "all", "--budget", "60", "--steps", "20"]
PENDULUM = [  # six cells, two of which share simulations
    *("--select", "pendulum/prior*/direct/in_distribution/seed0"),
    *("--select", "pendulum/simopt/direct/in_distribution"),
    *("--select", "pendulum/regression/direct/in_distribution/seed0"),
]


def sipe(*arguments: str) -> Result:
    return CliRunner().invoke(app, list(arguments))


def measured(folder: Path, *arguments: str) -> Result:
    return sipe("benchmark", "run", *SMALL, *arguments, "--executor", "inline", "--out", str(folder))


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("benchmark") / "out"
    found = measured(folder, *PENDULUM)
    assert found.exit_code == 0, found.output
    return folder


# Cells


def test_ids_name_a_cell_once() -> None:
    every = suite("all")
    assert len({cell.id for cell in every}) == len(every)
    for name in SUITES:
        assert {cell.id for cell in suite(name)} <= {cell.id for cell in every}, name
        assert len({cell.id for cell in suite(name)}) == len(suite(name))
    assert Cell("HalfCheetahLinks", "bayessim").id == "HalfCheetahLinks/bayessim/direct/in_distribution/seed0"


def test_every_estimator_and_the_baselines_are_cells() -> None:
    direct = {cell.estimator for cell in suite("all") if cell.setting == "direct"}
    assert direct == {"prior", "prior_mean", *ESTIMATORS}
    assert {c.estimator for c in suite("all") if c.setting == "gradient_steps"} == {"maml"}
    assert {c.estimator for c in suite("all") if c.setting == "learned_reward"} == {"simopt", "adr"}
    assert {dict(c.values).get("gradient_steps") for c in suite("gradient_steps")} == {None, *range(11)}


@pytest.mark.parametrize("name", ["paper", *(n for n in SUITES if n not in ("quick", "all"))])
def test_every_suite_has_what_its_cells_are_held_against(name: str) -> None:
    """The prior, its mean and laplace, of the direct setting, for each environment, variant and seed."""
    found = {(c.task, c.variant, c.seed, c.estimator) for c in suite(name) if c.setting == "direct"}
    wanted = {(c.task, c.variant, c.seed, e) for c in suite(name) for e in ("prior", "prior_mean", "laplace")}
    assert wanted <= found


def test_suites_are_those_of_the_paper() -> None:
    quick = suite("quick")
    assert len({c.task for c in quick}) == 3
    assert len({c.estimator for c in quick} - {"prior", "prior_mean"}) == 6
    assert {c.seed for c in quick} == {0}
    assert len({(c.task, c.estimator) for c in suite("direct")}) == 9 * 10
    assert len(NINE) == 9
    assert {c.setting for c in suite("paper")} == {
        *("direct", "learned_reward", "gradient_steps", "policy", "policy_learned_reward")
    }
    searched = [c for c in suite("sweep") if c.setting == "sweep"]
    assert {c.split for c in searched} == {"validation"}
    grid = [c for c in searched if (c.task, c.seed) == ("FetchPush", 0)]
    assert [sum(c.estimator == e for c in grid) for e in ("regression", "bayesopt", "maml", "simopt", "adr")] == [
        *(16, 8, 9, 54, 12)
    ]


@pytest.mark.parametrize("estimator", [name for name in ESTIMATORS if name in cells.GRIDS])
def test_sweep_holds_the_defaults(estimator: str) -> None:
    import inspect

    classes = estimator_class(estimator).__mro__[:-1]
    defaults = {p.name: p.default for c in reversed(classes) for p in inspect.signature(c).parameters.values()}
    grids = [dict(c.values) for c in suite("sweep") if c.estimator == estimator]
    assert all(name in defaults for values in grids for name in values)
    assert any(all(defaults[name] == value for name, value in values.items()) for values in grids)


@pytest.mark.parametrize(
    ("pattern", "matched"),
    [
        ("half_cheetah*/adr/*", True),
        ("HalfCheetahLinks/adr", True),
        ("half_cheetah_links/adr/direct/in_distribution/seed0", True),
        ("*/seed0", True),
        ("half_cheetah*/ad", False),
        ("adr", False),
    ],
)
def test_patterns(pattern: str, matched: bool) -> None:
    assert matches(Cell("HalfCheetahLinks", "adr").id, pattern) is matched


def test_the_humanoids_trajectories_are_shorter_unless_asked_for() -> None:
    assert [Cell(task, "adr").horizon for task in ("FetchPush", "HalfCheetahJoints", "HumanoidJoints")] == [
        50,
        250,
        100,
    ]
    assert Cell("HumanoidJoints", "adr", steps=200).horizon == 200


def test_select_keeps_the_order_and_each_cell_once() -> None:
    found = select("quick", ["*/simopt/*", "door/*"])
    assert [c.id for c in found] == [c.id for c in suite("quick") if c.task == "Door" or c.estimator == "simopt"]


# Records and runs


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
    assert found.output == "6 cells, 6 of them there already\n"
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
    """SIGKILL at random moments: after its plan is there, when it simulates, and after the first and the third record."""
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
    """Found in the CLI, the tables and the plots. Seed 1 fails; the others go on; it runs again when it is asked for, and then only it."""
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
    assert (before.exit_code, before.stdout) == (1, "3 cells, 3 of them there already, 1 failed\n")
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
        assert table.measure.name == "CPU seconds" or found_there.mean == known.mean
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


# Refusals


def refused(found: Result, *words: str) -> None:
    assert found.exit_code == 2, found.output
    assert found.stderr.count("\n") == 1, found.stderr
    assert found.stderr.startswith("sipe: ")
    for word in words:
        assert word in found.stderr


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--suite", "paper", "--select", "fetch_pushh/npe"], ["fetch_pushh/npe", "nearest is FetchPush/npe"]),
        (["--suite", "paper", "--select", "Hopper/npe"], ["of the suite paper", "--suite all"]),
        (["--suite", "papers"], ["--suite papers", "quick"]),
        (["--jobs", "0", "--executor", "pool"], ["--jobs 0"]),
        (["--budget", "0"], ["--budget 0"]),
        (["--executor", "slurm"], ["slurm", "pool, ray or inline"]),
        (["--address", "10.0.0.1:6379"], ["goes with --executor ray"]),
        (["--executor", "ray", "--address", "127.0.0.1:1"], ["127.0.0.1:1: does not answer"]),
        (["--executor", "ray", "--address", "somewhere"], ["expected HOST:PORT"]),
        (["--out", "/dev/null"], ["is a file"]),
        (["--out", "/proc/sipe"], ["/proc/sipe"]),
    ],
)
def test_bad_input_is_one_line(arguments: list[str], words: list[str], tmp_path: Path) -> None:
    out = [] if "--out" in arguments else ["--out", str(tmp_path / "out")]
    chosen = [] if {"--suite", "--select"} & set(arguments) else ["--suite", "all", "--select", "pendulum/prior/direct"]
    refused(sipe("benchmark", "run", *chosen, *arguments, *out), *words)


@pytest.mark.parametrize("kind", ["benchmark", "transfer"])
def test_no_suite_is_no_suite(kind: str, tmp_path: Path) -> None:
    """None is run, or shown, by accident."""
    refused(sipe(kind, "run", "--out", str(tmp_path / "out")), "--suite", "quick")
    refused(sipe(kind, "cells", "--select", "Door"), "--select Door")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"budget": 61}, ["with budget 61 and not 60"]),
        ({"steps": 7}, ["with steps 7 and not 20"]),
        ({"versions": {**measurement.versions(), "mujoco": "3.9"}}, ["with versions mujoco 3.9 and not mujoco "]),
    ],
)
def test_results_of_another_kind_are_left_alone(
    changes: dict[str, Any], words: list[str], undisturbed: Path, tmp_path: Path
) -> None:
    other = replace(Record.all_in(undisturbed)[0], **changes)
    other.write(tmp_path)
    refused(measured(tmp_path, *PENDULUM), *words, "choose another folder")
    assert Record.all_in(tmp_path) == [other]


def test_read_only_folder(tmp_path: Path) -> None:
    """To root every folder can be written but those that are none."""
    tmp_path.chmod(0o500)
    folder = Path("/proc/self/task") if os.access(tmp_path, os.W_OK) else tmp_path
    before = sorted(p.name for p in tmp_path.iterdir())
    found = measured(folder, *PENDULUM)
    refused(found, f"sipe: {folder}", "choose another folder")
    assert any(why in found.stderr for why in ("denied", "not permitted", "no such file"))
    assert "Errno" not in found.stderr
    assert sorted(p.name for p in tmp_path.iterdir()) == before


def test_versions_of_cells_not_asked_for_count_too(undisturbed: Path, tmp_path: Path) -> None:
    """Tables would mix them."""
    other = replace(Record.all_in(undisturbed)[0], versions={**measurement.versions(), "mujoco": "3.9"})
    other.write(tmp_path)
    elsewhere = ["--select", "cartpole/prior/direct/default/seed0"]
    refused(measured(tmp_path, *elsewhere), "with versions mujoco 3.9", other.id, "choose another folder")


def test_a_folder_that_is_elsewhere(undisturbed: Path) -> None:
    """On a machine that does not see the folder of results a cell makes its simulations itself: the same result, their cost apart,
    and nothing left behind."""
    nowhere, cell = Path("/proc/nowhere"), replace(Cell("Pendulum", "regression"), budget=60, steps=20)
    done = ESTIMATES.run(cell, nowhere, "")
    assert not done.failed, done.line
    record = json.loads(done.files[1][1])
    assert record["simulation_cpu_seconds"] > 0
    same = {k: v for k, v in record.items() if k not in TIMES}
    assert (same, done.files[0][1]) == what_counts(undisturbed)[cell.id]


@pytest.mark.parametrize(("room_for", "kept"), [(0, 0), (3, 0), (12, 2), (13, 3)])
def test_full_disk_loses_nothing(
    room_for: int, kept: int, monkeypatch: pytest.MonkeyPatch, undisturbed: Path, tmp_path: Path
) -> None:
    """After some files, plan and times among them, there is no room: what is there is whole, and the same command goes on."""
    room, replacing = [room_for], files.replacing

    @contextmanager
    def full(path: Path) -> Iterator[Path]:
        with replacing(path) as temporary:
            yield temporary
            room[0] -= 1
            if room[0] < 0:
                raise OSError(errno.ENOSPC, "No space left on device", str(path))

    monkeypatch.setattr(files, "replacing", full)
    refused(measured(tmp_path, *PENDULUM), "no space left", "free some space")
    assert len(list(tmp_path.glob("records/P*.json"))) == kept
    assert not list(tmp_path.rglob(".*.[a-z]*"))  # no half-written file
    monkeypatch.setattr(files, "replacing", replacing)
    assert measured(tmp_path, *PENDULUM).exit_code == 0
    assert what_counts(tmp_path) == what_counts(undisturbed)


def test_two_runs_at_once_are_refused(tmp_path: Path) -> None:
    with run.claimed(tmp_path):
        refused(measured(tmp_path, *PENDULUM), "another run is at work")


# Simulations of the prior

PENDULUM_BANK = Bank("Pendulum", "in_distribution", 0, 20)


def filled(folder: Path, budget: int) -> int:
    return run.simulate(PENDULUM_BANK, budget, run.Order(folder, Inline))


def test_shards_merge_resume_and_verify(tmp_path: Path) -> None:
    """Two folders that hold shards of one bank are merged by copying; what results is what an estimator simulates by itself."""
    filled(tmp_path / "a", 230)
    units = bank.shards(PENDULUM_BANK, 430, bank.place(PENDULUM_BANK, tmp_path / "a"))
    assert bank.place(PENDULUM_BANK, tmp_path / "a") == bank.known_place(PENDULUM_BANK, tmp_path / "a")
    assert [u.arguments["blocks"] for u in units] == [[(4, 50), (5, 50), (6, 50), (7, 50)], [(8, 30)]]
    for name, data in [*units[0]().files, *units[1]().files]:  # made elsewhere
        files.write_bytes(tmp_path / "b" / name, data)
    (made,) = (tmp_path / "b" / bank.FOLDER).iterdir()
    for path in made.iterdir():
        (tmp_path / "a" / bank.FOLDER / made.name / path.name).write_bytes(path.read_bytes())
    assert bank.verify(PENDULUM_BANK, 430, tmp_path / "a") == []
    assert filled(tmp_path / "a", 430) == 0
    merged = bank._opened.__wrapped__(PENDULUM_BANK, tmp_path / "a" / bank.FOLDER).first(430)
    alone = bank._opened.__wrapped__(PENDULUM_BANK, None).first(430)
    assert np.array_equal(merged.theta, alone.theta)
    assert np.array_equal(merged.observations, alone.observations, equal_nan=True)


def test_verify_finds_what_is_wrong(tmp_path: Path) -> None:
    filled(tmp_path, 200)
    (folder,) = (tmp_path / bank.FOLDER).iterdir()
    blocks = sorted(folder.glob("block-*.npz"))
    blocks[0].write_bytes(blocks[0].read_bytes()[:-100])
    with np.load(blocks[1], allow_pickle=False) as data:
        arrays = dict(data)
    np.savez(blocks[1], **{**arrays, "theta": arrays["theta"][::-1]})
    with np.load(blocks[2], allow_pickle=False) as data:
        arrays = dict(data)
    np.savez(blocks[2], **{**arrays, "observations": arrays["observations"] + np.float32(1e-3)})
    found = bank.verify(PENDULUM_BANK, 200, tmp_path)
    assert [line.split(": ")[1].split(" ")[0] for line in found] == ["holds", "its", "comes"]
    assert filled(tmp_path, 200) == 1  # the broken one
    assert len(bank.verify(PENDULUM_BANK, 200, tmp_path)) == 2


def test_simulate_command_serves_the_benchmark(tmp_path: Path) -> None:
    """Its simulations are those that the cells read."""
    out = ["--out", str(tmp_path), "--steps", "20", "--executor", "inline"]
    found = sipe("simulate", "Pendulum", "--budget", "60", *out)
    assert found.exit_code == 0, found.output
    assert "60 simulations" in found.output
    assert "verified" in found.output
    assert sipe("simulate", "Pendulum", "--budget", "120", *out, "--verify").exit_code == 1
    assert "1/1 " in measured(tmp_path, "--select", "pendulum/regression/direct/in_distribution/seed0").stdout
    assert Record.all_in(tmp_path)[0].simulation_cpu_seconds > 0
    refused(sipe("simulate", "Pendulumm", *out), "did you mean 'Pendulum'")
    refused(sipe("simulate", "Pendulum", "--variant", "odd", *out), "--variant odd")


def test_shard_that_cannot_be_made_stops_nothing(
    monkeypatch: pytest.MonkeyPatch, undisturbed: Path, tmp_path: Path
) -> None:
    def damaged(**_: object) -> None:
        raise RuntimeError("diverged")

    monkeypatch.setattr(bank, "_simulate", damaged)
    found = measured(tmp_path, "--select", "pendulum/regression/direct/in_distribution/seed0")
    assert "left out: RuntimeError: diverged" in found.stdout
    (record,) = Record.all_in(tmp_path)
    assert (record.id, what_counts(tmp_path)[record.id]) in what_counts(undisturbed).items()


def test_cells_that_share_simulations_are_the_prior_sampling_ones() -> None:
    for name in ESTIMATORS:
        shares = run.bank_of(Cell("Pendulum", name)) is not None
        assert shares is issubclass(estimator_class(name), PriorSampling)
