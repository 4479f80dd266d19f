"""Every code of a finding, how severe it usually is, and its text: the one place where they stand.

A new finding is a line in ``Code`` and an entry in ``TEXTS``; ``{places}`` are filled by ``findings.finding``.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum, auto


class Severity(StrEnum):
    """note: worth knowing. caution: a value or a prediction suffers. blocking: no interval is to be trusted."""

    NOTE = auto()
    CAUTION = auto()
    BLOCKING = auto()


class Code(StrEnum):
    """What a finding is; the names are stable and stand in result.json."""

    # any estimator
    BUDGET_SPENT = auto()
    AT_BOUND = auto()
    REMARK = auto()  # until every sentence has a code of its own


@dataclass(frozen=True)
class Text:
    """How severe a finding usually is, and its text with {places}."""

    severity: Severity
    template: str


_NOTE, _CAUTION, _BLOCKING = Severity.NOTE, Severity.CAUTION, Severity.BLOCKING

TEXTS: dict[Code, Text] = {
    # any estimator
    Code.BUDGET_SPENT: Text(_CAUTION, "the budget of {budget} rollouts ran out before the method had converged"),
    Code.AT_BOUND: Text(
        _CAUTION,
        "{parameters} at a bound: the truth may lie beyond it; widen the bounds, or look at the residuals",
    ),
    Code.REMARK: Text(_CAUTION, "{text}"),
}
