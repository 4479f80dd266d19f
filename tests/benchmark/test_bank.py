"""The simulations of the prior that cells share: shards that merge, resume and are verified."""

from pathlib import Path

import numpy as np
import pytest

from sipe_bayes.benchmark import bank, run
from sipe_bayes.benchmark.cells import Cell
from sipe_bayes.benchmark.executors.pool import Inline
from sipe_bayes.benchmark.records import Record
from sipe_bayes.core import files
from sipe_bayes.inference.amortised.prior_sampling import PriorSampling
from sipe_bayes.inference.registry import ESTIMATORS, estimator_class
from tests.problems.benchmarks import PENDULUM_BANK, measured, refused, sipe, what_counts


def filled(folder: Path, budget: int) -> int:
    return run.simulate(PENDULUM_BANK, budget, run.Order(folder, Inline))


def test_shards_merge_resume_and_verify(tmp_path: Path) -> None:
    """Two folders that hold shards of one bank are merged by copying.

    What results is what an estimator simulates by itself.
    """
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
