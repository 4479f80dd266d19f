"""Whether something is struck or let go along a log: there simulations jump, and slopes say little."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import mujoco
import numpy as np

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.simulation.callable_simulator import CallableSimulator
from sipe_bayes.simulation.simulator import Simulator

_LOOKS = 1000  # samples that are looked at, spread evenly: a bouncing ball touches in one of twenty


def contacts_change(simulator: Simulator | CallableSimulator, logs: Sequence[FloatArray]) -> bool:
    """Whether two geoms touch in some of the states (T+1, S) along logs and do not in others."""
    if isinstance(simulator, CallableSimulator) or not may_touch(simulator.model):
        return False
    model, states = simulator.model, np.concatenate(list(logs))
    looks = states[np.linspace(0, len(states) - 1, min(_LOOKS, len(states))).astype(int)]
    data, seen, looked = mujoco.MjData(model), Counter[tuple[int, int]](), 0
    for state in looks[np.isfinite(looks).all(1)]:
        data.qpos[:] = state[1 : 1 + model.nq]
        mujoco.mj_kinematics(model, data)
        mujoco.mj_collision(model, data)
        looked += 1
        seen.update({(int(a), int(b)) for a, b in data.contact.geom[data.contact.exclude == 0]})
    return any(count < looked for count in seen.values())


def may_touch(model: mujoco.MjModel) -> bool:
    """Whether any two geoms of a model may touch."""
    return bool(model.npair or (model.ngeom > 1 and model.geom_contype.any() and model.geom_conaffinity.any()))
