"""How long a physics step is: a machine has none.

A step of h seconds moves a simulation by an error of the order h: MuJoCo's Euler steps, explicit or implicit in the
velocity, lead an accelerated joint by about h/2. A step of h/n has an error of h/(2n), so it changes (n - 1)/n of all
that steps do (L. F. Richardson 1911, https://doi.org/10.1098/rsta.1911.0009).
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


class PhysicsStep(Extension):
    """Shorter physics steps: nothing about them is unknown."""

    name, kind, fixed = "physics_step", "world", True
    shorter = 8
    reference = "L. F. Richardson 1911"

    def sentence(self, site: str) -> str:
        """What it is."""
        return "physics steps an eighth as long"

    def off(self, site: str, share: float) -> str:
        """See ``Extension``."""
        return "the effect of the physics step"

    def parameters(self, machine: Machine, site: str) -> tuple[Parameter, ...]:
        """None."""
        return ()

    def edit(self, machine: Machine, site: str) -> Edit:
        """The option of the model, an eighth of what it was."""
        return partial(_shortened, timestep=float(machine.model.opt.timestep) / self.shorter)

    def probes(self, machine: Machine, parameters: tuple[Parameter, ...]) -> FloatArray:
        """One, of no parameters."""
        return np.zeros((1, 0))


def _shortened(spec: mujoco.MjSpec, timestep: float) -> None:
    """With histories of commands and measurements that are as long as before."""
    times = max(1, math.ceil(spec.option.timestep / timestep * (1 - 1e-9)))
    spec.option.timestep = min(timestep, spec.option.timestep)
    for owner in (*spec.actuators, *spec.sensors):
        owner.nsample *= times
