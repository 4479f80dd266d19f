"""`sipe init` on six inputs as people have them, each as a command of its own; bar: 10 s on two quiet cores.

    python tests/bench/init.py [--raw FOLDER]      # FOLDER: a recording of list cells and a file of joint names

Seconds are those of the whole command, with Python's start and the loading of the model and the logs.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2]))  # where this is run as a command
from tests.problems.forty_machines import MACHINES, written
from tests.problems.made_up_logs import KINDS, make_log

ROOT = Path(__file__).parents[2]
EXAMPLES = ROOT / "examples"


def made(folder: Path) -> dict[str, list[Path]]:
    """A two-joint arm of 20 s at 250 Hz, and an axis of 25 s at 1 kHz."""
    arm, axis = folder / "arm", folder / "axis"
    arm.mkdir(), axis.mkdir()
    make_log(arm, KINDS["arm"], 1, 0, steps=5000)
    written(axis, "encoder_1khz", replace(MACHINES["encoder_1khz"], steps=25_000))
    return {one.name: [one / "model.xml", one / "log.csv"] for one in (arm, axis)}


def table(raw: Path | None = None) -> None:
    """Print the table."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        so101 = EXAMPLES / "so101"
        inputs = {"SO-101, eight CSVs": [so101 / "so101.xml", so101 / "logs"], **made(folder)}
        inputs |= {"SO-101, raw folder": [so101 / "so101.xml", raw]} if raw else {}
        quadruped = EXAMPLES / "quadruped"
        inputs["quadruped with IMU"] = [
            quadruped / "quadruped.xml",
            quadruped / "train.csv",
            quadruped / "held_out.csv",
        ]
        inputs["50 tosses"] = [EXAMPLES / "cube" / "cube.xml", EXAMPLES / "cube" / "tosses"]
        for label, words in inputs.items():
            begun = time.perf_counter()
            out = ["--yes", "--force", "--out", str(folder / "calibrate.toml")]
            command = [sys.executable, "-m", "sipe_bayes.cli.app", "init", *map(str, words), *out]
            done = subprocess.run(command, capture_output=True, text=True, check=False)
            failed = "" if done.returncode == 0 else f"  {done.stderr[-200:]}"
            print(f"{label:22} {time.perf_counter() - begun:6.1f} s{failed}")


if __name__ == "__main__":
    given = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    given.add_argument("--raw", type=Path)
    table(given.parse_args().raw)
