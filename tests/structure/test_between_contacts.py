"""Logs through impacts are searched where nothing touches: a ball that bounces, with drag that its model lacks."""

from __future__ import annotations

import numpy as np
import pytest

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.parameters import Parameter
from sipe_bayes.core.trajectory import Trajectories, Trajectory
from sipe_bayes.envs.mjcf import MjcfEnvironment
from sipe_bayes.likelihood import Segments, bind
from sipe_bayes.simulation.simulator import Simulator
from sipe_bayes.structure.discovery import LEAST_SPAN, Restriction, discover

DT, SD = 0.01, 0.001
XML = """<mujoco><option timestep="0.002" integrator="implicitfast"/><worldbody>
<geom name="floor" type="plane" size="5 5 .1" solref="0.01 0.2"/>
<body name="ball" pos="0 0 1"><joint name="x" type="slide" axis="1 0 0"/><joint name="z" type="slide" axis="0 0 1"/>
<geom name="ball" size=".05" mass=".1" solref="0.01 0.2"/></body></worldbody>
<actuator><motor name="push" joint="x"/></actuator></mujoco>"""
GAIN = Parameter("gain", 0.5, 2.0, targets=("actuator:push.gain",))
DRAG = [Parameter(f"drag_{j}", 0.0, 0.5, targets=(f"joint:{j}.damping",)) for j in "xz"]


def ball(*more: Parameter) -> Simulator:
    channels = ["joint:x.position", "joint:z.position"]
    return Simulator(MjcfEnvironment.build(XML, [GAIN, *more], ["push"], channels), num_threads=1)


def dropped(drag: float, seed: int, seconds: float = 2.0) -> Trajectory:
    """A ball that is pushed to and fro as it bounces."""
    engine, random = ball(*DRAG), np.random.default_rng(seed)
    times = DT * np.arange(round(seconds / DT))
    actions = 0.3 * np.sin(2 * np.pi * (1.5 * times[:, None] + random.uniform()))
    theta = engine.space.normalise(np.array([1.2, drag, drag]))
    run = engine.rollout(theta[None], actions[None], engine.default_state()[None], dt=DT)
    noisy: FloatArray = run.observations[0] + SD * random.standard_normal(run.observations[0].shape)
    return Trajectory(noisy, actions, DT, name=f"drop {seed}", channels=run.channels)


@pytest.mark.parametrize(("drag", "found"), [(0.1, True), (0.0, False)])
def test_drag_is_found_in_flight_and_only_where_there_is_some(drag: float, found: bool) -> None:
    logs = Trajectories.stack([dropped(drag, seed) for seed in (1, 2)])
    assert bind(Segments(0.5), ball(), logs).impacts
    structures = discover(ball(), logs, restriction=Restriction(only=("viscous_friction", "dry_friction", "spring")))
    assert bool(structures.best.labels) == found
    if found:
        assert any(label.startswith("viscous_friction") for label in structures.best.labels)


def test_spans_are_those_in_which_the_ball_flies() -> None:
    log = dropped(0.0, 1)
    spans = bind(Segments(0.5), ball(), Trajectories.stack([log])).spans_apart(LEAST_SPAN)
    assert all(np.nanmin(span.observations[:, 1]) > -0.95 - 3 * SD for span in spans)
    assert 0.5 < sum(len(span) for span in spans) / len(log) < 1.0
    assert all(span.name.startswith("drop 1 from ") for span in spans)


def test_nothing_is_of_a_single_log_between_contacts() -> None:
    """Two flights of one log have no gains of their own; one flight is enough to be searched, held-out ones too."""
    log, other = dropped(0.1, 1, seconds=0.9), dropped(0.1, 2, seconds=0.9)
    few = Restriction(only=("log_gain", "viscous_friction"))
    found = discover(ball(), Trajectories.stack([log]), holdout=Trajectories.stack([other]), restriction=few)
    assert not any(label.startswith("log_gain") for label in found.search.placed)
    assert found.search.fitting.holdout is not None
    assert {name.partition(" from ")[0] for name in found.search.fitting.trajectories.names} == {"drop 1"}


def test_what_touches_all_along_is_refused_in_one_line() -> None:
    low = XML.replace('pos="0 0 1"', 'pos="0 0 0.05"')
    simulator = Simulator(MjcfEnvironment.build(low, [GAIN], ["push"], ["joint:x.position", "joint:z.position"]), 1)
    log, random = dropped(0.0, 1), np.random.default_rng(0)
    rolls = np.stack([0.3 * np.sin(0.1 * np.arange(len(log) + 1)), 0.02 * random.standard_normal(len(log) + 1)], axis=1)
    rests = Trajectory(rolls, log.actions, DT, name="rests", channels=log.channels)
    with pytest.raises(ValueError, match="bodies touch nearly all the time"):
        discover(simulator, Trajectories.stack([rests]))
