"""What a shorter physics step would change: exactly where it is known, named where a log shows it, and allowed for."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
import torch

from sipe_bayes.calibration.checks.lacking import untold
from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.parameters import Parameter
from sipe_bayes.core.trajectory import Trajectories, Trajectory
from sipe_bayes.diagnostics.misfit import misfit
from sipe_bayes.envs.mjcf import MjcfEnvironment
from sipe_bayes.inference import get_estimator
from sipe_bayes.likelihood import Noise, QuadraticPrior, Segments, bind
from sipe_bayes.likelihood.windows import Windows
from sipe_bayes.posterior import Particles
from sipe_bayes.simulation.simulator import Simulator
from sipe_bayes.structure import Restriction, Structures, discover
from sipe_bayes.structure.augmented import AugmentedModel
from sipe_bayes.structure.candidates import rank_candidates
from sipe_bayes.structure.discrepancy import find_discrepancy
from sipe_bayes.structure.extension import placements
from sipe_bayes.structure.machine import machine_of
from sipe_bayes.structure.probes import effects
from sipe_bayes.structure.registry import EXTENSIONS, get_extension
from sipe_bayes.structure.tolerances import EXACT, Tolerances
from tests.problems.pendulums import DT, log, pendulum, stepped

SLIDE = """
<mujoco>
  <option timestep="0.005" gravity="0 0 0"/>
  <worldbody>
    <body name="cart">
      <joint name="x" type="slide" axis="1 0 0"/>
      <geom size="0.1" mass="2" contype="0" conaffinity="0"/>
    </body>
  </worldbody>
  <actuator><motor name="push" joint="x"{history}/></actuator>
</mujoco>
"""
ALLOWED = Tolerances(physics_step=1.0)
ONE = Parameter("mass", 1.0, 3.0, targets=("body:cart.mass",))


def slide(history: str = "") -> Simulator:
    xml = SLIDE.format(history=history)
    return Simulator(MjcfEnvironment.build(xml, [ONE], ["push"], ["joint:x.position"]), 1)


def pushed(simulator: Simulator, states: bool = False) -> Windows:
    """A second, from .2 s on 6 N, which the mass of 2 kg follows by 3 m/s^2."""
    actions = np.where(np.arange(50)[:, None] < 10, 0.0, 6.0)
    motion = simulator.rollout([[0.5]], actions[None], np.atleast_2d(simulator.default_state()), dt=0.02)
    known = Trajectory(motion.observations[0], actions, 0.02, motion.states[0] if states else None, "pushed")
    settings = Segments(None, starts="recorded" if states else "estimated")
    return Windows(settings, simulator, Trajectories.stack([known]))


def lead_since(begin: float, step: float = 0.005, dt: float = 0.02) -> FloatArray:
    """What lacks of it where steps are an eighth as long."""
    return -3.0 * np.maximum(0.0, dt * np.arange(51) - begin) * 7 / 8 * step / 2


def change(windows: Windows, theta: FloatArray) -> FloatArray | None:
    """Of the predictions (W, L, C); None where nothing can be said."""
    own = list(placements(get_extension("physics_step"), machine_of(windows, theta, windows.no_starts())))
    found = effects(windows, theta, windows.no_starts(), own)
    return found[0].change[..., 0] if found else None


def test_eulers_steps_lead_by_half_a_step() -> None:
    """x_n = a h^2 n (n + 1) / 2 where the machine has a t^2 / 2."""
    found = change(pushed(slide()), np.array([0.5]))
    assert found is not None
    np.testing.assert_allclose(found[0, :, 0], lead_since(0.2), atol=1e-12)


def test_a_delay_of_the_models_own_stays_what_it_is() -> None:
    """Of 20 ms, whose history of commands is then twice as long; recorded states do not tell it."""
    late = slide(' delay="0.02" nsample="4" interp="linear"')
    found = change(pushed(late), np.array([0.5]))
    assert found is not None
    np.testing.assert_allclose(found[0, :, 0], lead_since(0.22), atol=1e-12)
    for simulator, asked in ((slide(), True), (late, False)):
        rows = pushed(simulator, states=True)
        assert (change(rows, np.array([0.5])) is not None) == asked


def fitted(step: float, seed: int) -> tuple[AugmentedModel, Particles, FloatArray]:
    """A log of a pendulum in steps of so many seconds, fitted by one in steps of 10 ms."""
    truth, simulator = pendulum(edits=[partial(stepped, seconds=step)]), pendulum()
    recorded = Trajectories.stack([log(truth, [0.6, 0.08], seed, sd=0.002)])
    method = get_estimator(simulator, "laplace", restarts=1, candidates=0)
    posterior = method.fit(recorded)
    noise = Noise(np.array(method.diagnostics["noise_sd"]), np.array(method.diagnostics["noise_tau"]))
    windows = bind(method.likelihood, simulator, recorded)
    values = simulator.space.normalise(np.array([0.6, 0.08]))
    drawn = Particles(posterior.sample((4000,), generator=torch.Generator().manual_seed(0)), simulator.space)
    return AugmentedModel(windows, posterior.mode.numpy(), noise), drawn, values


def test_each_log_has_the_error_of_its_own_steps() -> None:
    """Of 5 ms, and of 2 ms where a log has samples that close."""
    simulator = slide()
    rows = []
    for dt in (0.02, 0.002):
        actions = np.full((50, 1), 6.0)
        motion = simulator.rollout([[0.5]], actions[None], np.atleast_2d(simulator.default_state()), dt=dt)
        rows.append(Trajectory(motion.observations[0], actions, dt, None, f"{dt:g}"))
    windows = Windows(Segments(None), simulator, Trajectories.stack(rows))
    found = change(windows, np.array([0.5]))
    assert found is not None
    np.testing.assert_allclose(found[0, :, 0], lead_since(0.0), atol=1e-12)
    # of 2 ms: the longest that are shorter than .625 ms and divide a sample are .5 ms
    np.testing.assert_allclose(found[1, :, 0], lead_since(0.0, 0.002, 0.002) * 6 / 7, atol=1e-12)


def test_recorded_states_are_where_both_runs_begin() -> None:
    """Of a log that has them but whose starts are estimated, with a delay, whose history is then another."""
    simulator = pendulum(Parameter("delay", 0.0, 0.1, targets=("actuator:motor.delay",)))
    begun = log(simulator, [0.6, 0.08, 0.02], 3)
    motion = simulator.rollout(
        simulator.space.normalise([0.6, 0.08, 0.02]), begun.actions, simulator.default_state(), dt=DT
    )
    assert motion.states is not None
    known = Trajectory(begun.observations, begun.actions, DT, motion.states[0], "known")
    windows = Windows(Segments(0.5), simulator, Trajectories.stack([known]))
    found = change(windows, simulator.space.normalise(np.array([0.6, 0.08, 0.02])))
    assert found is not None
    np.testing.assert_allclose(found[:, 0], 0.0, atol=1e-12)
    assert np.abs(found).max() > 1e-4


@pytest.mark.parametrize(("step", "shows"), [(DT / 20, True), (DT, False)])
def test_a_machine_without_steps_is_told_from_one_with_the_models(step: float, shows: bool) -> None:
    """False alarms at 1 %, and the seed is fixed."""
    logs, drawn, values = fitted(step, 3)
    seen = misfit(find_discrepancy(logs), drawn.stddev.numpy())
    print(seen.finding.text)
    assert seen.alarm == shows
    assert ("physics step" in seen.finding.text) == shows
    for tolerances in (EXACT, ALLOWED):
        low, high = find_discrepancy(logs, tolerances).draw(drawn, 0).quantile([0.05, 0.95]).numpy()
        print(low, values, high, drawn.quantile([0.05, 0.95]).numpy())
        assert ((low <= values) & (values <= high)).all()


def test_a_step_of_which_the_logs_tell_is_not_untold() -> None:
    """Whichever sign its size seems to have, in logs in the model's own steps."""
    signs = set()
    for seed in (1, 2, 3, 4):
        logs, *_ = fitted(DT, seed)
        assert untold(find_discrepancy(logs, ALLOWED)) == []
        (k,) = (k for k, probe in enumerate(logs.probes) if probe.is_step)
        signs.add(bool(logs.seen.projected.score[k] > 0))
    assert signs == {True, False}


AMONG = ("physics_step", "delay", "lag", "sensor_delay", "dry_friction", "spring")
STEPS = {"physics_step:world"}


def among(recorded: Trajectory) -> Structures:
    """Searched among a few extensions."""
    without = tuple(name for name in EXTENSIONS if name not in AMONG)
    return discover(pendulum(), Trajectories.stack([recorded]), restriction=Restriction(without=without))


@pytest.mark.parametrize(
    ("steps", "planted", "size", "best"),
    [
        (0.1, None, 0.0, set()),
        (1.0, "actuator:motor.delay", 0.03, {"delay:motor"}),
        (0.1, "actuator:motor.delay", 0.03, {"delay:motor"}),
        (0.1, "joint:hinge.frictionloss", 0.1, {"dry_friction:hinge"}),
    ],
    ids=["steps", "delay", "steps and a delay", "steps and friction"],
)
def test_what_steps_do_is_not_named_as_a_piece(steps: float, planted: str | None, size: float, best: set[str]) -> None:
    """Without shorter steps that compete with them a delay of half a step would explain the first log."""
    extra = [] if planted is None else [Parameter("planted", 0.0, 0.5, targets=(planted,))]
    truth = pendulum(*extra, edits=[partial(stepped, seconds=steps * DT)])
    recorded = log(truth, [0.6, 0.08, size][: len(truth.space)], 5, sd=0.002)
    structures = among(recorded)
    print(structures.table())
    pieces = set(structures.best.labels)
    assert pieces - STEPS == best
    assert bool(pieces & STEPS) == (steps < 1.0)
    for label in best:
        (value,) = structures.posterior_of_piece(label).values(2000).mean(0)
        assert value == pytest.approx(size, rel=0.1)


def placed(restriction: Restriction, simulator: Simulator) -> set[str]:
    """Labels of all that a search may try."""
    theta = simulator.space.normalise(np.array([0.6, 0.08]))
    logs = Trajectories.stack([log(simulator, simulator.space.values(theta).tolist(), 3)])
    return set(discover(simulator, logs, restriction=restriction, budget=400).search.placed)


@pytest.mark.parametrize(
    ("restriction", "tried"),
    [
        (Restriction(sites=("hinge",)), False),
        (Restriction(only=("delay", "physics_step")), True),
        (Restriction(only=("delay", "spring")), False),
        (Restriction(without=("physics_step",)), False),
    ],
    ids=["sites", "chosen", "others", "without"],
)
def test_steps_are_tried_unless_other_pieces_are_chosen_or_they_are_left_out(
    restriction: Restriction, tried: bool
) -> None:
    assert STEPS & placed(restriction, pendulum()) == (STEPS if tried else set())


@pytest.mark.parametrize(("truth", "least", "most"), [(DT / 16, 30.0, 200.0), (DT, 0.0, 2.0)])
def test_what_shorter_steps_promise_is_about_what_they_gain(truth: float, least: float, most: float) -> None:
    """At the optimum of a log in fine steps as much as the fit then gains; of one in the model's own steps nothing."""
    simulator, machine = pendulum(), pendulum(edits=[partial(stepped, seconds=truth)])
    fitting = among(log(machine, [0.6, 0.08], 2, sd=0.002)).search.fitting
    plain = fitting.fit([], None, 2000)
    windows = fitting.windows(simulator)
    pieces = list(placements(get_extension("physics_step"), machine_of(windows, plain.theta, plain.starts)))
    at = plain.theta, plain.noise, plain.starts, QuadraticPrior.of(fitting.prior)
    ((gain, one),) = (
        (max(candidate.gain, 0.0), fitting.fit(pieces, plain.theta, 2000))
        for candidate in rank_candidates(AugmentedModel(windows, *at, placed=pieces))
    )
    print(gain, one.evidence - plain.evidence)
    assert least <= gain < most
    assert 0.4 * gain - 1 < max(one.evidence - plain.evidence, 0.0) < 2.5 * gain + 1
