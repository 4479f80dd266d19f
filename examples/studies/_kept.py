"""Fits of a study, one by one in a file of lines, so that an interrupted study goes on."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from sipe_bayes.benchmark.measurement import source


def fits(path: Path) -> list[dict[str, Any]]:
    """Those in a file; a line that an interruption cut off is removed.

    Raises SystemExit where other code than the present made some.
    """
    if not path.is_file():
        return []
    text = path.read_text(encoding="utf-8")
    whole = text[: text.rfind("\n") + 1]
    if whole != text:
        path.write_text(whole, encoding="utf-8")
    found = [json.loads(line) for line in whole.splitlines()]
    if any(row.get("source") != source() for row in found):
        raise SystemExit(f"{path}: holds fits that another state of the package's code made; delete it and run again")
    return found


def ensure(path: Path, which: dict[str, Any], made: Callable[[], dict[str, Any]]) -> None:
    """Make a fit that is not in the file yet, keep it and print it; which: what tells it from the others."""
    if not any(which.items() <= row.items() for row in fits(path)):
        print(json.dumps(keep(path, made())), flush=True)


def keep(path: Path, row: dict[str, Any]) -> dict[str, Any]:
    """Add a fit; returns it as it is kept."""
    path.parent.mkdir(parents=True, exist_ok=True)
    row = {**row, "source": source()}
    with path.open("a", encoding="utf-8") as file:
        file.write(json.dumps(row) + "\n")
    return row
