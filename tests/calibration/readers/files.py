"""Logs of those formats that ``tests.problems.log_files`` does not write."""

import json
from pathlib import Path

from sipe_bayes.calibration.readers.joined import JOINTS
from tests.problems.log_files import Table, Written


def json_file(folder: Path, table: Table) -> Written:
    """Records below a name, as BAM writes them."""
    rows = [{name: value.item() for name, value in row.items()} for row in _rows(table)]
    (folder / "log.json").write_text(json.dumps({"dt": 0.01, "motor": "mx64", "entries": rows}))
    return Written(folder / "log.json")


def joined_folder(folder: Path, table: Table) -> Written:
    """Two files with lists in their cells, as SAGE writes them."""
    root = folder / "motion"
    root.mkdir(exist_ok=True)
    (root / JOINTS).write_text("Pan\nLift\n")
    for name, word in (("control", "u"), ("state", "q")):
        lines = [f'X,{row["t"]!s},"[{-row[word]!s}, {row[word]!s}]"' for row in _rows(table)]
        (root / f"{name}.csv").write_text("\n".join(["type,timestamp,positions", *lines, ""]))
    (root / "event.csv").write_text("type,timestamp,event\nEVENT,0,START\n")
    return Written(root, {"t": "timestamp", "q": "state.positions[Lift]", "u": "control.positions[Lift]"})


OTHERS = {".json": json_file, JOINTS: joined_folder}


def _rows(table: Table) -> list[Table]:
    return [{name: values[k] for name, values in table.items()} for k in range(len(table["t"]))]
