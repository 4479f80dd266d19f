"""The command ``sipe init``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from sipe_bayes.cli.errors import command_line, exit_on_error
from sipe_bayes.inference.progress_bar import ProgressBar


def init(
    model: Annotated[Path | None, typer.Argument(help="The MJCF.")] = None,
    logs: Annotated[list[Path] | None, typer.Argument(help="Logs: files, folders or patterns.")] = None,
    out: Annotated[Path, typer.Option(help="The configuration to write.")] = Path("calibrate.toml"),
    rate: Annotated[float | None, typer.Option(min=1e-3, help="Hz of the rows, of logs without a clock.")] = None,
    force: Annotated[bool, typer.Option("--force", help="Overwrite it.")] = False,
) -> None:
    """A first configuration of `sipe calibrate` from a model and its logs, each guess with its evidence."""
    with exit_on_error():
        if model is None or not logs:
            raise ValueError("expected a model and at least one log: sipe init MODEL.xml LOG...")
        if out.exists() and not force:
            raise ValueError(f"--out {out}: exists already; give --force to overwrite it, or another name")
        from sipe_bayes.calibration.init.propose import propose
        from sipe_bayes.calibration.init.write import summary, toml_of
        from sipe_bayes.core.files import write_text

        with ProgressBar(unit="configuration", counted=False) as progress:
            draft = propose(model, logs, out.parent, rate, lambda what: progress(what, 0, 1))
        write_text(out, toml_of(draft, command_line()))
    for line in summary(draft, str(out)):
        print(line)
