"""The tables and SiPE plots of the committed benchmark, from its records.

    # the records, some hours on two cores; the same command goes on
    sipe benchmark run --suite direct --out results
    sipe benchmark run --suite learned_reward --out results
    sipe benchmark run --suite gradient_steps --out results
    python examples/studies/benchmark.py                       # results/README.md and its pictures

`sipe benchmark report results` says the same and more, as a page and as a PDF.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from sipe_bayes.benchmark.report_contents import Contents, Picture, Section, contents
from sipe_bayes.benchmark.tables import Entry, Table
from sipe_bayes.core.files import write_text

OFTEN = 10  # cells
READING = (
    "Means and standard errors over seeds. Logs are free of noise; every method has its default settings but for "
    "laplace's 100 starting "
    "candidates and single steps. Bold is the best of a column where it differs from every other estimator by Welch's "
    "test at 5 % and is "
    'better than the prior and its mean; nothing is on the default variant. "Better", "worse" and "not told apart" are '
    "t-tests over seeds at 5 %."
)
RESULTS = Path(__file__).parents[2] / "results"
SHOWN = (
    "direct-in_distribution",
    "direct-default",
    "direct-out_of_distribution",
    "direct-against-learned_reward",
    "gradient-steps",
)
PICTURES = (
    *(f"direct-in_distribution-compared{k}" for k in range(2)),
    *(f"direct-in_distribution-spread{k}" for k in range(3)),
    "direct-against-learned_reward0",
    "gradient-steps",
)


def cell(entry: Entry | None) -> str:
    if entry is None:
        return ""
    mean, error = entry.texts()
    text = f"{mean} ± {error}" if error else mean
    return f"**{text}**" if entry.best else text


def rows(table: Table) -> Iterator[str]:
    yield f"\n**{table.measure.name}**: {table.measure.meaning}\n"
    yield "| | " + " | ".join(table.columns) + " |"
    yield "|---" * (len(table.columns) + 1) + "|"
    for name, entries in table.rows:
        yield f"| `{name}` | " + " | ".join(map(cell, entries)) + " |"


def drawn(picture: Picture) -> Iterator[str]:
    picture.figure.savefig(RESULTS / f"{picture.name}.png", dpi=110)
    yield f"\n![{picture.caption}]({picture.name}.png)\n\n*{picture.caption}*\n"


def section(found: Section) -> Iterator[str]:
    yield f"\n## {found.title}\n"
    yield from (f"- {sentence}" for sentence in found.sentences)
    for picture in found.pictures:
        if picture.name in PICTURES:
            yield from drawn(picture)
    for table in found.tables:
        yield from rows(table)


def warned(found: Contents) -> Iterator[str]:
    yield "\n## Warnings\n"
    yield f"What estimators said of their own fits, in at least {OFTEN} cells; # stands for a number.\n"
    yield "| estimator | warning | cells |\n|---|---|---|"
    yield from (f"| `{name}` | {text} | {times} |" for name, text, times in found.warnings if times >= OFTEN)


def page(found: Contents) -> Iterator[str]:
    yield "# The benchmark\n"
    yield f"{found.headline}. {READING}\n"
    yield from (f"- {label}: {text}" for label, text in found.facts)
    for part in found.sections:
        if part.anchor in SHOWN:
            yield from section(part)
    yield from warned(found)


def main() -> None:
    write_text(RESULTS / "README.md", "\n".join(page(contents(RESULTS))) + "\n")
    print(RESULTS / "README.md")


if __name__ == "__main__":
    main()
