"""The benchmark's results as one self-contained HTML page: offline, on a phone, in print; tables sort by a click.

The script on the page does nothing but sort; without it every number is still there.
"""

from __future__ import annotations

from sipe_bayes.benchmark.cells import BASELINES
from sipe_bayes.benchmark.report_contents import Contents
from sipe_bayes.benchmark.tables import Table
from sipe_bayes.report.drawing import inside_page, png
from sipe_bayes.report.sipe_plot import two_lines
from sipe_bayes.report.templates import html_templates


def render(contents: Contents) -> str:
    """The page."""
    environment = html_templates("sipe_bayes.benchmark")
    environment.filters.update(
        two_lines=two_lines,
        label=label,
        most_seeds=most_seeds,
        capitalize_first=lambda text: text[:1].upper() + text[1:],
    )
    pictures = [p for section in contents.sections for p in (*section.pictures, *section.in_depth)]
    sources = {p.name: inside_page(png(p.figure)) for p in pictures}
    return environment.get_template("report.html.j2").render(contents=contents, sources=sources, baselines=BASELINES)


def label(estimator: str) -> str:
    """An estimator's name for the eye: "prior mean" for prior_mean."""
    return estimator.replace("_", " ") if estimator in BASELINES else estimator


def most_seeds(table: Table) -> int:
    """Of any estimator's entry; the baselines need no seeds."""
    counts = [len(e.values) for name, row in table.rows for e in row if e is not None and name not in BASELINES]
    return max(counts, default=0)
