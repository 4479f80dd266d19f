"""Questions that a person can answer, where the logs do not: one for each thing that stays open with an alternative."""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

from sipe_bayes.calibration.init.draft import Draft, Reading, turned

Ask = Callable[[str, Sequence[str]], int]
"""Shows a question and its answers, the default first, and returns the number of the one that is given."""


@dataclass(frozen=True)
class Choice:
    """A question: its text, its answers, and what each makes of the draft."""

    text: str
    answers: tuple[str, ...]
    drafts: tuple[Callable[[Draft], Draft], ...]


def choices_of(draft: Draft) -> list[Choice]:
    """All questions of a draft."""
    out = []
    for k, reading in enumerate(draft.readings):
        others = _alternatives(reading.instead)
        if others and reading.doubts:
            columns = ", ".join(map(repr, reading.match.columns))
            answers = (f"as proposed: {_now(reading)}", *("; ".join(lines) for lines in others))
            changes = (_settled(k, ()), *(_settled(k, lines) for lines in others))
            out.append(Choice(f"{columns}: {'; '.join(reading.doubts)}", answers, changes))
    for turned_columns in draft.together:
        group = [k for k, reading in enumerate(draft.readings) if reading.match.column in turned_columns]
        names = " and ".join(map(repr, turned_columns))
        text = f"{names}: sign ambiguity: flipped together they fit equally well"
        out.append(Choice(text, ("as proposed", "flipped"), (lambda d: d, _turned(group))))
    return out


def asked(draft: Draft, ask: Ask) -> Draft:
    """The draft with the answers."""
    for choice in choices_of(draft):
        draft = choice.drafts[ask(choice.text, choice.answers)](draft)
    return draft


def _now(reading: Reading) -> str:
    return f"unit {reading.unit}, sign {reading.sign}" + (f", factor {reading.factor:g}" if reading.factor != 1 else "")


def _alternatives(lines: Sequence[str]) -> list[tuple[str, ...]]:
    """Lines of TOML by alternative: each begins where a key comes again."""
    out: list[list[str]] = []
    for line in lines:
        key = line.partition(" =")[0]
        if not out or key in [own.partition(" =")[0] for own in out[-1]] or key in ("unit", "sign", "column"):
            out.append([])
        out[-1].append(line)
    return [tuple(own) for own in out]


def _settled(k: int, lines: Sequence[str]) -> Callable[[Draft], Draft]:
    """Reading number ``k`` with these lines in its table, and nothing open."""

    def change(draft: Draft) -> Draft:
        keys, own = tomllib.loads("\n".join(lines)), draft.readings[k]
        if "unit" in keys:
            keys = {"factor": 1.0} | ({"zero": 0.0} if own.ends or own.scale.zero else {}) | keys
        sign = keys.pop("sign", own.sign)
        changed = {k: replace(own, doubts=(), instead=(), **_fields(own, dict(keys))).turned_to(sign)}
        for place, other in enumerate(draft.readings):  # a set-point is read as the position that follows it
            if (own.match.column, other.match.column) in draft.tied and "unit" in keys:
                alike = (own.unit, own.factor) == (other.unit, other.factor)
                changed |= {place: replace(other, **_fields(other, dict(keys)))} if alike else {}
        return _put(draft, changed)

    return change


def _fields(reading: Reading, keys: dict[str, Any]) -> dict[str, Any]:
    """Fields of a reading by keys of its table."""
    column = keys.pop("column", None)
    match = reading.match if column is None else replace(reading.match, columns=(str(column),))
    quaternion = keys.pop("quaternion", None)
    match = match if quaternion is None else replace(match, quaternion=str(quaternion))
    return {"match": match, "ends": None if "unit" in keys else reading.ends} | keys


def _turned(group: Sequence[int]) -> Callable[[Draft], Draft]:
    def change(draft: Draft) -> Draft:
        joints = {draft.readings[k].match.target.rpartition(".")[0] for k in group} - {""}
        felt = [k for k, r in enumerate(draft.readings) if r.match.target.rpartition(".")[0] in joints]
        return _put(draft, {k: draft.readings[k].turned_to(turned(draft.readings[k].sign)) for k in {*group, *felt}})

    return change


def _put(draft: Draft, changed: dict[int, Reading]) -> Draft:
    return draft.with_readings([changed.get(k, reading) for k, reading in enumerate(draft.readings)])
