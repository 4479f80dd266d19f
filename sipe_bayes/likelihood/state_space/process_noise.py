"""What inferred process noise says of the model: a hint, no test."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sipe_bayes.core.arrays import FloatArray, IntArray
from sipe_bayes.core.findings import Code, Finding, Severity, finding
from sipe_bayes.core.thresholds import THRESHOLDS
from sipe_bayes.likelihood.state_space.chain import Chain


def process_noise_findings(
    chain: Chain, process: FloatArray, movement: FloatArray, outliers: Sequence[int] | IntArray = ()
) -> list[Finding]:
    """Hold the process noise (D,) against how far each coordinate moves in a control step (D,).

    Says where process noise is largest, which steps stand out (``outliers``: after which of the chain's states), and
    whether it is more than a model that lacks nothing needs.
    """
    share = np.where(chain.irrelevant, 0.0, process / movement)
    worst = int(share.argmax())
    percent = f"{100 * share[worst]:.0f}" if share[worst] > 0.1 else f"{100 * share[worst]:.2g}"
    much = share[worst] >= THRESHOLDS.much_process_noise
    large = (
        " A model that lacks nothing needs next to none. Either this one lacks something there, or measurement noise "
        "hides how stiff the contact is: then estimates may be off by several posterior sds"
    )
    largest = finding(
        Code.PROCESS_NOISE,
        severity=Severity.CAUTION if much else None,
        meaning=large if much else "",
        coordinate=chain.labels[worst],
        sd=float(process[worst]),
        percent=percent,
        count=len(outliers),
        steps=int(chain.linked.sum()),
        times=f": at {_times(chain, outliers)}" if len(outliers) else "",
    )
    return [largest]


def _times(chain: Chain, outliers: Sequence[int] | IntArray) -> str:
    """When the first four of them happen."""
    many = len(chain.trajectories) > 1
    times = [
        f"{chain.sample[k] * chain.dt[k]:.3g} s" + (f" of {chain.names[k] or f'log {chain.log[k]}'}" if many else "")
        for k in outliers[:4]
    ]
    return ", ".join(times) + (", ..." if len(outliers) > 4 else "")
