"""What a report of the benchmark says, apart from how it is laid out: sentences, tables and figures, in order.

``contents(folder)`` reads the records once; the HTML and the LaTeX report are two layouts of what it returns.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from matplotlib.figure import Figure

from sipe_bayes.benchmark import figures
from sipe_bayes.benchmark.cells import BASELINES, REFERENCE
from sipe_bayes.benchmark.findings import (
    Tried,
    facts,
    pair_findings,
    sweep_findings,
    sweep_rows,
    table_findings,
    unequal,
)
from sipe_bayes.benchmark.records import Record, planned
from sipe_bayes.benchmark.run_log import read_runs
from sipe_bayes.benchmark.tables import (
    BESIDE,
    OUTSIDE,
    VARIANT_NAMES,
    Context,
    Table,
    competes,
    counted,
    measures,
    order_tasks,
    renamed,
    results,
    score_table,
    warning_counts,
)
from sipe_bayes.report.drawing import equal_parts
from sipe_bayes.report.sipe_plot import LOOKS, settings_plot, sipe_plot

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
    (
        "policy",
        "policy_learned_reward",
        ("state differences", "learned rewards"),
        "The same, with a policy in the loop",
    ),
)
_NOTES = {
    "default": "The truth is the centre of every range here, where knowing nothing is a perfect guess: neither "
    "accuracy nor CRPS skill tells learning from not learning, so nothing is set in bold. Judge by the other variants.",
    "in_distribution": "accuracy is 1 - |mean - truth|, each parameter in units of its range. Each environment has one "
    "truth, .1 to .4 of the range from its centre in every parameter; logs and estimators differ with the seed. "
    "Standard errors are over seeds, so they do not tell how another truth would come out.",
    OUTSIDE: "The truth lies outside every range here, so only CRPS, the energy score and whether a method noticed "
    "mean anything.",
}
_SIGHT = (
    "laplace simulates single control steps from the recorded states, which are free of noise here, and a tenth of its "
    "rollouts find its starting points; regression and maml learn from single steps, too, the others from statistics "
    "of the log or windows of it."
)
_ON_THE_WAY = (
    ". Searches are looked at on the way, from when each seed has an estimate; methods that train once are known at "
    "the end alone."
)
RADARS = (
    "Radars: the radius is the value, on one spoke per environment; dashed is the prior mean, dotted laplace where it "
    "has no line of its own. CRPS skill is 0 on the grey ring for the prior and 1 on the rim for the truth; below −1 "
    "it is drawn at the centre."
)
SPREADS = 3
"""Estimators of one figure with worst and best parameters."""


@dataclass(frozen=True)
class Picture:
    """A figure of a report, laid out once for all files.

    Args:
        name: of its file, without the ending.
        caption: below it.
        figure: what is drawn.
    """

    name: str
    caption: str
    figure: Figure

    def __post_init__(self) -> None:
        self.figure.draw_without_rendering()
        self.figure.set_layout_engine("none")


@dataclass(frozen=True)
class Section:
    """Of a report.

    Args:
        anchor: its name in links.
        title: its heading.
        sentences: what is to be said.
        tables: of measures.
        pictures: figures.
        in_depth: figures that a reader opens when wanted.
        sweep: of the search over hyper-parameters.
    """

    anchor: str
    title: str
    sentences: list[str] = field(default_factory=list)
    tables: list[Table] = field(default_factory=list)
    pictures: list[Picture] = field(default_factory=list)
    in_depth: list[Picture] = field(default_factory=list)
    sweep: list[Tried] = field(default_factory=list)


@dataclass(frozen=True)
class Contents:
    """Everything that a report says.

    Args:
        headline: how far the folder is.
        facts: what was run, (label, text).
        sections: in order.
        missing: (setting, estimator, count, tasks).
        failed: (id, last line of the traceback).
        warnings: (estimator, text, how often).
        planned: how many cells were asked for.
    """

    headline: str
    facts: list[tuple[str, str]]
    sections: list[Section]
    missing: list[tuple[str, str, int, str]]
    failed: list[tuple[str, str]]
    warnings: list[tuple[str, str, int]]
    planned: int


def contents(folder: Path) -> Contents:
    """Everything a report shows of a folder of results.

    Raises:
        RecordError: for one without records.
    """
    records = Record.all_in(folder)
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
        facts=facts(records, read_runs(folder)),
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
        groups.setdefault((f"{label}, {VARIANT_NAMES.get(variant, variant)}", estimator), []).append(task)
    return [(*key, len(tasks), ", ".join(order_tasks(set(tasks)))) for key, tasks in groups.items()]


# Sections


def _sections(done: Sequence[Record]) -> Iterator[Section]:
    context = Context.of(done)
    for setting, title in SETTINGS.items():
        for variant, words in VARIANT_NAMES.items():
            group = [r for r in done if (r.setting, r.variant) == (setting, variant)]
            if any(r.estimator not in BASELINES for r in group):
                yield setting_section(
                    f"{setting}-{variant}", f"{title}, {words}", _with_baselines(group, done), context
                )
    for first, second, labels, title in _PAIRS:
        yield _pair(done, first, second, labels, title, context)
    yield _along(done, "gradient_steps", "Gradient steps of MAML", "gradient steps at test time")
    yield _along(done, "rollouts", "Accuracy against rollouts", "rollouts")
    yield _sweep(done)


def _with_baselines(group: Sequence[Record], done: Sequence[Record]) -> list[Record]:
    """The group and, where it has none of its own, the baselines and ``laplace`` of the direct setting on its tasks."""
    tasks, variants, own = ({getattr(r, name) for r in group} for name in ("task", "variant", "estimator"))
    direct = [r for r in done if r.setting == "direct" and r.task in tasks and r.variant in variants]
    baselines = [r for r in direct if r.estimator in BASELINES and r.estimator not in own]
    held_against = [] if REFERENCE in own else renamed([r for r in direct if r.estimator == REFERENCE], "direct")
    return [*group, *baselines, *held_against]


def setting_section(anchor: str, title: str, records: Sequence[Record], context: Context) -> Section:
    """Tables and SiPE plots of one setting and variant; in depth for direct estimation within the bounds.

    Args:
        anchor: of the section.
        title: of the section.
        records: with what they are held against.
        context: of all records.
    """
    shown, sentence = counted(records)
    variant = next(r.variant for r in shown if r.estimator not in BASELINES)
    tables = [t for name in measures(variant) if (t := score_table(shown, name, context)) is not None]
    notes = [_NOTES[variant], sentence, unequal(shown)]
    findings = [] if variant == "default" else table_findings(tables)
    if any(r.estimator == REFERENCE for r in shown):
        notes.append(_SIGHT)
    section = Section(anchor, title, [*(n for n in notes if n), *findings], tables)
    if variant != OUTSIDE:
        section.sentences.append(RADARS)
        section.pictures.extend(_radars(anchor, shown))
    if anchor == "direct-in_distribution":
        section.in_depth.extend(_parameters(shown))
    return section


def _radars(anchor: str, records: Sequence[Record]) -> Iterator[Picture]:
    scores = results(records)
    beside = {name: scores[name] for name in scores if name in BASELINES or _is_reference(name)}
    reference = next((name for name in beside if _is_reference(name)), None)
    mine = [name for name in scores if competes(name)]
    for k, part in enumerate(equal_parts(mine, len(LOOKS))):
        drawn = sipe_plot({**{n: scores[n] for n in part}, **beside}, "mean", None if reference in part else reference)
        yield Picture(f"{anchor}-compared{k}", f"Means over parameters and seeds: {', '.join(part)}.", drawn)
    for k, part in enumerate(equal_parts(mine, SPREADS)):
        caption = f"Mean (green), worst (blue) and best (orange) parameter of each environment: {', '.join(part)}."
        drawn = sipe_plot({**{n: scores[n] for n in part}, **beside}, None, None if reference in part else reference)
        yield Picture(f"{anchor}-spread{k}", caption, drawn)


def _is_reference(name: str) -> bool:
    return name.split(",")[0] == REFERENCE


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
    (one, of_one), (two, of_two) = (
        counted([r for r in done if r.setting == s and r.variant == "in_distribution"]) for s in (first, second)
    )
    both = {(r.task, r.estimator) for r in one} & {(r.task, r.estimator) for r in two}
    left, right = ([r for r in group if (r.task, r.estimator) in both] for group in (one, two))
    if not left or not right:
        return section
    beside = _with_baselines(left, done)[len(left) :]
    rows = [*renamed(left, labels[0]), *renamed(right, labels[1]), *beside]
    section.tables.extend(t for n in ("accuracy", "spread", "CRPS skill") if (t := score_table(rows, n, context)))
    section.sentences.extend(f"With {label}: {s}" for label, s in zip(labels, (of_one, of_two), strict=True) if s)
    section.sentences.extend([unequal(rows)] if unequal(rows) else [])
    section.sentences.extend([*pair_findings(left, right, labels), RADARS])
    everything = results([*left, *beside])
    names = [n for n in everything if competes(n)]
    for k, part in enumerate(equal_parts(names, SPREADS)):
        shown = {n: everything[n] for n in everything if n in part or n not in names}
        figure = settings_plot(shown, results(right), labels, BESIDE if BESIDE in everything else None)
        caption = (
            f"Means over parameters and seeds with {labels[0]} (green) and {labels[1]} (orange): {', '.join(part)}."
        )
        section.pictures.append(Picture(f"{section.anchor}{k}", caption, figure))
    return section


def _along(done: Sequence[Record], setting: str, title: str, what: str) -> Section:
    """Accuracy against gradient steps or rollouts; for these what was known on the way where nothing else was run."""
    section = Section(setting.replace("_", "-"), title)
    mine = [r for r in done if r.setting == setting]
    whole = bool(mine)
    if not whole and setting == "rollouts":
        mine = [r for r in done if (r.setting, r.variant) == ("direct", "in_distribution")]
        mine = mine if any(len(r.history) > 1 for r in mine) else []
    if not mine:
        return section
    tasks, variants = {r.task for r in mine}, {r.variant for r in mine}
    across = (*BASELINES, REFERENCE)
    beside = [r for r in done if r.setting == "direct" and r.estimator in across and r not in mine]
    beside = [r for r in beside if r.task in tasks and r.variant in variants]
    steps = setting == "gradient_steps"
    draw = figures.gradient_step_ablation if steps else figures.accuracy_against_rollouts
    caption = f"Mean accuracy against {what}: mean over seeds, shaded their range; dashed the prior mean"
    caption += ", dotted laplace." if steps else "." if whole else _ON_THE_WAY
    section.pictures.append(Picture(section.anchor, caption, draw([*mine, *beside])))
    if steps:
        few, many = (f([int(r.values["gradient_steps"]) for r in mine]) for f in (min, max))
        with_few, with_many = ([r for r in mine if r.values["gradient_steps"] == n] for n in (few, many))
        labels = (f"{few} gradient steps", f"{many} gradient steps")
        section.sentences.extend(pair_findings(with_few, with_many, labels))
    return section


def _sweep(done: Sequence[Record]) -> Section:
    rows = sweep_rows(done)
    searched = [row for row in rows if row.values]
    title = "Search over hyper-parameters"
    return Section("sweep", title, sweep_findings(searched), sweep=rows if searched else [])
