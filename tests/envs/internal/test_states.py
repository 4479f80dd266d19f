"""States that an extension brings: windows start at rest in them, as far from it as the model says."""

from __future__ import annotations

import re

import mujoco
import numpy as np
import pytest

from sipe_bayes.core.parameters import Parameter
from sipe_bayes.core.trajectory import Trajectories, Trajectory
from sipe_bayes.envs.internal.states import UNSETTLED, declare_start, filtered_command, filtered_commands, start_sd
from sipe_bayes.envs.mjcf import MjcfEnvironment
from sipe_bayes.likelihood import Segments, StateSpace
from sipe_bayes.likelihood.state_space.chain import Chain
from sipe_bayes.likelihood.windows import Windows
from sipe_bayes.simulation.simulator import Simulator
from sipe_bayes.structure.extensions.sites import FilteredCommand
from tests.problems.machines import MACHINES, environment


def test_a_models_own_states_have_any_states_prior_and_declared_ones_theirs() -> None:
    spec = mujoco.MjSpec.from_string(MACHINES["double"].xml)
    declare_start(spec, "joint:elbow", [0.1, 2.0])
    FilteredCommand(("m2",), 0.3)(spec)
    declare_start(spec, "actuator:m2", [7.0])  # said already
    model = mujoco.MjModel.from_xml_string(spec.compile() and spec.to_xml())
    wide = np.array([10.0, 10.0, 100.0, 100.0, 10.0])
    np.testing.assert_allclose(start_sd(model, wide), [10, 0.1, 100, 2.0, 0.3])
    assert filtered_commands(model) == [(1, 1 + 2 + 2)]
    plain = mujoco.MjModel.from_xml_string(MACHINES["double"].xml)
    np.testing.assert_array_equal(start_sd(plain, wide[:4]), wide[:4])


def test_windows_start_at_the_command_before_them() -> None:
    drive = MACHINES["double"]
    simulator = Simulator(environment(drive, edits=[FilteredCommand(("m2",), 0.3)]), 1)
    actions = np.random.default_rng(0).normal(size=(60, 2))
    run = simulator.rollout(np.full(1, 0.5), actions, simulator.default_state(), 0.008)
    channels = simulator.environment.channels
    recorded = Trajectories.stack([Trajectory(run.observations[0], actions, 0.008, channels=channels)])
    windows = Windows(Segments(window=0.16), simulator, recorded)
    np.testing.assert_array_equal(windows.reference[:, 5], actions[[0, 19, 39], 1])
    chain = Chain(StateSpace(), simulator, recorded)
    np.testing.assert_array_equal(chain.reference[:, 5], actions[[0, *range(60)], 1])
    np.testing.assert_allclose(windows.start_precision, np.array([10, 10, 100, 100, 0.3]) ** -2.0)


def filtered(kind: str = "filterexact", more: str = "", tau: float = 0.12) -> str:
    """A pendulum whose motor has a filter, or more."""
    own = rf'<general \1 dyntype="{kind}" dynprm="{tau}" {more}/>'
    return re.sub(r"<motor ([^>]*)/>", own, MACHINES["pendulum"].xml)


@pytest.mark.parametrize("recorded", [False, True])
@pytest.mark.parametrize(
    ("kind", "more"),
    [
        ("filter", ""),
        ("filterexact", ""),
        ("filterexact", 'ctrlrange="-.3 .3"'),
    ],
)
def test_windows_of_a_models_own_filter_start_where_the_commands_have_brought_it(
    kind: str, more: str, recorded: bool
) -> None:
    """As simulated from the first command on, to what steps as long as a thirtieth of its time constant differ by.

    Recorded states say it exactly, also of a filter that is another one.
    """
    lag, xml = Parameter("lag", 0.02, 0.5, targets=("actuator:motor.lag",)), filtered(kind, more)
    simulator = Simulator(MjcfEnvironment.build(xml, [lag], ["motor"], ["joint:hinge.position"]), 1)
    actions, begun = np.random.default_rng(0).normal(size=(60, 1)), simulator.default_state()
    begun[3] = filtered_command(simulator.model, 0, actions[:1, 0], 0.004)
    tau = 0.3 if recorded else 0.12
    run = simulator.rollout(simulator.space.normalise(np.array([tau]))[None], actions[None], begun[None], 0.02)
    assert run.states is not None
    states = run.states[0] if recorded else None
    logs = Trajectories.stack([Trajectory(run.observations[0], actions, 0.02, states=states, channels=run.channels)])
    windows = Windows(Segments(window=0.4), simulator, logs)
    np.testing.assert_allclose(
        windows.reference[:, 3], run.states[0, windows.start, 3], atol=1e-12 if recorded else 0.02
    )
    largest = 0.3 if "ctrlrange" in more else np.abs(actions).max()
    np.testing.assert_allclose(windows.start_precision[2], (UNSETTLED * largest) ** -2.0)


def test_where_a_filter_is_after_commands() -> None:
    past = np.array([1.0, 2.0, 4.0])

    def after(past: np.ndarray, more: str = "", tau: float = 0.12) -> float:
        return filtered_command(mujoco.MjModel.from_xml_string(filtered(more=more, tau=tau)), 0, past, 0.01)

    assert after(past, tau=0.0) == 4.0
    assert after(past, tau=1e-6) == 4.0
    assert after(past[:1]) == 1.0
    np.testing.assert_allclose(after(past, tau=1e6), 1.0, atol=1e-6)  # which has hardly moved yet
    assert after(past, 'delay="0.01" nsample="20"', tau=0.0) == 2.0
    assert after(past, 'ctrlrange="-3 3"', tau=0.0) == 3.0
    assert after(past, 'actrange="-.5 .5"') == 0.5
    assert after(past, 'delay="0.08" nsample="40"', tau=0.0) == 1.0


def test_laws_remember_that_the_motion_has_gone_on() -> None:
    """From the direction where the joint moves; friction that is built up over a distance wholly, long springs not."""
    drive = MACHINES["pendulum"]
    bounds = {"presliding_friction": 0.0, "presliding_range": 0.1, "hysteresis_force": 0.0, "hysteresis_range": 0.1}
    parameters = [Parameter(name, low, 1.0, targets=(f"joint:hinge.{name}",)) for name, low in bounds.items()]
    simulator = Simulator(environment(drive, parameters), 1)
    model, states = simulator.model, np.tile(simulator.default_state(), (3, 1))
    states[:, 2] = [2.0, 0.0, -2.0]
    begun = simulator.environment.history(model, states, [], np.full(3, 0.004))[:, 3:]
    np.testing.assert_allclose(begun[0], [1, 1, 0.5, 0], atol=1e-4)
    np.testing.assert_array_equal(begun[1], 0.0)
    np.testing.assert_array_equal(begun[2], -begun[0])
    np.testing.assert_allclose(simulator.environment.start_sd(model)[2:], 0.6)
