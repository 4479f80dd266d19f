"""Steps after a fit, none of which can lose it: an exception becomes a diagnostic, and the next step runs."""

from __future__ import annotations

import math
import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Generic, TypeVar

from sipe_bayes.core.files import no_room, was_interruption
from sipe_bayes.core.findings import Code, Finding, finding

S = TypeVar("S")
T = TypeVar("T")


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
