"""What is simulated again in float64, and what is finding of the difference."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sipe_bayes.core.findings import Code
from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.simulation.audit import Audit

STEPS, DT = 20, 0.1


def motion(batch: int) -> Trajectories:
    """Two channels of different size, which vary by 1 and 1000."""
    time = np.linspace(0, 8 * np.pi, STEPS + 1)
    waves = np.sqrt(2) * np.stack([np.sin(time), 1e3 * np.cos(time)], axis=1)
    return Trajectories(
        np.tile(waves, (batch, 1, 1)),
        np.zeros((batch, STEPS, 1)),
        np.full(batch, DT),
        np.full(batch, STEPS),
        np.ones((batch, STEPS + 1), bool),
    )


@pytest.mark.parametrize("batches", [[1] * 1000, [1000], [7, 250, 743]])
def test_the_stated_share_is_simulated_again_whatever_the_batches(batches: list[int]) -> None:
    audit, chosen, before = Audit(1 / 256), [], 0
    for batch in batches:
        chosen += (before + audit.chosen(batch)).tolist()
        before += batch
    assert chosen == [0, 256, 512, 768]
    with audit.every():
        assert audit.chosen(3).tolist() == [0, 1, 2]


@pytest.mark.parametrize(
    ("error", "code", "agreed"),
    [(0.0, Code.FLOAT32_AGREES, STEPS), (8.0, Code.FLOAT32_AGREES, STEPS), (12.0, Code.FLOAT32_DIFFERS, 11)],
)
def test_a_difference_counts_against_what_its_channel_varies_by(error: float, code: Code, agreed: int) -> None:
    double, audit = motion(4), Audit()
    seen = double.observations.copy()
    seen[2, 12:, 1] += error
    audit.chosen(4)
    audit.compare(replace(double, observations=seen), np.array([0, 2]), double[[0, 2]])
    (finding,) = audit.findings()
    assert finding.code is code
    assert [one.agreed for one in audit.compared] == [STEPS, agreed]
    if code is Code.FLOAT32_DIFFERS:
        assert "1 of the 2" in finding.text
        assert "the first 11 control steps (1.1 s)" in finding.text


def test_one_that_only_one_of_the_two_could_simulate_differs() -> None:
    double, audit = motion(2), Audit()
    valid = double.valid.copy()
    valid[1, 5:] = False
    audit.compare(replace(double, valid=valid), np.array([1]), double[[1]])
    assert audit.compared[0].agreed == 4
    assert audit.findings()[0].code is Code.FLOAT32_DIFFERS
