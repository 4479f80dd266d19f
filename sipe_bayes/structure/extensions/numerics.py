"""What is of the simulation and not of the machine: steps of a length, friction that creeps. Nothing of it is unknown.

A step of h seconds moves a simulation by an error of the order h: MuJoCo's Euler steps, explicit or implicit in the
velocity, lead an accelerated joint by about h/2. A step of h/n has an error of h/(2n), so it changes (n - 1)/n of all
that steps do (L. F. Richardson 1911, https://doi.org/10.1098/rsta.1911.0009). MuJoCo's dry friction is a soft
constraint: a joint at rest under a force creeps, by the time constant of ``solreffriction`` and the impedance of
``solimpfriction``.
"""

from __future__ import annotations

import math
from functools import partial

import mujoco
import numpy as np

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.parameters import Parameter
from sipe_bayes.envs.mjcf import Edit
from sipe_bayes.structure.extension import Extension
from sipe_bayes.structure.machine import Machine


class _Numerics(Extension):
    """An edit of the model without parameters."""

    kind, fixed = "world", True

    def parameters(self, machine: Machine, site: str) -> tuple[Parameter, ...]:
        """None."""
        return ()

    def probes(self, machine: Machine, parameters: tuple[Parameter, ...]) -> FloatArray:
        """One, of no parameters."""
        return np.zeros((1, 0))


class PhysicsStep(_Numerics):
    """Shorter physics steps."""

    name = "physics_step"
    shorter = slow = 8
    reference = "L. F. Richardson 1911"

    def sentence(self, site: str) -> str:
        """What it is."""
        return "physics steps an eighth as long"

    def off(self, site: str, share: float) -> str:
        """See ``Extension``."""
        return "the effect of the physics step"

    def edit(self, machine: Machine, site: str) -> Edit:
        """The option of the model, an eighth of what it was."""
        return partial(_shortened, timestep=float(machine.model.opt.timestep) / self.shorter)


class HardFriction(_Numerics):
    """Dry friction that holds a joint at rest where it is."""

    name = "hard_friction"
    impedance = 0.999
    reference = "MuJoCo documentation, joint solreffriction and solimpfriction"

    def sentence(self, site: str) -> str:
        """What it is."""
        return "dry friction that does not creep (solreffriction, solimpfriction)"

    def edit(self, machine: Machine, site: str) -> Edit | None:
        """As hard as the physics step allows, of all joints and tendons; none where nothing has friction."""
        known = (*machine.model.dof_frictionloss, *machine.model.tendon_frictionloss)
        if not any(known) and not any(target.endswith(".frictionloss") for target in machine.written()):
            return None
        return partial(_hardened, timeconst=2 * float(machine.model.opt.timestep), impedance=self.impedance)


def _shortened(spec: mujoco.MjSpec, timestep: float) -> None:
    """With histories of commands and measurements that are as long as before."""
    times = max(1, math.ceil(spec.option.timestep / timestep * (1 - 1e-9)))
    spec.option.timestep = min(timestep, spec.option.timestep)
    for owner in (*spec.actuators, *spec.sensors):
        owner.nsample *= times


def _hardened(spec: mujoco.MjSpec, timeconst: float, impedance: float) -> None:
    for owner in (*spec.joints, *spec.tendons):
        owner.solref_friction[0] = min(timeconst, owner.solref_friction[0])
        owner.solimp_friction[:2] = np.maximum(owner.solimp_friction[:2], impedance)
