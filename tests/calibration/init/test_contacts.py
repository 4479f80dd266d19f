"""Which frictions are asked for of what moves freely: those of wheels too, and of the side that counts."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest

from sipe_bayes.calibration.init.cases import rough_parameters
from sipe_bayes.calibration.init.draft import Proposal
from sipe_bayes.calibration.init.parameters import as_parameters, nameless
from sipe_bayes.calibration.init.propose import propose
from sipe_bayes.calibration.machine import Machine
from sipe_bayes.core.parameters import Parameter
from sipe_bayes.envs.mjcf import MjcfEnvironment
from sipe_bayes.envs.targets import bind
from sipe_bayes.simulation.simulator import Simulator


def asked(bodies: str, floor: str = "") -> dict[str, Proposal]:
    """Unknowns of contacts, all of which can be written into the model together."""
    text = f'<mujoco><worldbody><geom name="floor" type="plane" size="3 3 .1" {floor}/>{bodies}</worldbody></mujoco>'
    model = mujoco.MjModel.from_xml_string(text)
    unknowns = [u for u in rough_parameters(model, Machine.of(model), []) if any("geom:" in t for t in u.targets)]
    if unknowns:
        MjcfEnvironment.build(text, as_parameters(model, unknowns), [], [])
    return {unknown.name: unknown for unknown in unknowns}


def geom(name: str, more: str = "") -> str:
    return f'<geom name="{name}" size=".05" mass=".1" {more}/>' if name else f'<geom size=".05" mass=".1" {more}/>'


def rover(tyre: str, skid: str = "", chassis: str = "", named: bool = True) -> str:
    wheels = "".join(
        f'<body name="wheel_{s}"><joint name="{s}"/>{geom(f"tyre_{s}" if named else "", tyre)}</body>'
        for s in ("left", "right")
    )
    castor = f'<body name="castor">{geom("castor", skid)}</body>' if skid else ""
    return f'<body name="chassis"><freejoint/>{geom("hull", chassis)}{wheels}{castor}</body>'


def frictions(unknowns: dict[str, Proposal]) -> dict[str, tuple[tuple[str, ...], float]]:
    """Geoms and lower bounds."""
    return {
        name: (tuple(t.removeprefix("geom:").removesuffix(".friction") for t in unknown.targets), unknown.low)
        for name, unknown in unknowns.items()
        if "friction" in name
    }


AIR = 'contype="0" conaffinity="0"'
TYRES = ("tyre_left", "tyre_right")


@pytest.mark.parametrize(
    ("bodies", "floor", "expected"),
    [
        (rover(""), "", {"chassis_friction": (("hull", *TYRES, "floor"), 0.02)}),
        (rover("", chassis=AIR), "", {"chassis_friction": ((*TYRES, "floor"), 0.02)}),
        (
            rover("", skid='friction=".05" priority="1"'),
            "",
            {"chassis_friction": (("hull", *TYRES, "floor"), 0.02), "castor_friction": (("castor",), 0.02)},
        ),
        (  # what is rougher than the floor is never less rough than it, since the larger one is taken
            rover('friction="1.2"'),
            "",
            {"chassis_friction": (("hull", "floor"), 0.02), "wheel_friction": (TYRES, 1.0)},
        ),
        (rover('priority="1"'), 'priority="2"', {"chassis_friction": (("floor",), 0.02)}),
        (
            f'<body name="puck1"><freejoint/>{geom("a")}</body><body name="puck2"><freejoint/>{geom("b")}</body>',
            "",
            {"puck_friction": (("a", "b", "floor"), 0.02)},
        ),
        (
            f'<body name="cup"><freejoint/>{geom("a")}</body><body name="ball"><freejoint/>{geom("b")}</body>',
            'friction=".3"',
            {"cup_friction": (("a", "b", "floor"), 0.02)},
        ),
        (rover("", chassis=AIR, named=False), "", {}),
        (rover("", named=False), "", {"chassis_friction": (("hull", "floor"), 0.02)}),
    ],
)
def test_frictions_that_are_free(bodies: str, floor: str, expected: dict[str, tuple[tuple[str, ...], float]]) -> None:
    assert frictions(asked(bodies, floor)) == expected


def test_what_is_said_of_a_friction_is_what_mujoco_does() -> None:
    notes = {
        n: u.note
        for n, u in asked(rover('friction="1.2"', skid='friction=".05" priority="1"')).items()
        if "friction" in n
    }
    assert "the larger one where their priority is the same" in notes["chassis_friction"]
    assert "no less than the 1 of what stands still" in notes["wheel_friction"]
    assert "lower priority and does not count" in notes["castor_friction"]
    assert "2 geoms are left out that have no name" in asked(rover("", named=False))["chassis_friction"].note
    text = f'<mujoco><worldbody><geom type="plane" size="3 3 .1"/>{rover("", "", AIR, False)}</worldbody></mujoco>'
    model = mujoco.MjModel.from_xml_string(text)
    assert nameless(model, {model.body("chassis").id}) == [
        "friction of chassis is not asked for: no geom of it that may touch something has a name"
    ]


@pytest.mark.parametrize("floor", ["", 'priority="1"', 'friction=".3"'])
@pytest.mark.parametrize(
    "tyre", ["", 'friction=".01"', 'friction=".6"', 'friction="1.2"', 'priority="1" friction=".2"']
)
def test_each_friction_is_the_contacts(tyre: str, floor: str) -> None:
    """Half-way up its bounds, every contact of a group has that friction in MuJoCo; so has what the model says."""
    text = (
        f'<mujoco><worldbody><geom name="floor" type="plane" size="3 3 .1" {floor}/>{rover(tyre)}</worldbody></mujoco>'
    )
    for name, unknown in asked(rover(tyre), floor).items():
        if "friction" not in name:
            continue
        model = mujoco.MjModel.from_xml_string(text)
        value, geoms = 0.5 * (unknown.low + unknown.high), [t.split(":")[1].split(".")[0] for t in unknown.targets]
        for friction in (bind(model, unknown.targets[0]).value, value):
            for one in geoms if friction == value else ():
                model.geom(one).friction[0] = value
            data = mujoco.MjData(model)
            mujoco.mj_forward(model, data)
            pairs = {frozenset(int(g) for g in c.geom): c.friction[0] for c in data.contact}
            floor_id = model.geom("floor").id
            seen = [
                mu
                for pair, mu in pairs.items()
                if floor_id in pair and pair & {model.geom(g).id for g in {*geoms} - {"floor"}}
            ]
            assert seen or geoms == ["floor"]
            np.testing.assert_allclose(seen, friction)


def test_bounds_hold_the_friction_that_the_model_has() -> None:
    """A castor more slippery than is usual, with a priority over the floor: a file without that does not load."""
    unknowns = asked(rover("", skid='friction=".01" priority="1"'))
    castor = next(u for u in unknowns.values() if u.targets == ("geom:castor.friction",))
    assert castor.low <= 0.01


@pytest.mark.parametrize(("gap", "whole"), [(0.04, False), (0.8, True)])
def test_few_short_logs_through_impacts_are_cut(gap: float, whole: bool, tmp_path: Path) -> None:
    """Their scatter is of eight windows at least; logs without impacts stay whole."""
    model = tmp_path / "model.xml"
    model.write_text(f"""<mujoco><option timestep=".005"/><worldbody>
<body name="ram"><joint name="ram" type="slide" axis="1 0 0" damping="2"/>
<geom type="box" size=".05 .05 .05" mass=".8"/></body>
<body name="block" pos="{0.1 + gap} 0 0"><joint name="block" type="slide" axis="1 0 0" damping="1" stiffness="30"/>
<geom type="box" size=".05 .05 .05" mass=".5"/></body></worldbody>
<actuator><motor name="push" joint="ram" gear="4"/></actuator></mujoco>""")
    damping = Parameter("damping", 1.0, 3.0, targets=("joint:ram.damping",))
    positions = ["joint:ram.position", "joint:block.position"]
    simulator = Simulator(MjcfEnvironment.build(model, [damping], ["push"], positions))
    files = []
    for k in range(3):
        clock = 0.01 * np.arange(120)
        push = np.sin((4 + k) * clock) * np.sin(2.3 * clock + k)
        seen = simulator.rollout(np.array([[0.5]]), push[None, :, None], simulator.default_state()[None], 0.01)
        rows = np.column_stack([clock, seen.observations[0][:-1], push])
        files.append(tmp_path / f"log{k}.csv")
        np.savetxt(files[-1], rows, delimiter=",", header="time,ram,block,push", comments="")
    assert (propose(model, files, tmp_path).window == "log") == whole
