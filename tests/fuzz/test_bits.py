"""The same bits in whichever order a batch is simulated, of two methods; and that other bits would be seen."""

from __future__ import annotations

import numpy as np
import pytest

from tests.fuzz import bits
from tests.fuzz.bits import Ordered, Way
from tests.problems.pendulums import pendulum


@pytest.mark.parametrize("name", ["cem", "simopt"])
def test_order_and_threads_change_no_bit(name: str) -> None:
    alone = bits.bits(name, Way())
    assert bits.bits(name, Way(order="shuffled", threads=2)) == alone


def test_other_bits_are_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    alone = bits.bits("cem", Way())
    monkeypatch.setattr(bits, "BUDGET", 100)
    assert bits.bits("cem", Way()) != alone


@pytest.mark.parametrize("order", ["reversed", "shuffled"])
def test_batches_come_back_in_their_order(order: str) -> None:
    rng = np.random.default_rng(0)
    theta, actions = rng.random((5, 2)), rng.normal(size=(5, 7, 1))
    start = np.stack([pendulum().default_state()] * 5)
    one, other = (Ordered(1, how).rollout(theta, actions, start) for how in ("own", order))
    np.testing.assert_array_equal(one.observations, other.observations)
    np.testing.assert_array_equal(one.states, other.states)
