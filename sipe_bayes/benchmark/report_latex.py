"""The benchmark's results as a LaTeX document, tables in booktabs style, and its PDF where pdflatex is installed.

Every word that comes from outside is escaped where it is put in: in this template, what is not ``Raw`` is text.
"""

from __future__ import annotations

import io
import re
import shutil
import subprocess
import unicodedata
from collections.abc import Iterator
from pathlib import Path

from sipe_bayes.benchmark import report_html
from sipe_bayes.benchmark.cells import BASELINES
from sipe_bayes.benchmark.report_contents import Contents, Picture
from sipe_bayes.benchmark.tables import Entry, Table
from sipe_bayes.core.files import scratch, write_bytes, write_text
from sipe_bayes.report.drawing import equal_parts
from sipe_bayes.report.templates import latex_templates

_SPECIAL = {
    "\\": r"\textbackslash{}", "&": r"\&", "%": r"\%", "$": r"\$", "#": r"\#", "_": r"\_", "{": r"\{", "}": r"\}",
    "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "<": r"\textless{}", ">": r"\textgreater{}",
    "|": r"\textbar{}",
    "−": "$-$", "±": r"$\pm$", "–": "--", "…": r"\dots{}", "'": "'", '"': "''", "`": r"\textasciigrave{}",
}  # fmt: skip


class Raw(str):
    """LaTeX that is not escaped again."""


def escaped(value: object) -> str:
    """Text as LaTeX; what pdflatex has no letter for loses its accents, or becomes a question mark."""
    if isinstance(value, Raw):
        return value
    text = "".join(_letter(c) for c in str(value))
    return re.sub(r"-(?=-)", "-{}", text) if "--" in str(value) else text  # two hyphens are no dash


def _letter(letter: str) -> str:
    if letter in _SPECIAL:
        return _SPECIAL[letter]
    if " " <= letter <= "~":
        return letter
    if letter.isspace() or unicodedata.category(letter).startswith("C"):
        return " "
    plain = "".join(c for c in unicodedata.normalize("NFKD", letter) if " " <= c <= "~")
    return "".join(_SPECIAL.get(c, c) for c in plain) or "?"


def render(contents: Contents) -> str:
    """The document; its figures are read from ``figures/``."""
    environment = latex_templates("sipe_bayes.benchmark", escaped)
    environment.filters["label"] = report_html.label
    environment.globals.update(parts=parts, cell=cell, raw=Raw, breakable=breakable, baselines=BASELINES)
    return environment.get_template("report.tex.j2").render(contents=contents)


def parts(table: Table, columns: int = 5) -> Iterator[Table]:
    """The table in parts that fit on A4."""
    return (table.part(part) for part in equal_parts(range(len(table.columns)), columns))


def cell(entry: Entry | None, table: Table | None) -> Raw:
    """An entry: mean, standard error, and the seeds where there are fewer than elsewhere in its table.

    Args:
        entry: None for a dash.
        table: that it stands in, if any.
    """
    if entry is None:
        return Raw("--")
    mean, error = (text.replace("-", "$-$") for text in entry.texts())
    fewer = table is not None and len(entry.values) < report_html.most_seeds(table)
    shown = rf"\textbf{{{mean}}}" if entry.best else mean
    return Raw(
        shown + (rf"\se{{{error}}}" if error else "") + (rf" {{\scriptsize({len(entry.values)})}}" if fewer else "")
    )


def breakable(cell_id: str) -> Raw:
    """A cell's id that may be broken at the end of a line."""
    return Raw(escaped(cell_id).replace("/", r"/\allowbreak{}").replace(r"\_", r"\_\allowbreak{}"))


def pdf(picture: Picture) -> bytes:
    """A figure as a PDF file; the same bytes for the same figure."""
    buffer = io.BytesIO()
    picture.figure.savefig(buffer, format="pdf", metadata={"CreationDate": None})
    return buffer.getvalue()


def write_reports(contents: Contents, out: Path) -> tuple[list[Path], str]:
    """Write ``report.html``, ``report.tex`` with ``figures/``, and ``report.pdf``; all is drawn first.

    Returns:
        Their paths, and why there is no PDF, if there is none.
    """
    page, document = report_html.render(contents), render(contents)
    drawn = {p.name: pdf(p) for section in contents.sections for p in (*section.pictures, *section.in_depth)}
    figures = out / "figures"
    figures.mkdir(parents=True, exist_ok=True)
    for name, content in drawn.items():
        write_bytes(figures / f"{name}.pdf", content)
    write_text(out / "report.tex", document)
    write_text(out / "report.html", page)
    written = [out / "report.html", out / "report.tex"]
    note = compile_pdf(out)
    return (written, note) if note else ([*written, out / "report.pdf"], "")


def compile_pdf(folder: Path, seconds: int = 300) -> str:
    """Make ``report.pdf`` from ``report.tex``.

    Args:
        folder: of both.
        seconds: after which pdflatex is given up.

    Returns:
        Why there is none, empty where there is one.
    """
    program = shutil.which("pdflatex")
    if program is None:
        return "report.pdf not made: pdflatex is not installed (Debian: texlive-latex-recommended)"
    with scratch() as work:
        command = [program, "-interaction=nonstopmode", "-halt-on-error", f"-output-directory={work}", "report.tex"]
        for _ in range(3):  # contents, then the page numbers that they moved
            try:
                done = subprocess.run(
                    command, cwd=folder, capture_output=True, text=True, errors="replace", timeout=seconds
                )
            except subprocess.TimeoutExpired:
                return f"report.pdf not made: pdflatex took longer than {seconds} s on {folder / 'report.tex'}"
            if done.returncode:
                error = next((line for line in done.stdout.splitlines() if line.startswith("!")), "no reason given")
                return f"report.pdf not made: pdflatex on {folder / 'report.tex'} says {error!r}"
        write_bytes(folder / "report.pdf", (work / "report.pdf").read_bytes())
    return ""
