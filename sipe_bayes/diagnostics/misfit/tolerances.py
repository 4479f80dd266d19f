"""What numbers do to the values that no machine has exactly, and that no motion tells: forces, drawings, clocks.

A machine whose motors give a tenth more than the log says, with masses, inertias and friction a tenth larger, moves
alike; and so does one with a lighter link whose centre of mass lies further out. Joints that are read one after the
other at one time stamp look like servos that are softer from one to the next. Where theta can imitate another such
number but for a small part of what it does, the logs are not asked which it is: at that level the linearisation of dry
friction is no better. Theta's answer to a number that is off by its tolerance is then what values are unknown by beside
all that the logs tell.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.findings import Code, Finding, finding
from sipe_bayes.diagnostics.misfit.probed_logs import ProbedLogs
from sipe_bayes.posterior import Particles
from sipe_bayes.structure.physics_step import PHYSICS_STEP
from sipe_bayes.structure.probes import Probe

IMITATED = 0.05  # of a column's information, that theta leaves
_NAMED = 3  # numbers


@dataclass(frozen=True)
class Tolerances:
    """Sds of numbers that no machine has exactly; by default all are exact.

    Args:
        commands: of what each actuator delivers, as a share of what its command says.
        geometry: of where a body's centre of mass lies, as a share of its ``reach`` (``structure.machine``), and of a
            mass that is not unknown, as a share of it.
        timing: of when a measurement was taken, as a share of the time from sample to sample.
        physics_step: of what physics steps change, as a share of all that they do: a machine takes none.
    """

    commands: Mapping[str, float] = field(default_factory=dict)
    geometry: float = 0.0
    timing: float = 0.0
    physics_step: float = 0.0

    def of(self, probe: Probe) -> float:
        """The sd of the number that a probe changes."""
        if probe.extension is None:
            return 0.0
        if probe.extension is PHYSICS_STEP:
            return self.physics_step
        shares = {"body": self.geometry, "channel": self.timing, "actuator": self.commands.get(probe.site, 0.0)}
        return shares.get(probe.extension.kind, 0.0)


EXACT = Tolerances()
COMMANDS, GEOMETRY, TIMING = 0.1, 0.05, 0.1  # the usual sds: of motor constants, of drawings, of loops that read joints
PHYSICS_STEPS = 1.0  # between a machine without any and a simulated log in the model's own


def usual(actuators: Sequence[str]) -> Tolerances:
    """Those of machines of which nobody has said more."""
    return Tolerances(dict.fromkeys(actuators, COMMANDS), GEOMETRY, TIMING, PHYSICS_STEPS)


@dataclass(frozen=True)
class Untold:
    """A number that the logs do not tell.

    Args:
        probe: that changes it.
        sd: of it, as a share.
        shift: (N,) of theta where it is an sd larger.
    """

    probe: Probe
    sd: float
    shift: FloatArray

    @property
    def sentence(self) -> str:
        """What the model then lacks, in words."""
        assert self.probe.extension is not None
        return self.probe.extension.off(self.probe.site, self.sd)


def untold(logs: ProbedLogs, tolerances: Tolerances) -> list[Untold]:
    """The numbers with a tolerance that theta can imitate, of those that move it.

    Args:
        logs: linearised at the estimate.
        tolerances: of these numbers.
    """
    seen, n = logs.seen, logs.windows.num_theta
    whole = np.diag(logs.arrow.precision)[n:]
    numbers = []
    for k, probe in enumerate(logs.probes):
        sd = tolerances.of(probe)
        if sd and np.isfinite(probe.whole) and seen.two_sided[k] <= IMITATED * whole[k]:
            numbers.append(Untold(probe, sd, -seen.answer[:, k] * probe.whole * sd))
    return numbers


def _sd(logs: ProbedLogs) -> FloatArray:
    """What the logs tell of theta (N,); infinite of a parameter that is held by its bound, which nothing moves."""
    variance = logs.seen.variance
    return np.sqrt(np.where(variance > 0, variance, np.inf))


def named(logs: ProbedLogs, numbers: Sequence[Untold]) -> tuple[str, ...]:
    """Of these numbers, in words, those that move a value by more than the sd that the logs tell, the largest first."""
    size: dict[str, float] = {}
    for one in numbers:
        size[one.sentence] = max(size.get(one.sentence, 0.0), float(np.abs(one.shift / _sd(logs)).max()))
    return tuple(sorted((name for name in size if size[name] > 1), key=lambda name: -size[name])[:_NAMED])


def tolerance_findings(logs: ProbedLogs, numbers: Sequence[Untold]) -> list[Finding]:
    """Of the values that one of these numbers moves by more than an sd of what the logs tell."""
    sd, space = _sd(logs), logs.windows.simulator.space
    shifts = np.array([one.shift for one in numbers]).reshape(len(numbers), len(space))
    off, causes = np.sqrt((shifts**2).sum(0)), named(logs, numbers)
    if not causes:
        return []
    moved = np.flatnonzero(np.abs(shifts).max(0) > sd).tolist()
    ends = space.values(np.clip([logs.theta - off, logs.theta, logs.theta + off], 0, 1))
    by = [f"{space[j].name} by {np.abs(np.diff(ends[:, j])).max():.2g} {space[j].unit}" for j in moved]
    others = [one for one in numbers if one.probe.extension is not PHYSICS_STEP]  # the interval allows for steps
    hangs = np.abs([one.shift for one in others]).max(0) > sd if others else np.zeros(len(space), bool)
    names = [space[j].name for j in np.flatnonzero(hangs).tolist()]
    return [finding(Code.UNTOLD, parameters=names, causes=" or ".join(causes), moved=", ".join(by))]


def widened(further: Particles, numbers: Sequence[Untold], seed: int) -> Particles:
    """Draws of theta with these numbers drawn within their tolerances."""
    theta = further.theta.numpy()
    sizes = np.random.default_rng([seed, 1]).standard_normal((len(theta), len(numbers)))
    shifts = np.array([one.shift for one in numbers]).reshape(len(numbers), theta.shape[1])
    return Particles(np.clip(theta + sizes @ shifts, 0, 1), further.space, weights=further.weights.numpy())
