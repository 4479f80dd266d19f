"""Positions that jump where nothing moves so fast are told; motions, steps of an encoder and noise are not."""

from __future__ import annotations

import numpy as np
import pytest

from sipe_bayes.calibration.log_report import jumps
from sipe_bayes.core.arrays import FloatArray

TIME = np.arange(0, 5, 0.005)
SWING = 0.2 * np.sin(3 * TIME) + 0.05 * np.sin(11 * TIME)


def test_what_came_round_and_wild_samples_are_found() -> None:
    counts = np.round(SWING / 5e-6)
    wrapped = (counts + 2**15) % 2**16 - 2**15  # sixteen bits
    beyond = np.flatnonzero(np.diff(wrapped - counts) != 0)
    assert len(beyond) > 1
    assert jumps(wrapped).tolist() == beyond.tolist()
    wild = SWING.copy()
    wild[300] += 1.0
    assert jumps(wild).tolist() == [299, 300]


@pytest.mark.parametrize(
    "values",
    [
        SWING,
        SWING + np.random.default_rng(0).normal(0, 0.01, len(SWING)),
        np.round(SWING / 0.01) * 0.01,  # a coarse encoder
        np.where(TIME < 4, 0.0, np.sin(40 * (TIME - 4))),  # at rest, then fast
        np.abs(np.sin(7 * TIME)),  # bounces
        np.zeros(1000),
        np.zeros(3),
    ],
)
def test_motions_are_none(values: FloatArray) -> None:
    assert not len(jumps(values))
