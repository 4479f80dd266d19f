"""Which frictions are asked for of what moves freely: those of wheels too, and of the side that counts."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from sipe_bayes.calibration.init.draft import Unknown
from sipe_bayes.calibration.init.machine import Machine
from sipe_bayes.calibration.init.unknowns.candidates import as_parameters
from sipe_bayes.calibration.init.unknowns.contacts import nameless
from sipe_bayes.calibration.init.windows import rough_unknowns
from sipe_bayes.envs.mjcf import MjcfEnvironment
from sipe_bayes.envs.targets import bind


def asked(bodies: str, floor: str = "") -> dict[str, Unknown]:
    """Unknowns of contacts, all of which can be written into the model together."""
    text = f'<mujoco><worldbody><geom name="floor" type="plane" size="3 3 .1" {floor}/>{bodies}</worldbody></mujoco>'
    model = mujoco.MjModel.from_xml_string(text)
    unknowns = [u for u in rough_unknowns(model, Machine.of(model), []) if any("geom:" in t for t in u.targets)]
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


def frictions(unknowns: dict[str, Unknown]) -> dict[str, tuple[tuple[str, ...], float]]:
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
def test_frictions_that_are_asked_for(
    bodies: str, floor: str, expected: dict[str, tuple[tuple[str, ...], float]]
) -> None:
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
