"""Logs with recorded states: of the user's model, so an extension with states of its own starts from measurements."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.likelihood import Segments
from sipe_bayes.likelihood.windows import Windows
from sipe_bayes.simulation.simulator import Simulator
from sipe_bayes.structure.extension import extended, placements
from sipe_bayes.structure.machine import machine_of
from sipe_bayes.structure.probes import effects
from sipe_bayes.structure.registry import get_extension
from tests.problems.pendulums import log, pendulum

NAMES = ("dry_friction", "lag", "presliding", "base_compliance", "delay")
THETA = np.array([0.4, 0.4])


def windows(settings: Segments, simulator: Simulator | None = None) -> Windows:
    """Of a pendulum whose states were recorded."""
    plain, recorded = pendulum(), log(pendulum(), [0.6, 0.08], 4)
    run = plain.rollout(np.array([0.5, 0.4]), recorded.actions, plain.default_state(), recorded.dt)
    assert run.states is not None
    return Windows(settings, simulator or plain, Trajectories.stack([replace(recorded, states=run.states[0])]))


@pytest.mark.parametrize(("starts", "found"), [("estimated", NAMES), ("recorded", NAMES[:1])])
def test_only_estimated_starts_have_room_for_states_of_an_extension(starts: str, found: tuple[str, ...]) -> None:
    bound = windows(Segments(starts=starts))
    machine = machine_of(bound, THETA, bound.no_starts())
    placed = [p for name in NAMES for p in placements(get_extension(name), machine)]
    seen = effects(bound, THETA, bound.no_starts(), placed)
    assert {effect.placed.extension.name for effect in seen} == set(found)


def test_recorded_states_of_a_smaller_model_are_no_starts() -> None:
    bound = windows(Segments())
    machine = machine_of(bound, THETA, bound.no_starts())
    (lag,) = placements(get_extension("lag"), machine)
    larger = Simulator(extended(bound.simulator.environment, [lag]), 1)
    assert windows(Segments(), larger).reference.shape[1] == larger.engine.physics_size
    assert windows(Segments(), larger).starts_measured
    with pytest.raises(ValueError, match="needs trajectories with states of this model"):
        windows(Segments(starts="recorded"), larger)
