"""What a report of the benchmark says, apart from how it is laid out: sentences, tables and figures, in order.

``contents(folder)`` reads the records once; the HTML and the LaTeX report are two layouts of what it returns.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from matplotlib.figure import Figure

from sipe_bayes.benchmark import figures
from sipe_bayes.benchmark.cells import BASELINES
from sipe_bayes.benchmark.records import Record, load_all, planned
from sipe_bayes.benchmark.tables import (
    ALL,
    MEASURES,
    OUTSIDE,
    Context,
    Entry,
    Table,
    counted,
    measures,
    order_estimators,
    order_tasks,
    renamed,
    results,
    score_table,
    sweep_rows,
    warning_counts,
)
from sipe_bayes.diagnostics.sipe_plot import COMPARED, settings_plot, sipe_plot

SETTINGS = {
    "direct": "Direct estimation",
    "learned_reward": "Learned rewards",
    "policy": "Policy in the loop",
    "policy_learned_reward": "Policy in the loop, learned rewards",
}
"""The settings with tables of their own, in the report's order; the others have one figure or one table."""
_PAIRS = (
    ("direct", "policy", ("demonstrations", "policy"), "Policy against demonstrations"),
    ("direct", "learned_reward", ("state differences", "learned rewards"), "Learned rewards against state differences"),
    ("policy", "policy_learned_reward", ("state differences", "learned rewards"), "The same, with a policy in the loop"),
)  # fmt: skip
_VARIANTS = {"in_distribution": "in distribution", "default": "default", OUTSIDE: "out of distribution"}
_NOTES = {
    "default": "The truth is the centre of every range here, so the prior mean is exact: judge by CRPS skill and by the variants beside it.",
    "in_distribution": "",
    OUTSIDE: "The truth lies outside every range here, so only CRPS, the energy score and whether a method noticed mean anything.",
}
_PER_FIGURE = 3  # estimators
_RADARS = "The radius is the value, on one spoke per environment; dashed is the prior mean. CRPS skill is 0 on the grey ring for the prior and 1 on the rim for the truth; below −1 it is drawn at the centre."


@dataclass(frozen=True)
class Picture:
    """A figure of a report, laid out once for all files; name: of its file, without the ending."""

    name: str
    caption: str
    figure: Figure

    def __post_init__(self) -> None:
        self.figure.draw_without_rendering()
        self.figure.set_layout_engine("none")


@dataclass(frozen=True)
class Section:
    """in_depth: figures that a reader opens when wanted."""

    anchor: str
    title: str
    sentences: list[str] = field(default_factory=list)
    tables: list[Table] = field(default_factory=list)
    pictures: list[Picture] = field(default_factory=list)
    in_depth: list[Picture] = field(default_factory=list)
    sweep: list[tuple[str, str, Entry, bool]] = field(default_factory=list)


@dataclass(frozen=True)
class Contents:
    """facts: what was run, (label, text). missing: (setting, estimator, count, tasks). failed: (id, last line of the
    traceback). warnings: (estimator, text, how often)."""

    headline: str
    facts: list[tuple[str, str]]
    sections: list[Section]
    missing: list[tuple[str, str, int, str]]
    failed: list[tuple[str, str]]
    warnings: list[tuple[str, str, int]]
    planned: int


def contents(folder: Path) -> Contents:
    """Everything a report shows of a folder of results; raises RecordError for one without records."""
    records = load_all(folder)
    wanted = planned(folder)
    known = {r.id for r in records}
    missing = [cell for cell in wanted if cell not in known]
    failed = [(r.id, r.failure) for r in records if not r.done]
    done = [r for r in records if r.done]
    state = [f"{len(done):,} cells finished", f"{len(failed):,} failed"]
    state.append(
        f"{len(missing):,} of {len(wanted):,} planned are missing" if wanted else "no plan says what is missing"
    )
    return Contents(
        headline=", ".join(state),
        facts=_facts(records),
        sections=[s for s in _sections(done) if s.tables or s.pictures or s.sweep],
        missing=_grouped(missing),
        failed=failed,
        warnings=warning_counts(done),
        planned=len(wanted),
    )


def _grouped(missing: Sequence[str]) -> list[tuple[str, str, int, str]]:
    """Missing cells by setting and estimator."""
    groups: dict[tuple[str, str], list[str]] = {}
    for cell in missing:
        task, estimator, setting, variant, _ = cell.split("/")
        label = setting.split("=")[0].split(",")[0]
        groups.setdefault((f"{label}, {_VARIANTS.get(variant, variant)}", estimator), []).append(task)
    return [(*key, len(tasks), ", ".join(order_tasks(set(tasks)))) for key, tasks in groups.items()]


# What was run


def _facts(records: Sequence[Record]) -> list[tuple[str, str]]:
    method = sum(r.cpu_seconds or 0.0 for r in records)
    banks: dict[tuple[str, str, int, int], float] = {}  # each shared by several records
    for r in records:
        bank = (r.task, r.variant, r.seed, r.steps)
        banks[bank] = max(banks.get(bank, 0.0), r.simulation_cpu_seconds)
    estimators = order_estimators({r.estimator for r in records})
    facts = [
        ("environments", ", ".join(order_tasks({r.task for r in records}))),
        ("estimators", ", ".join(e for e in estimators if e not in BASELINES)),
        ("baselines", ", ".join(e for e in estimators if e in BASELINES) or "none was run: no figure shows the prior"),
        ("settings", ", ".join(sorted({r.setting for r in records}))),
        ("variants", ", ".join(text for name, text in _VARIANTS.items() if any(r.variant == name for r in records))),
        ("seeds", _numbers(r.seed for r in records)),
        ("budget", f"{_numbers(r.budget for r in records)} rollouts"),
        ("trajectories", f"{_horizons(records)} control steps; by {_listed(r.log for r in records)}"),
        (
            "time",
            f"{_duration(method)} of CPU for the methods, {_duration(sum(banks.values()))} for shared simulations",
        ),
        ("versions", "; ".join(f"{p} {_listed(r.versions.get(p, '') for r in records)}" for p in _packages(records))),
    ]
    commands = _listed(r.command for r in records)
    return [*facts, *([("command", commands)] if commands else [])]


def _packages(records: Sequence[Record]) -> list[str]:
    return list(dict.fromkeys(package for r in records for package in r.versions if r.versions[package]))


def _horizons(records: Sequence[Record]) -> str:
    """How long the trajectories are, by task where that differs."""
    tasks: dict[int, set[str]] = {}
    for record in records:
        tasks.setdefault(record.steps, set()).add(record.task)
    if len(tasks) == 1:
        return f"{next(iter(tasks)):,}"
    return "; ".join(f"{steps:,} ({', '.join(order_tasks(tasks[steps]))})" for steps in sorted(tasks))


def _numbers(values: Iterator[int]) -> str:
    return ", ".join(f"{v:,}" for v in sorted(set(values)))


def _listed(values: Iterator[str]) -> str:
    return ", ".join(sorted({v for v in values if v}))


def _duration(seconds: float) -> str:
    return (
        f"{seconds / 3600:.1f} h"
        if seconds >= 3600
        else f"{seconds / 60:.1f} min"
        if seconds >= 60
        else f"{seconds:.1f} s"
    )


# Sections


def _sections(done: Sequence[Record]) -> Iterator[Section]:
    context = Context.of(done)
    for setting, title in SETTINGS.items():
        for variant, words in _VARIANTS.items():
            group = [r for r in done if (r.setting, r.variant) == (setting, variant)]
            if any(r.estimator not in BASELINES for r in group):
                yield _group(f"{setting}-{variant}", f"{title}, {words}", _with_baselines(group, done), context)
    for first, second, labels, title in _PAIRS:
        yield _pair(done, first, second, labels, title, context)
    yield _along(done, "gradient_steps", "Gradient steps of MAML", "gradient steps at test time")
    yield _along(done, "rollouts", "Accuracy against rollouts", "rollouts")
    yield _sweep(done)


def _with_baselines(group: Sequence[Record], done: Sequence[Record]) -> list[Record]:
    """The group and, where it has none of its own, the baselines of the direct setting on its tasks."""
    if any(r.estimator in BASELINES for r in group):
        return list(group)
    tasks, variants = {r.task for r in group}, {r.variant for r in group}
    own = [r for r in done if r.estimator in BASELINES and r.task in tasks and r.variant in variants]
    return [*group, *own]


def _group(anchor: str, title: str, records: Sequence[Record], context: Context) -> Section:
    """Tables and SiPE plots of one setting and variant; in depth for direct estimation within the bounds."""
    shown, sentence = counted(records)
    variant = next(r.variant for r in shown if r.estimator not in BASELINES)
    tables = [t for name in measures(variant) if (t := score_table(shown, name, context)) is not None]
    notes = [_NOTES[variant], sentence]
    section = Section(anchor, title, [*(n for n in notes if n), *_findings(tables)], tables)
    if variant != OUTSIDE:
        section.pictures.extend(_radars(anchor, shown))
    if anchor == "direct-in_distribution":
        section.in_depth.extend(_parameters(shown))
    return section


def _radars(anchor: str, records: Sequence[Record]) -> Iterator[Picture]:
    found = results(records)
    base = {name: found.pop(name) for name in BASELINES if name in found}
    for k, part in enumerate(_parts(list(found), COMPARED)):
        figure = sipe_plot({**{n: found[n] for n in part}, **base}, "mean")
        yield Picture(
            f"{anchor}-compared{k}", f"Means over parameters and seeds of {', '.join(part)}. {_RADARS}", figure
        )
    for k, part in enumerate(_parts(list(found), _PER_FIGURE)):
        caption = (
            f"{', '.join(part)}: mean (green), worst (blue) and best (orange) parameter of each environment. {_RADARS}"
        )
        yield Picture(f"{anchor}-spread{k}", caption, sipe_plot({**{n: found[n] for n in part}, **base}))


def _parts(names: list[str], size: int) -> list[list[str]]:
    """Parts of nearly equal length, none longer than ``size``."""
    count = -(-len(names) // size)
    return [names[len(names) * k // count : len(names) * (k + 1) // count] for k in range(count)]


def _parameters(records: Sequence[Record]) -> Iterator[Picture]:
    for task in order_tasks({r.task for r in records}):
        mine = [r for r in records if r.task == task]
        if all(r.estimator in BASELINES for r in mine):
            continue
        yield Picture(
            f"error-{task}",
            f"{task}: error of each parameter, in units of its range.",
            figures.error_per_parameter(mine),
        )
        text = f"{task}: posterior against truth, in units of each parameter's range."
        yield Picture(f"posterior-{task}", text, figures.posterior_against_truth(mine))


def _pair(
    done: Sequence[Record], first: str, second: str, labels: tuple[str, str], title: str, context: Context
) -> Section:
    """Two settings on the tasks and estimators that both have, in distribution."""
    section = Section(f"{first}-against-{second}", title)
    (one, _), (two, sentence) = (
        counted([r for r in done if r.setting == s and r.variant == "in_distribution"]) for s in (first, second)
    )
    one = _with_baselines(one, done)
    both = {(r.task, r.estimator) for r in one} & {(r.task, r.estimator) for r in two}
    left, right = ([r for r in group if (r.task, r.estimator) in both] for group in (one, two))
    if not left or not right:
        return section
    trivial = [r for r in one if r.estimator in BASELINES and r.task in {task for task, _ in both}]
    rows = [*renamed(left, labels[0]), *renamed(right, labels[1]), *trivial]
    section.tables.extend(t for n in ("accuracy", "spread", "CRPS skill") if (t := score_table(rows, n, context)))
    section.sentences.extend([sentence] if sentence else [])
    everything = results([*left, *trivial])
    names = [n for n in everything if n not in BASELINES]
    base = {n: everything[n] for n in BASELINES if n in everything}
    for k, part in enumerate(_parts(names, _PER_FIGURE)):
        figure = settings_plot({**{n: everything[n] for n in part}, **base}, results(right), labels)
        caption = f"{', '.join(part)}: means over parameters and seeds with {labels[0]} (green) and {labels[1]} (orange). {_RADARS}"
        section.pictures.append(Picture(f"{section.anchor}{k}", caption, figure))
    return section


def _along(done: Sequence[Record], setting: str, title: str, what: str) -> Section:
    """Accuracy against gradient steps or rollouts; for rollouts, what was known on the way where no other budget was run."""
    section = Section(setting.replace("_", "-"), title)
    mine = [r for r in done if r.setting == setting]
    if not mine and setting == "rollouts":
        mine = [r for r in done if (r.setting, r.variant) == ("direct", "in_distribution") and len(r.history) > 1]
    if not mine:
        return section
    variants = {r.variant for r in mine}
    tasks = {r.task for r in mine}
    base = [r for r in done if r.estimator in BASELINES and r.variant in variants and r.task in tasks]
    draw = figures.gradient_step_ablation if setting == "gradient_steps" else figures.accuracy_against_rollouts
    caption = f"Mean accuracy against {what}: mean over seeds, shaded their range; dashed the prior mean."
    section.pictures.append(Picture(section.anchor, caption, draw([*mine, *base])))
    return section


def _sweep(done: Sequence[Record]) -> Section:
    rows = sweep_rows(done)
    section = Section("sweep", "Search over hyper-parameters", sweep=rows)
    for estimator in dict.fromkeys(row[0] for row in rows):
        mine = [row for row in rows if row[0] == estimator]
        defaults = next((row for row in mine if row[3]), None)
        first = mine[0]
        where = "outside noise" if first[2].best else "not outside noise"
        if first[3]:
            section.sentences.append(f"{estimator}: the search chooses the defaults, {first[1]}.")
        elif defaults is not None:
            section.sentences.append(
                f"{estimator}: the search would choose {first[1]} ({_text(first[2])}) and not the defaults, {defaults[1]} "
                f"({_text(defaults[2])}); its lead is {where}."
            )
    return section


# Sentences


def _findings(tables: Sequence[Table]) -> list[str]:
    """What the tables say, over all environments where they are complete."""
    found = []
    for table in tables:
        if table.measure.name not in ("accuracy", "CRPS skill", "CRPS"):
            continue
        column = ALL if ALL in table.columns else table.columns[0]
        rows = {name: entry for name, _ in table.rows if (entry := table.entry(name, column)) is not None}
        mine = {name: entry for name, entry in rows.items() if name not in BASELINES}
        if not mine:
            continue
        sign = MEASURES[table.measure.name].better
        first = max(mine, key=lambda name: sign * mine[name].mean)
        where = "over all environments" if column == ALL else f"on {column}"
        noise = "ahead of every other outside noise" if mine[first].best else "its lead is not outside noise"
        found.append(f"Best {table.measure.name} {where}: {first}, {_text(mine[first])}; {noise}.")
        reference = "prior_mean" if table.measure.name == "accuracy" else "prior"
        if reference in rows:
            ahead = [n for n, e in mine.items() if sign * (e.mean - rows[reference].mean) > 0]
            behind = [n for n in mine if n not in ahead]
            text = (
                f"Better in {table.measure.name} than the {reference.replace('_', ' ')}: {', '.join(ahead) or 'none'}"
            )
            found.append(f"{text}; not better: {', '.join(behind) or 'none'}.")
    return found


def _text(entry: Entry) -> str:
    mean, error = entry.texts()
    return f"{mean} ± {error}" if error else mean
