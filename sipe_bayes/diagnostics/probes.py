"""Probes: forces that a model may lack, each a small change of one actuator's command, and what it does to the log.

The changes u + b phi are dry friction tanh(v / v0), friction under load abs(u) tanh(v / v0), drag v abs(v), delay
u(t - 1) - u(t), a spring q, a stiffening spring q^3, an offset 1 and a gain that is not constant u abs(u); v and q are
the velocity and position of the joint that the actuator drives.
"""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from sipe_bayes.core.arrays import BoolArray, FloatArray
from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.likelihood.windows import Windows

_STEP = 1e-3  # of a command's size, how far a probe pushes: linear, and far above rounding
_SOFT = 0.05  # of a velocity's size, where friction turns round: a step that finite differences can see
_MODEL = "put it into the model"


@dataclass(frozen=True)
class Probe:
    """A force that a model may lack: what it is, and what to do about it, in words."""

    name: str
    remedy: str


def probe_effects(windows: Windows, theta: FloatArray, starts: FloatArray) -> tuple[list[Probe], FloatArray]:
    """Probe every actuator; those of one are simulated in one batch.

    Args:
        windows: the logs, W windows of L samples and C channels.
        theta: (N,) where the model stands.
        starts: (W, D) of the windows.

    Returns:
        The K probes that change what is observed, and their effects (W, L, C, K) on the predictions.
    """
    states = windows.states(starts)

    def simulated(actions: FloatArray) -> Trajectories:
        """Of actions (B W, T, A)."""
        many = len(actions) // windows.num_windows
        goals = None if windows.goals is None else np.tile(windows.goals, (many, 1))
        first, dt, names = np.tile(states, (many, 1)), np.tile(windows.dt, many), windows.names * many
        return windows.simulator.rollout(theta[None], actions, first, dt, names, goals=goals)

    motion = simulated(windows.actions)
    if motion.states is None:
        raise ValueError("simulator: probes need its states; use a simulator of a MuJoCo model")
    plain = motion.observations[..., windows.channels]
    inside = np.arange(windows.actions.shape[1]) < windows.steps[:, None]
    probes, effects = [], []
    for column in range(windows.actions.shape[-1]):
        changes = _changes(windows, motion.states[:, :-1], inside, column)
        if not changes:
            continue
        moved = np.tile(windows.actions, (len(changes), 1, 1))
        moved[..., column] += np.concatenate([change for _, change in changes])
        answer = simulated(moved).observations[..., windows.channels].reshape(len(changes), *plain.shape)
        for (probe, _), seen in zip(changes, answer, strict=True):
            effect = np.where(windows.observed, (seen - plain) / _STEP, 0.0)
            if np.isfinite(effect).all() and np.abs(effect).max() > 0:
                probes.append(probe)
                effects.append(effect)
    return probes, np.stack(effects, axis=-1) if effects else np.zeros((*plain.shape, 0))


def _changes(windows: Windows, states: FloatArray, inside: BoolArray, column: int) -> list[tuple[Probe, FloatArray]]:
    """Probes and changes (W, T) of one command, small against its size; states (W, T, S), inside (W, T) the windows."""
    simulator = windows.simulator
    own = getattr(simulator.environment, "actuators", None)
    label = own[column] if own is not None else f"actuator {column}"
    command = windows.actions[..., column]
    size = float(np.sqrt((command[inside] ** 2).mean())) or 1.0
    before = np.concatenate([command[:, :1], command[:, :-1]], axis=1)
    shapes = {
        f"a delay of {label}": (_unknown(f"actuator:{label}.delay"), before - command),
        f"an offset of {label}": (_unknown(f"actuator:{label}.offset"), np.ones_like(command)),
        f"a gain of {label} that is not constant": (_MODEL, command * np.abs(command)),
    }
    joint = _joint(simulator.model, label) if own is not None else None
    if joint is not None:
        name, position, velocity = joint
        q, v = states[..., position], states[..., velocity]
        turn = np.tanh(v / (_SOFT * max(float(np.sqrt((v[inside] ** 2).mean())), 1e-9)))
        shapes |= {
            f"dry friction at {name}": (_unknown(f"joint:{name}.frictionloss"), turn),
            f"friction under load at {name}": (_MODEL, np.abs(command) * turn),
            f"drag at {name}": (_MODEL, v * np.abs(v)),
            f"a spring at {name}": (_unknown(f"joint:{name}.stiffness"), q),
            f"a stiffening spring at {name}": (_MODEL, q**3),
        }
    changes = []
    for cause, (remedy, shape) in shapes.items():
        scale = float(np.sqrt((shape[inside] ** 2).mean()))
        if np.isfinite(scale) and scale > 0:
            changes.append((Probe(cause, remedy), _STEP * size * shape / scale))
    return changes


def _unknown(target: str) -> str:
    return f"make {target} a parameter, or widen its bounds"


def _joint(model: mujoco.MjModel, actuator: str) -> tuple[str, int, int] | None:
    """Name, and columns of position and velocity in the physics state, of the hinge or slide joint that it drives."""
    index = model.actuator(actuator).id
    if int(model.actuator_trntype[index]) != int(mujoco.mjtTrn.mjTRN_JOINT):
        return None
    joint = int(model.actuator_trnid[index, 0])
    if int(model.jnt_type[joint]) not in (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)):
        return None
    name = model.joint(joint).name or f"joint {joint}"
    return name, 1 + int(model.jnt_qposadr[joint]), 1 + model.nq + int(model.jnt_dofadr[joint])
