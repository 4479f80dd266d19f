"""What a search over structures hands back: the extended MJCF, a configuration of it, the table as data."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from typing import Any

from sipe_bayes.calibration.output import save_posterior
from sipe_bayes.calibration.problem import RUN, Problem
from sipe_bayes.core.files import printed, to_json, write_text
from sipe_bayes.core.findings import Code, Finding, finding
from sipe_bayes.core.parameters import Parameter
from sipe_bayes.core.toml import to_toml
from sipe_bayes.diagnostics.discovery import Discovery
from sipe_bayes.envs.export import ExportError, write_edited, write_identified
from sipe_bayes.envs.mjcf import MjcfEnvironment
from sipe_bayes.report.discovery.page import write_discovery_report
from sipe_bayes.structure.extension import Placed
from sipe_bayes.structure.structures import Structures

DISCOVERED_XML, DISCOVERED_TOML, EXTENDED_XML = "discovered.xml", "discovered.toml", "extended.xml"
STRUCTURES = "structures.json"


def write_discovery(discovery: Discovery, structures: Structures, problem: Problem, folder: Path) -> Discovery:
    """Fill the folder of a finished search, which claimed it; its ``run.json`` comes last and says so.

    Returns:
        The result with what was noticed on the way.
    """
    save_posterior(structures.posterior, folder)
    best, placed = structures.best, structures.placed(structures.best)
    environment = _environment(structures)
    noticed: list[Finding] = []
    try:
        values = environment.space.values(best.theta)
        noticed += write_identified(environment, values, folder / DISCOVERED_XML, _note(placed))
        write_configuration(problem, structures, folder, int(str(discovery.run["seed"])))
    except ExportError as error:
        noticed.append(finding(Code.NOT_EXPORTED, reason=error))
    discovery = replace(discovery, findings=(*discovery.findings, *noticed))
    write_discovery_report(discovery, folder)
    write_text(folder / STRUCTURES, to_json(discovery.to_dict(), indent=2))
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
    lines = [f"with {one.sentence}{_reservation(one)}" for one in placed]
    return "\n     ".join(["the model, calibrated:", *lines])


def _reservation(placed: Placed) -> str:
    """Where MuJoCo by itself does not simulate an extension: who does, and what comes nearest."""
    if placed.extension.kind == "channel":
        return " (of the measurement, which has no place in a model: see discovered.toml)"
    if placed.extension.native:
        return ""
    nearest = f"; nearest element: {placed.extension.nearest}" if placed.extension.nearest else ""
    return f" (numbers in <numeric>, simulated by sipe_bayes and not by MuJoCo itself{nearest})"


def write_configuration(problem: Problem, structures: Structures, folder: Path, seed: int) -> None:
    """Write ``discovered.toml``, a configuration of the best structure that ``sipe calibrate`` runs as it stands.

    Where extensions edit the model, it names ``extended.xml``: the edited MJCF, in which they do nothing yet.

    Args:
        problem: whose configuration it continues.
        structures: that were fitted.
        folder: that it is written to, and that its paths are relative to.
        seed: of the fit.

    Raises:
        ExportError: where the edited model cannot be written.
    """
    placed = structures.placed(structures.best)
    data = problem.config.model_dump(mode="json", by_alias=True, exclude_unset=True)
    data = _relocated(data, folder) | {"seed": seed}
    if any(one.edit is not None for one in placed):
        write_edited(_environment(structures), folder / EXTENDED_XML)
        data["model"] = EXTENDED_XML
    data["parameters"] = [*data["parameters"], *_entries([p for one in placed for p in one.parameters])]
    space = _environment(structures).space
    values = zip(space.names, space.values(structures.best.theta).tolist(), strict=True)
    weight = structures.table()[0].weight
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
            factors = sorted((p.low / p.default, p.high / p.default))
            entry["factor"] = factors
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
