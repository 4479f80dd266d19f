"""The page about a search over structures: what the model lacks, what was tried, before and after, what remains."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from pathlib import Path

from sipe_bayes.core.thresholds import THRESHOLDS
from sipe_bayes.diagnostics.discovery import Discovery, ModelErrors
from sipe_bayes.report.discovery import plots, words
from sipe_bayes.report.drawing import png, uncollected
from sipe_bayes.report.interactive.charts import charts
from sipe_bayes.report.page import Picture, run_details, write_page
from sipe_bayes.report.templates import html_templates
from sipe_bayes.report.words import error_text, number, times, unit_text


@uncollected()
def discovery_pictures(discovery: Discovery) -> list[Picture]:
    """Every figure of the report, rendered."""
    drawn = []
    for i, (log, use) in enumerate({s.log: s.use for s in discovery.signals}.items()):
        slug = re.sub(r"[^A-Za-z0-9]+", "_", log).strip("_")[:40]
        alt = f"Measured and simulated signals of {log}, before and after"
        drawn.append((f"signals_{use}", f"before_after_{i + 1}_{slug}", alt, plots.before_and_after(discovery, log)))
    alt = "Residuals before and after, and their autocorrelation"
    drawn.append(("residuals", "residuals_before_after", alt, plots.residuals(discovery)))
    alt = "Intervals of the parameters before and after"
    drawn.append(("values", "values_before_after", alt, plots.values(discovery)))
    return [
        Picture(section, f"{file}{f'_{k + 1}' if len(figures) > 1 else ''}.png", png(figure), alt)
        for section, file, alt, figures in drawn
        for k, figure in enumerate(figures)
    ]


def _error_row(row: ModelErrors) -> dict[str, str]:
    ratio = row.fitted_before / row.fitted_after if row.fitted_after > 0 else float("nan")
    return {
        "log": row.log,
        "channel": row.channel,
        "unit": unit_text(row.unit),
        **{key: error_text(getattr(row, key)) for key in ("given", "before", "after", "fitted_before", "fitted_after")},
        "ratio": times(ratio),
        "tone": "good" if ratio >= THRESHOLDS.alike else "bad" if ratio <= 1 / THRESHOLDS.alike else "fair",
    }


def render_discovery(discovery: Discovery, images: Sequence[Picture]) -> str:
    """The page as HTML."""
    sentences, rows = words.discovery_verdicts(discovery), words.value_rows(discovery)
    tones = {v.tone for v in sentences}
    sections: dict[str, list[Picture]] = {}
    for image in images:
        sections.setdefault(image.section, []).append(image)
    return (
        html_templates("sipe_bayes.report")
        .get_template("discovery.html.j2")
        .render(
            name=discovery.name,
            rollouts=f"{discovery.rollouts:,}",
            seconds=number(discovery.seconds, 2),
            tone="bad" if "bad" in tones else "fair" if "fair" in tones else "good",
            headline=sentences[0].text,
            sentences=sentences[1:],
            warnings=words.warnings(discovery),
            pieces=[words.piece_text(piece) for piece in discovery.kept],
            others=[words.alternative_text(row) for row in words.alternatives(discovery)],
            laws=[piece for piece in discovery.kept if not piece.native and piece.kind != "channel"],
            measured=[piece for piece in discovery.kept if piece.kind == "channel"],
            references={piece.sentence: piece.reference for piece in discovery.kept if len(piece.reference) > 1},
            structures=[
                {
                    "what": words.structure_text(row),
                    "gain": words.with_error(row.gain, row.error),
                    "evidence": words.nats(row.evidence),
                    "weight": words.weight_text(row),
                    "rollouts": f"{row.rollouts:,}",
                }
                for row in discovery.rows
            ],
            promises=[
                {
                    "what": p.sentence,
                    "gain": words.nats(p.gain),
                    "fitted": "yes" if p.fitted else "not to its end" if p.unfinished else "",
                }
                for p in discovery.promises
            ],
            values=[row for row in rows if not row["added"]],
            added=[row for row in rows if row["added"]],
            errors=[
                (title, [_error_row(row) for row in discovery.errors if row.use == use])
                for title, use in (("Held-out logs", "holdout"), ("Training logs", "train"))
            ],
            residual_lines=words.residual_lines(discovery),
            sections=sections,
            charts=charts(
                discovery.signals, dict.fromkeys(s.log for s in discovery.signals), plots.AFTER, plots.BEFORE
            ),
            details=run_details(discovery.run),
            out=discovery.out,
            next=words.next_steps(discovery),
        )
    )


def write_discovery_report(discovery: Discovery, folder: str | os.PathLike[str]) -> Path:
    """Write ``figures/*.png`` and ``report.html``, the report last.

    Returns:
        The report's path.
    """
    images = discovery_pictures(discovery)
    return write_page(render_discovery(discovery, images), images, folder)
