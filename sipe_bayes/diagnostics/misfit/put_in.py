"""What a fit put into the model, since its residuals asked for it."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class PutIn:
    """A piece of physics that the model lacks, put in as parameters and fitted.

    Args:
        cause: in words.
        parameter: the one of its parameters that is told best.
        value: of it, in its unit.
        sd: of the value.
        unit: SI.
        remedy: how the model gets it.
    """

    cause: str
    parameter: str
    value: float
    sd: float
    unit: str
    remedy: str
