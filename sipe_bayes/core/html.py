"""Tables and pages as HTML: how posteriors, spaces, logs, simulators and calibrations show themselves in a notebook."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path

from sipe_bayes.core.files import write_text

_SHOWN = 50  # rows, after which the others are counted


@dataclass(frozen=True)
class Page:
    """A whole HTML page, which a notebook shows in a frame.

    Args:
        html: its text.
    """

    html: str

    def _repr_html_(self) -> str:
        return f'<iframe srcdoc="{escape(self.html)}" style="width: 100%; height: 800px; border: 0"></iframe>'

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write it, whole or not at all."""
        write_text(Path(path), self.html)


def html_table(
    title: str, headings: Sequence[str], rows: Iterable[Sequence[object]], notes: Sequence[object] = ()
) -> str:
    """A title, a table and lines below it; every text is escaped.

    Args:
        title: above the table.
        headings: of its columns.
        rows: cells, as many as headings; of more than fifty rows the first are shown.
        notes: paragraphs below.
    """
    every = list(rows)
    lines = [f"<tr>{''.join(f'<td>{escape(str(cell))}</td>' for cell in row)}</tr>" for row in every[:_SHOWN]]
    below = [f"and {len(every) - _SHOWN} more"] * (len(every) > _SHOWN) + list(notes)
    head = "".join(f"<th>{escape(heading)}</th>" for heading in headings)
    return (
        f"<div><strong>{escape(title)}</strong><table><thead><tr>{head}</tr></thead>"
        f"<tbody>{''.join(lines)}</tbody></table>{''.join(f'<p>{escape(str(line))}</p>' for line in below)}</div>"
    )
