"""The configuration as TOML with its evidence in comments, what the terminal says of it, and a picture."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from sipe_bayes.calibration.config import load_config
from sipe_bayes.calibration.init.draft import Draft, Proposal, Reading, Row
from sipe_bayes.calibration.logs import load_log
from sipe_bayes.core.files import printed
from sipe_bayes.core.toml import to_toml
from sipe_bayes.core.units import find_unit


def toml_of(draft: Draft, command: str) -> str:
    """The whole file; command: what wrote it."""
    clock, inline = draft.clock, len(draft.logs) > 5  # which then stand on one line each
    logs = [f"    {{{', '.join(_lines(log.row()))}}}," for log in draft.logs]
    lines = [_comment(note) for note in (f"Written by: {command}", *_unused(draft), *draft.notes)]
    lines += [*map(_open, draft.doubts), "", *_lines({"model": draft.model, **draft.likelihood})]
    lines[-1] += f" # {printed(draft.window_note)}"
    lines += ["logs = [", *logs, "]"] * inline
    lines += ["", "[columns]", *map(_open, [clock.doubt] * bool(clock.doubt)), *_lines({"time": clock.row})]
    lines[-1] += f" # {printed(clock.why)}"
    lines += _lines({"episode": draft.episode} if draft.episode else {})
    lines += _lines({"names": list(draft.names)} if draft.names else {})
    blocks = [_reading("commands", reading) for reading in draft.commands]
    blocks += [_reading("measurements", reading) for reading in draft.measurements]
    blocks += [] if inline else [to_toml({"logs": [log.row()]}) for log in draft.logs]
    blocks += [_parameter(one) for one in draft.parameters]
    return "\n".join([*lines, "", *blocks])


def _lines(table: Row) -> list[str]:
    """The lines of a table, each key on one."""
    return to_toml({"row": [table]}).splitlines()[1:]


def _comment(text: str) -> str:
    return "\n".join(textwrap.wrap(printed(text), 118, initial_indent="# ", subsequent_indent="#   "))


def _open(doubt: str) -> str:
    return _comment(f"OPEN: {doubt}")


def _reading(table: str, reading: Reading) -> str:
    """A command or measurement: evidence, what is open, its keys, and what would stand there instead."""
    notes = [*map(_comment, (*reading.notes, *_of_range(reading))), *map(_open, reading.doubts)]
    instead = [f"# {printed(line)}" for line in reading.instead]
    return "\n".join([*notes, f"[[{table}]]", *_lines(reading.row()), *instead, ""])


def _of_range(reading: Reading) -> list[str]:
    """What a share of a joint's range is."""
    if reading.ends is None or reading.reach is None:
        return []
    (low, high), (first, last) = reading.reach, reading.ends if reading.sign > 0 else reading.ends[::-1]
    return [f"a share of the joint's range: {first:g} at {low:g} {reading.unit}, {last:g} at {high:g} {reading.unit}"]


def _parameter(one: Proposal) -> str:
    body = to_toml({"parameters": [one.row() | {"description": one.note}]})
    if not one.left_out:
        return body
    return _comment(f"left out: {one.left_out}") + "\n" + "".join(f"# {line}\n" for line in body.splitlines())


def summary(draft: Draft, path: str, picture: Path | None = None) -> list[str]:
    """What was found, what is open, and what to do next."""
    held = sum(max(1, len(log.episodes)) for log in draft.logs if log.use == "holdout")
    train = sum(max(1, len(log.episodes)) for log in draft.logs) - held
    about = f"{draft.seconds:.0f} s" if draft.seconds < 100 else f"{draft.seconds / 60:.0f} min"
    names = [one.name for one in draft.free]
    return [
        *_table([_said(reading) for reading in draft.readings]),
        *_unused(draft),
        f"time {draft.clock.column!r} in {draft.clock.unit}; {train} to train on, {held} held out",
        f"{len(names)} parameters: {', '.join(names)}",
        *(one.note for one in draft.free if one.name == "delay"),
        *(f"OPEN: {doubt}" for doubt in draft.open_doubts),
        *([] if picture is None else [f"columns: {picture}"]),
        f"next: sipe calibrate {path} (about {about})",
    ]


def _table(rows: Sequence[tuple[str, ...]]) -> list[str]:
    widths = [max(map(len, cells)) for cells in zip(*rows, strict=True)]
    return ["  ".join(cell.ljust(n) for cell, n in zip(row, widths, strict=True)).rstrip() for row in rows]


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


def plot_columns(draft: Draft, path: Path) -> Path:
    """Draw each matched column of the first log over time, set-points over the positions that follow them.

    Args:
        draft: of the configuration.
        path: of the configuration, which has been written.

    Returns:
        The PNG beside it.
    """
    from matplotlib.figure import Figure

    config = load_config(path)
    log, _ = load_log(config, config.logs[0])
    names = [*config.channels, *(f"command {reading.match.column}" for reading in draft.commands)]
    values = np.concatenate([log.observations, np.concatenate([log.actions, log.actions[-1:]])], axis=1)
    words = [m.unit for m in config.measurements for _ in m.channels] + [reading.unit for reading in draft.commands]
    figure = Figure(figsize=(9.0, 1.3 * max(2, len(names))), layout="constrained")
    rows = figure.subplots(len(names), sharex=True, squeeze=False)[:, 0]
    for axes, name, word, series in zip(rows, names, words, values.T, strict=True):
        axes.plot(log.dt * np.arange(len(log) + 1), series, linewidth=0.8)
        axes.set_title(f"{name} [{find_unit(word).si}]", fontsize=8, loc="left")
        axes.tick_params(labelsize=7)
    rows[-1].set_xlabel("time [s]", fontsize=8)
    target = path.with_suffix(".png")
    figure.savefig(target, dpi=110)
    return target
