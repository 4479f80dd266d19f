"""``sipe discover``: what a model lacks."""

from __future__ import annotations

import textwrap
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sipe_bayes.cli.errors import INTERRUPTED, check_least, exit_on_error, say_early, say_interrupted
from sipe_bayes.inference.progress_bar import ProgressBar

if TYPE_CHECKING:
    from sipe_bayes.diagnostics.discovery import Discovery
    from sipe_bayes.inference.recorded import Progress

_WIDTH = 58  # of what a structure has
TIME_LIMIT = 200.0  # s; the comparison and the report of an arm with six joints take another minute
_TRIED, _ERRORS, _VALUES = 5, 2, 3  # lines of each kind that are printed: twenty in all
_TONES = {"good": "green", "fair": "yellow", "bad": "bold red"}  # on a terminal


def counted(shown: Progress) -> Progress:
    """Progress that says how many rollouts a search has taken; how many it will take nobody knows."""

    def show(what: str, done: int, total: int) -> None:
        shown(f"{what}; {done} rollouts, at most {total}" if done < total else what, done, total)

    return show


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
    time_limit: Annotated[
        float, typer.Option(help="Seconds, after which the search ends with what it has; the same command goes on.")
    ] = TIME_LIMIT,
) -> None:
    """Physics that the model lacks: proposed, fitted, and compared by what it predicts of pieces that were held out."""
    from sipe_bayes.calibration.discover import run_discovery
    from sipe_bayes.core.files import to_json
    from sipe_bayes.core.telling import silent

    with exit_on_error("; the same command goes on"), ProgressBar(quiet=as_json, counted=False) as progress:
        check_least(0, seed=seed, time_limit=time_limit)
        check_least(1, budget=budget, threads=threads)
        told = counted(progress)
        warn = silent if as_json else say_early
        discovery = run_discovery(
            config, out, seed, budget, only or None, without or (), threads, told, time_limit, warn
        )
    if as_json:
        print(to_json(discovery.to_dict()))
    else:
        print_discovery(discovery)
    if discovery.ended == "interrupted":
        say_interrupted("; the same command goes on")
        raise typer.Exit(INTERRUPTED)


def print_discovery(discovery: Discovery) -> None:
    """What was tried and what it changes, then the answer, on standard output: twenty lines at most."""
    from rich.console import Console
    from rich.text import Text

    from sipe_bayes.report.discovery.words import discovery_verdicts, next_steps

    console = Console(soft_wrap=True)
    for line in lines_of(discovery):
        console.print(line, highlight=False, markup=False)
    for verdict in discovery_verdicts(discovery):
        console.print(Text(verdict.text, style=_TONES[verdict.tone]))
    if discovery.out:
        console.print(f"report: {Path(discovery.out) / 'report.html'}", highlight=False, markup=False)
        console.print(f"next: {next_steps(discovery)}", highlight=False, markup=False)


def lines_of(discovery: Discovery) -> list[str]:
    """What is printed above the answer."""
    from sipe_bayes.core.findings import singular
    from sipe_bayes.report.discovery.words import (
        error_line,
        structure_text,
        value_rows,
        warnings,
        weight_text,
        with_error,
    )

    effort = f"{len(discovery.rows)} structures fitted, {discovery.rollouts} rollouts"
    lines = [f"{discovery.name}, what the model lacks: {singular(effort)}, {discovery.seconds:.0f} s"]
    tried = [f"{'log predictive density in nats over the model as it was':60}{'gain':>18}{'weight':>9}"]
    for one in discovery.rows:
        cells = f"{with_error(one.gain, one.error):>18}{weight_text(one):>9}"
        text = structure_text(one)
        first, *rest = textwrap.wrap(text if len(text) <= _WIDTH else " + ".join(one.labels), _WIDTH)
        tried.append("\n    ".join([f"  {first:{_WIDTH}}{cells}", *rest]))
    lines += _cut(tried, _TRIED)
    errors = [error for error in discovery.errors if error.use == "holdout"] or list(discovery.errors)
    lines += _cut([f"{error.use} {error_line(error)}" for error in errors], _ERRORS)
    values = []
    for row in value_rows(discovery):
        if row["before"] and not row["nuisance"]:
            value = f"{row['name']} {row['value']} {row['unit']}".rstrip() + f" ({row['interval']})"
            value += f", with what it lacks {row['further']}" if row["further"] else ""
            values.append(f"{value}; before {row['before']} ({row['before_interval']})")
    lines += _cut(values, _VALUES)
    return lines + _cut([f"warning: {warning}" for warning in warnings(discovery)], 1)


def _cut(lines: list[str], most: int) -> list[str]:
    if len(lines) <= most:
        return lines
    return [*lines[: most - 1], f"  and {len(lines) - most + 1} more, in the report"]
