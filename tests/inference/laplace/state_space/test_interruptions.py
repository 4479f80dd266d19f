"""Searches over a chain of states that are interrupted, or go on from a checkpoint of another version."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors import safe_open
from safetensors.numpy import load_file, save_file

from sipe_bayes.core.checkpoint import CheckpointError, checksum
from sipe_bayes.core.trajectory import Trajectory
from sipe_bayes.inference.laplace.estimator import Laplace
from sipe_bayes.likelihood.settings import StateSpace
from sipe_bayes.posterior import Posterior
from sipe_bayes.simulation.simulator import Simulator
from tests.problems.hung import hung, hung_log
from tests.problems.interruptions import stop_after
from tests.problems.springs import (
    kicked_logs,
    spring,
)


@dataclass(frozen=True)
class Whole:
    """A fit that nothing disturbed, and the same on two threads."""

    starts: str

    @property
    def simulator(self) -> Callable[..., Simulator]:
        return spring if self.starts == "estimated" else hung

    @property
    def logs(self) -> list[Trajectory]:
        if self.starts == "estimated":
            return kicked_logs()
        return [hung_log(np.array([0.4]), 0), hung_log(np.array([0.4]), 1, 61)]

    @cached_property
    def fits(self) -> tuple[Posterior, Posterior, int]:
        alone, threads = (Laplace(self.simulator(n), likelihood=StateSpace(starts=self.starts)) for n in (1, 2))
        return alone.fit(self.logs), threads.fit(self.logs), alone.rollouts


WHOLE = {starts: Whole(starts) for starts in ("estimated", "recorded")}


@pytest.mark.parametrize(("starts", "steps"), [("estimated", 2), ("estimated", 9), ("recorded", 2), ("recorded", 4)])
def test_threads_and_an_interruption_change_no_bit(tmp_path: Path, starts: str, steps: int) -> None:
    """After two steps, while jumps are let go, and between estimates of the noise."""
    whole = WHOLE[starts]
    plain, threads, rollouts = whole.fits
    interrupted = Laplace(
        whole.simulator(), likelihood=StateSpace(starts=starts), checkpoint=tmp_path / "fit.safetensors"
    )
    interrupted.checkpoint_seconds = 0.0
    interrupted.progress = stop_after(steps)
    with pytest.raises(KeyboardInterrupt):
        interrupted.fit(whole.logs)
    outliers = load_file(tmp_path / "fit.safetensors").get(".state.search.here.noise.outliers", np.zeros(1))
    assert outliers.any() == (starts == "estimated" and steps > 2)
    interrupted.progress = None
    for other in (threads, interrupted.fit(whole.logs)):
        assert torch.equal(plain.means, other.means)  # type: ignore[attr-defined]
        assert torch.equal(plain.covariances, other.covariances)  # type: ignore[attr-defined]
    assert interrupted.rollouts == rollouts


def test_a_checkpoint_of_another_version_says_so(tmp_path: Path) -> None:
    """One that lacks what the search needs; it is neither a KeyError nor begun anew."""
    path = tmp_path / "fit.safetensors"
    estimator = Laplace(hung(), likelihood=StateSpace(starts="recorded"), checkpoint=path, progress=stop_after(2))
    estimator.checkpoint_seconds = 0.0
    logs = [hung_log(np.array([0.4]), 0)]
    with pytest.raises(KeyboardInterrupt):
        estimator.fit(logs)
    with safe_open(path, framework="numpy") as file:
        metadata = file.metadata()
    plain = json.loads(metadata["plain"])
    del plain["state"]["search"]["here"]["estimates"]
    text = json.dumps(plain)
    arrays = load_file(path)
    save_file(arrays, path, metadata={**metadata, "plain": text, "sha256": checksum(arrays, text)})
    with pytest.raises(CheckpointError, match=r"'estimates'.*of another version.*delete it"):
        Laplace(hung(), likelihood=StateSpace(starts="recorded"), checkpoint=path).fit(logs)
