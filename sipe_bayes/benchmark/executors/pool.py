"""The executors of one machine: a pool of processes, each on one thread, and none, for a debugger.

The pool keeps at most one unit in each process, so that it knows what a process was doing that died: the unit gets a
new one, and after the second death it is given up. Processes end with the one that started them.
"""

from __future__ import annotations

import multiprocessing
import os
import threading
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from typing import Self

from sipe_bayes.benchmark.executors.work import ONE_THREAD, Done, Unit


class Pool:
    """Processes of this machine; see the module.

    Args:
        workers: how many.
        lives: deaths of its process after which a unit is given up.
    """

    def __init__(self, workers: int, lives: int = 2) -> None:
        self.workers, self._lives = workers, lives
        self._queue: deque[Unit] = deque()
        self._busy: dict[Connection, tuple[BaseProcess, Unit]] = {}
        self._idle: list[tuple[BaseProcess, Connection]] = []
        self._deaths: dict[str, int] = {}

    def submit(self, unit: Unit) -> None:
        """See ``Executor``."""
        self._queue.append(unit)
        self._start()

    def next(self) -> tuple[Unit, Done]:
        """See ``Executor``."""
        while True:
            self._start()
            ready = wait(list(self._busy))[0]
            assert isinstance(ready, Connection)
            process, unit = self._busy.pop(ready)
            try:
                done = ready.recv()
            except (EOFError, OSError):
                instead = self._after_death(process, unit)
                if instead is None:
                    continue
                return unit, instead
            self._idle.append((process, ready))
            return unit, done

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        for process, pipe in [*self._idle, *((p, c) for c, (p, _) in self._busy.items())]:
            process.kill()
            process.join()
            pipe.close()
        self._idle, self._busy = [], {}

    def _start(self) -> None:
        """Give waiting units to idle processes, and to new ones as long as there may be more."""
        while self._queue and len(self._busy) < self.workers:
            process, pipe = self._idle.pop() if self._idle else self._worker()
            unit = self._queue.popleft()
            self._busy[pipe] = (process, unit)
            try:
                pipe.send(unit)
            except OSError:  # it died idle: ``next`` sees to it
                continue

    def _worker(self) -> tuple[BaseProcess, Connection]:
        context = multiprocessing.get_context("spawn")
        own_end, workers_end = context.Pipe()
        with _environment():
            process = context.Process(target=_work, args=(workers_end,), daemon=True)
            process.start()
        workers_end.close()
        return process, own_end

    def _after_death(self, process: BaseProcess, unit: Unit) -> Done | None:
        """What stands in for the result of a unit whose process died; None while it is tried again."""
        process.join()
        self._deaths[unit.name] = self._deaths.get(unit.name, 0) + 1
        if self._deaths[unit.name] < self._lives:
            self._queue.appendleft(unit)
            return None
        return unit.gave_up(f"its process ended with exit code {process.exitcode}, {self._lives} times")


class Inline:
    """This very process, one unit after the other."""

    workers = 1

    def __init__(self) -> None:
        self._queue: deque[Unit] = deque()

    def submit(self, unit: Unit) -> None:
        """See ``Executor``."""
        self._queue.append(unit)

    def next(self) -> tuple[Unit, Done]:
        """See ``Executor``."""
        unit = self._queue.popleft()
        return unit, unit()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._queue.clear()


@contextmanager
def _environment() -> Iterator[None]:
    """One thread for each process that starts within."""
    before = {name: os.environ.get(name) for name in ONE_THREAD}
    os.environ.update(ONE_THREAD)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def _work(pipe: Connection) -> None:
    """A worker's life."""
    parent = multiprocessing.parent_process()
    assert parent is not None
    threading.Thread(target=_end_with, args=(parent.sentinel,), daemon=True).start()
    while True:
        try:
            unit = pipe.recv()
        except (EOFError, OSError, KeyboardInterrupt):
            return
        try:
            pipe.send(unit())
        except KeyboardInterrupt:
            return


def _end_with(sentinel: int) -> None:
    wait([sentinel])
    os._exit(1)
