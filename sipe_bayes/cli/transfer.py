"""The commands ``sipe transfer ...``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sipe_bayes.cli.errors import check_least, exit_on_error
from sipe_bayes.cli.studies import Address, Jobs, Out, Retry, Where, add_status_and_cells, chosen, executor_of, measure

if TYPE_CHECKING:
    from sipe_bayes.benchmark.studies import Study

app = typer.Typer(
    name="transfer",
    help="Train agents where an estimator believes the target to be, and test them there.",
    no_args_is_help=True,
)


def _study() -> Study:
    from sipe_bayes.benchmark.studies import TRANSFER

    return TRANSFER


add_status_and_cells(app, _study, "How far a transfer is, what failed, and what each agent earns in the target.")


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
    """Measure a suite's cells that have no record yet, after the estimates they need; exit code 1 if one failed."""
    with exit_on_error("; the same command goes on"):
        from sipe_bayes.benchmark.transfer.study import varied

        check_least(1, training=training, budget=budget, steps=steps, jobs=jobs)
        check_least(1, action_delay=action_delay, wider=wider, particles=particles)
        if observation_noise is not None and not 0 < observation_noise < float("inf"):
            raise ValueError(f"--observation-noise {observation_noise}: expected an sd above 0; leave it out for none")
        study = _study()
        cells = chosen(study, suite, select, budget, steps, training)
        if point and particles is not None:
            raise ValueError(f"--particles {particles}: does not go with --point; leave one of them out")
        cells = varied(cells, point="mean" if point else None, particles=particles)
        cells = varied(cells, wider=wider, observation_noise=observation_noise, action_delay=action_delay)
        measure(study, cells, out, executor_of(executor, jobs, address), retry_failed)


@app.command()
def report(
    folder: Annotated[Path, typer.Argument(help="Folder of results, as `sipe transfer run --out` filled it.")],
    out: Annotated[Path | None, typer.Option(help="Where to write; default transfer/ in the same folder.")] = None,
) -> None:
    """transfer.md, transfer.csv, the bars of the paper's Figure 6 and learning curves."""
    with exit_on_error():
        from sipe_bayes.benchmark.transfer.report import write
        from sipe_bayes.core.files import not_a_file

        if out is not None:
            not_a_file(out)
        written = write(folder, out)
    for path in written:
        print(path)
