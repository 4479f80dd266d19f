"""The commands ``sipe leaderboard ...``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from sipe_bayes.cli.errors import check_least, command_line, exit_on_error
from sipe_bayes.cli.studies import say

app = typer.Typer(
    name="leaderboard",
    help="Versioned tasks on which every method of system identification is measured alike.",
    no_args_is_help=True,
)
_SHOWN = 16  # lines of an entry's tasks


@app.command()
def run(
    method: Annotated[
        str, typer.Argument(help="An estimator, calibrate or prior; methods of others write their entry.")
    ],
    out: Annotated[Path, typer.Option(help="Folder of the entry; the same command goes on where it was interrupted.")],
    tasks: Annotated[
        list[str] | None, typer.Option(help="Only this task; again for several. `sipe leaderboard tasks` lists them.")
    ] = None,
    seed: Annotated[int, typer.Option(help="Of the method.")] = 0,
) -> None:
    """Write an entry: a method on every log of every task, at the tasks' budgets."""
    with exit_on_error("; the same command goes on"):
        from sipe_bayes.benchmark.leaderboard.calibrate import NAME, Calibrate
        from sipe_bayes.benchmark.leaderboard.entry import Entry
        from sipe_bayes.benchmark.leaderboard.registry import chosen
        from sipe_bayes.benchmark.leaderboard.run import OwnMethod, run_entry
        from sipe_bayes.benchmark.measurement import versions

        check_least(0, seed=seed)
        which = chosen(tasks or ())
        fit = Calibrate(seed) if method == NAME else OwnMethod(method, seed)
        entry = Entry(method, command_line(), [seed], versions(), "sipe_bayes, its defaults")
        lines: list[str] = []
        ran = run_entry(entry, out, which, fit, lines.append)
    for line in lines[:_SHOWN]:
        say(line)
    if len(lines) > _SHOWN:
        say(f"and {len(lines) - _SHOWN} more tasks")
    failed, seconds = sum(one.failed for one in ran), sum(one.cpu_seconds for one in ran)
    say(f"{method}: {len(ran)} tasks, {failed} logs failed, {seconds:.0f} CPU s; next: sipe leaderboard report {out}")


@app.command()
def tasks() -> None:
    """The tasks, a line for each."""
    from sipe_bayes.benchmark.leaderboard.registry import TASKS

    for task in TASKS.values():
        print(f"{task.name}: {task.about}; {task.budget} rollouts a log")


@app.command("submit-check")
def submit_check(entry: Annotated[Path, typer.Argument(help="Folder of an entry.")]) -> None:
    """Whether an entry may be scored: shapes, numbers, versions, peeked truths; exit code 2 if not."""
    with exit_on_error():
        from sipe_bayes.benchmark.leaderboard.registry import TASKS
        from sipe_bayes.benchmark.leaderboard.scoring import scored

        result = scored(entry)
    missing = [name for name in TASKS if name not in result.tasks]
    failed = sum(score.failed for score in result.tasks.values())
    print(f"{entry}: {result.entry.method}, {len(result.tasks)} of {len(TASKS)} tasks, {failed} logs failed; accepted")
    if missing:
        print(f"without an answer, which counts as the prior: {', '.join(missing)}")


@app.command()
def report(
    entries: Annotated[list[Path], typer.Argument(help="Folders of entries.")],
    out: Annotated[Path, typer.Option(help="Where to write.")],
) -> None:
    """leaderboard.html, one self-contained page of scores and records; real.html, the same of real logs alone."""
    with exit_on_error():
        from sipe_bayes.benchmark.leaderboard.report import write
        from sipe_bayes.core.files import not_a_file

        not_a_file(out)
        written = write(entries, out)
    for path in written:
        print(path)
