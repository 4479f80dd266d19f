"""Filters of commands start where the commands before a window have brought them."""

from __future__ import annotations

import numpy as np
import pytest

from sipe_bayes.core.parameters import Parameter
from sipe_bayes.core.trajectory import Trajectories, Trajectory
from sipe_bayes.envs.mjcf import MjcfEnvironment
from sipe_bayes.likelihood import Segments
from sipe_bayes.likelihood.windows import Windows
from sipe_bayes.simulation.simulator import Simulator

XML = """<mujoco><option timestep="0.005" integrator="INTEGRATOR"/><worldbody><body>
<joint name="rail" type="slide" axis="1 0 0" damping="2"/><geom size="0.1" mass="1"/></body></worldbody><actuator>
<general name="valve" joint="rail" dyntype="DYNTYPE" dynprm="0.03" ctrlrange="-1 1" actearly="true" LIMITS/></actuator>
</mujoco>"""
DT, STEPS, OTHER, ACTIVATION = 0.01, 100, 0.07, 3  # s, control steps, an activation, its column of the state


def machine(dyntype: str, *parameters: Parameter, integrator: str = "Euler", limits: str = "") -> Simulator:
    xml = XML.replace("DYNTYPE", dyntype).replace("INTEGRATOR", integrator).replace("LIMITS", limits)
    return Simulator(MjcfEnvironment.build(xml, parameters, ["valve"], ["joint:rail.position"]), num_threads=1)


def lag(log: str | None = None) -> Parameter:
    return Parameter(f"lag{log or ''}", 0.01, 0.2, targets=("actuator:valve.lag",), log=log)


def recorded(
    simulator: Simulator, theta: np.ndarray, names: tuple[str, ...], other: float = OTHER
) -> tuple[Trajectories, np.ndarray]:
    """Logs that begin with another activation than the first command's, and their states (L, STEPS + 1, S)."""
    rng, logs, states = np.random.default_rng(0), [], []
    for name in names:
        actions = rng.uniform(-1.3, 1.3, (STEPS, 1))
        start = simulator.default_state()
        start[ACTIVATION] = np.clip(actions[0, 0], -1, 1) + other
        run = simulator.rollout(theta[None], actions[None], start[None], DT, [name])
        assert run.states is not None
        logs.append(Trajectory(run.observations[0], actions, DT, name=name))
        states.append(run.states[0])
    return Trajectories.stack(logs), np.stack(states)


@pytest.mark.parametrize("dyntype", ["filter", "filterexact"])
@pytest.mark.parametrize("lags", [(0.013,), (0.16,), (0.02, 0.16)])
def test_filters_start_where_a_simulation_of_the_whole_log_has_them(lags: tuple[float, ...], dyntype: str) -> None:
    """Also one with a lag of its own in each log, and whatever it was before the log."""
    names = tuple(f"log {k}" for k in range(len(lags)))
    parameters = [lag()] if len(lags) == 1 else [lag(name) for name in names]
    simulator = machine(dyntype, *parameters)
    theta = np.array([p.normalise(value) for p, value in zip(parameters, lags, strict=True)])
    logs, states = recorded(simulator, theta, names)
    windows = Windows(Segments(0.2), simulator, logs)
    starts = windows.no_starts()
    starts[:, windows.filters.numbers] = OTHER
    for view in (windows, windows.part(np.array([4, 1]))):
        both = view.states(np.stack([np.full_like(theta, 0.5), theta]), np.stack([starts[: view.num_windows]] * 2))
        expected = states[view.log, view.start, ACTIVATION]
        np.testing.assert_allclose(both[1, :, ACTIVATION], expected, atol=1e-9)
        assert np.abs(both[0, :, ACTIVATION] - expected).max() > 0.02


@pytest.mark.parametrize(
    ("integrator", "late", "accuracy"),
    [
        ("Euler", 0.01, 1e-6),
        ("implicitfast", 0.0126, 1e-6),
        ("Euler", 0.0174, 1e-6),
        ("RK4", 0.0, 1e-6),
        ("RK4", 0.0126, 0.1),
    ],
)
@pytest.mark.parametrize("dyntype", ["filter", "filterexact"])
def test_filters_are_late_and_integrated_as_the_simulation_has_them(
    dyntype: str, integrator: str, late: float, accuracy: float
) -> None:
    """Delays are no whole numbers of physics steps; by RK4 to half a step of theirs."""
    delay = Parameter("delay", 0.0, 0.03, targets=("actuator:valve.delay",))
    parameters = [lag(), delay][: 1 + (late > 0)]
    simulator = machine(dyntype, *parameters, integrator=integrator)
    theta = np.array([p.normalise(value) for p, value in zip(parameters, (0.03, late), strict=False)])
    logs, states = held(simulator, theta)
    windows = Windows(Segments(0.2), simulator, logs)
    begun = windows.states(theta[None], windows.no_starts()[None])[0]
    np.testing.assert_allclose(begun[:, ACTIVATION], states[0, windows.start, ACTIVATION], atol=accuracy)


def test_a_filter_stays_within_its_limits() -> None:
    simulator = machine("filterexact", lag(), limits='actlimited="true" actrange="-.2 .3"')
    theta = np.array([lag().normalise(0.03)])
    logs, states = held(simulator, theta)
    windows = Windows(Segments(0.2), simulator, logs)
    begun = windows.states(theta[None], windows.no_starts()[None])[0]
    np.testing.assert_allclose(begun[:, ACTIVATION], states[0, windows.start, ACTIVATION], atol=1e-6)


def held(simulator: Simulator, theta: np.ndarray) -> tuple[Trajectories, np.ndarray]:
    """A log whose first command was held for long."""
    actions = np.random.default_rng(1).uniform(-1.3, 1.3, (STEPS, 1))
    actions[:60] = 0.25
    run = simulator.rollout(theta[None], actions[None], simulator.default_state()[None], DT)
    assert run.states is not None
    log = Trajectory(run.observations[0, 50:], actions[50:], DT)
    return Trajectories.stack([log]), run.states[:, 50:]


def test_what_is_recorded_is_taken_as_it_is() -> None:
    simulator = machine("filterexact", lag())
    logs, states = recorded(simulator, np.array([0.3]), ("log",))
    full = Trajectory(logs.observations[0], logs.actions[0], DT, states=states[0])
    windows = Windows(Segments(0.2), simulator, Trajectories.stack([full]))
    begun = windows.states(np.array([[0.9]]), windows.no_starts()[None])[0]
    np.testing.assert_allclose(begun[:, ACTIVATION], states[0, windows.start, ACTIVATION], atol=1e-12)
