"""How much may be simulated: a budget of rollouts, and a time."""

from __future__ import annotations

import math
import time


class BudgetExhausted(RuntimeError):
    """Raised instead of simulating beyond the budget."""


class BudgetTooSmall(ValueError):
    """A budget that ran out before there was anything to estimate from."""


class Deadline:
    """A time on the monotonic clock after which nothing is simulated; ``hit`` once a simulation was refused."""

    def __init__(self, ends: float = math.inf) -> None:
        self.ends, self.hit = ends, False

    def check(self) -> None:
        """Raise BudgetExhausted where the time has passed."""
        if time.monotonic() > self.ends:
            self.hit = True
            raise BudgetExhausted("the time limit has passed")
