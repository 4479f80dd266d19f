"""What forces that are not quite as large as the commands say do to the values: the scale that no motion tells.

A machine whose motors give a tenth more than the log says, with masses, inertias and friction a tenth larger, moves
alike. Where theta can imitate another gain but for a small part of what it does, the logs are not asked which it is: at
that level the linearisation of dry friction is no better. Theta's answer to a gain of one tolerance is then what values
are unknown by beside all that the logs tell.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.findings import Code, Finding, finding
from sipe_bayes.diagnostics.misfit.probed_logs import ProbedLogs
from sipe_bayes.posterior import Particles

IMITATED = 0.05  # of a column's information, that theta leaves


@dataclass(frozen=True)
class Tolerance:
    """The gain of an actuator that the logs do not tell.

    Args:
        actuator: which.
        sd: of what it delivers, as a share of what its command says.
        shift: (N,) of theta where it delivers an sd more.
    """

    actuator: str
    sd: float
    shift: FloatArray


def open_gains(logs: ProbedLogs, tolerances: Mapping[str, float]) -> list[Tolerance]:
    """The gains that theta can imitate.

    Args:
        logs: linearised at the estimate.
        tolerances: sd of what each actuator delivers, as a share of what its command says.
    """
    seen, n = logs.seen, logs.windows.num_theta
    whole = np.diag(logs.arrow.precision)[n:]
    opened = []
    for k, probe in enumerate(logs.probes):
        size = probe.whole * tolerances.get(probe.site, 0.0)
        determined = seen.information[k] < np.inf and seen.information[k] > IMITATED * whole[k]
        if size and np.isfinite(size) and not determined:
            opened.append(Tolerance(probe.site, tolerances[probe.site], -seen.answer[:, k] * size))
    return opened


def tolerance_findings(logs: ProbedLogs, opened: list[Tolerance]) -> list[Finding]:
    """Of each gain by which a value moves more than an sd of what the logs tell."""
    sd, space = np.sqrt(logs.seen.variance), logs.windows.simulator.space
    findings = []
    for one in opened:
        moved = [j for j in range(len(space)) if abs(one.shift[j]) > sd[j]]
        if moved:
            change = np.diff(space.values(np.clip([logs.theta, logs.theta + one.shift], 0, 1)), axis=0)[0]
            by = [f"{space[j].name} by {change[j]:+.2g} {space[j].unit}" for j in moved]
            names, percent, words = [space[j].name for j in moved], 100 * one.sd, ", ".join(by)
            code = Code.COMMAND_SCALE
            findings.append(finding(code, parameters=names, actuator=one.actuator, percent=percent, moved=words))
    return findings


def widened(further: Particles, opened: list[Tolerance], seed: int) -> Particles:
    """Draws of theta with gains drawn within their tolerances."""
    theta = further.theta.numpy()
    sizes = np.random.default_rng([seed, 1]).standard_normal((len(theta), len(opened)))
    shifts = np.array([one.shift for one in opened]).reshape(len(opened), theta.shape[1])
    return Particles(np.clip(theta + sizes @ shifts, 0, 1), further.space, weights=further.weights.numpy())
