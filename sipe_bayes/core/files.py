"""Files appear whole or not at all: written in the same folder under a name of their own, then renamed."""

from __future__ import annotations

import json
import math
import os
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A temporary path to write to, which becomes ``path`` at the end and is removed where something fails.

    Missing folders are made.
    """
    temporary = path.with_name(f".{path.stem}.{uuid.uuid4().hex}{path.suffix}")
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        yield temporary
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def write_bytes(path: Path, content: bytes) -> None:
    """Write a whole file."""
    with replacing(path) as temporary:
        temporary.write_bytes(content)


def write_text(path: Path, text: str) -> None:
    """Write a whole file of UTF-8."""
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


class OutputError(ValueError):
    """An output folder that cannot be used."""


def not_a_file(folder: Path) -> None:
    """Raises OutputError where the folder to write into is a file."""
    if folder.exists() and not folder.is_dir():
        raise OutputError(f"--out {folder}: is a file, not a folder; choose another name")


def installed_version(package: str) -> str:
    """Of a Python package, for the records of a run; "" where it is not installed."""
    try:
        return version(package)
    except PackageNotFoundError:
        return ""


def to_json(data: object, indent: int | None = None) -> str:
    """JSON as the standard has it: what is not a finite number becomes null."""
    return json.dumps(_finite(data), indent=indent, allow_nan=False)


def _finite(data: Any) -> Any:
    if isinstance(data, dict):
        return {key: _finite(value) for key, value in data.items()}
    if isinstance(data, list | tuple):
        return [_finite(value) for value in data]
    return None if isinstance(data, float) and not math.isfinite(data) else data
