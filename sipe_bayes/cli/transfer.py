"""The commands ``sipe transfer ...``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from sipe_bayes.cli.benchmark import (
    Address,
    AsJson,
    Folder,
    Jobs,
    OneSuite,
    Out,
    Retry,
    Where,
    about,
    asked,
    at_least_one,
    command_line,
    executor_of,
    exit_if_failed,
    needs_suite,
    print_status,
    say,
)
from sipe_bayes.cli.refusing import refusing

app = typer.Typer(
    name="transfer",
    help="Train agents where an estimator believes the target to be, and test them there.",
    no_args_is_help=True,
)


@app.command()
def run(
    suite: Annotated[str | None, typer.Option(help="Required; see `sipe transfer cells`.")] = None,
    select: Annotated[
        list[str] | None,
        typer.Option(help="Only ids like this one, such as 'half_cheetah*/laplace/*'; again for several."),
    ] = None,
    out: Out = Path("results"),
    training: Annotated[
        int | None,
        typer.Option(help="Control steps of each training; default the suite's, which differ between tasks."),
    ] = None,
    budget: Annotated[int | None, typer.Option(help="Rollouts of each estimate; default 1000.")] = None,
    steps: Annotated[int | None, typer.Option(help="Control steps of an estimate's trajectory.")] = None,
    wider: Annotated[float | None, typer.Option(help="Spread every posterior this many times as far.")] = None,
    point: Annotated[bool, typer.Option("--point", help="Train under every posterior's mean alone.")] = False,
    particles: Annotated[int | None, typer.Option(help="Train under so many draws of every posterior.")] = None,
    observation_noise: Annotated[
        float | None, typer.Option(help="Greatest sd of the noise on observations in training, in the channels' units.")
    ] = None,
    action_delay: Annotated[
        int | None, typer.Option(help="Greatest delay of actions in training, control steps.")
    ] = None,
    jobs: Jobs = None,
    executor: Where = "pool",
    address: Address = None,
    retry_failed: Retry = False,
) -> None:
    """Measure the cells of a suite that have no record yet, and first the estimates that they need; exit code 1 if one failed."""
    with refusing("; the same command goes on"):
        from sipe_bayes.benchmark.run import changed
        from sipe_bayes.benchmark.transfer import run as transfer_run
        from sipe_bayes.benchmark.transfer.study import select as chosen
        from sipe_bayes.benchmark.transfer.study import varied

        at_least_one(
            training=training,
            budget=budget,
            steps=steps,
            jobs=jobs,
            action_delay=action_delay,
            wider=wider,
            particles=particles,
        )
        if observation_noise is not None and not 0 < observation_noise < float("inf"):
            raise ValueError(f"--observation-noise {observation_noise}: expected an sd above 0; leave it out for none")
        cells = changed(chosen(asked(suite), select or ()), training=training, budget=budget, steps=steps)
        if point and particles is not None:
            raise ValueError(f"--particles {particles}: does not go with --point; leave one of them out")
        cells = varied(cells, point="mean" if point else None, particles=particles)
        cells = varied(cells, wider=wider, observation_noise=observation_noise, action_delay=action_delay)
        start = executor_of(executor, jobs, address)
        failed = transfer_run.run(cells, out, start, command_line(), retry_failed, say)
    exit_if_failed("unit", failed, f"transfer status {out}")


@app.command()
def status(folder: Folder = Path("results"), as_json: AsJson = False) -> None:
    """How far a transfer is, what failed, and what each agent earns in the target."""
    with refusing():
        from sipe_bayes.benchmark.transfer.run import lines, summary

        found = summary(folder)
    print_status(found, lines, as_json)


@app.command()
def report(
    folder: Annotated[Path, typer.Argument(help="Folder of results, as `sipe transfer run --out` filled it.")],
    out: Annotated[Path | None, typer.Option(help="Where to write; default transfer/ in the same folder.")] = None,
) -> None:
    """transfer.md, transfer.csv, the bars of the paper's Figure 6 and learning curves."""
    with refusing():
        from sipe_bayes.benchmark.run import not_a_file
        from sipe_bayes.benchmark.transfer.report import write

        if out is not None:
            not_a_file(out)
        written = write(folder, out)
    for path in written:
        print(path)


@app.command()
def cells(
    suite: OneSuite = None,
    select: Annotated[list[str] | None, typer.Option(help="As of `sipe transfer run`.")] = None,
) -> None:
    """The suites, or the ids of a suite's cells."""
    with refusing():
        from sipe_bayes.benchmark.transfer.study import SUITES
        from sipe_bayes.benchmark.transfer.study import select as chosen

        needs_suite(suite, select)
        cells = [] if suite is None else chosen(suite, select or ())
        found = about(SUITES) if suite is None else [f"{c.id} ({c.training:,} control steps)" for c in cells]
    print("\n".join(found))
