"""Questions that a person can answer, where the logs do not: one for each thing that stays open with an alternative."""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
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
            factor = f", factor {reading.factor:g}" if reading.factor != 1 else ""
            now = f"as proposed: unit {reading.unit}, sign {reading.sign}{factor}"
            changes = tuple(partial(_settle, k=k, lines=lines) for lines in ((), *others))
            answers = (now, *("; ".join(lines) for lines in others))
            out.append(Choice(f"{columns}: {'; '.join(reading.doubts)}", answers, changes))
    for group in draft.together:
        text = f"{' and '.join(map(repr, group))}: sign ambiguity: flipped together they fit equally well"
        out.append(Choice(text, ("as proposed", "flipped"), (lambda d: d, partial(_flip, columns=group))))
    return out


def asked(draft: Draft, ask: Ask) -> Draft:
    """The draft with the answers."""
    for choice in choices_of(draft):
        draft = choice.drafts[ask(choice.text, choice.answers)](draft)
    return draft


def _alternatives(lines: Sequence[str]) -> list[tuple[str, ...]]:
    """Lines of TOML by alternative: each begins where a key comes again."""
    out: list[list[str]] = []
    for line in lines:
        key = line.partition(" =")[0]
        if not out or key in ("unit", "sign", "column") or any(key == own.partition(" =")[0] for own in out[-1]):
            out.append([])
        out[-1].append(line)
    return [tuple(own) for own in out]


def _settle(draft: Draft, k: int, lines: Sequence[str]) -> Draft:
    """The draft with these lines in the table of reading ``k``, and nothing open of it."""
    keys, own, readings = tomllib.loads("\n".join(lines)), draft.readings[k], list(draft.readings)
    readings[k] = replace(_with_keys(own, keys), doubts=(), instead=())
    for place, other in enumerate(draft.readings):  # a set-point is read as the position that follows it
        tied = (own.match.column, other.match.column) in draft.tied and "unit" in keys
        if tied and (own.unit, own.factor) == (other.unit, other.factor):
            readings[place] = _with_keys(other, {key: value for key, value in keys.items() if key != "sign"})
    return draft.with_readings(readings)


def _with_keys(reading: Reading, keys: dict[str, Any]) -> Reading:
    """A reading with other values of keys of its table."""
    match = replace(
        reading.match,
        columns=(str(keys["column"]),) if "column" in keys else reading.match.columns,
        quaternion=str(keys.get("quaternion", reading.match.quaternion)),
    )
    if "unit" in keys:
        zero = 0.0 if reading.ends or reading.scale.zero else reading.zero
        reading = replace(reading, ends=None, factor=1.0, zero=zero)
    numbers = {key: keys[key] for key in ("unit", "factor", "zero") if key in keys}
    return replace(reading, match=match, **numbers).turned_to(keys.get("sign", reading.sign))


def _flip(draft: Draft, columns: Sequence[str]) -> Draft:
    """The draft with the other sign of columns, and of all else that is measured of their joints."""
    joints = {r.match.target.rpartition(".")[0] for r in draft.readings if r.match.column in columns} - {""}
    turn = [r.match.column in columns or r.match.target.rpartition(".")[0] in joints for r in draft.readings]
    pairs = zip(draft.readings, turn, strict=True)
    return draft.with_readings([r.turned_to(turned(r.sign)) if own else r for r, own in pairs])
