"""What a policy may be trained under: the distribution whose intervals the report says to use.

Draws come from the discrepancy-aware posterior where there is one (``structure.discrepancy``), correlations included.
Where no value of a parameter may be used, it is drawn from its prior, by default all of its bounds, whatever the others
are: the logs defend nothing narrower.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch

from sipe_bayes.core.arrays import BoolArray
from sipe_bayes.core.findings import Findings
from sipe_bayes.diagnostics.result import Calibration
from sipe_bayes.posterior import Particles, Posterior
from sipe_bayes.report.verdicts import doubt, parameter_verdict
from sipe_bayes.rl.randomization import Usable

_DRAWS = 4000  # of a posterior some of whose parameters may not be used


@dataclass(frozen=True)
class Basis:
    """What a parameter's draws stand on.

    Args:
        usable: which interval may be used.
        reason: the verdict on it, in words.
    """

    usable: Usable
    reason: str


@dataclass(frozen=True)
class Recommended:
    """What to draw from.

    Args:
        posterior: over the N parameters of the calibration; the one that was fitted where nothing differs from it.
        bases: of each parameter, by name.
    """

    posterior: Posterior
    bases: Mapping[str, Basis]

    @property
    def plain(self) -> bool:
        """Whether it is the posterior that was fitted."""
        return all(basis.usable is Usable.PLAIN for basis in self.bases.values())

    def names(self, usable: Usable) -> tuple[str, ...]:
        """The parameters of which this may be used."""
        return tuple(name for name, basis in self.bases.items() if basis.usable is usable)

    def remarks(self) -> list[str]:
        """What whoever draws from it has to know, a line for each kind of draws."""
        lines = []
        if wider := self.names(Usable.WIDER):
            lines.append(f"Drawn with what the model lacks or may lack: {', '.join(wider)}.")
        if none := self.names(Usable.NONE):
            reasons = dict.fromkeys(self.bases[name].reason for name in none)
            alike = {reason: [n for n in none if self.bases[n].reason == reason] for reason in reasons}
            why = "; ".join(f"{', '.join(names)}: {reason}" for reason, names in alike.items())
            lines.append(f"WARNING, not calibrated, drawn from the prior: {why}.")
        return lines


def recommended(calibration: Calibration) -> Recommended:
    """The distribution whose intervals the report says to use."""
    findings, blocked = Findings(calibration.findings), doubt(calibration)
    printed = Usable.PLAIN if calibration.further is None else Usable.WIDER
    bases = {}
    for parameter in calibration.parameters:
        verdict = parameter_verdict(parameter, findings)
        usable = Usable.NONE if blocked or verdict.tone == "bad" else printed
        bases[parameter.name] = Basis(usable, blocked or verdict.text)
    unusable = np.array([basis.usable is Usable.NONE for basis in bases.values()])
    posterior = calibration.posterior if calibration.further is None else calibration.further
    if unusable.all():
        posterior = calibration.prior
    elif unusable.any():
        posterior = _freed(posterior, calibration.prior, unusable)
    return Recommended(posterior, bases)


def _freed(posterior: Posterior, prior: Posterior, unusable: BoolArray) -> Particles:
    """Draws of a posterior, or its own points, parameters that are ``unusable`` (N,) drawn from the prior."""
    generator, weights = torch.Generator().manual_seed(0), None
    if isinstance(posterior, Particles):
        theta, weights = posterior.theta.numpy(), posterior.weights
    else:
        theta = posterior.sample((_DRAWS,), generator=generator).numpy()
    before = prior.sample((len(theta),), generator=generator).numpy()
    return Particles(np.where(unusable, before, theta), posterior.space, weights=weights)
