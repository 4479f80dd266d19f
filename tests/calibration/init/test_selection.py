"""Which parameters `sipe init` frees: what the logs tell well enough, though another one does nearly the same."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from sipe_bayes.calibration.column_names import read_name
from sipe_bayes.calibration.init.draft import Proposal, Reading
from sipe_bayes.calibration.init.matching import Match, match_columns
from sipe_bayes.calibration.init.parameters import candidates, least_of, springs
from sipe_bayes.calibration.init.readings import first_readings
from sipe_bayes.calibration.init.regression import Outcome
from sipe_bayes.calibration.init.selection import Fit, choose, delay_of, find_springs, select_identifiable, widen_bounds
from sipe_bayes.calibration.init.tables import Clock
from sipe_bayes.calibration.machine import Machine, Sizes


@pytest.mark.parametrize(
    ("share", "size", "away", "kept"),
    [
        (0.09, 600.0, 0.0, True),  # dry friction at a usual speed is nearly viscous, but the logs tell it to a fiftieth
        (0.09, 60.0, 0.0, False),  # told to a fifth of its range
        (0.09, 60.0, 0.4, False),  # two sds of noise, as often happens by itself
        (0.1, 120.0, 0.6, True),  # seven, which the others would have to make up for
        (0.02, 600.0, 0.0, False),  # the same but for rounding
        (0.005, 2000.0, 0.9, False),
        (0.4, 20.0, 0.0, True),
        (0.3, 8.0, 0.0, True),  # weakly told, but what it would do is in others if it is left out
        (1.0, 2.0, 0.0, False),
    ],
)
def test_what_is_nearly_the_same_is_free_where_logs_tell_it(share: float, size: float, away: float, kept: bool) -> None:
    """Also where the model's own value, so far away, would cost more than noise."""
    rng = np.random.default_rng(0)
    basis = np.linalg.qr(rng.standard_normal((400, 2)))[0]
    both = np.stack([500 * basis[:, 0], size * (np.sqrt(1 - share**2) * basis[:, 0] + share * basis[:, 1])], axis=1)
    unknowns = [Proposal(name, (), 0.0, 1.0, False, "") for name in ("damping", "friction")]
    fit = Fit(np.full(2, 0.5), np.full(2, 0.5 - away), both)
    first, second = select_identifiable(unknowns, fit)
    assert not first.left_out
    assert (not second.left_out) is kept, second.left_out


FILTERED = """<mujoco><option timestep="0.002"/><worldbody><body name="arm"><joint name="hinge" axis="0 1 0"/>
    <geom size=".1" mass="1"/><body name="payload"><geom name="tip" size=".1" mass=".2"/></body></body></worldbody>
    <actuator><general name="drive" joint="hinge" dyntype="filter" dynprm="0.02"/></actuator></mujoco>"""
SERVO = 'biastype="affine" biasprm="0 0 -5"'


@pytest.mark.parametrize(
    ("target", "relative", "bounds", "theta", "wider"),
    [
        ("body:payload.mass", True, (0.5, 2.0), 0.5, (0.5, 2.0)),
        ("body:payload.mass", True, (0.5, 2.0), 1.0, (0.5, 6.0)),
        ("body:payload.mass", True, (0.5, 2.0), 0.0, (0.17, 2.0)),
        ("joint:hinge.damping", False, (0.0, 1.0), 0.0, (0.0, 1.0)),  # none is none
        ("joint:hinge.springref", False, (-0.2, 0.2), 0.0, (-0.6, 0.2)),
        ("actuator:drive.lag", True, (0.2, 5.0), 0.0, (0.1, 5.0)),  # no shorter than a physics step
        ("geom:tip.friction", False, (0.3, 1.5), 0.0, (0.3, 1.5)),
    ],
)
def test_bounds_that_a_fit_presses_against_are_widened(
    target: str, relative: bool, bounds: tuple[float, float], theta: float, wider: tuple[float, float]
) -> None:
    unknown = Proposal("it", (target,), *bounds, relative, "as in the model")
    kept = widen_bounds(mujoco.MjModel.from_xml_string(FILTERED), unknown, theta)
    assert (kept.low, kept.high) == pytest.approx(wider, abs=0.01)
    assert ("wider" in kept.note) is (wider != bounds)


def outcome(*behind: float) -> Outcome:
    """Of delays that leave so much more than the best: logarithms."""
    none, costs = np.zeros(1), np.array(behind)
    delay = float(np.argmin(costs))
    return Outcome(none, none, none, none, none, none, delay, costs - costs.min(), 0.0, 0.0, np.zeros((1, 1)), none)


@pytest.mark.parametrize(("behind", "asked"), [([0.34, 0.1, 0.0, 0.18], True), ([0.4, 0.04, 0.02, 0.0], False)])
def test_a_delay_at_the_end_of_those_tried_is_none(behind: list[float], asked: bool) -> None:
    """A force that the model lacks is met the better the later commands come."""
    unknowns, note = delay_of(["motor"], outcome(*behind), 100.0, (0, 14, 15, 16), 0.005)
    assert bool(unknowns) is asked
    assert ("none is asked for" in note) is not asked


def test_the_bounds_of_a_delay_hold_it_and_none_at_all() -> None:
    """None is what the model has, and a configuration without it in the bounds does not load."""
    (delay,), _ = delay_of(["motor"], outcome(0.5, 0.1, 0.0, 0.1), 100.0, (0, 9, 10, 11), 0.002)
    assert delay.low == 0
    assert delay.high > 0.022


@pytest.mark.parametrize(
    ("behind", "asked", "words"),
    [
        ((0.01, 0.005, 0.0, 0.01), True, "hardly tell"),
        ((0.3, 0.01, 0.0, 0.01), True, "about 20 ms late"),
        ((0.0, 0.3, 0.4, 0.5), False, "would not explain more"),
    ],
)
def test_a_delay_that_the_logs_may_have_is_asked_for(behind: tuple[float, ...], asked: bool, words: str) -> None:
    unknowns, note = delay_of(["motor"], outcome(*behind), 100.0, (0, 3, 4, 5), 0.01)
    assert bool(unknowns) is asked
    assert words in note, note


@pytest.mark.parametrize(("size", "theta", "shown"), [(600.0, 0.5, True), (600.0, 0.01, False), (5.0, 0.5, False)])
def test_a_spring_is_asked_for_where_one_shows(size: float, theta: float, shown: bool) -> None:
    """Of 4 N m/rad at most: with what it is about, and where it rests between the ends of the motion."""
    basis = np.linalg.qr(np.random.default_rng(0).standard_normal((400, 2)))[0]
    fit = Fit(np.array([0.5, theta]), np.zeros(2), basis * [500.0, size])
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><worldbody><body name="arm"><joint name="j"/><geom size=".1"/></body></worldbody></mujoco>'
    )
    spring = Proposal("j_spring", ("joint:j.stiffness",), 0.0, 4.0, False, "")
    states = np.array([[0.0, -0.7, 0.0], [0.1, 0.2, 0.0]])
    asked, lines = find_springs(model, [spring], fit, states)
    names = [("j_spring", ("joint:j.stiffness",)), ("j_spring_rest", ("joint:j.springref",))]
    assert [(u.name, u.targets) for u in asked] == names * shown
    for unknown, ends in zip(asked, ([0.0, 4.0], [-0.7, 0.2]), strict=False):
        assert [unknown.low, unknown.high] == pytest.approx(ends, abs=0.02)
        assert unknown.low <= ends[0] < ends[1] <= unknown.high
    words = ("of about 2 in SI", "'joint:j.stiffness' and 'joint:j.springref'")
    assert [all(word in line for word in words) for line in lines] == [True] * shown


FOUR_BAR = """<mujoco><option timestep="0.002"/><worldbody>
  <body name="crank"><joint name="crank" axis="0 1 0"/>
  <geom type="capsule" fromto="0 0 0 0 0 .1" size=".01" mass=".2" contype="0" conaffinity="0"/>
  <body name="rod" pos="0 0 .1"><joint name="pin" axis="0 1 0"/>
  <geom type="capsule" fromto="0 0 0 .3 0 .1" size=".01" mass=".3" contype="0" conaffinity="0"/></body></body>
  <body name="rocker" pos=".3 0 0"><joint name="rocker" axis="0 1 0"/>
  <geom type="capsule" fromto="0 0 0 0 0 .2" size=".01" mass=".4" contype="0" conaffinity="0"/></body>
  <body name="bob" pos="1 0 0"><joint name="bob" axis="0 1 0"/><geom size=".05" mass="1"/></body></worldbody>
  <equality><connect body1="rod" body2="rocker" anchor=".3 0 .1" active="{}"/></equality>
  <actuator><motor name="motor" joint="crank"/></actuator></mujoco>"""


def read_as(model: mujoco.MjModel, targets: dict[str, str]) -> tuple[mujoco.MjModel, Machine, list[Reading], Sizes]:
    """What candidates are looked for in: a column of each name."""
    readings = [Reading(Match((n,), target, read_name(n, set()), 1.0), "m") for n, target in targets.items()]
    return model, Machine.of(model), readings, Sizes.of(model, Machine.of(model), None, None)


@pytest.mark.parametrize("active", [True, False])
def test_what_a_closed_chain_moves_is_asked_for(active: bool) -> None:
    """Masses, friction and springs of a linkage whose crank alone is measured; not of what hangs beside it."""
    model = mujoco.MjModel.from_xml_string(FOUR_BAR.format(str(active).lower()))
    read = read_as(model, {"crank": "joint:crank.position", "u": "actuator:motor"})
    names = {unknown.name for unknown in candidates(*read)}
    follow = {"rod_mass", "rocker_mass", *(f"{j}_{w}" for j in ("pin", "rocker") for w in ("damping", "frictionloss"))}
    assert {"crank_mass", "crank_damping"} <= names
    assert names & follow == (follow if active else set())
    assert not {"bob_mass", "bob_damping", "pin_armature"} & names
    sprung_joints = {spring.targets[0] for spring in springs(*read)}
    closed = {"joint:pin.stiffness", "joint:rocker.stiffness"} if active else set()
    assert sprung_joints == {"joint:crank.stiffness"} | closed


def test_a_driven_joint_that_only_its_fellow_measures_is_asked_for() -> None:
    """Of two fingers that an equality ties, the one that is driven has no column."""
    fingers = """<mujoco><worldbody><body name="l"><joint name="left" type="slide"/><geom size=".1" mass="1"/></body>
      <body name="r" pos="1 0 0"><joint name="right" type="slide"/><geom size=".1" mass="1"/></body></worldbody>
      <equality><joint joint1="left" joint2="right"/></equality>
      <actuator><position name="a" joint="right" kp="20"/></actuator></mujoco>"""
    model = mujoco.MjModel.from_xml_string(fingers)
    names = {u.name for u in candidates(*read_as(model, {"left": "joint:left.position", "u": "actuator:a"}))}
    assert {"l_mass", "r_mass", "left_damping", "right_damping"} <= names


def test_thrusters_of_what_slides_and_turns_share_a_gain_that_nothing_tells() -> None:
    """As those of a free body: shares of a thrust are no newton metres."""
    raft = """<mujoco><worldbody><body name="raft"><joint name="x" type="slide" axis="1 0 0"/>
      <joint name="turn" axis="0 0 1"/><geom size=".1" mass="9"/><site name="left" pos="0 .3 0"/>
      <site name="right" pos="0 -.3 0"/></body></worldbody>
      <actuator><motor name="port" site="left" gear="40 0 0 0 0 0"/>
      <motor name="starboard" site="right" gear="40 0 0 0 0 0"/></actuator></mujoco>"""
    model = mujoco.MjModel.from_xml_string(raft)
    machine = Machine.of(model)
    random = np.random.default_rng(0)
    names = ("x_position", "turn_position", "port", "starboard")
    table = {name: random.standard_normal(50) for name in names}
    clock = Clock("t", "s", 0.01, "")
    measurements, commands = first_readings(machine, match_columns(machine, table), table, {}, clock)
    assert [command.unit for command in commands] == ["1", "1"]
    sizes = Sizes.of(model, machine, None, None)
    asked = {u.name for u in candidates(model, machine, [*measurements, *commands], sizes)}
    assert {"rotors_gain", "raft_mass"} <= asked
    assert not {"port_gain", "starboard_gain"} & asked


def test_the_damping_of_a_velocity_servo_has_no_least_factor() -> None:
    """It is negative in the model and bounded by nothing below: its factor had none but infinity."""
    model = mujoco.MjModel.from_xml_string(FILTERED.replace('dyntype="filter" dynprm="0.02"', SERVO))
    name = model.actuator(0).name
    unknown = Proposal("servo", (f"actuator:{name}.bias_velocity",), 0.25, 4.0, True, "")
    assert least_of(model, unknown) == -np.inf
    kept = widen_bounds(model, unknown, 0.0)
    assert np.isfinite([kept.low, kept.high]).all()
    assert 0 < kept.low < 0.25


@pytest.mark.parametrize(("theta", "high"), [(1e-4, 0.06), (0.05, 4.0), (0.3, 8.0)])
def test_the_bound_of_a_rotor_holds_what_the_logs_say_and_what_the_model_alone_does(theta: float, high: float) -> None:
    """Of slow logs, whose forces over their accelerations are 8 kg m^2: the joint carries 0.1 kg m^2."""
    arm = '<body><joint name="j"/><inertial pos="0 0 0" mass="1" diaginertia=".1 .1 .1"/></body>'
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{arm}</worldbody></mujoco>")
    rotor = Proposal("j_armature", ("joint:j.armature",), 0.0, 8.0, False, "")
    (chosen,), _ = choose(model, [rotor], Fit(np.array([theta]), np.zeros(1), np.full((400, 1), 5e3)), False)
    assert (chosen.left_out, chosen.high) == ("", pytest.approx(high, rel=0.1))
