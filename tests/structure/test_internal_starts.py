"""States of an extension begin where the window before has ended; the user's begin where they are."""

from __future__ import annotations

import numpy as np
import pytest

from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.likelihood import Segments
from sipe_bayes.likelihood.windows import Windows
from sipe_bayes.simulation.simulator import Simulator
from sipe_bayes.structure.extension import Placed, extended, placements
from sipe_bayes.structure.internal_starts import carried_starts, mapped_starts
from sipe_bayes.structure.machine import machine_of
from sipe_bayes.structure.registry import get_extension
from tests.problems.pendulums import log, pendulum

THETA = np.array([0.4, 0.4])
LOGS = Trajectories.stack([log(pendulum(), [0.6, 0.08], seed, f"log {seed}", steps=120) for seed in (1, 2)])


def larger(name: str) -> tuple[Windows, Placed, Windows]:
    """The plain pendulum's windows, an extension, and the extended pendulum's windows: three of either log."""
    plain = Windows(Segments(window=0.4), pendulum(), LOGS)
    (placed,) = placements(get_extension(name), machine_of(plain, THETA, plain.no_starts()))
    simulator = Simulator(extended(plain.simulator.environment, [placed]), 1)
    return plain, placed, Windows(Segments(window=0.4), simulator, LOGS)


OWN = {"hysteresis": [3, 4, 5], "base_compliance": [1, 2, 4, 5]}  # columns of the physics state


@pytest.mark.parametrize(("name", "columns"), OWN.items())
def test_a_window_begins_where_the_one_before_it_ends(name: str, columns: list[int]) -> None:
    plain, placed, windows = larger(name)
    theta = np.concatenate([THETA, np.full(len(placed.parameters), 0.4)])
    starts = mapped_starts(plain.simulator.model, windows.simulator.model, np.full((6, 2), 0.01))
    begun = carried_starts(plain.simulator.model, windows, theta[None], starts[None])[0]
    at_rest, states = windows.states(theta[None], starts[None])[0], windows.states(theta[None], begun[None])[0]
    run = windows.simulator.rollout(theta, windows.actions, at_rest, windows.dt, windows.names)
    assert run.states is not None
    for window in range(6):
        expected = at_rest[window].copy()
        if window % 3:
            expected[columns] = run.states[window - 1, 40, columns]
            assert (expected[columns] != at_rest[window, columns]).any()
        np.testing.assert_allclose(states[window], expected, rtol=1e-12, atol=1e-12)
    assert windows.rollouts == 2


def test_an_extension_without_states_begins_as_the_plain_model_does() -> None:
    plain, placed, windows = larger("dry_friction")
    starts = np.random.default_rng(0).normal(size=(1, 6, 2))
    mapped = mapped_starts(plain.simulator.model, windows.simulator.model, starts)
    theta = np.concatenate([THETA, placed.plain])[None]
    np.testing.assert_array_equal(carried_starts(plain.simulator.model, windows, theta, mapped), starts)
    assert windows.rollouts == 0
