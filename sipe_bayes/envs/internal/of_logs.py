"""Which parameters hold in which log."""

from __future__ import annotations

import numpy as np

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.parameters import ParameterSpace


def standing_for(parameters: ParameterSpace, log: str | None) -> dict[int, list[int]]:
    """Parameter -> the parameters whose mean it takes in ``log``; absent when it does not apply there.

    A nuisance parameter of a log that was not calibrated takes the mean over the logs that were.
    """
    groups: dict[tuple[str, ...], list[int]] = {}
    for j, p in enumerate(parameters):
        if p.log is not None:
            groups.setdefault(p.targets, []).append(j)
    table = {j: [j] for j, p in enumerate(parameters) if p.log is None or p.log == log}
    for members in groups.values():
        if not any(parameters[j].log == log for j in members):
            table[members[0]] = members
    return table


def mean_over(values: FloatArray, members: list[int]) -> float:
    """What a parameter's targets get: its own value, or the mean of those that it stands for."""
    return float(values[members[0]] if len(members) == 1 else np.mean(values[members]))
