"""What ``sipe discover`` does: search the physics that a user's model lacks, and write what was found.

Beside the report these are the extended MJCF, a configuration of it, and the table as data.
"""

from __future__ import annotations

import math
import os
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from sipe_bayes.calibration.checks.followed import not_followed
from sipe_bayes.calibration.discovery_summary import summarise, without_worse
from sipe_bayes.calibration.output import CHECKPOINT, IDENTITY, claimed, describe_run, save_posterior
from sipe_bayes.calibration.problem import RUN, Problem, prepare
from sipe_bayes.calibration.run import run_name
from sipe_bayes.core.files import printed, to_json, write_text
from sipe_bayes.core.findings import Code, Finding, finding
from sipe_bayes.core.parameters import Parameter
from sipe_bayes.core.telling import Tell, silent
from sipe_bayes.core.toml import to_toml
from sipe_bayes.core.validation import at_least
from sipe_bayes.diagnostics.discovery import Discovery
from sipe_bayes.envs.export import ExportError, write_edited, write_identified
from sipe_bayes.envs.mjcf import MjcfEnvironment
from sipe_bayes.inference.recorded import Progress
from sipe_bayes.report.discovery.page import write_discovery_report
from sipe_bayes.structure.discovery import Restriction, SearchInterrupted
from sipe_bayes.structure.discovery import discover as search
from sipe_bayes.structure.extension import Placed
from sipe_bayes.structure.state import BUDGET, DiscoverOptions
from sipe_bayes.structure.structures import Structures

DISCOVERED_XML, DISCOVERED_TOML, EXTENDED_XML = "discovered.xml", "discovered.toml", "extended.xml"
# by which a search differs from others; with a larger budget it goes on
_KEYS = (*(key for key in IDENTITY if key != "budget"), "only", "without", "extensions_sha256")


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
    structures = search(
        problem.simulator,
        problem.train,
        holdout=problem.holdout,
        prior=problem.prior,
        likelihood=problem.segments,
        restriction=_restriction(problem, only, without),
        options=options,
        budget=_budget(problem, budget),
        seed=problem.config.seed if seed is None else seed,
        time_limit=math.inf if time_limit is None else at_least("time_limit", time_limit, 0),
        checkpoint=checkpoint,
        progress=progress,
    )
    return without_worse(problem, structures)


def _restriction(problem: Problem, only: Sequence[str] | None, without: Sequence[str]) -> Restriction:
    """Which extensions may be tried, and where: what is given here, then the configuration's ``[structure]``."""
    table = problem.config.structure
    return Restriction(
        table.only if only is None else tuple(only), (*table.without, *without), table.extra, table.sites
    )


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

    ``config`` is a TOML file, ``out`` the folder of the results, by default runs/NAME-discover, ``num_threads`` native
    ones, by default all cores; ``warn`` is called before the search with a line for each column of which the model
    explains nothing. All else is as in ``discover``.

    Raises:
        ValueError: for input that cannot be used; the message is one line with the remedy.
    """
    began = time.monotonic()
    problem = prepare(config, num_threads)
    restriction = _restriction(problem, only, without)
    restriction.check(problem.simulator, problem.train, problem.segments)
    chosen = problem.config.seed if seed is None else seed
    name = run_name(problem.config.path)
    folder = Path("runs") / f"{name}-discover" if out is None else out
    record = {
        **describe_run(problem, "discover", chosen, _budget(problem, budget)),
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
            structures = interruption.structures
            if not structures.fitted:
                raise

        def tell(what: str) -> None:
            if progress is not None:
                progress(f"comparing before and after: {what}", structures.rollouts, structures.rollouts)

        try:
            if structures.search.ended == "interrupted":
                structures = without_worse(problem, structures, tell)
            discovery = summarise(problem, structures, name, chosen, began, tell)
            findings = (*unexplained, *discovery.findings)
            discovery = replace(discovery, findings=findings, run=record, out=str(folder))
            return _write(discovery, structures, problem, folder)
        except KeyboardInterrupt:
            raise KeyboardInterrupt(structures.so_far) from None


def _write(discovery: Discovery, structures: Structures, problem: Problem, folder: Path) -> Discovery:
    """Fill the folder of a finished search, which claimed it; its ``run.json`` comes last and says so.

    Returns:
        The result with what was noticed on the way.
    """
    save_posterior(structures.posterior, folder)
    environment, noticed = _environment(structures), list[Finding]()
    try:
        values, note = environment.space.values(structures.best.theta), _note(structures.placed(structures.best))
        noticed += write_identified(environment, values, folder / DISCOVERED_XML, note)
        _write_configuration(problem, structures, folder, int(str(discovery.run["seed"])))
    except ExportError as error:
        noticed.append(finding(Code.NOT_EXPORTED, reason=error))
    discovery = replace(discovery, findings=(*discovery.findings, *noticed))
    write_discovery_report(discovery, folder)
    write_text(folder / "structures.json", to_json(discovery.to_dict(), indent=2))
    status = "interrupted" if discovery.ended in ("time", "interrupted") else "complete"
    write_text(folder / RUN, to_json({**discovery.run, "status": status}, indent=2))
    return discovery


def _environment(structures: Structures) -> MjcfEnvironment:
    """Of the best structure."""
    environment = structures.simulator(structures.best).environment
    assert isinstance(environment, MjcfEnvironment)
    return environment


def _note(placed: list[Placed]) -> str:
    """What the model has that it had not, and what MuJoCo itself does not simulate of it."""
    if not placed:
        return "the model as it was, calibrated: nothing was found that it lacks"
    lines = ["the model, calibrated:"]
    for piece in placed:
        nearest, reservation = piece.extension.nearest, ""
        if piece.extension.kind == "channel":
            reservation = " (of the measurement, which has no place in a model: see discovered.toml)"
        elif not piece.extension.native:
            nearest = nearest and f"; nearest element: {nearest}"
            reservation = f" (numbers in <numeric>, simulated by sipe_bayes and not by MuJoCo itself{nearest})"
        lines.append(f"with {piece.sentence}{reservation}")
    return "\n     ".join(lines)


def _write_configuration(problem: Problem, structures: Structures, folder: Path, seed: int) -> None:
    """Write ``discovered.toml``, a configuration of the best structure that ``sipe calibrate`` runs as it stands.

    Where extensions edit the model, it names ``extended.xml``: the edited MJCF, in which they do nothing yet.

    Raises:
        ExportError: where the edited model cannot be written.
    """
    environment, placed = _environment(structures), structures.placed(structures.best)
    data = problem.config.model_dump(mode="json", by_alias=True, exclude_unset=True)
    data = _relocated(data, folder) | {"seed": seed}
    if any(one.edit is not None for one in placed):
        write_edited(environment, folder / EXTENDED_XML)
        data["model"] = EXTENDED_XML
    data["parameters"] = [*data["parameters"], *_entries([p for one in placed for p in one.parameters])]
    space, weight = environment.space, structures.table()[0].weight
    values = zip(space.names, space.values(structures.best.theta).tolist(), strict=True)
    data["structure"] = {**data.get("structure", {}), "weight": max(float(f"{weight:.3g}"), 1e-3)}
    data["search"] = {**data.get("search", {}), "start": dict(values)}
    remarks = [f"{problem.config.path.name} with what `sipe discover` put in; run it from anywhere:"]
    remarks.append(f"  sipe calibrate {folder / DISCOVERED_TOML}")
    lines = [f"# {printed(remark)}" for remark in (*remarks, *(one.sentence for one in placed))]
    write_text(folder / DISCOVERED_TOML, "\n".join(lines) + "\n\n" + to_toml(data))


def _relocated(data: dict[str, Any], folder: Path) -> dict[str, Any]:
    """The configuration's data with its paths as they are from a folder."""

    def moved(path: str) -> str:
        return Path(os.path.relpath(path, folder)).as_posix()

    def rows(table: dict[str, Any]) -> dict[str, Any]:
        return {key: moved(value) if key in ("file", "from") else value for key, value in table.items()}

    logs = [{"file": data["logs"]}] if isinstance(data["logs"], str) else data["logs"]
    out = {**data, "model": moved(data["model"]), "logs": [rows(log) for log in logs]}
    if data.get("prior"):
        out["prior"] = rows(data["prior"])
    extra = data.get("structure", {}).get("extra")
    if extra:
        own = [moved(word) if word.rpartition(":")[0].endswith(".py") else word for word in extra]
        out["structure"] = {**data["structure"], "extra": own}
    return out


def _entries(parameters: list[Parameter]) -> list[dict[str, object]]:
    """``[[parameters]]`` of an extension, one for those that differ by log alone."""
    entries: dict[str, dict[str, object]] = {}
    for p in parameters:
        name = p.name.removesuffix(f"[{p.log}]")
        entry: dict[str, object] = {"name": name, "targets": list(p.targets)}
        if p.relative and p.default:
            entry["factor"] = sorted((p.low / p.default, p.high / p.default))
        else:
            entry["bounds"] = [p.low, p.high]
        if p.scale != "linear":
            entry["scale"] = p.scale
        if p.prior_mean is not None and p.prior_sd is not None:
            unit = p.default if p.relative and p.default else 1.0
            entry["prior"] = {"mean": p.prior_mean / unit, "sd": p.prior_sd / abs(unit)}
        if p.log is not None:
            entry["per_log"] = True
        if p.description:
            entry["description"] = p.description
        entries.setdefault(name, entry)
    return list(entries.values())
