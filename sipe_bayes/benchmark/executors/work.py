"""Units of work, which an executor carries out anywhere, and what they come to."""

from __future__ import annotations

import traceback
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Protocol, Self

from sipe_bayes.core.files import no_room

ONE_THREAD = {name: "1" for name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")}
"""Environment of a worker: set before it starts, as numerical libraries read it when they are loaded."""


@dataclass(frozen=True)
class Done:
    """What a unit came to.

    Args:
        files: (path in the folder of results, bytes), to be written in this order.
        line: a few words.
        cpu_seconds: that it took.
        failed: whether it did.
        spent: a path in the folder of results that nothing needs any more once the files are written.
        stopped: why no unit can go on: the disk is full. It is the machine's fault, and recorded of none.
    """

    files: tuple[tuple[str, bytes], ...]
    line: str
    cpu_seconds: float
    failed: bool = False
    spent: str = ""
    stopped: OSError | None = None


@dataclass(frozen=True)
class Unit:
    """A call of a function that can be pickled and does not write where the results lie.

    Args:
        name: of the unit.
        function: what is called.
        arguments: with which.
        broken: what it comes to when it raises, or its process dies again and again.
        needs: names of units that have to be written before.
    """

    name: str
    function: Callable[..., Done]
    arguments: Mapping[str, object]
    broken: Callable[..., Done]
    needs: frozenset[str] = field(default=frozenset())

    def __call__(self) -> Done:
        """Do the work."""
        import torch

        torch.set_num_threads(1)
        try:
            return self.function(**self.arguments)
        except Exception as error:
            full = no_room(error)
            if full is not None:
                return Done((), str(full), 0.0, failed=True, stopped=full)
            return self.gave_up(traceback.format_exc().strip().splitlines()[-1])

    def gave_up(self, why: str) -> Done:
        """What it comes to where it cannot be done."""
        return self.broken(why=why, **self.arguments)


class Executor(Protocol):
    """Where units run: ``submit`` returns at once, ``next`` waits for one to end."""

    workers: int

    def submit(self, unit: Unit) -> None:
        """Hand a unit over."""

    def next(self) -> tuple[Unit, Done]:
        """The next one that ends, and what it came to."""

    def __enter__(self) -> Self: ...

    def __exit__(self, *_: object) -> None:
        """Ends what still runs."""
