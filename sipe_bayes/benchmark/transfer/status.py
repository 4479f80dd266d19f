"""How far a folder's transfer is, and what its agents trained under.

A folder of results holds the transfer's records and plan in ``transfer/`` beside the benchmark's own; estimates that
are missing are cells of the benchmark like any other, measured first and there for both.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from sipe_bayes.benchmark.records import Progress, posterior_path, record_path
from sipe_bayes.benchmark.transfer.measure import randomization
from sipe_bayes.benchmark.transfer.study import TransferRecord, cell_of, estimate_of, trained_as
from sipe_bayes.diagnostics.scores import crps
from sipe_bayes.posterior import Posterior

_ROUNDING = 1e-9  # in theta: what another number of threads changes in a mean


@dataclass(frozen=True)
class Sources:
    """What each finished agent's episodes drew from, by record, as far as its estimate is there.

    Args:
        posteriors: of those whose estimate is the one that they trained under.
        stale: agents that were trained under another posterior than their estimate's record has now, and why.
    """

    posteriors: dict[str, Posterior]
    stale: dict[str, str]

    @classmethod
    def of(cls, records: Sequence[TransferRecord], folder: Path) -> Sources:
        """Of the agents of a folder."""
        sources = cls({}, {})
        for record in (r for r in records if r.done):
            cell = cell_of(record)
            estimate = estimate_of(cell)
            paths = [] if estimate is None else [record_path(folder, estimate.id), posterior_path(folder, estimate.id)]
            if not all(path.is_file() for path in paths):
                continue
            try:
                posterior = randomization(cell, folder).posterior
            except ValueError as error:
                sources.stale[record.id] = str(error)
                continue
            now, then = [posterior.mean.numpy(), posterior.stddev.numpy()], [record.mean, record.sd]
            if np.allclose(now, then, rtol=0, atol=_ROUNDING):
                sources.posteriors[record.id] = posterior
            else:
                sources.stale[record.id] = "its estimate was measured anew"
        return sources

    def crps(self, records: Sequence[TransferRecord]) -> dict[str, float]:
        """Mean CRPS, in theta, of what each agent's episodes drew from, by record."""
        known = [(r, self.posteriors[r.id]) for r in records if r.id in self.posteriors]
        return {r.id: float(crps(posterior, np.array(r.truth)).mean()) for r, posterior in known}


@dataclass(frozen=True)
class Summary(Progress):
    """How far a transfer is.

    Args:
        stale: agents whose estimate is another one now, and why.
        returns: in the target, by record.
        training_seconds: of all trainings, a shared one once.
    """

    stale: Mapping[str, str]
    returns: Mapping[str, float]
    training_seconds: float

    def to_dict(self) -> dict[str, object]:
        """As JSON has it."""
        return asdict(self)

    def lines(self) -> list[str]:
        """To be read."""
        text = [f"{self.headline}; {self.training_seconds:.0f} s of training"]
        text += [f"{cell}: return {earned:.1f}" for cell, earned in self.returns.items()]
        text += [f"stale: {cell}: {why}; delete its record, and run again" for cell, why in self.stale.items()]
        text += [f"failed: {cell}: {why}" for cell, why in self.failed.items()]
        return text + [f"missing: {cell}" for cell in self.missing]


def summary(folder: Path) -> Summary:
    """Of a folder of results.

    Raises:
        RecordError: for one without a transfer.
    """
    records = TransferRecord.every(folder)
    progress = Progress.of(TransferRecord, records, folder)
    done = [r for r in records if r.done]
    seconds = {trained_as(cell_of(r)).id: r.seconds or 0.0 for r in done}  # of a shared training once
    return Summary(
        **vars(progress),
        stale=Sources.of(records, folder).stale,
        returns={r.id: r.earned.mean for r in done},
        training_seconds=sum(seconds.values()),
    )
