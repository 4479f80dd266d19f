"""What counts of a benchmark's folder, shared by the tests of runs and of executors."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from sipe_bayes.benchmark.records import Record, posterior_path

TIMES = ("seconds", "cpu_seconds", "simulation_cpu_seconds", "command")


def what_counts(folder: Path) -> dict[str, Any]:
    """Records without what they took, and the bytes of their posteriors."""
    found = {r.id: {k: v for k, v in json.loads(r.to_json()).items() if k not in TIMES} for r in Record.all_in(folder)}
    return {name: (record, posterior_path(folder, name).read_bytes()) for name, record in found.items()}
