"""What ``sipe discover`` does: search the physics that a user's model lacks, and write what was found."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from sipe_bayes.calibration.checks.followed import not_followed
from sipe_bayes.calibration.discovered import write_discovery
from sipe_bayes.calibration.discovery_summary import summarise, without_worse
from sipe_bayes.calibration.output import CHECKPOINT, IDENTITY, claimed, describe_run
from sipe_bayes.calibration.problem import Problem, prepare
from sipe_bayes.calibration.run import run_name
from sipe_bayes.core.telling import Tell, silent
from sipe_bayes.core.validation import at_least
from sipe_bayes.diagnostics.discovery import Discovery
from sipe_bayes.inference.recorded import Progress
from sipe_bayes.structure.discovery import Restriction, SearchInterrupted, check_restriction
from sipe_bayes.structure.discovery import discover as search
from sipe_bayes.structure.state import BUDGET, DiscoverOptions
from sipe_bayes.structure.structures import Structures

_KEYS = (*(key for key in IDENTITY if key != "budget"), "only", "without", "extensions_sha256")
"""By which a search differs from others; with a larger budget it goes on."""


def discover(
    problem: Problem | str | Path,
    *,
    only: Sequence[str] | None = None,
    without: Sequence[str] = (),
    seed: int | None = None,
    budget: int | None = None,
    time_limit: float | None = None,
    options: DiscoverOptions | None = None,
    checkpoint: Path | None = None,
    progress: Progress | None = None,
) -> Structures:
    """Search the physics that a model lacks.

    Args:
        problem: a configuration read and bound, as ``prepare`` returns it, or the path of one.
        only: names of the extensions that may be tried; default the configuration's, then all.
        without: names that are left out, beside the configuration's.
        seed: default the configuration's.
        budget: rollouts of all fits; default the configuration's, then 30,000.
        time_limit: s, after which the search ends with what it has; default none. The model as it is is fitted.
        options: of the search.
        checkpoint: a file to go on from and to keep up to date; the same call goes on to the same bits, and one with
            a larger budget where the smaller one was spent.
        progress: called along the way.

    Returns:
        The structures that were fitted: ``.table()``, ``.best``, ``.posterior`` (stacked over the set).

    Raises:
        ValueError: for input that cannot be used; the message is one line with the remedy.
        SearchInterrupted: with what the search has, where it is interrupted.
    """
    problem = problem if isinstance(problem, Problem) else prepare(problem)
    config = problem.config
    return search(
        problem.simulator,
        problem.train,
        holdout=problem.holdout,
        prior=problem.prior,
        likelihood=problem.segments,
        restriction=restriction_of(problem, only, without),
        options=options,
        budget=_budget(problem, budget),
        seed=config.seed if seed is None else seed,
        time_limit=math.inf if time_limit is None else at_least("time_limit", time_limit, 0),
        checkpoint=checkpoint,
        progress=progress,
    )


def restriction_of(problem: Problem, only: Sequence[str] | None = None, without: Sequence[str] = ()) -> Restriction:
    """Which extensions may be tried, and where: what is given here, then the configuration's ``[structure]``.

    Args:
        problem: a configuration read and bound.
        only: in place of the configuration's.
        without: beside the configuration's.

    Raises:
        ValueError: for names that do not exist; one line with the remedy.
    """
    table = problem.config.structure
    chosen = table.only if only is None else tuple(only)
    return Restriction(chosen, (*table.without, *without), table.extra, table.sites)


def _budget(problem: Problem, budget: int | None) -> int:
    return budget or problem.config.structure.budget or BUDGET


def run_discovery(
    config: Path,
    out: Path | None = None,
    seed: int | None = None,
    budget: int | None = None,
    only: Sequence[str] | None = None,
    without: Sequence[str] = (),
    num_threads: int | None = None,
    progress: Progress | None = None,
    time_limit: float | None = None,
    warn: Tell = silent,
) -> Discovery:
    """What the command does: read, claim the output folder, search with a checkpoint, write everything.

    Every input is checked before the folder is touched, the user's own extensions among it. What an interrupted search
    has is written as well; the same call goes on.

    Args:
        config: the TOML file.
        out: folder of the results; default runs/NAME-discover.
        seed: default the configuration's.
        budget: rollouts of all fits; default the configuration's, then 30,000.
        only: names of the extensions that may be tried.
        without: names that are left out.
        num_threads: native ones; default all cores.
        progress: called along the way.
        time_limit: s of the search, as of ``discover``.
        warn: called before the search with a line for each column of which the model explains nothing.

    Raises:
        ValueError: for input that cannot be used; the message is one line with the remedy.
    """
    began = time.monotonic()
    problem = prepare(config, num_threads)
    restriction = restriction_of(problem, only, without)
    check_restriction(problem.simulator, problem.train, problem.segments, restriction)
    chosen = problem.config.seed if seed is None else seed
    name = run_name(problem.config.path)
    folder = Path("runs") / f"{name}-discover" if out is None else out
    record = describe_run(problem, "discover", chosen, _budget(problem, budget))
    record |= {
        "only": restriction.only and list(restriction.only),
        "without": list(restriction.without),
        "extensions_sha256": restriction.digests,
    }
    unexplained = not_followed(problem)
    for item in unexplained:
        warn(item.text)
    with claimed(folder, {**record, "status": "started"}, keys=_KEYS):
        try:
            structures = discover(
                problem,
                only=only,
                without=without,
                seed=chosen,
                budget=budget,
                time_limit=time_limit,
                checkpoint=folder / CHECKPOINT,
                progress=progress,
            )
        except SearchInterrupted as interruption:  # who is told waits for what there is, or interrupts again
            if not interruption.structures.fitted:
                raise
            structures = interruption.structures

        def tell(what: str) -> None:
            if progress is not None:
                progress(f"comparing before and after: {what}", structures.rollouts, structures.rollouts)

        try:
            structures = without_worse(problem, structures, tell)
            discovery = summarise(problem, structures, name, chosen, began, tell)
            findings = (*unexplained, *discovery.findings)
            discovery = replace(discovery, findings=findings, run=record, out=str(folder))
            return write_discovery(discovery, structures, problem, folder)
        except KeyboardInterrupt:
            raise KeyboardInterrupt(structures.so_far) from None
