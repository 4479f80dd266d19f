"""Whether something is struck or let go along a log: there simulations jump, and slopes say little."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.simulation.callable_simulator import CallableSimulator
from sipe_bayes.simulation.simulator import Simulator

_LOOKS = 1000  # samples that are looked at, spread evenly: a bouncing ball touches in one of twenty
_APART = 0.05  # of the smaller geom's size, that two are apart beyond what noise makes of one that rests on the other


@dataclass(frozen=True)
class Contacts:
    """What the states along logs have of contact.

    Args:
        touch: whether any two geoms touch.
        change: whether two touch in some of the states and are clearly apart in others.
    """

    touch: bool = False
    change: bool = False


def contacts_along(simulator: Simulator | CallableSimulator, logs: Sequence[FloatArray]) -> Contacts:
    """Of the states (T+1, S) along logs."""
    if isinstance(simulator, CallableSimulator) or not may_touch(simulator.model):
        return Contacts()
    model, states = simulator.model, np.concatenate(list(logs))
    looks = states[np.linspace(0, len(states) - 1, min(_LOOKS, len(states))).astype(int)]
    looks, data, seen = looks[np.isfinite(looks).all(1)], mujoco.MjData(model), Counter[tuple[int, int]]()
    for state in looks:
        data.qpos[:] = state[1 : 1 + model.nq]
        mujoco.mj_kinematics(model, data)
        mujoco.mj_collision(model, data)
        seen.update({(int(a), int(b)) for a, b in data.contact.geom[data.contact.exclude == 0]})
    change = any(_part(model, data, pair, looks) for pair, count in seen.items() if count < len(looks))
    return Contacts(bool(seen), change)


def _part(model: mujoco.MjModel, data: mujoco.MjData, pair: tuple[int, int], looks: FloatArray) -> bool:
    """Whether two geoms are apart by more than noise in any of the states (n, S)."""
    sizes = [float(size) for size in model.geom_rbound[list(pair)] if size > 0]  # a plane has none
    least = _APART * min(sizes, default=0.0)
    for state in looks:
        data.qpos[:] = state[1 : 1 + model.nq]
        mujoco.mj_kinematics(model, data)
        if mujoco.mj_geomDistance(model, data, *pair, 2 * least, None) > least:
            return True
    return False


def may_touch(model: mujoco.MjModel) -> bool:
    """Whether any two geoms of a model may touch: on bodies that move against each other, and not parent and child."""
    if model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_CONTACT:
        return False
    weld = model.body_weldid[model.geom_bodyid]
    above = model.body_weldid[model.body_parentid[weld]]
    kin = (above[:, None] == weld) & (weld != 0)
    if model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_FILTERPARENT:
        kin[:] = False
    types = (model.geom_contype[:, None] & model.geom_conaffinity) != 0
    apart = weld[:, None] != weld
    return bool(model.npair or ((types | types.T) & apart & ~(kin | kin.T)).any())
