"""What extensions would do to the predictions of a fit: the rows of score tests.

Every extension is simulated a small step away from the plain model, from the same starts. Those that need no more than
parameters are simulated in one batch, those that are laws in another, those that change the model's states each by
itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from sipe_bayes.core.arrays import FloatArray, IntArray
from sipe_bayes.envs.mjcf import MjcfEnvironment
from sipe_bayes.likelihood.windows import Windows
from sipe_bayes.simulation.simulator import Simulator
from sipe_bayes.structure.extension import Placed, extended


@dataclass(frozen=True)
class Effect:
    """What an extension does to the predictions.

    Args:
        placed: which.
        change: (W, L, C, K) of the predictions along each of its probes; a share of one gives a share of it.
        probes: theta (K, P) of these probes.
    """

    placed: Placed
    change: FloatArray
    probes: FloatArray


def effects(windows: Windows, theta: FloatArray, starts: FloatArray, placed: Sequence[Placed]) -> list[Effect]:
    """The effects of extensions that change what is observed.

    Args:
        windows: the logs, of an ``MjcfEnvironment``.
        theta: (N,), the estimate.
        starts: (W, D).
        placed: the extensions.
    """
    groups: dict[object, list[Placed]] = {}
    for one in placed:
        key: object = one.label if one.edit is not None else one.extension.native
        groups.setdefault(key, []).append(one)
    return [effect for group in groups.values() for effect in _of_group(windows, theta, starts, group)]


def _of_group(windows: Windows, theta: FloatArray, starts: FloatArray, group: list[Placed]) -> list[Effect]:
    environment = windows.simulator.environment
    assert isinstance(environment, MjcfEnvironment)
    batches = [group]
    try:
        extended(environment, group)
    except ValueError:  # two of them write the same number
        batches = [[one] for one in group]
    return [effect for batch in batches for effect in _simulated(windows, theta, starts, batch, environment)]


def _simulated(
    windows: Windows, theta: FloatArray, starts: FloatArray, group: list[Placed], environment: MjcfEnvironment
) -> list[Effect]:
    simulator = Simulator(extended(environment, group), windows.simulator.num_threads)
    bound = Windows(windows.settings, simulator, windows.trajectories)
    plain = np.concatenate([theta, *(one.plain for one in group)])
    rows, first = [plain], len(theta)
    for one in group:
        for probe in one.probes:
            row = plain.copy()
            row[first : first + len(probe)] = probe
            rows.append(row)
        first += len(one.plain)
    mapped = mapped_starts(windows.simulator.model, simulator.model, starts)
    predicted, valid = bound.predict(np.stack(rows), np.tile(mapped, (len(rows), 1, 1)))
    windows.rollouts += bound.rollouts
    out, at = [], 1
    for one in group:
        mine = np.arange(at, at + len(one.probes))
        at += len(one.probes)
        with np.errstate(invalid="ignore"):
            change = np.where(windows.observed, predicted[mine] - predicted[0], 0.0)
        use = valid[mine] & np.isfinite(change).all((1, 2, 3)) & (np.abs(change).max((1, 2, 3)) > 0)
        if valid[0] and use.any():
            out.append(Effect(one, np.moveaxis(change[use], 0, -1), one.probes[use]))
    return out


def mapped_starts(before: mujoco.MjModel, after: mujoco.MjModel, starts: FloatArray) -> FloatArray:
    """Starts (..., W, D) of one model as starts of an extended one: what it has more begins at its reference."""
    if not starts.shape[-1]:
        return starts
    out = np.zeros((*starts.shape[:-1], 2 * after.nv + after.na))
    dofs, acts = _dofs(before, after), _activations(before, after)
    out[..., dofs] = starts[..., : before.nv]
    out[..., after.nv + dofs] = starts[..., before.nv : 2 * before.nv]
    out[..., 2 * after.nv + acts] = starts[..., 2 * before.nv :]
    return out


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
