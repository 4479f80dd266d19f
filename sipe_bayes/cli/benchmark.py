"""The commands ``sipe benchmark ...`` and ``sipe simulate``."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sipe_bayes.cli.refusing import refusing

if TYPE_CHECKING:
    from sipe_bayes.benchmark.cells import Suite
    from sipe_bayes.benchmark.executors.work import Executor

app = typer.Typer(name="benchmark", help="Measure estimators on the benchmark's environments.", no_args_is_help=True)

Out = Annotated[Path, typer.Option(help="Folder of results; the same command goes on where it was interrupted.")]
Folder = Annotated[Path, typer.Argument(help="Folder of results.")]
AsJson = Annotated[bool, typer.Option("--json", help="Print one JSON object and nothing else.")]
OneSuite = Annotated[str | None, typer.Argument(help="Without one, the suites.")]
Retry = Annotated[bool, typer.Option("--retry-failed", help="Measure failed cells again.")]
Jobs = Annotated[int | None, typer.Option(help="Processes of one thread each; default all cores.")]
Where = Annotated[
    str, typer.Option(help="pool: processes of this machine; ray: a cluster; inline: this process alone.")
]
Address = Annotated[str | None, typer.Option(help="HOST:PORT of a Ray cluster; default one on this machine.")]


@app.command()
def report(
    folder: Annotated[Path, typer.Argument(help="Folder of results, as `sipe benchmark run --out` filled it.")],
    out: Annotated[Path | None, typer.Option(help="Where to write; default the same folder.")] = None,
) -> None:
    """report.html, one self-contained page; report.tex with its figures; report.pdf where pdflatex is installed."""
    with refusing():
        from sipe_bayes.benchmark.report_contents import contents
        from sipe_bayes.benchmark.report_latex import write_reports
        from sipe_bayes.benchmark.run import not_a_file

        target = folder if out is None else out
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
    retry_failed: Retry = False,
) -> None:
    """Measure the cells of a suite that have no record yet; exit code 1 if one failed."""
    with refusing("; the same command goes on"):
        from sipe_bayes.benchmark import run as runs
        from sipe_bayes.benchmark.cells import select as chosen

        at_least_one(budget=budget, steps=steps, training=training, jobs=jobs)
        cells = runs.changed(chosen(asked(suite), select or ()), budget=budget, steps=steps, training=training)
        failed = runs.run(cells, out, executor_of(executor, jobs, address), command_line(), retry_failed, say)
    exit_if_failed("cell", failed, f"benchmark status {out}")


@app.command()
def status(folder: Folder = Path("results"), as_json: AsJson = False) -> None:
    """How far a run is, what failed, and what it took."""
    with refusing():
        from sipe_bayes.benchmark.status import lines, summary

        found = summary(folder)
    print_status(found, lines, as_json)


@app.command()
def cells(
    suite: OneSuite = None,
    select: Annotated[list[str] | None, typer.Option(help="As of `sipe benchmark run`.")] = None,
) -> None:
    """The suites, or the ids of a suite's cells."""
    with refusing():
        from sipe_bayes.benchmark.cells import SUITES
        from sipe_bayes.benchmark.cells import select as chosen

        needs_suite(suite, select)
        found = about(SUITES) if suite is None else [cell.id for cell in chosen(suite, select or ())]
    print("\n".join(found))


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
) -> None:
    """Simulate the prior for the estimators that learn from it, in shards, which `sipe benchmark run --out` finds."""
    with refusing("; the same command goes on"):
        from sipe_bayes.benchmark import bank
        from sipe_bayes.benchmark import run as runs
        from sipe_bayes.benchmark.cells import Cell
        from sipe_bayes.envs.task import VARIANTS

        at_least_one(budget=budget, steps=steps, jobs=jobs)
        if variant not in VARIANTS:
            raise ValueError(f"--variant {variant}: expected one of {', '.join(VARIANTS)}")
        cell: Any = Cell(environment, "prior", variant=variant, seed=seed, steps=steps)
        which = bank.Bank(environment, cell.variant, seed, cell.horizon)
        if not verify:
            runs.simulate(which, budget, out, executor_of(executor, jobs, address), command_line(), say)
        wrong = bank.verify(which, budget, out)
    for line in wrong:
        print(f"sipe: {line}", file=sys.stderr)
    if wrong:
        raise typer.Exit(1)
    print(f"{which.id}: {budget} simulations in {out / bank.FOLDER}, verified")


def executor_of(name: str, jobs: int | None, address: str | None) -> Callable[[], Executor]:
    """What makes the executor; raises ValueError for options that do not go together."""
    from sipe_bayes.core.validation import cores

    if address is not None and name != "ray":
        raise ValueError(f"--address {address}: goes with --executor ray alone; add it, or leave the address out")
    if jobs is not None and name != "pool":
        raise ValueError(f"--jobs {jobs}: goes with --executor pool alone; leave it out")
    if name == "ray":
        from sipe_bayes.benchmark.executors.ray_executor import RayExecutor

        return lambda: RayExecutor(address)
    from sipe_bayes.benchmark.executors.pool import Inline, Pool

    if name not in ("pool", "inline"):
        raise ValueError(f"--executor {name}: expected pool, ray or inline")
    return Inline if name == "inline" else lambda: Pool(jobs or cores())


def asked(suite: str | None) -> str:
    """The suite; raises ValueError where none is named, as most take hours."""
    if suite is None:
        raise ValueError("--suite: expected the name of one, such as --suite quick; the cells command lists them")
    return suite


def needs_suite(suite: str | None, select: list[str] | None) -> None:
    if suite is None and select:
        raise ValueError(f"--select {select[0]}: goes with a suite; name one before it, such as all")


def at_least_one(**options: float | None) -> None:
    for option, value in options.items():
        if value is not None and value < 1:
            raise ValueError(f"--{option.replace('_', '-')} {value}: expected at least 1; raise it or leave it out")


def about(suites: Mapping[str, Suite]) -> list[str]:
    """A line for each suite."""
    return [f"{name}: {len(list(suite.cells()))} cells; {suite.about}" for name, suite in suites.items()]


def print_status(found: dict[str, Any], lines: Callable[[dict[str, Any]], list[str]], as_json: bool) -> None:
    """A summary as JSON, or as its ``lines``."""
    from sipe_bayes.core.files import to_json

    print(to_json(found) if as_json else "\n".join(lines(found)))


def exit_if_failed(what: str, failed: int, status: str) -> None:
    """Exit code 1 where so many of ``what`` failed, with the command that shows why."""
    if failed:
        print(
            f"sipe: {failed} {what}{'s' * (failed > 1)} failed; `sipe {status}` shows why; the same command with --retry-failed tries "
            "again, and other settings go into a new --out",
            file=sys.stderr,
        )
        raise typer.Exit(1)


def say(line: str) -> None:
    print(line, flush=True)


def command_line() -> str:
    return shlex.join(["sipe", *sys.argv[1:]])
