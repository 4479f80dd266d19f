"""The command ``sipe explain``."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sipe_bayes.cli.errors import exit_on_error

if TYPE_CHECKING:
    from sipe_bayes.core.finding_texts import Code, Severity


def explain(
    codes: Annotated[
        list[str] | None,
        typer.Argument(help="Of findings, such as not_mixed, or the folder of a run, for its own; none lists all."),
    ] = None,
) -> None:
    """What a finding of a report or of result.json means, and what to do."""
    from sipe_bayes.core.finding_advice import ADVICE
    from sipe_bayes.core.finding_texts import Code

    if not codes:
        print("\n".join(f"{code} ({code.value.severity})" for code in Code))
    with exit_on_error():
        entries = [one for name in codes or () for one in _entries(name)]
    for entry in entries:
        times = f", {entry.count} times, of which the first" if entry.count > 1 else ""
        print(f"{entry.code} ({entry.severity}{times})\n  {entry.text}\n  {ADVICE[entry.code]}")


@dataclass(frozen=True)
class _Entry:
    """A finding to explain, and how many of its code there are."""

    code: Code
    severity: Severity
    text: str
    count: int = 1


def _alone(code: Code) -> _Entry:
    from sipe_bayes.core.finding_advice import plain

    return _Entry(code, code.value.severity, plain(code))


def _entries(name: str) -> list[_Entry]:
    """Of a run's folder what it found, else of the code of that name what it means."""
    from sipe_bayes.core.files import is_folder

    if not is_folder(name):
        return [_alone(_named(name))]
    records = [Path(name) / file for file in ("result.json", "structures.json")]
    entries = _of_run(next((record for record in records if record.exists()), records[0]))
    if not entries:
        print(f"{name}: nothing was noticed")
    return entries


def _named(name: str) -> Code:
    """The code of that name."""
    from sipe_bayes.core.finding_texts import Code
    from sipe_bayes.core.validation import nearest_name

    known = {str(one): one for one in Code}
    if name.lower() not in known:
        hint = nearest_name(name, known) or "; `sipe explain` lists them"
        raise ValueError(f"CODES: expected the code of a finding, or the folder of a run, got {name!r}{hint}")
    return known[name.lower()]


def _of_run(record: Path) -> list[_Entry]:
    """What a run found, worst first, of each code the first one."""
    from pydantic import TypeAdapter

    from sipe_bayes.core.files import read_json, reading
    from sipe_bayes.core.finding_texts import Severity
    from sipe_bayes.core.findings import rank

    what, remedy = "the result of a run", "give the folder of sipe calibrate or sipe discover"
    plain = read_json(record, what, remedy)
    entries: dict[Code, _Entry] = {}
    with reading(record, what, remedy):
        for item in TypeAdapter(list[dict[str, object]]).validate_python(plain["findings"]):
            new = _Entry(_named(str(item["code"])), Severity(str(item["severity"])), str(item["text"]))
            first = entries.get(new.code)
            entries[new.code] = replace(first, count=first.count + 1) if first else new
    return sorted(entries.values(), key=lambda entry: rank(entry.code, entry.severity))
