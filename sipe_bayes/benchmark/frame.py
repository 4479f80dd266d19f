"""The frame around a cell's measurement: a blank record of its kind, and whatever happens meanwhile as files and a line."""

from __future__ import annotations

import hashlib
import time
import traceback
import warnings
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, TypeVar

from sipe_bayes.benchmark.cells import Cell
from sipe_bayes.benchmark.executors.work import Done
from sipe_bayes.benchmark.records import Record

R = TypeVar("R", bound=Record)
Files = tuple[tuple[str, bytes], ...]
_PACKAGES = ("sipe-bayes", "mujoco", "numpy", "scipy", "torch", "sbi", "botorch")


def versions() -> dict[str, str]:
    """Of this package and those that numbers depend on, "" for one that is not installed."""
    found = {}
    for package in _PACKAGES:
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            found[package] = ""
    return found


@cache
def source() -> str:
    """A digest of this package's code: two records of one version may stem from different states of it."""
    root, found = Path(__file__).parents[1], hashlib.sha256()
    for path in sorted(root.rglob("*.py")):
        found.update(str(path.relative_to(root)).encode() + path.read_bytes())
    return found.hexdigest()[:12]


def blank(kind: type[R], cell: Cell, command: str, **more: Any) -> R:
    """A cell's record before it is measured. more: entries that its kind adds, or takes from elsewhere."""
    entries = {
        "id": cell.id,
        "task": cell.task,
        "estimator": cell.estimator,
        "setting": cell.setting,
        "variant": cell.variant,
        "seed": cell.seed,
        "budget": cell.budget,
        "steps": cell.horizon,
        "status": "done",
        "values": dict(cell.values),
        "versions": versions(),
        "checksums": {"source": source()},
        "command": command,
    }
    return kind(**{**entries, **more})


def measured(record: R, measure: Callable[[R], tuple[R, Files, str]], spent: str = "") -> Done:
    """What a cell comes to. measure: from the blank record the full one, files to be written before it, and a few words. spent: as of
    ``Done``."""
    began = time.process_time()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            full, files, line = measure(record)
    except Exception:  # a failed cell must not stop the others
        return failed(record, traceback.format_exc(), time.process_time() - began)
    return Done((*files, full.file), line, time.process_time() - began, spent=spent)


def failed(record: Record, why: str, cpu_seconds: float = 0.0) -> Done:
    """What a cell comes to that was not measured. why: a traceback, or its last line."""
    record = replace(record, status="failed", traceback=why)
    return Done((record.file,), record.failure, cpu_seconds, True)
