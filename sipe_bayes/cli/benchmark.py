"""The commands ``sipe benchmark ...`` and ``sipe simulate``."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sipe_bayes.cli.check import SimulatedOn
from sipe_bayes.cli.errors import check_least, check_one_of, command_line, exit_on_error
from sipe_bayes.cli.studies import (
    Address,
    Jobs,
    Out,
    Retry,
    Where,
    add_status_and_cells,
    chosen,
    executor_of,
    measure,
    say,
)

if TYPE_CHECKING:
    from sipe_bayes.benchmark.studies import Study

app = typer.Typer(name="benchmark", help="Measure estimators on the benchmark's environments.", no_args_is_help=True)


def _study() -> Study:
    from sipe_bayes.benchmark.studies import BENCHMARK

    return BENCHMARK


add_status_and_cells(app, _study, "How far a run is, what failed, and what it took.")


@app.command()
def report(
    folder: Annotated[Path, typer.Argument(help="Folder of results, as `sipe benchmark run --out` filled it.")],
    out: Annotated[Path | None, typer.Option(help="Where to write; default the same folder.")] = None,
) -> None:
    """report.html, one self-contained page; report.tex with its figures; report.pdf where pdflatex is installed."""
    with exit_on_error():
        from sipe_bayes.benchmark.report_contents import contents
        from sipe_bayes.benchmark.report_latex import write_reports
        from sipe_bayes.core.files import not_a_file

        target = out or folder
        not_a_file(target)
        written, note = write_reports(contents(folder), target)
    for path in written:
        print(path)
    if note:
        print(f"sipe: {note}", file=sys.stderr)


@app.command()
def run(
    suite: Annotated[str | None, typer.Option(help="Required; see `sipe benchmark cells`.")] = None,
    select: Annotated[
        list[str] | None, typer.Option(help="Only ids like this one, such as 'half_cheetah*/adr/*'; again for several.")
    ] = None,
    out: Out = Path("results"),
    budget: Annotated[int | None, typer.Option(help="Rollouts of each cell; default the suite's.")] = None,
    steps: Annotated[int | None, typer.Option(help="Control steps of a trajectory; default the suite's.")] = None,
    training: Annotated[int | None, typer.Option(help="Control steps of an agent's training.")] = None,
    jobs: Jobs = None,
    executor: Where = "pool",
    address: Address = None,
    device: SimulatedOn = "cpu",
    retry_failed: Retry = False,
) -> None:
    """Measure the cells of a suite that have no record yet; exit code 1 if one failed."""
    with exit_on_error("; the same command goes on"):
        check_least(1, budget=budget, steps=steps, training=training, jobs=jobs)
        study = _study()
        cells = chosen(study, suite, select, budget, steps, training, device)
        measure(study, cells, out, executor_of(executor, jobs, address, device), retry_failed)


def simulate(
    environment: Annotated[str, typer.Argument(help="A task of `sipe envs`.")],
    budget: Annotated[int, typer.Option(help="Simulations.")] = 1000,
    out: Out = Path("results"),
    variant: Annotated[str, typer.Option(help="Whose trajectory is replayed.")] = "in_distribution",
    seed: Annotated[int, typer.Option(help="Of the simulations and the trajectory.")] = 0,
    steps: Annotated[
        int | None,
        typer.Option(help="Control steps; default an episode, at most 250, 100 of the humanoid and the hand."),
    ] = None,
    verify: Annotated[
        bool, typer.Option("--verify", help="Check what is there; exit code 1 where it is wrong.")
    ] = False,
    jobs: Jobs = None,
    executor: Where = "pool",
    address: Address = None,
    device: SimulatedOn = "cpu",
) -> None:
    """Simulate the prior for the estimators that learn from it, in shards, which `sipe benchmark run --out` finds."""
    with exit_on_error("; the same command goes on"):
        from sipe_bayes.benchmark import bank
        from sipe_bayes.benchmark import run as runs
        from sipe_bayes.benchmark.cells import Cell
        from sipe_bayes.envs.task import VARIANTS

        check_least(1, budget=budget, steps=steps, jobs=jobs)
        check_least(0, seed=seed)
        check_one_of("variant", variant, VARIANTS)
        (replayed,) = (v for v in VARIANTS if v == variant)
        horizon = Cell(environment, "prior", variant=replayed, seed=seed, steps=steps).horizon
        which = bank.Bank(environment, replayed, seed, horizon, device)
        if not verify:
            order = runs.Order(out, executor_of(executor, jobs, address, device), command_line(), report=say)
            runs.simulate(which, budget, order)
        wrong = bank.verify(which, budget, out)
    for line in wrong:
        print(f"sipe: {line}", file=sys.stderr)
    if wrong:
        raise typer.Exit(1)
    print(f"{which.id}: {budget} simulations in {out / bank.FOLDER}, verified")
