"""Parts that are alike in the model share a parameter where the logs tell more than are asked for."""

from __future__ import annotations

import mujoco
import numpy as np

from sipe_bayes.calibration.init.draft import Proposal
from sipe_bayes.calibration.init.selection import MOST, Fit, alike_parts, choose, share_parameters

LEGS = ("FL", "FR", "RL", "RR")
JOINTS = [f"{side}_{joint}" for side in LEGS for joint in ("hip", "knee")]


def leg(name: str, hip: str = "", mass: float = 0.3) -> str:
    return (
        f'<body name="{name}_thigh"><joint name="{name}_hip" {hip}/><geom size=".05" mass="{mass}"/>'
        f'<body name="{name}_shank"><joint name="{name}_knee" axis="0 1 0"/><geom size=".05" mass=".3"/></body></body>'
    )


def model_of(legs: str, kp: dict[str, float]) -> mujoco.MjModel:
    servos = "".join(f'<position name="{j}" joint="{j}" kp="{kp.get(j, 20.0)}"/>' for j in JOINTS)
    return mujoco.MjModel.from_xml_string(
        f'<mujoco><worldbody><body name="trunk"><freejoint/><geom size=".1" mass="5"/>{legs}</body></worldbody>'
        f"<actuator>{servos}</actuator></mujoco>"
    )


def unknown(name: str, target: str, high: float = 1.0, relative: bool = False) -> Proposal:
    return Proposal(name, (target,), 0.0, high, relative, "0 in the model")


def names(model: mujoco.MjModel, unknowns: list[Proposal], what: str) -> list[set[str]]:
    return [{unknowns[k].name for k in group} for group in alike_parts(model, unknowns, what)]


def test_who_shares() -> None:
    """Joints of which the model says nothing by their names, others by what it says; masses by both."""
    legs = leg("FL") + leg("FR") + leg("RL", 'damping=".2"') + leg("RR", 'damping=".2"', mass=0.4)
    model = model_of(legs, {"RR_knee": 25.0})
    frictions = [unknown(f"{j}_damping", f"joint:{j}.damping") for j in JOINTS]
    assert sorted(names(model, frictions, "damping"), key=sorted) == [
        {"FL_hip_damping", "FR_hip_damping"},
        {"FL_knee_damping", "FR_knee_damping", "RL_knee_damping"},
        {"RL_hip_damping", "RR_hip_damping"},
        {"RR_knee_damping"},  # another servo
    ]
    assert all(len(group) == 1 for group in names(model, frictions, "armature"))
    gains = [unknown(j, f"actuator:{j}.kp", relative=True) for j in ("FL_hip", "FL_knee", "RR_knee")]
    assert names(model, gains, "kp") == [{"FL_hip", "FL_knee"}, {"RR_knee"}]
    masses = [unknown(f"{n}_mass", f"body:{n}.mass") for n in ("FL_thigh", "FR_thigh", "RR_thigh", "FL_shank", "trunk")]
    assert names(model, masses, "mass") == [{"FL_thigh_mass", "FR_thigh_mass"}, {"RR_thigh_mass"}, {"FL_shank_mass"}, {
        "trunk_mass"
    }]  # fmt: skip


def test_what_one_parameter_does_is_what_all_of_them_do() -> None:
    """In units of the shared bounds, at the mean of the values."""
    first = unknown("FL_hip_damping", "joint:FL_hip.damping")
    unknowns = [first, unknown("FR_hip_damping", "joint:FR_hip.damping", 2.0)]
    jacobian = np.random.default_rng(0).standard_normal((50, 3))  # and of what stands behind them
    fit = Fit(np.array([0.4, 0.1, 0.9]), np.array([0.2, 0.1, 0.0]), jacobian)
    (one,), after = share_parameters(unknowns, fit, [[0, 1]], "damping")
    assert (one.name, one.low, one.high) == ("hip_damping", 0.0, 2.0)
    assert one.targets == ("joint:FL_hip.damping", "joint:FR_hip.damping")
    np.testing.assert_allclose([after.theta[0], after.nominal[0]], [0.5 * (0.4 + 0.2) / 2.0, 0.5 * (0.2 + 0.2) / 2.0])
    np.testing.assert_allclose(after.jacobian[:, 0], 2.0 * jacobian[:, 0] + jacobian[:, 1])


def test_only_as_many_share_as_is_needed() -> None:
    model = model_of("".join(leg(side) for side in LEGS), {})
    rng = np.random.default_rng(1)

    def asked(fields: tuple[str, ...]) -> list[str]:
        unknowns = [unknown(f"{j}_kp", f"actuator:{j}.kp", relative=True) for j in JOINTS]
        unknowns += [unknown(f"{j}_{field}", f"joint:{j}.{field}") for j in JOINTS for field in fields]
        n = len(unknowns)
        fit = Fit(np.full(n, 0.5), np.zeros(n), 100 * rng.standard_normal((400, n)))
        left, values = choose(model, unknowns, fit, False)
        assert len(values) == len(left)
        return [u.name for u in left if not u.left_out]

    few = asked(("damping", "frictionloss"))
    assert len(few) == 24 <= MOST
    many = asked(("damping", "frictionloss", "armature"))
    assert len(many) == 26
    assert {"hip_armature", "knee_armature", "FL_hip_damping", "RR_knee_kp"} <= {*many}
