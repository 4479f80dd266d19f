"""How structures are searched, and where a search stands: what was fitted, predicted gains, what comes next."""

from __future__ import annotations

import enum
from collections.abc import Sequence
from dataclasses import dataclass, replace

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.options import Options, option
from sipe_bayes.structure.fitted import FittedStructure

BUDGET = 30_000  # rollouts by default: structures with two pieces of a machine with two joints


@dataclass(frozen=True)
class DiscoverOptions(Options):
    """How structures are searched."""

    width: int = option(3, "candidates that are fitted in a round; in the first up to twice as many", least=1)
    beam: int = option(2, "structures that each round extends", least=1)
    most: int = option(5, "extensions that a structure may have", least=1)
    least_gain: float = option(5.0, "predicted gain from which an extension is fitted", "nats", above=0)
    plain_share: float = option(0.5, "of the budget, for the model as it is at most", above=0, below=1)
    fit_budget: int = option(2000, "rollouts of one fit, or forty steps of it if that is more", least=1)
    physics_steps: int = option(
        10000, "of the logs that are searched on at most, in blocks; fewer where parameters are many", least=1
    )


class Phase(enum.Enum):
    """What the next step does."""

    PLAIN = "plain"
    RANK = "rank"
    FIT = "fit"
    PRUNE = "prune"
    DONE = "done"


@dataclass(frozen=True)
class Offer:
    """The predicted gain of an extension beside a structure.

    Args:
        at: labels of the structure.
        label: of the extension.
        gain: predicted gain of the log likelihood, in nats.
        theta: (P,), where its parameters are to start.
        others: (N,), where those of the structure then are to.
    """

    at: tuple[str, ...]
    label: str
    gain: float
    theta: FloatArray
    others: FloatArray


@dataclass(frozen=True)
class DiscoverState:
    """Where a search over structures stands.

    Args:
        phase: what comes next.
        fitted: structures, the plain model first.
        beam: labels of the structures that this round extends.
        offers: predicted gains until now.
        ranked: labels of structures at which all extensions were ranked.
        queue: labels of the structures that this round still has to fit.
        pruned: labels of structures that were fitted from a larger one that ended elsewhere.
        failed: labels of structures that could not be fitted.
        rank_rollouts: of the rankings.
        failed_rollouts: of fits that failed, as far as they told.
        cut: what the search was doing when it was cut short; None while it is not.
        cut_off: labels of the structure whose fit was, which counts for nothing then; None where none was.
        budget: rollouts at most, of which the plain fit gets a share.
        placed_at: theta and initial states of the plain model, by whose motion extensions' parameters have bounds.
    """

    phase: Phase = Phase.PLAIN
    fitted: tuple[FittedStructure, ...] = ()
    beam: tuple[tuple[str, ...], ...] = ((),)
    offers: tuple[Offer, ...] = ()
    ranked: tuple[tuple[str, ...], ...] = ()
    queue: tuple[tuple[str, ...], ...] = ()
    pruned: tuple[tuple[str, ...], ...] = ()
    failed: tuple[tuple[str, ...], ...] = ()
    rank_rollouts: int = 0
    failed_rollouts: int = 0
    cut: Phase | None = None
    cut_off: tuple[str, ...] | None = None
    budget: int = 0
    placed_at: tuple[FloatArray, FloatArray] | None = None

    def with_budget(self, budget: int, plain_fit: float) -> DiscoverState:
        """It with another budget; from the beginning where a larger one would have fitted the plain model further.

        Args:
            budget: rollouts at most, of all.
            plain_fit: budget from which the plain fit has all that a fit may have.
        """
        short = self.budget < plain_fit and not (self.fitted and self.fitted[0].settled)
        return DiscoverState(budget=budget) if budget > self.budget and short else replace(self, budget=budget)

    def describe(self, extensions: int) -> str:
        """What comes next, for the progress bar; of so many extensions."""
        at = next((labels for labels in self.beam if labels not in self.ranked), ())
        beside = f" beside {' and '.join(at)}" if at else ""
        return {
            Phase.PLAIN: "fitting the model as it is",
            Phase.RANK: f"testing {extensions} extensions{beside}",
            Phase.FIT: f"fitting {' and '.join(self.queue[0]) if self.queue else ''}",
            Phase.PRUNE: "leaving out what the best structure needs least",
            Phase.DONE: "done",
        }[self.phase]

    @property
    def done(self) -> bool:
        """Whether the search has ended."""
        return self.phase is Phase.DONE

    @property
    def rollouts(self) -> int:
        """Of all fits, those that failed too, and of rankings."""
        return sum(one.rollouts for one in self.fitted) + self.rank_rollouts + self.failed_rollouts

    def of(self, labels: Sequence[str]) -> FittedStructure | None:
        """The fit of a structure, whatever the order of its extensions."""
        return next((one for one in self.fitted if set(one.labels) == set(labels)), None)

    def is_tried(self, labels: Sequence[str]) -> bool:
        """Whether a structure was fitted, or could not be, whatever the order of its extensions."""
        return any(set(labels) == set(one) for one in (*(o.labels for o in self.fitted), *self.failed))

    def surpasses(self, one: FittedStructure) -> bool:
        """Whether one with fewer of its pieces has the greater evidence: then the search has not ended yet."""
        return any(set(o.labels) < set(one.labels) and o.evidence > one.evidence for o in self.fitted)
