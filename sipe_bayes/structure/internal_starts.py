"""Where windows start in states that an extension brings: where the window before has ended, simulated from rest."""

from __future__ import annotations

import mujoco
import numpy as np

from sipe_bayes.core.arrays import FloatArray, IntArray
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

    ``before`` is the model without the extension; at theta (B, N), the other states are those of ``starts`` (B, W, D).
    """
    after, count = windows.simulator.model, windows.num_windows
    known = np.concatenate([_places(before, after), windows.filters.numbers])
    own = np.setdiff1d(np.arange(starts.shape[-1]), known)
    # windows but the first (W - 1,) that go on where the one before them ends
    follows = (windows.log[1:] == windows.log[:-1]) & (windows.start[1:] == windows.start[:-1] + windows.stride[:-1])
    if not len(own) or not follows.any():
        return starts
    windows.spend(len(theta))
    thetas, actions = np.repeat(theta, count, axis=0), np.tile(windows.actions, (len(theta), 1, 1))
    states = windows.states(theta, starts).reshape(len(thetas), -1)
    dt, names = np.tile(windows.dt, len(theta)), windows.names * len(theta)
    run = windows.simulator.rollout(thetas, actions, states, dt, names)
    assert run.states is not None
    last = run.states.reshape(len(theta), count, *run.states.shape[1:])[:, np.arange(count), windows.stride]
    # of the physics state: of joints with one position, of velocities and of activations
    columns = np.concatenate([after.jnt_qposadr[after.dof_jntid], after.nq + np.arange(after.nv + after.na)])[own] + 1
    shift = last[:, :-1][..., columns] - windows.reference[1:][:, columns]
    out = starts.copy()
    out[:, 1:, own] = np.where(follows[:, None] & np.isfinite(shift), shift, out[:, 1:, own])
    return out


def _places(before: mujoco.MjModel, after: mujoco.MjModel) -> IntArray:
    """Where each number of a model's start is in an extended one's: by names of joints and actuators, else by order."""
    joints = [after.joint(name).id if (name := before.joint(k).name) else k for k in range(before.njnt)]
    own = before.dof_jntid
    dofs = after.jnt_dofadr[np.array(joints, int)][own] + np.arange(before.nv) - before.jnt_dofadr[own]
    actuators = [after.actuator(name).id if (name := before.actuator(k).name) else k for k in range(before.nu)]
    counts = zip(actuators, before.actuator_actnum, strict=True)
    acts = [after.actuator_actadr[actuator] + k for actuator, count in counts for k in range(count)]
    return np.concatenate([dofs, after.nv + dofs, 2 * after.nv + np.array(acts, int)])
