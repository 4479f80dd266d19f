"""One self-contained page about a calibration, which first of all answers: which of these values can I trust?

``write_report`` draws the figures, puts the result into words and writes ``report.html`` with every image
inside: no script, no reference to anything outside the file. Words and rounding are made here; the template
only lays out.
"""

from __future__ import annotations

import base64
import json
import math
import os
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jinja2
import numpy as np

from sipe_bayes.core.files import write_bytes
from sipe_bayes.core.parameters import Parameter
from sipe_bayes.diagnostics.records import ChannelScore, Comparison, Ridge
from sipe_bayes.diagnostics.result import Calibration, ParameterSummary
from sipe_bayes.report import calibration_plots as plots

WELL_DETERMINED = 0.8
"""Contraction from which a parameter counts as well determined: its interval is at most a fifth of the
prior's."""
ALIKE = 1.05
"""Errors within this factor of one another count as the same."""
_ONE = "The one value may be trusted within its interval"
_NAMED, _DOUBTS = 6, 2  # parameters and doubts that a sentence lists
MIXED = 1.05
"""R-hat above which chains are called not mixed."""

_PROBLEMS = {
    "at_bound": "at a bound",
    "no_effect": "changes nothing",
    "not_determined": "not determined",
    "disagrees": "disagrees between logs",
    "misfit": "model lacks something",
}


# Numbers in words


def significant(value: float, sd: float, scale: float | None = None) -> str:
    """``value`` to the second significant digit of ``sd``: significant(0.69751, 0.0030) is "0.6975".

    scale: the largest of several numbers that stand together, so that all of them are written alike, either
    plainly or, below 0.001 and from a million on, with a power of ten. Without an uncertainty, four
    significant digits.
    """
    if not math.isfinite(value):
        return "–"
    if not (math.isfinite(sd) and sd > 0):
        return f"{value:.4g}"
    last = math.floor(math.log10(float(f"{sd:.1e}"))) - 1
    size = max(abs(value), abs(scale or 0.0), sd)
    exponent = math.floor(math.log10(size))
    if -4 < exponent < 6:
        return f"{round(value, -last) + 0.0:.{max(-last, 0)}f}"
    return f"{round(value / 10.0**exponent, exponent - last) + 0.0:.{max(exponent - last, 0)}f}e{exponent}"


def number(value: Any, digits: int = 3) -> str:
    """``value`` to some significant digits, as short as it goes; a dash when it is missing or not finite."""
    if value is None or not math.isfinite(float(value)):
        return "–"
    rounded = float(f"{float(value):.{digits - 1}e}")
    text = f"{rounded:.0f}" if 10 ** (digits - 1) <= abs(rounded) < 1e6 else f"{rounded:.{digits}g}"
    return re.sub(r"e([+-])0*", r"e\1", text).replace("e+", "e")


def error_text(value: float) -> str:
    """An error to three significant digits, zeros included."""
    return f"{value:#.3g}".rstrip(".") if 1e-4 <= abs(value) < 1000 else number(value)


def times(ratio: float) -> str:
    """An error ratio (model as given over calibrated) in words."""
    if not math.isfinite(ratio):
        return "–"
    if 1 / ALIKE < ratio < ALIKE:
        return "about the same"
    factor, word = (ratio, "smaller") if ratio > 1 else (1 / ratio, "larger")
    return f"{factor:.1f} times {word}" if factor < 9.95 else f"{number(factor, 2)} times {word}"


def listed(names: Sequence[str]) -> str:
    """The names as words of a sentence: "a, b and c"."""
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}" if names else ""


# Verdicts


@dataclass(frozen=True)
class Verdict:
    """What to think of something: a ``tone`` (good, fair or bad) and words."""

    tone: str
    text: str


def parameter_verdict(parameter: ParameterSummary, ridges: Sequence[Ridge] = (), doubts: Sequence[str] = ()) -> Verdict:
    """What to think of one parameter: what is wrong with it, else how far the logs determine it. One that is poorly determined but
    belongs to one of the ``ridges`` is determined with the others of it. None is good while the method has ``doubts``."""
    others = [n for r in ridges if parameter.name in r.parameters for n in r.parameters if n != parameter.name]
    shared = bool(others) and parameter.contraction < WELL_DETERMINED and "no_effect" not in parameter.flags
    told = {flag: text for flag, text in _PROBLEMS.items() if not (shared and flag == "not_determined")}
    problems = [text for flag, text in told.items() if flag in parameter.flags]
    if problems:
        return Verdict("bad", ", ".join(problems))
    if shared:
        return Verdict("fair", f"only with {listed(list(dict.fromkeys(others)))}")
    if not parameter.sd > 0:
        return Verdict("fair", "a point without uncertainty")
    partly = "; part of its range changes nothing" if "dead_range" in parameter.flags else ""
    if parameter.contraction >= WELL_DETERMINED:
        doubted = "; but see the doubt above" if doubts else ""
        return Verdict("fair" if partly or doubted else "good", "determined" + partly + doubted)
    return Verdict("fair", "weakly determined" + partly)


def improvement(scores: Iterable[ChannelScore]) -> float:
    """How many times smaller the error became: geometric mean over logs and channels; NaN when none
    compares."""
    ratios = [s.rmse_default / s.rmse for s in scores if s.rmse > 0 and s.rmse_default > 0]
    ratios = [r for r in ratios if math.isfinite(r)]
    return float(np.exp(np.mean(np.log(ratios)))) if ratios else math.nan


def headline(
    parameters: Sequence[ParameterSummary], ridges: Sequence[Ridge] = (), doubts: Sequence[str] = ()
) -> Verdict:
    """Which of the parameters, nuisance ones aside, may be trusted; none while the method has ``doubts``."""
    wanted = [p for p in parameters if "nuisance" not in p.flags]
    good = [p.name for p in wanted if parameter_verdict(p, ridges).tone == "good"]
    if not wanted:
        return Verdict("fair", "Only nuisance parameters were estimated.")
    if doubts:
        others = f"; and {len(doubts) - _DOUBTS} more, among the warnings" if len(doubts) > _DOUBTS else ""
        return Verdict(
            "bad", f"No value may be trusted within its interval yet: {'; '.join(doubts[:_DOUBTS])}{others}."
        )
    if not good:
        return Verdict("bad", "No value may be trusted within its interval; the table says why.")
    if len(good) == len(wanted):
        text = f"All {len(good)} values may be trusted within their intervals" if len(good) > 1 else _ONE
        return Verdict("good", f"{text}.")
    named = listed(good) if len(good) <= _NAMED else f"{listed(good[:_NAMED])} and others"
    text = f"{len(good)} of {len(wanted)} values may be trusted within their intervals: {named}"
    return Verdict("fair", f"{text}; the table says why not the others.")


def prediction(scores: Sequence[ChannelScore], comparison: Comparison | None) -> Verdict:
    """Whether the calibrated model foretells held-out logs better than the model as given."""
    if not scores:
        text = "No log was held out, so nothing here shows how well the model predicts a log it has not seen."
        return Verdict("fair", text)
    lost = [s for s in scores if not math.isfinite(s.rmse)]
    if lost:
        where = listed([f"{s.log} ({s.channel})" for s in lost])
        return Verdict("bad", f"On held-out logs the calibrated model has no finite error in {where}.")
    if comparison is None:
        return Verdict("fair", "On held-out logs the errors of the two models cannot be compared.")
    found = f"{_margin(comparison)}; paired t-test on {comparison.pieces} pieces of the logs, p = {comparison.p:.2g}"
    if comparison.starts is not None:
        found += f"; from starts that each model fits, since those measured make {100 * comparison.starts:.3g} % of the error"
    found += ")"
    if comparison.verdict == "worse":
        return Verdict(
            "bad", f"On held-out logs the calibrated model is WORSE than the model you had: its error is {found}."
        )
    if comparison.verdict == "not better":
        text = (
            "On held-out logs it is NOT shown that the calibrated model is better than the model you had: its error is "
        )
        return Verdict("bad", f"{text}{found}.")
    alone = comparison.starts is None  # the errors by log are from measured starts
    worse = [f"{s.log} ({s.channel})" for s in scores if alone and s.rmse > ALIKE * s.rmse_default]
    text = f"On held-out logs the calibrated model is better than the model you had: its error is {found}"
    if worse:
        return Verdict("fair", f"{text}; but it is larger in {listed(worse)}.")
    return Verdict("good" if comparison.ratio >= ALIKE else "fair", f"{text}.")


def _margin(comparison: Comparison) -> str:
    """The ratio in words with its 95 % interval, in the direction in which it lies."""
    ratio, low, high = comparison.ratio, comparison.low, comparison.high
    if ratio < 1:
        ratio, low, high = 1 / ratio, 1 / high, 1 / low
    digits = 3 if ratio < ALIKE else 2
    word = "smaller" if comparison.ratio >= 1 else "larger"
    return f"{number(ratio, digits)} times {word} (95 % interval {number(low, digits)} to {number(high, digits)}"


def lack(calibration: Calibration) -> Verdict | None:
    """What the model lacks, where that matters; the warnings say more."""
    found = calibration.misfit
    if found is None or not found.alarm:
        return None
    channel = max(found.share, key=lambda name: found.share[name])
    share = f"{100 * found.share[channel]:.2g} % of the residual of {channel}"
    if not found.matters:
        return Verdict("fair", f"The model lacks something small: it looks like {found.cause} ({share}).")
    return Verdict("bad", f"The model lacks something: it looks like {found.cause} ({share}, p = {found.p:.2g}).")


def mixing_verdict(calibration: Calibration) -> Verdict | None:
    """Whether the Markov chains have mixed, when there are any that say so."""
    names = calibration.posterior.space.names
    rhat = plots.scores_by_name(calibration.mixing, "rhat", names)
    found = (calibration.mixing or {}).get("rhat")
    worst = max(rhat.values()) if rhat else float(found) if isinstance(found, int | float) else None
    if worst is None:
        return None
    if worst <= MIXED:
        return Verdict("good", f"The chains have mixed (largest R-hat {worst:.3f}).")
    where = f" in {max(rhat, key=lambda name: rhat[name])}" if rhat else ""
    text = f"The chains have NOT mixed (R-hat {worst:.2f}{where}): do not use the intervals yet."
    return Verdict("bad", text)


def verdicts(calibration: Calibration) -> list[Verdict]:
    """The sentences at the top of the report; the first says so where the calibration does not help."""
    predicted = prediction(calibration.holdout, calibration.comparison)
    first = [headline(calibration.parameters, calibration.ridges, calibration.doubts), predicted]
    if predicted.tone == "bad":
        first.reverse()
    mixing = mixing_verdict(calibration)
    if mixing is not None and mixing.tone == "bad" and any("not mixed" in said for said in calibration.doubts):
        mixing = None  # said already
    return [v for v in (*first, lack(calibration), mixing) if v]


# Rows of the tables


def _values(summary: ParameterSummary, parameter: Parameter) -> dict[str, str]:
    """Estimate, sd, median and interval, all to the digits that the sd leaves; each to its own where the
    interval spans a factor of three on a log scale, since one sd then says little."""
    found = {"estimate": summary.mode, "median": summary.q50, "low": summary.q05, "high": summary.q95}
    if parameter.scale == "log" and summary.q95 > 3 * summary.q05:
        return {key: number(value, 2) for key, value in found.items()} | {"sd": number(summary.sd, 2)}
    scale = max(abs(value) for value in found.values())
    texts = {key: significant(value, summary.sd, scale) for key, value in found.items()}
    return texts | {"sd": significant(summary.sd, summary.sd, scale) if summary.sd > 0 else ""}


def _parameter_row(summary: ParameterSummary, parameter: Parameter, calibration: Calibration) -> dict[str, Any]:
    verdict = parameter_verdict(summary, calibration.ridges, calibration.doubts)
    return {
        "name": summary.name,
        "unit": plots.unit_text(summary.unit),
        "targets": ", ".join(summary.targets),
        "description": parameter.description,
        **_values(summary, parameter),
        "prior": f"{number(parameter.low, 4)} to {number(parameter.high, 4)}",
        "contraction": f"{100 * summary.contraction:.0f} %" if math.isfinite(summary.contraction) else "–",
        "bar": f"{100 * min(max(np.nan_to_num(summary.contraction), 0.0), 1.0):.1f}",
        "default": number(summary.default, 4),
        "outside": summary.default is not None and not summary.q05 <= summary.default <= summary.q95,
        "tone": verdict.tone,
        "verdict": verdict.text,
    }


def _score_row(score: ChannelScore) -> dict[str, str]:
    ratio = improvement([score])
    tone = "fair" if not math.isfinite(ratio) or 1 / ALIKE < ratio < ALIKE else "good" if ratio > 1 else "bad"
    return {
        "log": score.log,
        "channel": score.channel,
        "unit": plots.unit_text(score.unit),
        "rmse": error_text(score.rmse),
        "rmse_default": error_text(score.rmse_default),
        "ratio": times(ratio),
        "tone": tone,
    }


def _noise_row(channel: str, noise: dict[str, Any]) -> dict[str, str]:
    tau = noise.get("tau")
    correlated = "white" if tau == 0 else "–" if tau is None else f"{number(tau)} s"
    unit = plots.unit_text(str(noise.get("unit", "")))
    return {"channel": channel, "sd": number(noise.get("sd")), "unit": unit, "tau": correlated}


def _counts(found: Any) -> str:
    if not isinstance(found, dict):
        return ""
    return ", ".join(f"{name} {count}" for name, count in found.items() if count) or "none"


def _log_row(log: dict[str, Any], uses: dict[str, str]) -> dict[str, Any]:
    name = str(log.get("name", ""))
    gaps = log.get("gaps") or []
    spans = ", ".join(f"{number(a)} to {number(b)} s" for a, b in gaps[:4])
    return {
        "name": name,
        "file": log.get("file", ""),
        "use": {"train": "train", "holdout": "held out"}.get(str(log.get("use") or uses.get(name)), ""),
        "rate": number(log.get("rate_hz"), 4),
        "duration": number(log.get("duration_s")),
        "samples": log.get("samples", ""),
        "resampled": {True: "yes", False: "no"}.get(log.get("resampled"), ""),  # type: ignore[arg-type]
        "gaps": spans + (f" and {len(gaps) - 4} more" if len(gaps) > 4 else "") or "none",
        "missing": _counts(log.get("missing")),
        "clipped": _counts(log.get("clipped")),
        "notes": [str(note) for note in log.get("notes") or []],
    }


def _details(run: dict[str, Any]) -> list[tuple[str, str]]:
    """What the run was made of, each part as text."""
    texts = {
        key: value if isinstance(value, str) else json.dumps(value, indent=1, ensure_ascii=False, default=str)
        for key, value in run.items()
    }
    return [(key.replace("_", " "), text) for key, text in texts.items()]


def _mixing_rows(calibration: Calibration) -> dict[str, Any]:
    """Numbers by parameter as a table, all else as a list."""
    names = calibration.posterior.space.names
    mixing = calibration.mixing or {}
    columns = {key: plots.scores_by_name(mixing, key, names) for key in mixing}
    table = {key: column for key, column in columns.items() if column}
    rows = [[name, *(number(column.get(name), 4) for column in table.values())] for name in names]
    other = [
        (key, number(value, 4) if isinstance(value, int | float) else str(value))
        for key, value in mixing.items()
        if key not in table
    ]
    return {"head": list(table), "rows": rows if table else [], "other": other}


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
        return "data:image/png;base64," + base64.b64encode(self.content).decode("ascii")


def _logs(calibration: Calibration) -> list[tuple[str, str]]:
    """(log, use) of the logs with signals: held out first, else in the order given."""
    seen = {s.log: s.use for s in calibration.signals}
    return sorted(seen.items(), key=lambda item: item[1] != "holdout")


def pictures(calibration: Calibration) -> list[Picture]:
    """Every figure of the report, rendered."""
    found = [("marginals", "marginals", "Marginal of each parameter", plots.marginals(calibration))]
    found.append(("pairs", "pairs", "Pairs of parameters", plots.pairs(calibration)))
    for i, (log, use) in enumerate(_logs(calibration)):
        slug = re.sub(r"[^A-Za-z0-9]+", "_", log).strip("_")[:40]
        alt = f"Measured and simulated signals of {log}"
        found.append((f"signals_{use}", f"signals_{i + 1}_{slug}", alt, plots.signals(calibration, log)))
    found.append(("residuals", "residuals", "Residuals and their autocorrelation", plots.residuals(calibration)))
    found.append(("chains", "chains", "Traces of the Markov chains", plots.chains(calibration)))
    return [
        Picture(section, f"{file}{f'_{k + 1}' if len(figures) > 1 else ''}.png", plots.png(figure), alt)
        for section, file, alt, figures in found
        for k, figure in enumerate(figures)
    ]


# The page


def _context(calibration: Calibration, images: Sequence[Picture]) -> dict[str, Any]:
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
        "warnings": calibration.warnings,
        "parameters": [row for p, row in rows if "nuisance" not in p.flags],
        "nuisance": [row for p, row in rows if "nuisance" in p.flags],
        "scores": [
            ("Held-out logs", [_score_row(s) for s in calibration.holdout]),
            ("Training logs", [_score_row(s) for s in calibration.train]),
        ],
        "ridges": [ridge.text for ridge in calibration.ridges],
        "left_out": calibration.left_out,
        "sections": sections,
        "noise": [_noise_row(channel, noise) for channel, noise in calibration.noise.items()],
        "mixing": _mixing_rows(calibration) if calibration.mixing else None,
        "logs": [_log_row(log, uses) for log in calibration.logs],
        "details": _details(calibration.run),
        "limits": {"well": f"{100 * WELL_DETERMINED:.0f} %"},
    }


def render(calibration: Calibration, images: Sequence[Picture]) -> str:
    """The page as HTML."""
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("sipe_bayes.report", "templates"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template("report.html.j2").render(**_context(calibration, images))


def write_report(calibration: Calibration, folder: str | os.PathLike[str]) -> Path:
    """Write ``figures/*.png`` and ``report.html`` into ``folder``, made when missing; returns the report's
    path.

    Everything is drawn and rendered before the first file is written, and the report comes last.
    """
    images = pictures(calibration)
    page = render(calibration, images)
    figures = Path(folder) / "figures"
    figures.mkdir(parents=True, exist_ok=True)
    for image in images:
        write_bytes(figures / image.file, image.content)
    path = Path(folder) / "report.html"
    write_bytes(path, page.encode())
    return path
