"""Simulations drawn from the prior: one cache, shared by the estimators that learn from them.

Row i of the cache depends on the seed and on i alone (rows come in blocks, each with its own generator), so a larger
budget extends it, and a run that lost it makes the same rows again. On disk it is one folder for each content hash (model,
parameters, prior, seed, actions, starts), one npz file for each block, written atomically. Simulations that diverged stay:
they are counted, marked and described.
"""

from __future__ import annotations

import hashlib
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import scipy.stats
import torch
from numpy.typing import NDArray

from sipe_bayes.core.files import replacing
from sipe_bayes.core.parameters import ParameterSpace
from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.posterior import Posterior

FloatArray = NDArray[np.float64]

BLOCK = 50  # rows; one file, one generator
_SHIFTED = 1e-3  # p-value below which invalid simulations are said to lie elsewhere in the prior


@dataclass(frozen=True)
class Simulations:
    """theta (n, N), observations (n, R, T+1, O) float32 of R replayed trajectories, NaN from where one diverged and on its
    padding, and valid (n,): whether all R are."""

    theta: FloatArray
    observations: NDArray[np.float32]
    valid: NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.theta)

    def usable(self) -> Simulations:
        """The valid ones."""
        return Simulations(self.theta[self.valid], self.observations[self.valid], self.valid[self.valid])


class Cache:
    """Simulations of theta drawn from ``prior``, replaying R ``trajectories`` from ``starts`` (R, S); in memory, and in
    ``folder`` if one is given."""

    def __init__(
        self,
        simulator: Any,
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
        for array in (
            *arrays,
            np.nan_to_num(self.trajectories.observations[:, 0]),
        ):  # holds the goals, if there are any
            digest.update(np.ascontiguousarray(array).tobytes())
        return digest.hexdigest()[:24]

    def first(self, count: int) -> Simulations:
        """The first ``count`` rows, simulating what is not there yet."""
        for k in range((count + BLOCK - 1) // BLOCK):
            want = min(BLOCK, count - k * BLOCK)
            if k == len(self._blocks):
                self._blocks.append(self._read(k) or self._none())
            if len(self._blocks[k]) < want:
                self._blocks[k] = self._extended(k, want)
        parts = self._blocks[: (count + BLOCK - 1) // BLOCK]
        theta, observations, valid = (
            np.concatenate([getattr(part, name) for part in parts])[:count]
            for name in ("theta", "observations", "valid")
        )
        return Simulations(theta, observations, valid)

    def _none(self) -> Simulations:
        shape = self.trajectories.observations.shape
        n = len(self.simulator.space)
        return Simulations(np.empty((0, n)), np.empty((0, *shape), np.float32), np.empty(0, bool))

    def _extended(self, block: int, rows: int) -> Simulations:
        old = self._blocks[block]
        generator = torch.Generator().manual_seed(int(np.random.SeedSequence([self.seed, block]).generate_state(1)[0]))
        theta = self.prior.sample((BLOCK,), generator=generator).numpy()[len(old) : rows]
        parts = (old, self.simulate(theta))
        both = Simulations(
            *(np.concatenate([getattr(p, name) for p in parts]) for name in ("theta", "observations", "valid"))
        )
        self._write(block, both)
        return both

    def simulate(self, theta: FloatArray) -> Simulations:
        """Simulations of any theta (n, N), which are not kept."""
        motion = self.simulator.replay(theta, self.trajectories, self.starts)
        count = len(self.trajectories)
        inside = np.arange(motion.valid.shape[1]) <= motion.length[:, None]
        valid = (motion.valid | ~inside).reshape(len(theta), -1).all(1)
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
        try:
            with np.load(self.folder / f"block-{block:06d}.npz", allow_pickle=False) as data:
                return Simulations(data["theta"], data["observations"], data["valid"])
        except (OSError, ValueError, KeyError, zipfile.BadZipFile):
            return None


def describe_invalid(simulations: Simulations, space: ParameterSpace, failure: str = "diverged") -> str | None:
    """A sentence on how many simulations diverged, or what else their ``failure`` was, and where in the prior they lie; None if none
    did."""
    bad = ~simulations.valid
    if not bad.any():
        return None
    where = []
    for j, name in enumerate(space.names):
        inside, outside = simulations.theta[~bad, j], simulations.theta[bad, j]
        if len(inside) and scipy.stats.mannwhitneyu(inside, outside).pvalue < _SHIFTED:
            where.append(f"{'high' if np.median(outside) > np.median(inside) else 'low'} {name}")
    place = f", mostly at {' and '.join(where)}" if where else ", all over the prior"
    return f"{int(bad.sum())} of {len(bad)} simulations {failure}{place}; the others were used"
