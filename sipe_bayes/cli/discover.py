"""``sipe discover``: what a model lacks."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sipe_bayes.cli.errors import check_least, exit_on_error
from sipe_bayes.cli.progress import Progress

if TYPE_CHECKING:
    from sipe_bayes.diagnostics.discovery import Discovery

_PIECES, _ERRORS, _CHANNELS, _VALUES = 4, 3, 2, 4  # lines of each kind that are printed: twenty in all
_TONES = {"good": "green", "fair": "yellow", "bad": "bold red"}  # on a terminal


def discover(
    config: Annotated[Path, typer.Argument(help="TOML file: model, logs, parameters. See examples/.")],
    out: Annotated[Path | None, typer.Option(help="Output folder; default runs/NAME-discover.")] = None,
    seed: Annotated[int | None, typer.Option(help="Default: the configuration's.")] = None,
    budget: Annotated[int | None, typer.Option(help="Rollouts of all fits; default the configuration's.")] = None,
    only: Annotated[
        list[str] | None, typer.Option(help="An extension that may be tried; repeat it. Default all.")
    ] = None,
    without: Annotated[list[str] | None, typer.Option(help="An extension that is left out; repeat it.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object and nothing else.")] = False,
    threads: Annotated[int | None, typer.Option(help="Native threads; default all cores.")] = None,
) -> None:
    """Physics that the model lacks: proposed, fitted, and kept where evidence and held-out pieces keep it."""
    from sipe_bayes.calibration.discover import run_discovery
    from sipe_bayes.core.files import to_json

    with exit_on_error("; the same command goes on"), Progress(quiet=as_json) as progress:
        check_least(0, seed=seed)
        check_least(1, budget=budget, threads=threads)
        discovery = run_discovery(config, out, seed, budget, only or None, without or (), threads, progress.update)
    if as_json:
        print(to_json(discovery.to_dict()))
    else:
        print_discovery(discovery)


def print_discovery(discovery: Discovery) -> None:
    """What the model lacks, before and after, what remains and what to do next, on standard output: twenty lines."""
    from rich.console import Console
    from rich.text import Text

    from sipe_bayes.report.discovery.words import discovery_verdicts

    console = Console(soft_wrap=True)
    for verdict in discovery_verdicts(discovery):
        console.print(Text(verdict.text, style=_TONES[verdict.tone]))
    for line in lines_of(discovery):
        console.print(line, highlight=False, markup=False)


def lines_of(discovery: Discovery) -> list[str]:
    """What is printed below the verdicts."""
    from sipe_bayes.report.discovery.words import (
        alternatives,
        error_line,
        piece_text,
        residual_lines,
        value_rows,
        warnings,
    )

    lines = [f"  lacks {piece_text(piece)}" for piece in discovery.kept]
    lines += [f"  perhaps {piece_text(piece)}" for piece in alternatives(discovery)]
    lines = _cut(lines, _PIECES)
    held_out = [f"held out {error_line(row)}" for row in discovery.errors if row.use == "holdout"]
    train = [f"train {error_line(row)}" for row in discovery.errors if row.use == "train"]
    lines += _cut(held_out or train, _ERRORS)
    lines += _cut([f"residual {line}" for line in residual_lines(discovery)], _CHANNELS)
    rows = [row for row in value_rows(discovery) if not row["nuisance"]]
    values = []
    for row in rows:
        before = f"; {row['before']} ({row['before_interval']}) before" if row["before"] else ", of what was found"
        values.append(f"{row['name']} {row['value']} ({row['interval']}) {row['unit']}".rstrip() + before)
    lines += _cut(values, _VALUES)
    lines += _cut([f"warning: {warning}" for warning in warnings(discovery)], 1)
    lines.append(f"{len(discovery.rows)} structures, {discovery.rollouts} rollouts, {discovery.seconds:.1f} s")
    if discovery.out:
        lines.append(f"report: {Path(discovery.out) / 'report.html'}")
        lines.append(f"next: sipe calibrate {Path(discovery.out) / 'discovered.toml'}")
    return lines


def _cut(lines: list[str], most: int) -> list[str]:
    if len(lines) <= most:
        return lines
    return [*lines[: most - 1], f"  and {len(lines) - most + 1} more, in the report"]
