"""The command ``sipe validate``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from sipe_bayes.cli.errors import exit_on_error
from sipe_bayes.inference.progress_bar import ProgressBar


def validate(config: Annotated[Path, typer.Argument(help="The configuration.")]) -> None:
    """What is odd in a configuration and its logs, in seconds; exit code 1 where something is."""
    with exit_on_error():
        from sipe_bayes.calibration.init.validate import validate_config

        with ProgressBar(unit="configuration", counted=False) as progress:
            progress(f"holding {config} against its logs", 0, 1)
            result = validate_config(config)
    agreed = "units, signs, delays and columns agree with the logs"
    untold = f"in what the logs tell, which leaves {len(result.doubts)} open"
    nothing = f"{config}: nothing is odd{f' {untold}' if result.doubts else f': {agreed}'}"
    for line in [*(result.odd or [nothing]), *(f"OPEN: {doubt}" for doubt in result.doubts)]:
        print(line)
    if result.odd:
        raise typer.Exit(1)
