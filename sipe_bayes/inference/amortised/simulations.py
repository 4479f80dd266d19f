"""Simulations drawn from the prior: one cache, shared by the estimators that learn from them.

Row i of the cache depends on the seed and on i alone (rows come in blocks, each with its own generator), so a larger
budget extends it, and a run that lost it makes the same rows again. On disk it is one folder for each content hash
(model, parameters, prior, seed, actions, starts, goals), one npz file for each block, written atomically. Simulations
that diverged stay: they are counted, marked and described.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import scipy.stats
from numpy.typing import NDArray

from sipe_bayes.core.arrays import BoolArray, FloatArray
from sipe_bayes.core.files import FileError, read_arrays, reading, replacing
from sipe_bayes.core.parameters import ParameterSpace
from sipe_bayes.core.seeding import torch_generator
from sipe_bayes.core.thresholds import THRESHOLDS
from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.posterior import Posterior
from sipe_bayes.simulation.callable_simulator import CallableSimulator
from sipe_bayes.simulation.simulator import Simulator

BLOCK = 50  # rows; one file, one generator


@dataclass(frozen=True)
class Simulations:
    """Simulations of R replayed trajectories each.

    Attributes:
        theta: (n, N).
        observations: (n, R, T+1, O) float32, NaN from where one diverged and on its padding.
        valid: (n,): whether all R of them are.
    """

    theta: FloatArray
    observations: NDArray[np.float32]
    valid: BoolArray

    def __len__(self) -> int:
        return len(self.theta)

    def __getitem__(self, rows: slice | BoolArray) -> Simulations:
        return Simulations(self.theta[rows], self.observations[rows], self.valid[rows])

    def usable(self) -> Simulations:
        """The valid ones."""
        return self[self.valid]

    @staticmethod
    def joined(parts: Sequence[Simulations]) -> Simulations:
        """Several, one after the other."""
        return Simulations(*(np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(Simulations)))


class Cache:
    """Simulations of theta drawn from a prior, in memory and perhaps on disk.

    Args:
        simulator: what simulates.
        prior: that theta comes from.
        trajectories: R of them, whose actions are replayed.
        starts: (R, S), states that they are replayed from.
        seed: of the draws.
        folder: kept there, in a folder of its own; None for memory alone.
    """

    def __init__(
        self,
        simulator: Simulator | CallableSimulator,
        prior: Posterior,
        trajectories: Trajectories,
        starts: FloatArray,
        seed: int,
        folder: Path | None = None,
    ) -> None:
        self.simulator, self.prior, self.trajectories, self.seed = simulator, prior, trajectories, seed
        self.starts = starts
        self.key = self._key()
        self.folder = None if folder is None else folder / self.key
        self._blocks: list[Simulations] = []

    def _key(self) -> str:
        digest = hashlib.sha256()
        prior = [x.tolist() for x in self.prior.gaussian_moments()]
        plain = (self.simulator.checksum(), self.simulator.space.to_dict(), repr(self.prior), prior, self.seed)
        digest.update(repr((*plain, self.trajectories.names)).encode())
        arrays = (self.trajectories.actions, self.trajectories.dt, self.trajectories.length, self.starts)
        goals = np.nan_to_num(self.trajectories.observations[:, 0])  # first samples hold them, if there are any
        for array in (*arrays, goals):
            digest.update(np.ascontiguousarray(array).tobytes())
        return digest.hexdigest()[:24]

    def first(self, count: int) -> Simulations:
        """The first ``count`` rows, simulating what is not there yet."""
        blocks = (count + BLOCK - 1) // BLOCK
        self._blocks += [self._read(k) or self._none() for k in range(len(self._blocks), blocks)]
        rows = [(k, min(BLOCK, count - k * BLOCK)) for k in range(blocks)]
        short = [(k, wanted) for k, wanted in rows if len(self._blocks[k]) < wanted]
        together = max(1, self.wave // BLOCK)
        for begin in range(0, len(short), together):
            self._extend(dict(short[begin : begin + together]))
        return Simulations.joined(self._blocks[:blocks])[:count]

    def _none(self) -> Simulations:
        shape, n = self.trajectories.observations.shape, len(self.simulator.space)
        return Simulations(np.empty((0, n)), np.empty((0, *shape), np.float32), np.empty(0, bool))

    def drawn(self, block: int) -> FloatArray:
        """All theta (BLOCK, N) of a block."""
        theta: FloatArray = self.prior.sample((BLOCK,), generator=torch_generator([self.seed, block])).numpy()
        return theta

    @property
    def wave(self) -> int:
        """Rows that are best simulated at once."""
        return self.simulator.wave(self.trajectories.actions.shape[1]) // len(self.trajectories)

    def _extend(self, blocks: dict[int, int]) -> None:
        """Simulate what blocks lack of so many rows, together."""
        lacking = [self.drawn(k)[len(self._blocks[k]) : wanted] for k, wanted in blocks.items()]
        made = self.simulate(np.concatenate(lacking))
        ends = np.cumsum([len(theta) for theta in lacking])
        for k, theta, end in zip(blocks, lacking, ends.tolist(), strict=True):
            self._blocks[k] = Simulations.joined((self._blocks[k], made[end - len(theta) : end]))
            self._write(k, self._blocks[k])

    def simulate(self, theta: FloatArray) -> Simulations:
        """Simulations of any theta (n, N), which are not kept."""
        motion = self.simulator.replay(theta, self.trajectories, self.starts)
        count = len(self.trajectories)
        inside = np.arange(motion.valid.shape[1]) <= motion.length[:, None]
        valid = np.asarray((motion.valid | ~inside).reshape(len(theta), -1).all(1))
        seen = np.where(motion.valid[..., None], motion.observations, np.nan).astype(np.float32)
        return Simulations(theta, seen.reshape(len(theta), count, *seen.shape[1:]), valid)

    def _write(self, block: int, simulations: Simulations) -> None:
        if self.folder is None:
            return
        with replacing(self.folder / f"block-{block:06d}.npz") as temporary, temporary.open("wb") as file:
            np.savez(file, theta=simulations.theta, observations=simulations.observations, valid=simulations.valid)

    def _read(self, block: int) -> Simulations | None:
        """A block from disk; None where there is none or it cannot be read: it is then simulated again."""
        if self.folder is None:
            return None
        path = self.folder / f"block-{block:06d}.npz"
        try:
            with reading(path, "simulations", "simulate again"):
                arrays: dict[str, Any] = read_arrays(path)
                return Simulations(arrays["theta"], arrays["observations"], arrays["valid"])
        except FileError:
            return None


def place_of_invalid(simulations: Simulations, space: ParameterSpace) -> str:
    """Where in the prior the invalid simulations lie, in words that end a sentence on them."""
    bad, where = ~simulations.valid, []
    for j, name in enumerate(space.names):
        inside, outside = simulations.theta[~bad, j], simulations.theta[bad, j]
        if len(inside) and scipy.stats.mannwhitneyu(inside, outside).pvalue < THRESHOLDS.invalid_elsewhere:
            where.append(f"{'high' if np.median(outside) > np.median(inside) else 'low'} {name}")
    return f"mostly at {' and '.join(where)}" if where else "all over the prior"
