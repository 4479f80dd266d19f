"""Changed files and odd options, many of them: each ends in a result or in one line, soon, in little memory.

    python -m tests.fuzz.run --cases 100000 --processes 2
    python -m tests.fuzz.run --target posterior --seed 4711   # one case again, with its traceback

A case is a target and a seed: what is printed of a failure is all that is needed to see it again. It fails if it
raises what is not for the user, words it in more than a line or without naming what is at fault, takes longer than
``PATIENCE``, or asks for more than ``ROOM`` bytes beyond what the process has.
"""

from __future__ import annotations

import argparse
import contextlib
import math
import multiprocessing
import os
import random
import resource
import signal
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any

PATIENCE = 10.0  # s of a case, in which it did not wait for a processor that others have
KILLED = 300.0  # s after which a case that no signal reaches is ended
ROOM = 2 * 2**30
LONGEST = 1000  # characters of a line
WORDS = (
    "log ",
    "posterior: ",
    "key ",
    "model",
    "parameter",
    "trajectory",
    "checkpoint",
    "--",
    "sipe:",
)  # that name what is at fault, beside files


class Hang(BaseException):
    """A case that takes too long."""


@dataclass
class Outcome:
    """Of one case: what is wrong with it, nothing where all is well."""

    target: str
    seed: int
    seconds: float = 0.0
    refused: str = ""
    wrong: str = ""


@dataclass
class Tally:
    """Of one target."""

    cases: int = 0
    refused: int = 0
    slowest: float = 0.0
    wrong: list[Outcome] = field(default_factory=list)

    def add(self, outcome: Outcome) -> None:
        self.cases += 1
        self.refused += bool(outcome.refused)
        self.slowest = max(self.slowest, outcome.seconds)
        if outcome.wrong:
            self.wrong.append(outcome)


def targets() -> dict[str, tuple[Any, int]]:
    """Files and the command line."""
    from tests.fuzz.commands import COMMANDS
    from tests.fuzz.files import TARGETS
    from tests.fuzz.kinds import KINDS
    from tests.fuzz.stored import STORED

    return TARGETS | STORED | COMMANDS | KINDS


class Player:
    """Plays cases of targets, whose sound files it makes once in a folder of its own."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.changes, self.targets = folder, dict[str, Any](), targets()
        _, hard = resource.getrlimit(resource.RLIMIT_DATA)
        self.hard = hard

    def play(self, target: str, seed: int, loud: bool = False) -> Outcome:
        """One case."""
        import warnings

        place = self.folder / target.replace(" ", "_").replace("/", "_")
        outcome = Outcome(target, seed)
        if target not in self.changes:
            place.mkdir()
            self.changes[target] = self.targets[target][0](place)
        read = self.changes[target](random.Random(f"{target} {seed}"))
        waits: dict[str, int] = {}
        began = _clock(waits)

        def late(*_: object) -> None:
            left = PATIENCE - (_clock(waits) - began)
            if left <= 0:
                raise Hang
            signal.setitimer(signal.ITIMER_REAL, min(max(left, 0.01), 1.0))

        signal.signal(signal.SIGALRM, late)
        signal.setitimer(signal.ITIMER_REAL, PATIENCE)
        resource.setrlimit(resource.RLIMIT_DATA, (_data() + ROOM, self.hard))
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                read()
        except (Exception, Hang) as error:
            signal.setitimer(signal.ITIMER_REAL, 0)
            outcome.refused, outcome.wrong = _judged(error, place)
            if loud or (outcome.wrong and os.environ.get("FUZZ_LOUD")):
                traceback.print_exc()
        finally:
            signal.setitimer(signal.ITIMER_REAL, 0)
            resource.setrlimit(resource.RLIMIT_DATA, (resource.RLIM_INFINITY, self.hard))
        outcome.seconds = _clock(waits) - began
        return outcome


def _clock(waits: dict[str, int]) -> float:
    """Seconds that pass, without those in which this process, or one that it started, waits for a processor.

    Args:
        waits: ns of each process, which are kept when it has ended.
    """
    started = [word for file in Path("/proc/self/task").glob("*/children") for word in file.read_text().split()]
    for process in ("self", *started):
        with contextlib.suppress(OSError, IndexError):
            waits[process] = int(Path(f"/proc/{process}/schedstat").read_text(encoding="ascii").split()[1])
    return time.perf_counter() - 1e-9 * sum(waits.values())


def _data() -> int:
    """Bytes of this process that RLIMIT_DATA counts."""
    with open("/proc/self/status", encoding="ascii") as file:
        return next(int(line.split()[1]) * 1024 for line in file if line.startswith("VmData"))


def _judged(error: BaseException, place: Path) -> tuple[str, str]:
    """What a user is told, and what is wrong with it."""
    text, kind = str(error), type(error).__name__
    if isinstance(error, Hang):
        return "", f"longer than {PATIENCE:g} s"
    for_users = isinstance(error, ValueError | FileNotFoundError | ImportError)
    if not for_users or kind.endswith(("DecodeError", "LinAlgError")):
        return "", f"{kind}: {' '.join(text.split())[:300]}"
    if "\n" in text or len(text) > LONGEST or not text.isprintable():
        return text, f"not one line of at most {LONGEST} characters: {text[:500]!r}"
    names = {name for path in place.rglob("*") for name in (path.name, path.stem)}
    if not any(name in text for name in (*names, *WORDS)):
        return text, f"names nothing: {text}"
    return text, ""


def schedule(names: dict[str, tuple[Any, int]], start: int = 0) -> Iterator[tuple[str, int]]:
    """Cases in their order: target and seed, targets as often as their weights say."""
    turn = [name for name, (_, weight) in names.items() for _ in range(weight)]
    random.Random(0).shuffle(turn)
    number = start
    while True:
        yield turn[number % len(turn)], number
        number += 1


def _work(first: int, step: int, last: int, chosen: list[str], base: int, out: Connection) -> None:
    """Play every ``step``-th case from ``first`` on; tells which it begins, and what it came to."""
    silent = os.open(os.devnull, os.O_WRONLY)
    for stream in (1, 2):  # what native code prints, too
        os.dup2(silent, stream)
    os.environ |= {"OMP_NUM_THREADS": "1", "SIPE_MODEL_SECONDS": "2", "SIPE_MODEL_GIB": "2"}
    known = targets()
    order = schedule({name: known[name] for name in chosen or known})
    with tempfile.TemporaryDirectory(prefix="sipe-fuzz-") as folder:
        player = Player(Path(folder))
        for target, number in order:
            if number >= last:
                break
            if number >= first and number % step == first % step:
                out.send((number, target))
                out.send(player.play(target, base + number))
    out.send(None)


def fuzz(
    cases: int, processes: int = 1, chosen: list[str] | None = None, base: int = 0, seconds: float = math.inf
) -> dict[str, Tally]:
    """Play so many cases in processes of their own, which are replaced where one crashes or hangs.

    Args:
        cases: how many.
        processes: side by side.
        chosen: targets; default all.
        base: added to every seed, for other cases than the last time.
        seconds: after which no more are played.
    """
    context = multiprocessing.get_context("spawn")
    tallies: dict[str, Tally] = {}
    running: dict[Connection, _Worker] = {}

    def start(first: int) -> None:
        mine, theirs = context.Pipe(duplex=False)
        process = context.Process(
            target=_work, args=(first, processes, cases, chosen or [], base, theirs), daemon=False
        )
        process.start()
        theirs.close()
        running[mine] = _Worker(process, first)

    def lost(channel: Connection, why: str) -> None:
        worker = running.pop(channel)
        worker.process.kill()
        worker.process.join()
        target = worker.target or "start"
        tallies.setdefault(target, Tally()).add(Outcome(target, base + worker.number, KILLED, wrong=why))
        if worker.target:
            start(worker.number + processes)

    for first in range(processes):
        start(first)
    deadline = time.monotonic() + seconds
    while running:
        if time.monotonic() > deadline:
            for worker in running.values():
                worker.process.kill()
            break
        for channel in wait(list(running), timeout=1.0):
            assert isinstance(channel, Connection)
            worker = running[channel]
            try:
                message = channel.recv()
            except EOFError:
                worker.process.join()
                lost(channel, f"the process ended with exit code {worker.process.exitcode}")
                continue
            if message is None:
                running.pop(channel).process.join()
            elif isinstance(message, Outcome):
                tallies.setdefault(message.target, Tally()).add(message)
                worker.began = None
                if message.wrong:
                    print(f"{message.target} --seed {message.seed}: {message.wrong}", flush=True)
            else:
                worker.number, worker.target = message
                worker.began = time.monotonic()
        for channel, worker in list(running.items()):
            if worker.began is not None and time.monotonic() - worker.began > KILLED:
                lost(channel, f"did not end within {KILLED:g} s, whatever signal it got")
    return tallies


@dataclass
class _Worker:
    process: Any
    number: int
    target: str = ""
    began: float | None = None


def main() -> int:
    """Print a row for each target; exit code 1 where something is wrong."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", type=int, default=100_000)
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--minutes", type=float, default=math.inf, help="after which no more are played")
    parser.add_argument("--target", action="append", help="again for several; default all")
    parser.add_argument("--seed", type=int, help="play this one case of the one target")
    parser.add_argument("--base", type=int, default=0, help="added to every seed")
    given = parser.parse_args()
    if given.seed is not None:
        folder = Path(tempfile.mkdtemp(prefix="sipe-fuzz-"))
        outcome = Player(folder).play(given.target[0], given.seed, loud=True)
        print(outcome, f"its files are in {folder}", sep="\n")
        return bool(outcome.wrong)
    began = time.perf_counter()
    tallies = fuzz(given.cases, given.processes, given.target, given.base, 60 * given.minutes)
    print(f"{'target':24}{'cases':>8}{'refused':>9}{'slowest s':>11}{'wrong':>7}")
    for name, tally in sorted(tallies.items()):
        print(f"{name:24}{tally.cases:8}{tally.refused:9}{tally.slowest:11.2f}{len(tally.wrong):7}")
    wrong = Counter(name for name, tally in tallies.items() for _ in tally.wrong)
    cases = sum(tally.cases for tally in tallies.values())
    print(f"{cases} cases, {sum(wrong.values())} wrong, {time.perf_counter() - began:.0f} s")
    return bool(wrong)


if __name__ == "__main__":
    sys.exit(main())
