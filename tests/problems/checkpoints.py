"""What a checkpoint holds."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from safetensors import safe_open


def contents(path: Path) -> dict[str, Any]:
    """A checkpoint's arrays and numbers."""
    with safe_open(path, framework="numpy") as file:
        return {**json.loads(file.metadata()["plain"]), **{k: file.get_tensor(k) for k in file.keys()}}  # noqa: SIM118
