"""A scale that no motion tells is allowed for, and one that the logs tell is not."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import sipe_bayes as sipe
from sipe_bayes.calibration.checks.lacking import untold
from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.findings import Code
from sipe_bayes.core.parameters import Parameter
from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.envs.mjcf import MjcfEnvironment
from sipe_bayes.likelihood import Noise, Segments
from sipe_bayes.likelihood.windows import Windows
from sipe_bayes.posterior import Particles
from sipe_bayes.simulation.simulator import Simulator
from sipe_bayes.structure.augmented import AugmentedModel
from sipe_bayes.structure.discrepancy import Contribution, Discrepancy, find_discrepancy
from sipe_bayes.structure.tolerances import EXACT, Tolerances, usual
from tests.problems.pendulums import XML, log, pendulum

EXAMPLES = Path(__file__).parents[2] / "examples"
GAIN, TOLERANCES = 1.1, Tolerances({"motor": 0.1})


def probed(simulator: Simulator, theta: FloatArray) -> AugmentedModel:
    """Two logs of a pendulum of .6 kg whose motor is a tenth stronger than its commands say, at theta."""
    machine = pendulum(Parameter("gain", 0.5, 1.5, targets=("actuator:motor.gain",)))
    logs = Trajectories.stack([log(machine, [0.6, 0.08, GAIN], seed, name=str(seed)) for seed in (2, 3)])
    windows = Windows(Segments(0.5), simulator, logs)
    return AugmentedModel(windows, theta, Noise(np.array([0.01]), np.zeros(1)))


def moving(logs: AugmentedModel, tolerances: Tolerances) -> list[Contribution]:
    """Numbers that move a value by more than the logs leave unknown."""
    sd = np.sqrt(np.diag(logs.seen.projected.covariance))
    return [one for one in find_discrepancy(logs, tolerances).contributions() if one.moves(sd).any()]


def test_masses_are_allowed_the_tolerance_of_the_motor_and_said_to_be(monkeypatch: pytest.MonkeyPatch) -> None:
    """At the best fit, mass and damping a tenth too small, motions are those of the true values: no log tells."""
    simulator = pendulum()
    truth = simulator.space.normalise(np.array([0.6, 0.08]))
    seen = probed(simulator, simulator.space.normalise(np.array([0.6, 0.08]) / GAIN))
    (opened,) = moving(seen, TOLERANCES)
    np.testing.assert_allclose(opened.shift, truth - seen.theta, rtol=0.05)
    covariance = seen.seen.projected.covariance
    scatter = np.sqrt(np.diag(covariance)) * np.random.default_rng(0).standard_normal((4000, 2))
    fitted = Particles(seen.theta + scatter, simulator.space)
    exact, there = find_discrepancy(seen), find_discrepancy(seen, TOLERANCES)
    assert not there.is_doubted  # then it is named alone
    np.testing.assert_allclose(there.draw(fitted, 0).variance, exact.draw(fitted, 0).variance, rtol=0.5)
    monkeypatch.setattr(Discrepancy, "is_doubted", True)
    squares, allowed = exact.draw(fitted, 0).variance.numpy(), there.draw(fitted, 0)
    # how much of it is moved has a second moment of 1.25
    np.testing.assert_allclose(allowed.variance, squares + 1.25 * opened.shift**2, rtol=0.15)
    low, high = allowed.quantile([0.05, 0.95]).numpy()
    assert ((low <= truth) & (truth <= high)).all()
    (noticed,) = untold(there)
    assert noticed.code is Code.UNTOLD
    assert (
        "A 10 % error of the gain of motor cannot be seen in these logs. It would bias rod_mass by 0.05" in noticed.text
    )


def test_the_shift_of_a_gain_has_its_sign_whichever_the_gain_has_and_its_size_on_a_log_scale() -> None:
    """A motor mounted the other way round, its commands too, with damping on a log scale."""
    xml = XML.replace('joint="hinge"/>', 'joint="hinge" gear="-1"/>').replace("<motor", '<general gainprm="-1"')
    unknowns = [
        Parameter("rod_mass", 0.3, 1.0, targets=("body:rod.mass",)),
        Parameter("damping", 0.001, 1.0, scale="log", targets=("joint:hinge.damping",)),
    ]
    simulator = Simulator(MjcfEnvironment.build(xml, unknowns, ["motor"], ["joint:hinge.position"]), 1)
    values = np.array([0.6, 0.08]) / GAIN
    seen = probed(simulator, simulator.space.normalise(values))
    (opened,) = moving(seen, TOLERANCES)
    moved = simulator.space.values(seen.theta + opened.shift)
    np.testing.assert_allclose(moved - values, 0.1 * values, rtol=0.15)
    (noticed,) = untold(find_discrepancy(seen, TOLERANCES))
    assert "rod_mass by 0.05" in noticed.text
    assert "damping by 0.1" not in noticed.text


def test_where_the_logs_tell_the_gain_or_it_is_exact_nothing_is_allowed() -> None:
    """With the mass known only the friction is open, which does not move as another gain does."""
    friction = Parameter("damping", 0.0, 0.2, targets=("joint:hinge.damping",))
    simulator = Simulator(MjcfEnvironment.build(XML, [friction], ["motor"], ["joint:hinge.position"]), 1)
    seen = probed(simulator, np.array([0.4]))
    assert moving(seen, TOLERANCES) == []
    seen = probed(pendulum(), pendulum().space.normalise(np.array([0.6, 0.08]) / GAIN))
    assert moving(seen, Tolerances({"motor": 0.0})) == moving(seen, EXACT) == []


def test_a_centre_of_mass_that_no_motion_tells_moves_mass_and_inertia_as_one_that_lies_further_out() -> None:
    """A rod of .6 kg whose mass lies a twentieth of its reach further out than in the model."""
    armature = Parameter("armature", 0.0, 0.1, targets=("joint:hinge.armature",))
    reach = np.sqrt(0.25**2 + 0.5**2 / 12)
    length = 0.25 + 0.05 * reach
    machine = pendulum(armature, Parameter("com", -0.5, 0.0, targets=("body:rod.com_z",)))
    logs = Trajectories.stack([log(machine, [0.6, 0.08, 0.02, -length], s, name=str(s)) for s in (2, 3)])
    simulator = pendulum(armature)
    heavier = 0.6 * length / 0.25
    same_inertia = 0.02 + 0.6 * length**2 - heavier * 0.25**2 + (0.6 - heavier) * 0.5**2 / 12
    truth, fitted = simulator.space.normalise(np.array([[0.6, 0.08, 0.02], [heavier, 0.08, same_inertia]]))
    windows = Windows(Segments(0.5), simulator, logs)
    seen = AugmentedModel(windows, fitted, Noise(np.array([0.01]), np.zeros(1)))
    (opened,) = moving(seen, Tolerances(geometry=0.05))
    print(truth - fitted, opened.shift)
    np.testing.assert_allclose(-opened.shift, truth - fitted, rtol=0.15, atol=0.001)
    (noticed,) = untold(find_discrepancy(seen, Tolerances(geometry=0.05)))
    assert "An error of the centre of mass of rod by 5 % of its reach cannot be seen" in noticed.text
    assert noticed.parameters == ("rod_mass", "armature")
    known = pendulum(Parameter("com", -0.5, 0.0, targets=("body:rod.com_z",)))  # an unknown of its own
    windows, values = Windows(Segments(0.5), known, logs), np.array([0.6, 0.08, -length])
    seen = AugmentedModel(windows, known.space.normalise(values), seen.noise)
    assert moving(seen, Tolerances(geometry=0.05)) == []


def test_a_mass_that_is_not_asked_for_is_what_forces_and_friction_are_relative_to() -> None:
    """With the rod's mass as in the model a twentieth of it is a twentieth of the motor's gain and of the damping."""
    unknowns = [
        Parameter("gain", 0.5, 1.5, targets=("actuator:motor.gain",)),
        Parameter("damping", 0.0, 0.2, targets=("joint:hinge.damping",)),
    ]
    simulator = Simulator(MjcfEnvironment.build(XML, unknowns, ["motor"], ["joint:hinge.position"]), 1)
    values = np.array([1.0, 0.08])
    weighed = pendulum(unknowns[0])
    logs = Trajectories.stack([log(weighed, [0.6, 0.08, 1.0], s, name=str(s)) for s in (2, 3)])
    windows = Windows(Segments(0.5), simulator, logs)
    seen = AugmentedModel(windows, simulator.space.normalise(values), Noise(np.array([0.01]), np.zeros(1)))
    (opened,) = moving(seen, Tolerances(geometry=0.05))
    np.testing.assert_allclose(simulator.space.values(seen.theta + opened.shift) - values, 0.05 * values, rtol=0.1)
    assert opened.sentence == "a 5 % error of the mass of rod"
    assert moving(seen, Tolerances(timing=0.05)) == []  # there is nothing that comes late for it


def test_what_a_measurement_is_taken_later_the_delay_of_the_commands_is_shorter() -> None:
    simulator = pendulum(Parameter("delay", 0.0, 0.05, targets=("actuator:motor.delay",)))
    values = np.array([0.6, 0.08, 0.02])
    logs = Trajectories.stack([log(simulator, values.tolist(), seed, name=str(seed)) for seed in (2, 3)])
    windows = Windows(Segments(0.5), simulator, logs)
    seen = AugmentedModel(windows, simulator.space.normalise(values), Noise(np.array([0.01]), np.zeros(1)))
    (opened,) = moving(seen, Tolerances(timing=0.05))
    late = 0.05 * float(logs.dt[0])
    np.testing.assert_allclose(simulator.space.values(seen.theta + opened.shift)[2] - 0.02, -late, rtol=0.1)
    assert opened.sentence.endswith("by 5 % of a sample")


def test_a_configuration_says_them_all() -> None:
    problem = sipe.prepare(EXAMPLES / "simple_pendulum" / "calibrate.toml")
    assert problem.tolerances == usual(problem.environment.actuators)
    given = {"geometry_tolerance": 0.2, "timing_tolerance": 0.3, "step_tolerance": 0.0}
    own = replace(problem, config=problem.config.model_copy(update=given)).tolerances
    assert own == Tolerances(usual(problem.environment.actuators).commands, 0.2, 0.3, 0.0)


def test_of_several_numbers_that_no_log_tells_the_one_to_measure_first_is_named() -> None:
    """A tenth of the motor's gain moves mass and damping further than a twentieth of the rod's reach."""
    simulator = pendulum(Parameter("armature", 0.0, 0.1, targets=("joint:hinge.armature",)))
    seen = probed(simulator, simulator.space.normalise(np.array([0.6, 0.08, 0.02]) / GAIN))
    first, both = "Measure that first: nothing else moves a value as far.", Tolerances({"motor": 0.1}, geometry=0.05)
    (alone,), (noticed,) = (untold(find_discrepancy(seen, one)) for one in (TOLERANCES, both))
    assert first not in alone.text
    gain, rest = noticed.text.split(first)
    assert "10 % error of the gain of motor" in gain
    assert "centre of mass of rod" in rest
