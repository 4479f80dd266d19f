"""A probe beside a parameter that does about the same: what tells a lag from a delay, and where both then are."""

from __future__ import annotations

import numpy as np
import pytest

from sipe_bayes.core.parameters import Parameter
from sipe_bayes.core.trajectory import Trajectories, Trajectory
from sipe_bayes.diagnostics.misfit import misfit
from sipe_bayes.inference import get_estimator
from sipe_bayes.likelihood import Noise, Segments, bind
from sipe_bayes.likelihood.windows import Windows
from sipe_bayes.simulation.simulator import Simulator
from sipe_bayes.structure import Restriction, discover
from sipe_bayes.structure.augmented import AugmentedModel
from sipe_bayes.structure.discrepancy import find_discrepancy
from sipe_bayes.structure.extension import Extension, members, placements
from sipe_bayes.structure.extensions.sites import FilteredCommand
from sipe_bayes.structure.machine import machine_of
from sipe_bayes.structure.probes import effects, imitating
from sipe_bayes.structure.registry import get_extension
from tests.problems.machines import MACHINES, environment
from tests.problems.pendulums import log, pendulum

DELAY = Parameter("delay", 0.0, 0.15, targets=("actuator:motor.delay",))
LATE = Parameter("late", 0.0, 0.1, targets=("sensor:joint:hinge.position.delay",))
LAG = Parameter("lag", 0.0, 0.2, targets=("actuator:motor.lag",))
FILTER = Parameter("filter", 0.0, 0.1, targets=("sensor:joint:hinge.position.filter",))
MISSING = {
    "a first-order lag of motor": (DELAY, [DELAY, LAG], [FilteredCommand(("motor",), 0.6)], [0.03, 0.06]),
    "a low-pass filter of joint:hinge.position": (LATE, [LATE, FILTER], [], [0.02, 0.06]),
}


def test_a_part_of_windows_that_come_late_is_probed_on_its_own_samples() -> None:
    """As of long logs that are searched: a sample more or less would raise."""
    simulator, settings = pendulum(), Segments(0.5, late=(("joint:hinge.position", 0.1),))
    windows = Windows(settings, simulator, Trajectories.stack([log(simulator, [0.6, 0.08], 2)]))
    part = windows.part(np.array([1, 3]))
    like = Windows(settings, simulator, windows.trajectories, part)
    assert part.steps.tolist() == like.steps.tolist() == [60, 60]
    assert (part.observed == like.observed).all()


@pytest.mark.parametrize("cause", MISSING)
def test_what_is_missing_beside_a_delay_is_named_and_the_delay_held(cause: str) -> None:
    """The delay alone takes most of it on, and lies by as much; its interval with what is missing reaches the truth."""
    own, both, edits, values = MISSING[cause]
    truth, simulator = pendulum(*both, edits=edits), pendulum(own)
    recorded = Trajectories.stack([log(truth, [0.6, 0.08, *values], k, name=str(k), sd=0.003) for k in (2, 3)])
    method = get_estimator(simulator, "laplace", restarts=1, candidates=0)
    posterior = method.fit(recorded)
    noise = Noise(np.array(method.diagnostics["noise_sd"]), np.array(method.diagnostics["noise_tau"]))
    logs = AugmentedModel(bind(method.likelihood, simulator, recorded), posterior.mode.numpy(), noise)
    lacking = find_discrepancy(logs)
    seen = misfit(lacking, posterior.stddev.numpy())
    delay, plain = (
        own.value(lacking.draw(posterior, 0).quantile([0.05, 0.95]).numpy()[:, 2]),
        posterior.quantile([0.05]).numpy(),
    )
    print(seen.finding.text, lacking.causes, delay, own.value(plain[0, 2]))
    assert seen.alarm
    assert cause in (*seen.cause.split(" or "), *lacking.causes)
    assert own.value(plain[0, 2]) > values[0] + 0.01
    assert delay[0] <= values[0] <= delay[1]


def test_a_search_begins_and_ends_where_delay_and_lag_are() -> None:
    truth = pendulum(DELAY, LAG, edits=[FilteredCommand(("motor",), 0.6)])
    recorded = log(truth, [0.6, 0.08, 0.03, 0.06], 2, sd=0.003)
    structures = discover(pendulum(DELAY), Trajectories.stack([recorded]), restriction=Restriction(only=("lag",)))
    offer, plain = structures.offers()[0], structures.plain
    delay = DELAY.value(np.array([plain.theta[2], offer.others[2], structures.best.theta[2]]))
    print(offer, delay)
    assert delay[0] > 0.07
    assert abs(delay[1] - 0.03) < 0.02
    assert structures.best.labels == ("lag:motor",)
    assert delay[2] == pytest.approx(0.03, abs=0.006)
    assert structures.best.theta[3] * 0.2 == pytest.approx(0.06, abs=0.006)


def double(*targets: str) -> Windows:
    """Two driven joints with a parameter of these targets beside a mass."""
    made = Simulator(environment(MACHINES["double"], [Parameter("shared", 0.0, 0.1, targets=targets)]), 1)
    actions = np.sin(0.1 * np.arange(90)[:, None] + np.arange(2))
    run = made.rollout(np.array([0.5, 0.5]), actions, made.default_state(), 0.008)
    recorded = Trajectory(run.observations[0], actions, 0.008, name="a", channels=made.environment.channels)
    return Windows(Segments(window=0.24), made, Trajectories.stack([recorded]))


SHARED = [
    (get_extension("lag"), ["actuator:m1.delay", "actuator:m2.delay"], "m1 and\u00a0m2", "actuator:{}.lag"),
    (
        get_extension("sensor_filter"),
        ["sensor:joint:shoulder.position.delay", "sensor:joint:elbow.position.delay"],
        "joint:shoulder.position and\u00a0joint:elbow.position",
        "sensor:{}.filter",
    ),
]


@pytest.mark.parametrize(("extension", "targets", "site", "target"), SHARED)
def test_sites_of_one_parameter_are_a_site_together(
    extension: Extension, targets: list[str], site: str, target: str
) -> None:
    """Where the user takes two to be late alike, they may lag alike; and each by itself, which no probe trades."""
    windows = double(*targets)
    theta, starts = np.array([0.5, 0.5]), windows.no_starts()
    placed = list(placements(extension, machine_of(windows, theta, starts)))
    (*alone, last) = placed
    assert (last.site, last.label) == (site, f"{extension.name}:{site}")
    assert last.parameters[0].targets == tuple(target.format(name) for name in members(site))
    assert all(len(members(one.site)) == 1 for one in alone)
    seen = {effect.placed.site: effect for effect in effects(windows, theta, starts, placed)}
    step = float(last.parameters[0].value(seen[site].probes[0, 0]))
    np.testing.assert_allclose(seen[site].trades, [[0.0, -step / 0.1]])  # of the 50 ms, all
    assert step == pytest.approx(0.05)
    assert all(not seen[one.site].trades.any() for one in alone)


def test_nothing_is_taken_from_a_parameter_at_its_bound_nor_from_one_of_other_targets() -> None:
    windows = double("actuator:m1.delay")
    space, starts = windows.simulator.space, windows.no_starts()
    for theta, far in ((0.5, 0.05), (0.0, 0.008)):
        at = np.array([0.5, theta])
        (first, second) = placements(get_extension("lag"), machine_of(windows, at, starts))
        for one, step, trade in ((first, far, -far * (far == 0.05) / 0.1), (second, 0.008, 0.0)):
            (effect,) = effects(windows, at, starts, [one])
            assert float(one.parameters[0].value(effect.probes[0, 0])) == pytest.approx(step)
            np.testing.assert_allclose(effect.trades, [[0.0, trade]])
    lag, sites = get_extension("lag"), ("m1", "m2", "m1 and\u00a0m2")
    assert [imitating(lag, site, tuple(space)) for site in sites] == [1, None, 1]
