"""What ``sipe benchmark`` and ``sipe transfer`` share: options, measuring, ``status`` and ``cells``."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sipe_bayes.cli.errors import command_line, exit_on_error

if TYPE_CHECKING:
    from sipe_bayes.benchmark.cells import Cell
    from sipe_bayes.benchmark.executors.work import Executor
    from sipe_bayes.benchmark.studies import Study

Out = Annotated[Path, typer.Option(help="Folder of results; the same command goes on where it was interrupted.")]
Folder = Annotated[Path, typer.Argument(help="Folder of results.")]
AsJson = Annotated[bool, typer.Option("--json", help="Print one JSON object and nothing else.")]
OneSuite = Annotated[str | None, typer.Argument(help="Without one, the suites.")]
Select = Annotated[list[str] | None, typer.Option(help="As of `run`.")]
Retry = Annotated[bool, typer.Option("--retry-failed", help="Measure failed cells again.")]
Jobs = Annotated[int | None, typer.Option(help="Processes of one thread each; default all cores, 1 on a GPU.")]
Where = Annotated[
    str, typer.Option(help="pool: processes of this machine; ray: a cluster; inline: this process alone.")
]
Address = Annotated[str | None, typer.Option(help="HOST:PORT of a Ray cluster; default one on this machine.")]


def add_status_and_cells(app: typer.Typer, load: Callable[[], Study], about_status: str) -> None:
    """Give a study, which ``load`` imports, its commands ``status`` and ``cells``."""

    @app.command(help=about_status)
    def status(folder: Folder = Path("results"), as_json: AsJson = False) -> None:
        from sipe_bayes.core.files import to_json

        with exit_on_error():
            summary = load().summary(folder)
        print(to_json(summary.to_dict()) if as_json else "\n".join(summary.lines()))

    @app.command()
    def cells(suite: OneSuite = None, select: Select = None) -> None:
        """The suites, or the ids of a suite's cells."""
        with exit_on_error():
            study = load()
            if suite is None and select:
                raise ValueError(f"--select {select[0]}: goes with a suite; name one before it, such as all")
            if suite is None:
                lines = [f"{name}: {len(list(s.cells()))} cells; {s.about}" for name, s in study.suites.items()]
            else:
                lines = [study.describe(cell) for cell in study.select(suite, select or ())]
        print("\n".join(lines))


def chosen(
    study: Study,
    suite: str | None,
    select: Sequence[str] | None,
    budget: int | None,
    steps: int | None,
    training: int | None,
    device: str = "cpu",
) -> Sequence[Cell]:
    """The cells of a suite that the options ask for; raises ValueError where none is named, as most take hours."""
    from sipe_bayes.benchmark.cells import changed

    if suite is None:
        raise ValueError("--suite: expected the name of one, such as --suite quick; the cells command lists them")
    return changed(study.select(suite, select or ()), budget, steps, training, device)


def measure(study: Study, cells: Sequence[Cell], out: Path, start: Callable[[], Executor], retry_failed: bool) -> None:
    """Measure a study's cells by the executor that ``start`` makes; exit code 1 where cells failed."""
    from sipe_bayes.benchmark.run import Order, run
    from sipe_bayes.benchmark.run_log import write_looks

    failed = run(cells, Order(out, start, command_line(), retry_failed, say), study.kind)
    table, logs = write_looks(out)
    say(f"how the estimates went: {table}; tensorboard --logdir {logs}")
    if failed:
        print(
            f"sipe: {failed} {study.unit}{'s' * (failed > 1)} failed; `sipe {study.name} status {out}` shows why; "
            "the same command with --retry-failed tries again, and other settings go into a new --out",
            file=sys.stderr,
        )
        raise typer.Exit(1)


def executor_of(name: str, jobs: int | None, address: str | None, device: str = "cpu") -> Callable[[], Executor]:
    """What makes the executor of a name; raises ValueError for options that do not go together.

    Processes of one machine share its GPU: by default there is one. On a cluster each unit has a GPU to itself.
    """
    from sipe_bayes.core.validation import cores

    if address is not None and name != "ray":
        raise ValueError(f"--address {address}: goes with --executor ray alone; add it, or leave the address out")
    if jobs is not None and name != "pool":
        raise ValueError(f"--jobs {jobs}: goes with --executor pool alone; leave it out")
    if name == "ray":
        from sipe_bayes.benchmark.executors.ray_executor import RayExecutor

        return lambda: RayExecutor(address, on_gpus=device.startswith("cuda"))
    from sipe_bayes.benchmark.executors.pool import Inline, Pool

    if name not in ("pool", "inline"):
        raise ValueError(f"--executor {name}: expected pool, ray or inline")
    return Inline if name == "inline" else lambda: Pool(jobs or (cores() if device == "cpu" else 1))


def say(line: str) -> None:
    """Print a line at once."""
    print(line, flush=True)
