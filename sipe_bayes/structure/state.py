"""Where a search over structures stands: what was fitted, the predicted gains, and what comes next."""

from __future__ import annotations

import enum
from collections.abc import Sequence
from dataclasses import dataclass, replace

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.options import Options, option
from sipe_bayes.structure.fitted import FittedStructure

BUDGET = 30_000  # rollouts by default: structures with two pieces of a machine with two joints
Labels = tuple[str, ...]


@dataclass(frozen=True)
class DiscoverOptions(Options):
    """How structures are searched."""

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
    """The predicted gain of the extension ``label`` beside the structure ``at``, in nats of log likelihood.

    A fit starts from ``theta`` (P,) of the extension and ``others`` (N,), the parameters of the structure.
    """

    at: Labels
    label: str
    gain: float
    theta: FloatArray
    others: FloatArray


@dataclass(frozen=True)
class DiscoverState:
    """Where a search over structures stands; structures are named by the labels of their extensions.

    Args:
        phase: what comes next.
        fitted: structures, the plain model first.
        beam: structures that this round extends.
        offers: predicted gains until now.
        ranked: structures beside which all extensions were ranked.
        queue: structures that this round still has to fit.
        pruned: structures that were fitted from a larger one that ended elsewhere.
        failed: structures that could not be fitted.
        rank_rollouts: of the rankings.
        failed_rollouts: of fits that failed, as far as they reported.
        cut: what the search was doing when it was cut short; None while it is not.
        cut_off: the structure whose fit was cut short, which counts for nothing then; None where none was.
        budget: rollouts at most, of which the plain fit gets a share.
        placed_at: theta and initial states of the plain model, by whose motion extensions' parameters have bounds.
    """

    phase: Phase = Phase.PLAIN
    fitted: tuple[FittedStructure, ...] = ()
    beam: tuple[Labels, ...] = ((),)
    offers: tuple[Offer, ...] = ()
    ranked: tuple[Labels, ...] = ()
    queue: tuple[Labels, ...] = ()
    pruned: tuple[Labels, ...] = ()
    failed: tuple[Labels, ...] = ()
    rank_rollouts: int = 0
    failed_rollouts: int = 0
    cut: Phase | None = None
    cut_off: Labels | None = None
    budget: int = 0
    placed_at: tuple[FloatArray, FloatArray] | None = None

    def with_budget(self, budget: int, plain_fit: float) -> DiscoverState:
        """The state with another budget; a new one where a larger budget would have fitted the plain model further.

        plain_fit: budget from which the plain fit has all the rollouts that a fit may have.
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
        return self.of(labels) is not None or any(set(labels) == set(one) for one in self.failed)
