"""Where windows start in states that an extension brings: nothing measures them, so they are carried on.

A window begins where the one before it has ended, simulated from rest: what came before that is mostly forgotten.
"""

from __future__ import annotations

import mujoco
import numpy as np

from sipe_bayes.core.arrays import BoolArray, FloatArray, IntArray
from sipe_bayes.likelihood import BoundLikelihood


def mapped_starts(before: mujoco.MjModel, after: mujoco.MjModel, starts: FloatArray) -> FloatArray:
    """Starts (..., W, D) of one model as starts of an extended one: what it has more begins at its reference."""
    if not starts.shape[-1]:
        return starts
    out = np.zeros((*starts.shape[:-1], 2 * after.nv + after.na))
    out[..., _places(before, after)] = starts
    return out


def carried_starts(
    before: mujoco.MjModel, windows: BoundLikelihood, theta: FloatArray, starts: FloatArray
) -> FloatArray:
    """Starts (B, W, D) in which an extended model's own states are those at the end of the window before.

    Args:
        before: the model without the extension.
        windows: the logs, of the extended model.
        theta: (B, N).
        starts: (B, W, D), which tell the other states.
    """
    after, count = windows.simulator.model, windows.num_windows
    known = np.concatenate([_places(before, after), windows.filters.numbers])
    own = np.setdiff1d(np.arange(starts.shape[-1]), known)
    follows = _follows(windows)
    if not len(own) or not follows.any():
        return starts
    windows.spend(len(theta))
    thetas, actions = np.repeat(theta, count, axis=0), np.tile(windows.actions, (len(theta), 1, 1))
    states = windows.states(theta, starts).reshape(len(thetas), -1)
    dt, names = np.tile(windows.dt, len(theta)), windows.names * len(theta)
    run = windows.simulator.rollout(thetas, actions, states, dt, names)
    assert run.states is not None
    last = run.states.reshape(len(theta), count, *run.states.shape[1:])[:, np.arange(count), windows.stride]
    columns = np.array([_column(after, int(number)) for number in own])
    shift = last[:, :-1][..., columns] - windows.reference[1:][:, columns]
    out = starts.copy()
    out[:, 1:, own] = np.where(follows[:, None] & np.isfinite(shift), shift, out[:, 1:, own])
    return out


def _follows(windows: BoundLikelihood) -> BoolArray:
    """Which windows but the first (W - 1,) go on where the one before them ends."""
    return (windows.log[1:] == windows.log[:-1]) & (windows.start[1:] == windows.start[:-1] + windows.stride[:-1])


def _column(model: mujoco.MjModel, number: int) -> int:
    """The column of the physics state of a number of a start, of a joint with one position or an activation."""
    if number < model.nv:
        return 1 + int(model.jnt_qposadr[int(model.dof_jntid[number])])
    return 1 + int(model.nq) + number - int(model.nv)


def _places(before: mujoco.MjModel, after: mujoco.MjModel) -> IntArray:
    """Where each number of a model's start is in an extended one's."""
    dofs, acts = _dofs(before, after), _activations(before, after)
    return np.concatenate([dofs, after.nv + dofs, 2 * after.nv + acts])


def _dofs(before: mujoco.MjModel, after: mujoco.MjModel) -> IntArray:
    """Where each dof of a model is in an extended one, by the names of the joints, or their order without names."""
    places: list[int] = []
    for joint in range(before.njnt):
        name = before.joint(joint).name
        other = after.joint(name).id if name else joint
        width = (int(before.jnt_dofadr[joint + 1]) if joint + 1 < before.njnt else before.nv) - before.jnt_dofadr[joint]
        places.extend(range(int(after.jnt_dofadr[other]), int(after.jnt_dofadr[other]) + int(width)))
    return np.array(places, np.int64)


def _activations(before: mujoco.MjModel, after: mujoco.MjModel) -> IntArray:
    places: list[int] = []
    for actuator in range(before.nu):
        name, count = before.actuator(actuator).name, int(before.actuator_actnum[actuator])
        other = after.actuator(name).id if name else actuator
        places.extend(range(int(after.actuator_actadr[other]), int(after.actuator_actadr[other]) + count))
    return np.array(places, np.int64)
