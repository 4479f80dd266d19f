"""Numbers that no machine has exactly, and that often no motion tells: forces, drawings, clocks.

A machine whose motors give a tenth more, with masses, inertias and friction a tenth larger, moves alike.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from sipe_bayes.structure.probes import Probe


@dataclass(frozen=True)
class Tolerances:
    """Sds of numbers that no machine has exactly, as shares; by default all are exact.

    ``commands``: of what each actuator's command says. ``geometry``: of the ``reach`` of a body's centre of mass, and
    of a mass that is fixed. ``timing``: of the time between samples. ``physics_step``: of all that steps do.
    """

    commands: Mapping[str, float] = field(default_factory=dict)
    geometry: float = 0.0
    timing: float = 0.0
    physics_step: float = 0.0

    def of(self, probe: Probe) -> float:
        """The sd of the number that a probe changes."""
        if probe.is_step:  # n times as short it changes (n - 1)/n of all that steps do
            return self.physics_step * probe.placed.extension.slow / (probe.placed.extension.slow - 1)
        commands = self.commands.get(probe.placed.site, 0.0)
        shares = {"body": self.geometry, "channel": self.timing, "actuator": commands}
        return shares.get(probe.placed.extension.kind, 0.0)


EXACT = Tolerances()
COMMANDS, GEOMETRY, TIMING = 0.1, 0.05, 0.1  # the usual sds: of motor constants, of drawings, of loops that read joints
PHYSICS_STEPS = 1.0  # between a machine without any and a simulated log in the model's own


def usual(actuators: Sequence[str]) -> Tolerances:
    """Those of machines of which nobody has said more."""
    return Tolerances(dict.fromkeys(actuators, COMMANDS), GEOMETRY, TIMING, PHYSICS_STEPS)
