"""One self-contained page about a calibration, which first of all answers: which of these values can I trust?

``write_report`` draws the figures, puts the result into words (``report.verdicts``, ``report.words``) and writes
``report.html`` with every image inside, and the signals as charts (``report.interactive``): no reference to anything
outside the file. The template only lays out. Where no script runs, and in print, figures stand in the charts' place.
"""

from __future__ import annotations

import json
import math
import os
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from sipe_bayes.core.files import write_bytes
from sipe_bayes.core.finding_advice import ADVICE
from sipe_bayes.core.findings import Code, Finding, Findings, Guard, Severity
from sipe_bayes.core.html import Page
from sipe_bayes.core.parameters import Parameter
from sipe_bayes.core.thresholds import THRESHOLDS
from sipe_bayes.diagnostics.records import ChannelNoise, ChannelScore, Comparison, LogReport, improvement
from sipe_bayes.diagnostics.result import Calibration, ParameterSummary
from sipe_bayes.report import calibration_plots as plots
from sipe_bayes.report.drawing import inside_page, png, uncollected
from sipe_bayes.report.interactive.charts import charts
from sipe_bayes.report.interactive.clips import Clip
from sipe_bayes.report.templates import html_templates
from sipe_bayes.report.verdicts import lacking, parameter_verdict, verdicts
from sipe_bayes.report.words import correlation_time, error_text, number, significant, times, unit_text

_GAPS = 4  # that a row of the logs lists
_DRAWN = 4  # logs whose signals are drawn, half of them held out, where there are more: a panel takes .1 s

# Rows of the tables


def _values(summary: ParameterSummary, parameter: Parameter) -> dict[str, str]:
    """Estimate, sd, median and interval, all to the digits that the sd leaves.

    Each is to its own where the interval spans a factor of three on a log scale, since one sd then says little.
    """
    values = {"estimate": summary.mode, "median": summary.q50, "low": summary.q05, "high": summary.q95}
    if parameter.scale == "log" and summary.q95 > 3 * summary.q05:
        return {key: number(value, 2) for key, value in values.items()} | {"sd": number(summary.sd, 2)}
    scale = max(abs(value) for value in values.values())
    texts = {key: significant(value, summary.sd, scale) for key, value in values.items()}
    return texts | {"sd": significant(summary.sd, summary.sd, scale) if summary.sd > 0 else ""}


def _parameter_row(summary: ParameterSummary, parameter: Parameter, calibration: Calibration) -> dict[str, object]:
    verdict = parameter_verdict(summary, Findings(calibration.findings))
    return {
        "name": summary.name,
        "unit": unit_text(summary.unit),
        "targets": ", ".join(summary.targets),
        "description": parameter.description,
        **_values(summary, parameter),
        "prior": f"{number(parameter.low, 4)} to {number(parameter.high, 4)}",
        "contraction": f"{100 * summary.contraction:.0f} %" if math.isfinite(summary.contraction) else "–",
        "bar": f"{100 * min(max(np.nan_to_num(summary.contraction), 0.0), 1.0):.1f}",
        "default": number(summary.default, 4),
        "further": _further(summary),
        "outside": summary.default is not None and not summary.q05 <= summary.default <= summary.q95,
        "tone": verdict.tone,
        "verdict": verdict.text,
    }


def _further(summary: ParameterSummary) -> str:
    """The interval with what the model lacks or may lack, to the digits that its own width leaves."""
    if summary.further is None:
        return ""
    low, high = summary.further
    return " to ".join(significant(x, max(high - low, 1e-300) / 3, max(abs(low), abs(high))) for x in (low, high))


def _score_row(score: ChannelScore) -> dict[str, str]:
    ratio = improvement([score])
    tone = (
        "fair"
        if not math.isfinite(ratio) or 1 / THRESHOLDS.alike < ratio < THRESHOLDS.alike
        else "good"
        if ratio > 1
        else "bad"
    )
    return {
        "log": score.log,
        "channel": score.channel,
        "unit": unit_text(score.unit),
        "rmse": error_text(score.rmse),
        "rmse_default": error_text(score.rmse_default),
        "ratio": times(ratio),
        "tone": tone,
    }


def _noise_row(channel: str, noise: ChannelNoise) -> dict[str, str]:
    size = {"sd": number(noise.sd), "unit": unit_text(noise.unit)}
    return {"channel": channel, **size, "tau": correlation_time(noise)}


def _compared(comparison: Comparison | None) -> str:
    """Why the ratio at the top is none of those in the table."""
    if comparison is None:
        return ""
    text = "Each row is one channel of one log; the ratio at the top is the geometric mean over all that are held out"
    return f"{text}, from starts that each model fits." if comparison.starts is not None else f"{text}."


def _counts(counts: Mapping[str, int]) -> str:
    return ", ".join(f"{name} {count}" for name, count in counts.items() if count) or "none"


def _log_row(log: LogReport, use: str) -> dict[str, object]:
    spans = ", ".join(f"{number(a)} to {number(b)} s" for a, b in log.gaps[:_GAPS])
    return {
        "name": log.name,
        "file": log.file,
        "use": {"train": "train", "holdout": "held out"}.get(use, ""),
        "rate": number(log.rate_hz, 4),
        "duration": number(log.duration_s),
        "samples": log.samples,
        "resampled": "yes" if log.resampled else "no",
        "gaps": spans + (f" and {len(log.gaps) - _GAPS} more" if len(log.gaps) > _GAPS else "") or "none",
        "missing": _counts(log.missing),
        "wild": _counts(log.wild),
        "clipped": _counts(log.clipped),
        "notes": log.notes,
    }


def run_details(run: Mapping[str, object]) -> list[tuple[str, str]]:
    """What the run was made of, each part as text."""
    texts = {
        key: value if isinstance(value, str) else json.dumps(value, indent=1, ensure_ascii=False, default=str)
        for key, value in run.items()
    }
    return [(key.replace("_", " "), text) for key, text in texts.items()]


# Figures


@dataclass(frozen=True)
class Picture:
    """One rendered figure of a ``section``, the file it is written to, and what is to be seen."""

    section: str
    file: str
    content: bytes
    alt: str

    @property
    def source(self) -> str:
        """It inside a page."""
        return inside_page(self.content)


def _logs(calibration: Calibration) -> list[tuple[str, str]]:
    """(log, use) of the logs whose signals are drawn: held out first, else in the order given.

    Of many logs some stand for all; the tables have each.
    """
    seen = {s.log: s.use for s in calibration.signals}
    by_use = [[item for item in seen.items() if item[1] == use] for use in ("holdout", "train")]
    each = _DRAWN // 2 if len(seen) > _DRAWN else len(seen)
    return [item for items in by_use for item in items[:each]]


@uncollected()
def pictures(calibration: Calibration, guard: Guard) -> list[Picture]:
    """Every figure of the report, rendered; one that raises is left out."""
    drawn: list[tuple[str, str, str, Callable[[], list[Figure]]]] = [
        ("marginals", "marginals", "Marginal of each parameter", lambda: plots.marginals(calibration)),
        ("pairs", "pairs", "Pairs of parameters", lambda: plots.pairs(calibration)),
    ]
    logs = _logs(calibration)
    shown = {log for log, _ in logs}
    for i, (log, use) in enumerate(logs):
        slug = re.sub(r"[^A-Za-z0-9]+", "_", log).strip("_")[:40]
        alt = f"Measured and simulated signals of {log}"
        drawn.append((f"signals_{use}", f"signals_{i + 1}_{slug}", alt, partial(plots.signals, calibration, log)))
    fitted = replace(calibration, residuals=[row for row in calibration.residuals if row.log in shown])
    drawn.append(("residuals", "residuals", "Residuals and their autocorrelation", lambda: plots.residuals(fitted)))
    drawn.append(("chains", "chains", "Traces of the Markov chains", lambda: plots.chains(calibration)))
    return [image for one in drawn for image in guard.run(f"figure {one[1]}", partial(_rendered, *one)).otherwise([])]


def _rendered(section: str, file: str, alt: str, draw: Callable[[], list[Figure]]) -> list[Picture]:
    figures = draw()
    return [
        Picture(section, f"{file}{f'_{k + 1}' if len(figures) > 1 else ''}.png", png(figure), alt)
        for k, figure in enumerate(figures)
    ]


# The page


def _context(calibration: Calibration, images: Sequence[Picture], clip: Clip | None) -> dict[str, object]:
    space = calibration.posterior.space
    rows = [(p, _parameter_row(p, space[space.index(p.name)], calibration)) for p in calibration.parameters]
    sentences = verdicts(calibration)
    tones = {v.tone for v in sentences}
    sections: dict[str, list[Picture]] = {}
    for image in images:
        sections.setdefault(image.section, []).append(image)
    uses = {s.log: s.use for s in calibration.signals}
    uses |= {s.log: "train" for s in calibration.train} | {s.log: "holdout" for s in calibration.holdout}
    return {
        "name": calibration.name,
        "estimator": calibration.estimator,
        "rollouts": f"{calibration.rollouts:,}",
        "seconds": number(calibration.seconds, 2),
        "tone": "bad" if "bad" in tones else "fair" if "fair" in tones or calibration.warnings else "good",
        "headline": sentences[0].text,
        "sentences": sentences[1:],
        "warnings": noticed(item for item in calibration.findings if item.severity is not Severity.NOTE),
        "notes": noticed(notes(calibration)),
        "lacks": lacking(Findings(calibration.findings)),
        "parameters": [row for p, row in rows if not p.nuisance],
        "nuisance": [row for p, row in rows if p.nuisance],
        "scores": [
            ("Held-out logs", [_score_row(s) for s in calibration.holdout]),
            ("Training logs", [_score_row(s) for s in calibration.train]),
        ],
        "compared": _compared(calibration.comparison),
        "ridges": [ridge.text for ridge in calibration.ridges],
        "sections": sections,
        "charts": charts(calibration.signals, [log for log, _ in _logs(calibration)], "calibrated", "model as given"),
        "clip": clip,
        "noise": [_noise_row(channel, noise) for channel, noise in calibration.noise.items()],
        "mixing": [(key, number(value, 4)) for key, value in calibration.mixing.items()],
        "logs": [_log_row(log, uses.get(log.name, "")) for log in calibration.logs],
        "details": run_details(calibration.run),
        "limits": {"well": f"{100 * THRESHOLDS.well_determined:.0f} %"},
    }


def notes(calibration: Calibration) -> list[Finding]:
    """Those that no other part of the page has."""
    return [item for item in calibration.findings if item.severity is Severity.NOTE and item.log is None]


def noticed(findings: Iterable[Finding]) -> list[dict[str, object]]:
    """Findings, worst first, those of one code together, with what to do, split at code."""
    groups: dict[Code, list[str]] = {}
    for item in Findings(findings).ranked:
        groups.setdefault(item.code, []).append(item.text)
    return [{"texts": texts, "advice": ADVICE[code].split("`")} for code, texts in groups.items()]


def render(calibration: Calibration, images: Sequence[Picture], clip: Clip | None = None) -> str:
    """The page as HTML."""
    template = html_templates("sipe_bayes.report").get_template("report.html.j2")
    return template.render(**_context(calibration, images, clip))


def page(calibration: Calibration) -> Page:
    """The page, with its figures inside."""
    guard = Guard()
    images = pictures(calibration, guard)
    return Page(render(_with(calibration, guard), images))


def write_pictures(images: Sequence[Picture], folder: str | os.PathLike[str]) -> None:
    """Write them into ``figures``."""
    figures = Path(folder) / "figures"
    figures.mkdir(parents=True, exist_ok=True)
    for image in images:
        write_bytes(figures / image.file, image.content)


def write_report(
    calibration: Calibration, folder: str | os.PathLike[str], clip: Clip | None = None, guard: Guard | None = None
) -> Path:
    """Write ``figures/*.png`` and ``report.html``; everything is drawn and rendered before the first file is written.

    Figures that raise are left out; where the page does, estimates and diagnostics are written in its place.

    Args:
        calibration: the result.
        folder: where to.
        clip: the machine as measured and as simulated, or why there is none.
        guard: is told of what could not be drawn.

    Returns:
        The report's path.
    """
    guard = guard or Guard()
    images = pictures(calibration, guard)
    whole = _with(calibration, guard)
    page = guard.run("page of the report", lambda: render(whole, images, clip)).made
    for image in images:
        guard.run(f"file {image.file}", partial(write_pictures, [image], folder))
    return write_page(page[0] if page else f"<!DOCTYPE html>{_with(calibration, guard)._repr_html_()}", [], folder)


def _with(calibration: Calibration, guard: Guard) -> Calibration:
    """The calibration with the diagnostics of what could not be drawn."""
    return replace(calibration, findings=(*calibration.findings, *guard.findings))


def write_page(text: str, images: Sequence[Picture], folder: str | os.PathLike[str]) -> Path:
    """Write the pictures of a page, then the page as ``report.html``.

    Returns:
        The page's path.
    """
    write_pictures(images, folder)
    path = Path(folder) / "report.html"
    write_bytes(path, text.encode())
    return path
