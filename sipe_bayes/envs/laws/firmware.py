"""A controller in firmware: it reads its encoder, and sets its output, so many times a second, and holds it between.

MuJoCo evaluates its own controllers (``position``, ``velocity``, ``pid``, ``dcmotor`` with a set-point) at every
physics step. Which of them stand for firmware, and at which rate, says a custom tuple ``firmware:NAME`` of the model,
whose numbers are the rate, and the column of the supply's voltage where the log has one. The motor behind the
controller is physics and goes on without a break. A rate is not a parameter.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco

from sipe_bayes.envs.laws.base import SINGLE, LawError

_NAME = "firmware:"
_JOINT = int(mujoco.mjtTrn.mjTRN_JOINT)
_SET_POINT = (int(mujoco.mjtCtrlInput.mjINPUT_POS), int(mujoco.mjtCtrlInput.mjINPUT_VEL))
_FILTERS = (int(mujoco.mjtDyn.mjDYN_FILTER), int(mujoco.mjtDyn.mjDYN_FILTEREXACT))
_DYNAMICS = (int(mujoco.mjtDyn.mjDYN_NONE), int(mujoco.mjtDyn.mjDYN_PID), *_FILTERS)


@dataclass(frozen=True)
class Firmware:
    """An edit that declares the controller of an actuator as sampled.

    Args:
        actuator: its name.
        rate: Hz.
        supply: name of the control that scales its output, "" without.
    """

    actuator: str
    rate: float
    supply: str = ""

    def __call__(self, spec: mujoco.MjSpec) -> None:
        """Declare it, and the control of the supply, once; raises LawError for an unknown actuator."""
        if spec.actuator(self.actuator) is None:
            raise LawError(f"command for actuator {self.actuator!r}: the model has no such actuator; correct the name")
        names, numbers = [self.actuator], [self.rate]
        if self.supply:
            if spec.actuator(self.supply) is None:
                driven = spec.actuator(self.actuator)
                silent = spec.add_actuator(name=self.supply, trntype=driven.trntype, target=driven.target)
                silent.gainprm = [0.0] * len(silent.gainprm)
            names, numbers = [*names, self.supply], [*numbers, 0.0]
        kinds = [mujoco.mjtObj.mjOBJ_ACTUATOR] * len(names)
        spec.add_tuple(name=_NAME + self.actuator, objtype=kinds, objname=names, objprm=numbers)


def supplies_of(edits: Sequence[object]) -> tuple[str, ...]:
    """Names of the controls that edits of a model declare as supplies, in their order."""
    return tuple(dict.fromkeys(edit.supply for edit in edits if isinstance(edit, Firmware) and edit.supply))


@dataclass(frozen=True)
class BoundFirmware:
    """A sampled controller of a compiled model.

    Args:
        actuator: whose.
        period: s from one evaluation to the next.
        position: column of the physics state.
        velocity: column of the physics state.
        control: column of the controls, its set-point.
        supply: column of the controls that scales its output; -1 without.
        activations: columns of the physics state.
        history: columns of the physics state with past set-points.
    """

    actuator: int
    period: float
    position: int
    velocity: int
    control: int
    supply: int
    activations: slice
    history: slice


def is_controller(model: mujoco.MjModel, actuator: int) -> bool:
    """Whether an actuator follows a set-point: its force or voltage depends on how far its joint is from there."""
    if int(model.actuator_gaintype[actuator]) == int(mujoco.mjtGain.mjGAIN_DCMOTOR):
        return int(model.actuator_ctrlspec[actuator]) in _SET_POINT
    affine = int(model.actuator_biastype[actuator]) == int(mujoco.mjtBias.mjBIAS_AFFINE)
    kinds = (int(mujoco.mjtGain.mjGAIN_FIXED), int(mujoco.mjtGain.mjGAIN_PID))
    return (
        affine and int(model.actuator_gaintype[actuator]) in kinds and bool(model.actuator_biasprm[actuator, 1:3].any())
    )


def firmware_of(model: mujoco.MjModel) -> tuple[BoundFirmware, ...]:
    """The sampled controllers that a compiled model declares; raises LawError for what can not be sampled."""
    bounds = []
    for index in range(model.ntuple):
        label = mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_TUPLE, index) or ""
        if label.startswith(_NAME):
            first, size = int(model.tuple_adr[index]), int(model.tuple_size[index])
            members = [int(k) for k in model.tuple_objid[first : first + size]]
            bounds.append(_bound(model, members, float(model.tuple_objprm[first]), label.removeprefix(_NAME)))
    return tuple(bounds)


def _bound(model: mujoco.MjModel, members: list[int], rate: float, name: str) -> BoundFirmware:
    actuator = members[0]
    where = f"command for actuator {name!r}: `rate` is for a controller"
    if int(model.actuator_ctrlnum[actuator]) != 1 or not is_controller(model, actuator):
        raise LawError(f"{where} with one set-point (position, velocity, pid, dcmotor); drop it")
    motor = int(model.actuator_gaintype[actuator]) == int(mujoco.mjtGain.mjGAIN_DCMOTOR)
    if not motor and int(model.actuator_dyntype[actuator]) not in _DYNAMICS:
        raise LawError(f"{where} without dynamics of its own but a filter, an integral or a slew rate; drop it")
    joint = int(model.actuator_trnid[actuator, 0]) if int(model.actuator_trntype[actuator]) == _JOINT else -1
    if joint < 0 or int(model.jnt_type[joint]) not in SINGLE:
        raise LawError(f"{where} of one hinge or slide joint; drop it")
    first = 1 + model.nq + model.nv
    begin, count = first + int(model.actuator_actadr[actuator]), int(model.actuator_actnum[actuator])
    past, samples = int(model.actuator_historyadr[actuator]), int(model.actuator_history[actuator, 0])
    past = first + model.na + past if past >= 0 else -1
    return BoundFirmware(
        actuator,
        1.0 / rate,
        1 + int(model.jnt_qposadr[joint]),
        1 + model.nq + int(model.jnt_dofadr[joint]),
        int(model.actuator_ctrladr[actuator]),
        int(model.actuator_ctrladr[members[1]]) if len(members) > 1 else -1,
        slice(begin, begin + count) if count else slice(0, 0),
        slice(past + 2, past + 2 + 2 * samples) if past >= 0 else slice(0, 0),
    )
