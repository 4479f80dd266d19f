"""``sipe benchmark report``: the results of a folder as an HTML page and a LaTeX document."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

BAD_INPUT = 2


def report(
    folder: Annotated[Path, typer.Argument(help="Folder of results, as `sipe benchmark run --out` filled it.")],
    out: Annotated[Path | None, typer.Option(help="Where to write; default the same folder.")] = None,
) -> None:
    """report.html, one self-contained page; report.tex with its figures; report.pdf where pdflatex is installed."""
    from sipe_bayes.benchmark.report_contents import contents
    from sipe_bayes.benchmark.report_latex import write_reports

    target = folder if out is None else out
    try:
        if target.exists() and not target.is_dir():
            raise ValueError(f"--out {target}: is a file, not a folder; choose another name")
        written, note = write_reports(contents(folder), target)
    except (ValueError, OSError) as error:
        print(f"sipe: {' '.join(str(error).split())}", file=sys.stderr)
        raise typer.Exit(BAD_INPUT) from None
    for path in written:
        print(path)
    if note:
        print(f"sipe: {note}", file=sys.stderr)
