"""Logs as tables of every format, and the configuration that reads one."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from hypothesis import HealthCheck, settings

from sipe_bayes.calibration.config import Config, load_config
from sipe_bayes.calibration.logs import load_log
from sipe_bayes.core.trajectory import Trajectory
from sipe_bayes.diagnostics.records import LogReport, plain

EXAMPLES = Path(__file__).parents[2] / "examples"
QUIET = settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])

TOML = """\
model = "m.xml"
window = {window}
[resample]
{resample}
[columns]
time = {{ column = "t", unit = "s" }}
[[commands]]
actuator = "motor"
column = "u"
unit = "N m"
[[measurements]]
column = "q"
target = "joint:hinge.position"
unit = "rad"
{measurements}
[[logs]]
file = "{file}"
name = "log"
{log}
[[parameters]]
name = "mass"
target = "body:rod.mass"
bounds = [0.1, 1.0]
"""
FAST = '[[measurements]]\ncolumn = "slow"\ntarget = "sensor:slow"\nunit = "1"\n'


def write(path: Path, columns: dict[str, Any]) -> None:
    """A table in the format of the path's suffix."""
    if path.suffix == ".npz":
        np.savez(path, **{k: np.asarray(v) for k, v in columns.items()})
    elif path.suffix == ".parquet":
        pd.DataFrame(columns).to_parquet(path)
    else:
        pd.DataFrame(columns).to_csv(path, index=False)


def configure(folder: Path, file: str = "log.npz", **words: str) -> Config:
    words = {"window": "0.001", "resample": "", "measurements": "", "log": "", **words}
    (folder / "m.xml").write_text("<mujoco/>")
    (folder / "run.toml").write_text(TOML.format(file=file, **words))
    return load_config(folder / "run.toml")


def load(
    folder: Path, columns: dict[str, Any] | None = None, file: str = "log.npz", **words: str
) -> tuple[Trajectory, LogReport]:
    """Write ``columns`` to a log and load it."""
    if columns is not None:
        write(folder / file, columns)
    config = configure(folder, file, **words)
    trajectory, report = load_log(config, config.logs[0])
    json.dumps(plain(report), allow_nan=False)
    return trajectory, report


def regular(n: int = 50, dt: float = 0.01) -> dict[str, Any]:
    t = np.arange(n) * dt
    return {"t": t, "u": np.cos(9 * t), "q": np.sin(7 * t)}
