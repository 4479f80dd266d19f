"""What a unit of work costs beside its work: table of `bench.py executors`.

Units that do nothing and return a file of 100 kB, as a posterior's, one worker: the seconds until the first is back,
processes and imports included, and the milliseconds of each after that, by the clock and of this process' CPU.
"""

from __future__ import annotations

import time
from collections.abc import Callable

from sipe_bayes.benchmark.executors.pool import Inline, Pool
from sipe_bayes.benchmark.executors.ray_executor import RayExecutor
from sipe_bayes.benchmark.executors.work import Done, Executor, Unit

UNITS, SIZE = 200, 100_000
EXECUTORS: dict[str, Callable[[], Executor]] = {"inline": Inline, "pool": lambda: Pool(1), "ray": RayExecutor}


def nothing(why: str = "") -> Done:
    """A unit's work."""
    return Done((("file", bytes(SIZE)),), why, 0.0)


def table() -> None:
    """A row for each executor."""
    print(f"\nExecutors: {UNITS} units that do nothing and return {SIZE // 1000} kB, one after the other")
    print(f"{'executor':<10}{'first unit s':>14}{'each ms':>10}{'of this CPU ms':>16}")
    for name, make in EXECUTORS.items():
        began = time.perf_counter()
        with make() as executor:
            executor.submit(Unit("first", nothing, {}, nothing))
            executor.next()
            first = time.perf_counter() - began
            began, cpu = time.perf_counter(), time.process_time()
            for k in range(UNITS):
                executor.submit(Unit(str(k), nothing, {}, nothing))
                executor.next()
            each, own = time.perf_counter() - began, time.process_time() - cpu
        print(f"{name:<10}{first:>14.2f}{1e3 * each / UNITS:>10.2f}{1e3 * own / UNITS:>16.2f}", flush=True)
