"""The simulations of the prior that estimators of one cell group share: filled in shards, anywhere, and verified.

A bank is a folder of ``inference.amortised.simulations.Cache``: its name is a hash of model, parameters, prior, seed,
actions and starts, and row i follows from the seed and i alone. So shards made on different machines are the parts of
one bank: merging is copying their files into one folder, and a lost file is made again bit for bit (on a card but
for what docs/gpu.md says). ``shard-*.json`` beside the blocks says what a shard cost.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from pydantic import TypeAdapter

from sipe_bayes.benchmark.executors.work import Done, Unit
from sipe_bayes.benchmark.log import recorded
from sipe_bayes.core.files import FileError, read_arrays, read_json, reading, to_json
from sipe_bayes.core.validation import whole
from sipe_bayes.envs.registry import make_task
from sipe_bayes.envs.task import Variant
from sipe_bayes.inference.amortised.simulations import BLOCK, Cache, Simulations
from sipe_bayes.likelihood import first_states
from sipe_bayes.posterior import prior
from sipe_bayes.simulation.simulator import Simulator

FOLDER = "simulations"
UNITS = "simulations/"  # what the names of shards begin with


@dataclass(frozen=True)
class Bank:
    """Which simulations: those that replay the trajectory of a task's variant, of ``benchmark.log.recorded``."""

    task: str
    variant: Variant
    seed: int
    steps: int
    device: str = "cpu"

    @property
    def id(self) -> str:
        """Such as ``Door/in_distribution/seed0/100``, with the device where it is not the processor."""
        own = f"{self.task}/{self.variant}/seed{self.seed}/{self.steps}"
        return own if self.device == "cpu" else f"{own}/{self.device}"


@dataclass(frozen=True)
class _Shard:
    """What the file beside a shard's blocks says of them."""

    bank: str
    cpu_seconds: float


def _shard(path: Path) -> _Shard:
    what, remedy = "the note of a shard", "delete its folder, and it is simulated again"
    plain = read_json(path, what, remedy)
    with reading(path, what, remedy):
        return TypeAdapter(_Shard).validate_python(plain)


class _Blocks(Cache):
    """A cache whose blocks are made in any order."""

    def fill(self, rows: dict[int, int]) -> list[Simulations]:
        """The first rows of blocks, read or made together."""
        self._blocks = [self._none()] * (max(rows) + 1)
        for number in rows:
            self._blocks[number] = self._read(number) or self._none()
        short = {number: wanted for number, wanted in rows.items() if len(self._blocks[number]) < wanted}
        if short:
            self._extend(short)
        return [self._blocks[number] for number in rows]

    def path(self, number: int) -> str:
        """Of a block, in the folder of results."""
        return f"{FOLDER}/{self.key}/block-{number:06d}.npz"


@lru_cache(maxsize=2)
def _opened(bank: Bank, folder: Path) -> _Blocks:
    log = recorded(bank.task, bank.variant, bank.seed, bank.steps)
    simulator = Simulator(make_task(bank.task), 1, bank.device)
    starts = first_states(simulator, log.trajectories)
    return _Blocks(simulator, prior(simulator.space), log.trajectories, starts, bank.seed, folder)


def place(bank: Bank, folder: Path) -> Path:
    """Where the blocks of a bank lie; its log is made to know that."""
    return folder / FOLDER / _opened(bank, folder / FOLDER).key


def known_place(bank: Bank, folder: Path) -> Path | None:
    """Where they lie as far as the shards that are there tell.

    Returns:
        None where there are none, or those of several logs.
    """
    notes = (folder / FOLDER).glob("*/shard-*.json")
    folders = {path.parent for path in notes if _shard(path).bank == bank.id}
    return folders.pop() if len(folders) == 1 else None


def shards(bank: Bank, budget: int, made: Path | None, size: int | None = None) -> list[Unit]:
    """What is to be simulated of the first rows of a bank.

    Args:
        bank: which.
        budget: rows.
        made: where blocks lie already.
        size: blocks of a shard; default 4, or 80 for a GPU, which takes them all at once.
    """
    size = size or (4 if bank.device == "cpu" else 80)
    rows = [min(BLOCK, budget - start) for start in range(0, whole("budget", budget), BLOCK)]
    missing = [k for k, count in enumerate(rows) if made is None or _rows(made / f"block-{k:06d}.npz") < count]
    return [
        Unit(
            f"{UNITS}{bank.id}/{part[0]}",
            _simulate,
            {"bank": bank, "blocks": [(k, rows[k]) for k in part]},
            broken=_left_out,
        )
        for part in (missing[i : i + size] for i in range(0, len(missing), size))
    ]


def _left_out(bank: Bank, blocks: list[tuple[int, int]], why: str) -> Done:
    """What a shard comes to that cannot be made: nothing; the cells that need it make it themselves, or fail."""
    return Done((), f"left out: {why}", 0.0)


def _rows(path: Path) -> int:
    """Rows of a block's file, 0 where it is missing or broken."""
    try:
        with reading(path, "simulations", "simulate again"):
            return len(read_arrays(path)["valid"])
    except FileError:
        return 0


def _simulate(bank: Bank, blocks: list[tuple[int, int]]) -> Done:
    """A shard, simulated in a folder of its own: the machine need not see that of the results."""
    began, cpu = time.perf_counter(), time.process_time()
    with TemporaryDirectory() as made_in:
        made = _opened.__wrapped__(bank, Path(made_in))
        assert made.folder is not None
        invalid = sum(int((~part.valid).sum()) for part in made.fill(dict(blocks)))
        files = [(made.path(k), (made.folder / f"block-{k:06d}.npz").read_bytes()) for k, _ in blocks]
    seconds, cpu = time.perf_counter() - began, time.process_time() - cpu
    rows = sum(count for _, count in blocks)
    cost = {"bank": bank.id, "rows": rows, "seconds": seconds, "cpu_seconds": cpu, "invalid": invalid}
    files.append((f"{FOLDER}/{made.key}/shard-{blocks[0][0]:06d}.json", to_json(cost).encode()))
    return Done(tuple(files), f"{rows} simulations, {seconds:.1f} s", cpu)


def cost(folder: Path, key: str) -> float:
    """CPU seconds that a bank took, as far as its shards are there."""
    return float(sum(_shard(path).cpu_seconds for path in (folder / key).glob("shard-*.json")))


def verify(bank: Bank, budget: int, folder: Path, again: int = 1) -> list[str]:
    """What is wrong with the first rows of a bank.

    Args:
        bank: which.
        budget: rows.
        folder: of results.
        again: rows of each block that are simulated again and compared.

    Returns:
        A line for each block that is missing, broken, holds other theta than the seed gives, or comes out otherwise.
    """
    blocks, wrong = _opened(bank, folder / FOLDER), []
    for number, start in enumerate(range(0, budget, BLOCK)):
        kept = blocks._read(number)
        name, want = blocks.path(number), min(BLOCK, budget - start)
        if kept is None or len(kept) < want:
            wrong.append(f"{name}: holds {0 if kept is None else len(kept)} of {want} simulations; simulate again")
        elif not np.array_equal(kept.theta, blocks.drawn(number)[: len(kept)]):
            wrong.append(f"{name}: its theta are not those of seed {bank.seed}; delete it and simulate again")
        else:
            made = blocks.simulate(kept.theta[:again])
            if not np.array_equal(made.observations, kept.observations[:again], equal_nan=True):
                wrong.append(f"{name}: comes out otherwise here; delete it, or simulate on one kind of processor")
    return wrong
