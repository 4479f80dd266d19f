"""The configuration as TOML with its evidence in comments, and what the terminal says of it."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from pathlib import Path

from sipe_bayes.calibration.init.draft import Draft, Reading, Unknown
from sipe_bayes.core.files import printed
from sipe_bayes.core.toml import to_toml

_WIDTH = 118
_INLINE = 6  # logs from which they stand on one line each


def toml_of(draft: Draft, command: str) -> str:
    """The whole file; command: what wrote it."""
    notes = [f"Written by: {command}", *_unused(draft), *draft.notes]
    parts = [*map(_comment, notes), *map(_open, draft.doubts)]
    text = "\n".join(parts) + "\n\n" + to_toml({"model": draft.model, **draft.likelihood}).rstrip("\n")
    text += f" # {printed(draft.window_note)}\n"
    if len(draft.logs) >= _INLINE:
        rows = [to_toml({"row": [log.row()]}) for log in draft.logs]
        lines = ["{" + ", ".join(row.splitlines()[1:]) + "}" for row in rows]
        text += "logs = [\n" + "".join(f"    {line},\n" for line in lines) + "]\n"
    clock = draft.clock
    text += "\n[columns]\n" + "".join(f"{_open(clock.doubt)}\n" for _ in range(bool(clock.doubt)))
    text += to_toml({"row": [{"time": clock.row}]}).splitlines()[1] + f" # {printed(clock.why)}\n"
    text += f"episode = {_string(draft.episode)}\n" if draft.episode else ""
    text += to_toml({"names": list(draft.names)}) if draft.names else ""
    blocks = [_reading("commands", reading) for reading in draft.commands]
    blocks += [_reading("measurements", reading) for reading in draft.measurements]
    if len(draft.logs) < _INLINE:
        blocks += [to_toml({"logs": [log.row()]}) for log in draft.logs]
    blocks += [_unknown(unknown) for unknown in draft.unknowns]
    return text + "\n" + "\n".join(blocks)


def _string(word: str) -> str:
    return to_toml({"w": word}).split(" = ", 1)[1].rstrip("\n")


def _comment(text: str) -> str:
    return "\n".join(textwrap.wrap(printed(text), _WIDTH, initial_indent="# ", subsequent_indent="#   "))


def _open(doubt: str) -> str:
    return _comment(f"OPEN: {doubt}")


def _reading(table: str, reading: Reading) -> str:
    """A command or measurement: evidence, what is open, its keys, and what would stand there instead."""
    lines = [_comment(note) for note in (*reading.notes, *_of_range(reading))]
    lines += [_open(doubt) for doubt in reading.doubts]
    body = to_toml({table: [reading.row()]}).rstrip("\n")
    instead = [f"# {printed(line)}" for line in reading.instead]
    return "\n".join([*lines, body, *instead]) + "\n"


def _of_range(reading: Reading) -> list[str]:
    """What a share of a joint's range is."""
    if reading.ends is None or reading.reach is None:
        return []
    (low, high), (first, last) = reading.reach, reading.ends if reading.sign > 0 else reading.ends[::-1]
    return [f"a share of the joint's range: {first:g} at {low:g} {reading.unit}, {last:g} at {high:g} {reading.unit}"]


def _unknown(unknown: Unknown) -> str:
    body = to_toml({"parameters": [unknown.row() | {"description": unknown.note}]})
    if not unknown.left_out:
        return body
    return _comment(f"left out: {unknown.left_out}") + "\n" + "".join(f"# {line}\n" for line in body.splitlines())


def summary(draft: Draft, path: str, picture: Path | None = None) -> list[str]:
    """What was found, what is open, and what to do next."""
    held, train = (
        sum(max(1, len(log.episodes)) for log in draft.logs if log.use == use) for use in ("holdout", "train")
    )
    names = [unknown.name for unknown in draft.proposed]
    return [
        *_table([_said(reading) for reading in draft.readings]),
        *_unused(draft),
        f"time {draft.clock.column!r} in {draft.clock.unit}; {train} to train on, {held} held out",
        f"{len(names)} parameters: {', '.join(names)}",
        *(u.note for u in draft.proposed if u.name == "delay"),
        *(f"OPEN: {doubt}" for doubt in draft.open_doubts),
        *([] if picture is None else [f"columns: {picture}"]),
        f"next: sipe calibrate {path}{_about(draft.seconds)}",
    ]


def _table(rows: Sequence[tuple[str, ...]]) -> list[str]:
    widths = [max(map(len, cells)) for cells in zip(*rows, strict=True)]
    return ["  ".join(cell.ljust(n) for cell, n in zip(row, widths, strict=True)).rstrip() for row in rows]


def _about(seconds: float) -> str:
    if not seconds:
        return ""
    return f" (about {seconds:.0f} s)" if seconds < 100 else f" (about {seconds / 60:.0f} min)"


def _unused(draft: Draft) -> list[str]:
    left = draft.unused
    return [f"not used: {', '.join(left[:12])}{f' and {len(left) - 12} others' * (len(left) > 12)}"] if left else []


def _said(reading: Reading) -> tuple[str, ...]:
    """A row of the table: target, columns, unit, and what else."""
    sign = "-" if reading.sign < 0 else ""
    word = str(reading.scale) if reading.ends else reading.unit
    unit = f"quaternion {reading.match.quaternion}" if reading.match.quaternion else f"{sign}{word}"
    extra = [f"zero {reading.zero:.4g}"] * bool(reading.zero) + ["wraps"] * reading.wraps
    extra += ["not fitted"] * (not reading.fit)
    return reading.match.target, f"<- {', '.join(reading.match.columns)}", f"[{unit}]", ", ".join(extra)
