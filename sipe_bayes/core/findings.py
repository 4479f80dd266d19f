"""Findings: what a fit, a check or a log reader noticed, as data.

A ``Finding`` has a code, a severity, the parameters and the log that it is about, and a text for people. Code asks for
the code (``findings.of(Code.NOT_MIXED)``), never for words of the text; warnings, doubts, flags and the report are
views of one list. All texts stand in ``core.finding_texts``; whatever is put there changes no behaviour.

``Guard`` runs steps after a fit, none of which can lose it: an exception becomes a finding, and the next step runs.
"""

from __future__ import annotations

import math
import re
import time
import traceback
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Generic, TypeVar

from sipe_bayes.core.files import no_room, was_interruption
from sipe_bayes.core.finding_texts import TEXTS, Code, Severity

__all__ = [
    "Code",
    "Finding",
    "Findings",
    "Guard",
    "NotMade",
    "Outcome",
    "Severity",
    "finding",
    "p_text",
    "rank",
    "singular",
]

S = TypeVar("S")
T = TypeVar("T")
_ONE = re.compile(r"(?<![\w.,])1 (column|draw|group|log|sample|simulation|step|structure|window)s\b")
_UNFINISHED = (
    Code.BUDGET_SPENT,
    Code.TIME_LIMIT,
    Code.SEARCH_CUT_SHORT,
    Code.SEARCH_UNSETTLED,
    Code.NOT_JUDGED,
)
"""Those that say no more than that a search did not come to its end: what the model lacks is often the cause."""


def rank(code: Code, severity: Severity) -> int:
    """How early a finding is told: what blocks, what the model lacks, a search without an end, cautions, notes."""
    if severity is Severity.BLOCKING:
        return 2 if code in _UNFINISHED else 0
    if severity is Severity.CAUTION:
        return 1 if code is Code.MISFIT else 3
    return 4


@dataclass(frozen=True)
class Finding:
    """One thing that was noticed.

    Args:
        code: what it is.
        severity: note, caution, or blocking: no interval is to be trusted.
        text: one or two sentences for people, without the final full stop.
        parameters: names of those that it is about; none for all.
        log: name of the log that it is about, if it is about one.
    """

    code: Code
    severity: Severity
    text: str
    parameters: tuple[str, ...] = ()
    log: str | None = None

    def to_dict(self) -> dict[str, object]:
        """As JSON has it."""
        plain = {"code": str(self.code), "severity": str(self.severity), "parameters": list(self.parameters)}
        return asdict(self) | plain


def finding(
    code: Code,
    *,
    parameters: Iterable[str] = (),
    log: str | None = None,
    severity: Severity | None = None,
    **values: object,
) -> Finding:
    """A finding with the text that ``TEXTS`` has for its code.

    Args:
        code: what it is.
        parameters: names of those that it is about.
        log: name of the log that it is about.
        severity: where it is not the code's usual one.
        **values: what the text's places stand for; ``parameters`` and ``log`` may be named in it as well.
    """
    text = TEXTS[code]
    names = tuple(parameters)
    places = {"parameters": ", ".join(names), "log": log, **values}
    return Finding(code, severity or text.severity, singular(text.template.format(**places)), names, log)


def singular(text: str) -> str:
    """The text with one sample where it said ``1 samples``."""
    return _ONE.sub(r"1 \1", text)


def p_text(p: float, floor: float) -> str:
    """A p-value as a sentence has it; at the ``floor``, the least that the draws behind it can give, it may be less."""
    return f"p {'<=' if p <= floor else '='} {p:.2g}"


class Findings:
    """Findings in the order in which they came, each once."""

    def __init__(self, items: Iterable[Finding] = ()) -> None:
        self._items: dict[Finding, None] = dict.fromkeys(items)

    def add(self, item: Finding) -> None:
        """Add one, unless it is there."""
        self._items.setdefault(item)

    def extend(self, items: Iterable[Finding]) -> None:
        """Add several."""
        for item in items:
            self.add(item)

    def drop(self, *codes: Code) -> None:
        """Take back all findings of these codes."""
        self._items = {item: None for item in self._items if item.code not in codes}

    def of(self, *codes: Code) -> list[Finding]:
        """Those of these codes."""
        return [item for item in self._items if item.code in codes]

    def about(self, name: str) -> list[Finding]:
        """Those about one parameter, or about all."""
        return [item for item in self._items if name in item.parameters or not item.parameters]

    def __contains__(self, code: object) -> bool:
        return any(item.code == code for item in self._items)

    def __iter__(self) -> Iterator[Finding]:
        return iter(self._items)

    def __len__(self) -> int:
        return len(self._items)

    @property
    def blocking(self) -> list[Finding]:
        """Those for which no interval is to be trusted, causes first."""
        return [item for item in self.ranked if item.severity is Severity.BLOCKING]

    @property
    def ranked(self) -> list[Finding]:
        """All of them, worst first, and causes before what follows from them."""
        return sorted(self._items, key=lambda item: rank(item.code, item.severity))

    @property
    def warnings(self) -> list[str]:
        """The texts of all but notes, worst first."""
        return [item.text for item in self.ranked if item.severity is not Severity.NOTE]

    @property
    def kinds(self) -> list[str]:
        """The warnings, worst first, those of one kind about several logs as one with their number."""
        groups: dict[tuple[object, ...], list[Finding]] = {}
        for item in self.ranked:
            if item.severity is Severity.NOTE:
                continue
            alike = (item.code, item.severity, item.parameters) if item.log is not None else (item,)
            groups.setdefault(alike, []).append(item)
        others = ((items[0].text, len(items) - 1) for items in groups.values())
        return [text + (f" (and so {n} more)" if n else "") for text, n in others]

    @property
    def doubts(self) -> list[str]:
        """The texts of those that block."""
        return [item.text for item in self.blocking]


class NotMade(Exception):
    """Raised in a step that needs the result of a step without one."""


@dataclass(frozen=True)
class Outcome(Generic[S]):
    """The result of a step, if the step came to its end.

    Args:
        made: the result alone, or nothing.
    """

    made: tuple[S, ...]

    @property
    def value(self) -> S:
        """The result; raises NotMade without one, so that the step that asks is skipped."""
        if not self.made:
            raise NotMade
        return self.made[0]

    def otherwise(self, default: T) -> S | T:
        """The result, or the default without one."""
        return self.made[0] if self.made else default


class Guard:
    """Runs steps by name; an exception in one of them is noted, and leaves that step without a result.

    Interruptions and a full disk are raised as ever: the same command resumes after them.

    Args:
        deadline: on the monotonic clock, after which steps that may be skipped are skipped.
    """

    def __init__(self, deadline: float = math.inf) -> None:
        self._deadline = deadline
        self._errors: list[Finding] = []
        self._late: list[str] = []
        self._dependent: list[str] = []

    def run(self, name: str, make: Callable[[], S], *, skippable: bool = False) -> Outcome[S]:
        """Run a step.

        Args:
            name: of the step, in words.
            make: gives its result.
            skippable: whether the step is skipped after the deadline.
        """
        if skippable and time.monotonic() > self._deadline:
            self._late.append(name)
            return Outcome(())
        try:
            return Outcome((make(),))
        except NotMade:
            self._dependent.append(name)
        except Exception as error:
            if was_interruption(error) or no_room(error):
                raise
            self._errors.append(_internal_error(name, error))
        return Outcome(())

    def gather(self, looks: Mapping[str, Callable[[], Sequence[Finding]]]) -> list[Finding]:
        """The diagnostics that several steps give, by the steps' names."""
        return [item for name, look in looks.items() for item in self.run(name, look).otherwise(())]

    @property
    def is_late(self) -> bool:
        """Whether the deadline has cost a step."""
        return bool(self._late)

    @property
    def findings(self) -> tuple[Finding, ...]:
        """Diagnostics of the steps that have no result."""
        skipped = {"the time limit had passed": self._late, "each needs one that has no result": self._dependent}
        lists = [finding(Code.CHECKS_SKIPPED, checks=", ".join(n), reason=why) for why, n in skipped.items() if n]
        return (*self._errors, *lists)


def _internal_error(name: str, error: Exception) -> Finding:
    """The diagnostic of an exception, with the line that raised it."""
    place = traceback.extract_tb(error.__traceback__)[-1]
    text = f"{type(error).__name__}: {' '.join(str(error).split())}"
    return finding(Code.INTERNAL_ERROR, check=name, error=text, place=f"{Path(place.filename).name}:{place.lineno}")
