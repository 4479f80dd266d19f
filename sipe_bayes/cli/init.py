"""The command ``sipe init``."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from sipe_bayes.cli.errors import command_line, exit_on_error
from sipe_bayes.core.files import was_interruption
from sipe_bayes.inference.progress_bar import ProgressBar


def init(
    model: Annotated[Path | None, typer.Argument(help="The MJCF or URDF, or menagerie:NAME.")] = None,
    logs: Annotated[list[Path] | None, typer.Argument(help="Logs: files, folders or patterns.")] = None,
    out: Annotated[Path, typer.Option(help="The configuration to write.")] = Path("calibrate.toml"),
    rate: Annotated[float | None, typer.Option(min=1e-3, help="Hz of the rows, of logs without a clock.")] = None,
    columns: Annotated[str, typer.Option(help="Names of the columns, of logs without a header: t,q,dq,tau.")] = "",
    force: Annotated[bool, typer.Option("--force", help="Overwrite it.")] = False,
    yes: Annotated[bool, typer.Option("--yes", help="Ask nothing: what is open stays as proposed.")] = False,
    plot: Annotated[bool, typer.Option("--plot", help="Draw the matched columns into NAME.png.")] = False,
) -> None:
    """A first configuration of `sipe calibrate` from a model and its logs, each guess with its evidence."""
    with exit_on_error():
        if model is None or not logs:
            raise ValueError("expected a model and at least one log: sipe init MODEL.xml LOG...")
        _check_paths(model, out, force)
        from sipe_bayes.calibration.init.asking import asked
        from sipe_bayes.calibration.init.propose import propose
        from sipe_bayes.calibration.init.write import plot_columns, summary, toml_of
        from sipe_bayes.core.files import write_text
        from sipe_bayes.envs.foreign.named import model_file

        with ProgressBar(unit="configuration", counted=False) as progress:
            names = tuple(name.strip() for name in columns.split(",")) if columns else ()
            draft = propose(model_file(model), logs, out.parent, rate, lambda what: progress(what, 0, 1), names)
        if not yes and sys.stdin.isatty() and sys.stdout.isatty():
            draft = asked(draft, _ask)
        write_text(out, toml_of(draft, command_line()))
        picture = plot_columns(draft, out) if plot else None
    for line in summary(draft, str(out), picture):
        print(line)


def _check_paths(model: Path, out: Path, force: bool) -> None:
    """Raise ValueError for a log in place of the model, and for a file that cannot be written or must not be."""
    from sipe_bayes.calibration.readers.tables import READERS

    if model.is_dir() or (model.is_file() and model.suffix.lower() in READERS):
        raise ValueError(f"{model}: is a log, and the model comes first; exchange them: sipe init MODEL.xml LOG...")
    if out.is_dir():
        raise ValueError(f"--out {out}: is a folder; give the name of a file: --out {out / 'calibrate.toml'}")
    if not out.parent.exists():
        raise ValueError(f"--out {out}: the folder {str(out.parent)!r} does not exist; make it, or give another name")
    if out.exists() and not force:
        raise ValueError(f"--out {out}: exists already; give --force to overwrite it, or another name")


def _ask(text: str, answers: Sequence[str]) -> int:
    """Show a question on the terminal; Enter takes the first answer.

    Raises:
        ValueError: the input ended.
    """
    print(f"{text}")
    for k, answer in enumerate(answers, 1):
        print(f"  {k}) {answer}")
    while True:
        try:
            given: int = typer.prompt("which", default=1, type=int)
        except typer.Abort as abort:
            if was_interruption(abort):
                raise
            raise ValueError("no answer: the input ended, nothing is written; --yes keeps what is proposed") from None
        if 1 <= given <= len(answers):
            return given - 1
        print(f"expected a number from 1 to {len(answers)}, got {given}")
