"""The leaderboard's pages: entries ranked, a cell for each task and entry, and the record behind each cell.

One HTML file each with nothing outside it but links to the entries' own JSON. Without scripts every number is there; a
script sorts, filters, chooses the measure and draws the radar.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sipe_bayes.benchmark.leaderboard.entry import EntryError, answers_path
from sipe_bayes.benchmark.leaderboard.registry import TASKS
from sipe_bayes.benchmark.leaderboard.scoring import LEVEL, Scored, TaskScore, scored
from sipe_bayes.benchmark.leaderboard.task import VERSION, Kind, Task
from sipe_bayes.core.files import write_text
from sipe_bayes.report.templates import html_templates
from sipe_bayes.report.words import number

_NEAR = 0.05  # of 90 %: the intervals of a task count as right


@dataclass(frozen=True)
class Measure:
    """What a cell may show.

    Args:
        key: in the page.
        name: for people.
        meaning: which way is better.
        of: its value, None where there is none.
    """

    key: str
    name: str
    meaning: str
    of: Callable[[TaskScore], float | None]


MEASURES = (
    Measure("skill", "CRPS skill", "0 is the prior, 1 the truth", lambda s: s.skill),
    Measure("coverage", "coverage of 90 %", "of the intervals, ± its standard error", lambda s: s.coverage),
    Measure("interval", "interval score", "in ranges; smaller is better", lambda s: s.interval),
    Measure(
        "heldout",
        "held-out error",
        "of what is predicted with, over that of the model as given; smaller is better",
        lambda s: s.heldout,
    ),
    Measure("rollouts", "rollouts", "for each log", lambda s: s.rollouts),
    Measure("cpu", "CPU seconds", "for each log", lambda s: s.cpu_seconds),
    Measure("failed", "failed logs", "which count as the prior", lambda s: float(s.failed)),
)


@dataclass(frozen=True)
class Value:
    """Of a measure: as a number to sort by, and as text."""

    key: str
    number: float | None
    text: str
    error: str = ""


@dataclass(frozen=True)
class Cell:
    """Of an entry on a task; ``anchor`` is its record's."""

    anchor: str
    values: tuple[Value, ...]


@dataclass(frozen=True)
class Row:
    """An entry over all tasks of the page."""

    name: str
    scored: Scored
    values: tuple[Value, ...]


@dataclass(frozen=True)
class Page:
    """What is laid out.

    Args:
        title: of the page.
        other: file name and title of the other page.
        tasks: its tasks.
        rows: entries, the first the best.
        cells: (task, entry) -> cell.
        records: of the cells: anchor, task, entry, score, link to the JSON.
        measure: by which entries are ranked, and which is shown first.
    """

    title: str
    other: tuple[str, str]
    tasks: tuple[Task, ...]
    rows: tuple[Row, ...]
    cells: dict[tuple[str, str], Cell]
    records: tuple[tuple[str, Task, str, TaskScore, str], ...]
    measure: str


def write(folders: Sequence[Path], out: Path) -> list[Path]:
    """Check and score entries, and write ``leaderboard.html`` and ``real.html``.

    Args:
        folders: of the entries.
        out: where to.

    Returns:
        The pages.

    Raises:
        EntryError: for an entry that is not to be trusted, or two of one method.
    """
    entries: dict[str, Scored] = {}
    for folder in folders:
        one = scored(folder)
        if one.entry.method in entries:
            first = entries[one.entry.method].folder
            raise EntryError(
                f"{folder}: an entry of {one.entry.method!r}, as {first} is; give one of them another name"
            )
        entries[one.entry.method] = one
    names = {"leaderboard.html": f"Leaderboard {VERSION}", "real.html": f"Leaderboard {VERSION}, real logs"}
    every = tuple(TASKS.values())
    choices = {"leaderboard.html": every, "real.html": tuple(t for t in every if t.kind is Kind.REAL)}
    template = html_templates("sipe_bayes.benchmark", "sipe_bayes.report").get_template("leaderboard.html.j2")
    written = []
    for file, title in names.items():
        (other,) = [(f, t) for f, t in names.items() if f != file]
        view = _page(title, other, choices[file], entries, out, "skill" if choices[file] == every else "heldout")
        page = template.render(page=view, measures=MEASURES, level=LEVEL, charts=None, kinds=list(Kind))
        write_text(out / file, page)
        written.append(out / file)
    return written


def _page(
    title: str, other: tuple[str, str], tasks: tuple[Task, ...], entries: dict[str, Scored], out: Path, measure: str
) -> Page:
    cells, records = {}, []
    for k, (name, one) in enumerate(entries.items()):
        for task in tasks:
            score = one.tasks.get(task.name)
            if score is not None:
                anchor = f"r{k}-{task.name}"
                link = os.path.relpath(answers_path(one.folder, task.name), out)
                cells[task.name, name] = Cell(anchor, tuple(_value(m, score) for m in MEASURES))
                records.append((anchor, task, name, score, link))
    rows = [Row(name, one, _summary(one, tasks)) for name, one in entries.items()]
    sign, ranked = (-1, "skill") if measure == "skill" else (1, measure)
    rows.sort(key=lambda row: sign * next(v.number or 0.0 for v in row.values if v.key == ranked))
    return Page(title, other, tasks, tuple(rows), cells, tuple(records), measure)


def _value(measure: Measure, score: TaskScore) -> Value:
    value = measure.of(score)
    if value is None:
        return Value(measure.key, None, "point" if score.points and measure.key in ("coverage", "interval") else "–")
    error = score.coverage_error if measure.key == "coverage" else None
    return Value(measure.key, value, _text(measure.key, value), "" if error is None else f"{error:.2f}")


def _text(key: str, value: float) -> str:
    if key in ("skill", "coverage"):
        return f"{round(value, 2) + 0.0:.2f}"  # no minus zero
    if key in ("rollouts", "failed"):
        return f"{value:.0f}"
    return number(value, 2)


def _summary(one: Scored, tasks: Sequence[Task]) -> tuple[Value, ...]:
    """Over the tasks of a page; one without an answer counts as the prior, held out as the model as given."""
    scores = [one.tasks[task.name] for task in tasks if task.name in one.tasks]
    skills = [one.tasks[t.name].skill or 0.0 if t.name in one.tasks else 0.0 for t in tasks if t.truths]
    errors = [one.tasks[t.name].heldout or 1.0 if t.name in one.tasks else 1.0 for t in tasks if t.heldout]
    covers = [(s.coverage, s.coverage_error or 0.0) for s in scores if s.coverage is not None]
    right = sum(round(abs(cover - LEVEL), 9) <= _NEAR for cover, _ in covers)  # 17 of 20 are .85
    failed, logs = sum(s.failed for s in scores), sum(len(s.logs) for s in scores)
    error = math.hypot(*(e for _, e in covers)) / len(covers) if covers else 0.0
    return (
        Value("answered", len(scores), f"{len(scores)} of {len(tasks)}"),
        _mean("skill", skills),
        _mean("coverage", [cover for cover, _ in covers], f"{error:.2f}" if covers else ""),
        Value("right", right, f"{right} of {len(covers)}") if covers else Value("right", None, "–"),
        _mean("heldout", errors),
        _mean("rollouts", [s.rollouts for s in scores]),
        _mean("cpu", [s.cpu_seconds for s in scores]),
        Value("failed", failed, f"{failed} of {logs}"),
    )


def _mean(key: str, values: Sequence[float], error: str = "") -> Value:
    """Geometric of errors."""
    if not values:
        return Value(key, None, "–")
    value = float(np.exp(np.mean(np.log(values)))) if key == "heldout" else float(np.mean(values))
    return Value(key, value, _text(key, value), error)
