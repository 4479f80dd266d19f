"""A base that does not stand level."""

from __future__ import annotations

import numpy as np

from sipe_bayes.core.parameters import Parameter
from sipe_bayes.structure.extension import Extension
from sipe_bayes.structure.machine import Machine


class GravityTilt(Extension):
    """A base that does not stand level."""

    name, kind = "gravity_tilt", "world"
    reference = "-"

    def sentence(self, site: str) -> str:
        """What it is."""
        return "a base that is tilted"

    def parameters(self, machine: Machine, site: str) -> tuple[Parameter, ...]:
        """Up to three degrees either way: bases are put up with a level."""
        most = 0.05 * float(np.linalg.norm(machine.model.opt.gravity))
        if not most:
            return ()
        names = ("gravity_x", "gravity_y")
        return tuple(
            Parameter(name, -most, most, targets=(f"option.{name}",), description="of a tilted base") for name in names
        )
