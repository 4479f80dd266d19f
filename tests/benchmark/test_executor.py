"""Where units run: a pool of processes, and Ray's workers on nodes that die."""

import os
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from sipe_bayes.benchmark import run
from sipe_bayes.benchmark.cells import Cell
from sipe_bayes.benchmark.executors.pool import Inline, Pool
from sipe_bayes.benchmark.executors.work import Done, Unit
from sipe_bayes.benchmark.measure import EstimateMeasurement
from sipe_bayes.benchmark.records import Record
from tests.problems.benchmarks import what_counts
from tests.problems.workers import gave_up, told

CELLS = [
    *(Cell("Pendulum", "prior", seed=k, budget=60, steps=20) for k in range(3)),
    *(Cell("Pendulum", "simopt", seed=k, budget=60, steps=20) for k in range(3)),
]


def test_pool_survives_the_death_of_its_processes() -> None:
    """The unit that kills its process is given up after the second time; the others are done, on one thread each."""
    before = dict(os.environ)
    with Pool(1) as pool:
        for name in ("look", "die", "raise", "look again"):
            pool.submit(Unit(name, told, {"what": name}, gave_up))
        found = {unit.name: done for unit, done in (pool.next() for _ in range(4))}
        processes = [process for process, _ in pool._idle]
    assert found["die"].failed
    assert found["die"].line == "its process ended with exit code 7, 2 times"
    assert (found["raise"].failed, found["raise"].line) == (True, "LookupError: nothing here")
    assert found["look"].line == found["look again"].line == "1 ['1', '1', '1']"
    assert processes
    assert all(not process.is_alive() for process in processes)
    assert dict(os.environ) == before


@dataclass(frozen=True)
class OnceStuck(EstimateMeasurement):
    """Cells of which one hangs where it is tried on another node than the head, the first time one is.

    The head waits for that: on a busy machine it would be done with all of them before the other has begun.
    """

    head: str

    def run(self, cell: Cell, folder: Path, command: str) -> Done:
        import ray

        node = ray.get_runtime_context().get_node_id()
        with (folder / "tries").open("a") as file:
            file.write(f"{cell.id} {node}\n")
        if node != self.head and not (folder / "stuck").exists():
            (folder / "stuck").write_text(node)
            time.sleep(600)
        until = time.monotonic() + 80
        while not (folder / "stuck").exists() and time.monotonic() < until:
            time.sleep(0.05)
        return super().run(cell, folder, command)


def test_ray_cluster_loses_a_node(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of two node processes one is killed while at work on a cell: every cell finishes once, as on one machine."""
    pytest.importorskip("ray")
    from ray.cluster_utils import Cluster

    from sipe_bayes.benchmark.executors.ray_executor import RayExecutor

    monkeypatch.setenv("RAY_USAGE_STATS_ENABLED", "0")
    out = tmp_path / "ray"
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False})
    try:
        other = cluster.add_node(num_cpus=1)
        head = cluster.head_node.node_id
        with monkeypatch.context() as patched:
            patched.setattr(run, "ESTIMATES", OnceStuck(head))
            killer = threading.Thread(target=_kill_when_stuck, args=(cluster, other, out))
            killer.start()
            said: list[str] = []
            failed = run.run(CELLS, run.Order(out, lambda: RayExecutor(cluster.address), report=said.append))
            killer.join()
    finally:
        cluster.shutdown()
    tries = [line.split() for line in (out / "tries").read_text().splitlines()]
    stuck = (out / "stuck").read_text()
    assert failed == 0
    assert len(said) == 1 + len(CELLS), said  # every cell once
    assert [cell for cell, node in tries if node == stuck], tries
    assert len(tries) > len(CELLS), tries  # the one that was lost began again
    assert run.run(CELLS, run.Order(tmp_path / "local", Inline, report=said.append)) == 0
    assert what_counts(out) == what_counts(tmp_path / "local")


def _kill_when_stuck(cluster: Any, node: Any, out: Path) -> None:
    until = time.monotonic() + 90
    while not (out / "stuck").exists() and time.monotonic() < until:
        time.sleep(0.05)
    cluster.remove_node(node, allow_graceful=False)


def test_pool_gives_what_one_process_gives(tmp_path: Path) -> None:
    chosen = CELLS[2:5]
    assert run.run(chosen, run.Order(tmp_path / "pool", lambda: Pool(2), report=lambda _: None)) == 0
    assert run.run(chosen, run.Order(tmp_path / "inline", Inline, report=lambda _: None)) == 0
    assert what_counts(tmp_path / "pool") == what_counts(tmp_path / "inline")
    assert all(isinstance(record, Record) for record in Record.all_in(tmp_path / "pool"))
