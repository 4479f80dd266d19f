"""A pendulum whose dry friction its model lacks: a log, a configuration, and an extension of one's own."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from sipe_bayes.core.parameters import Parameter
from sipe_bayes.envs.mjcf import Edit
from tests.problems.pendulums import DT, XML, log, pendulum

FRICTION = 0.15
CONFIG = """\
model = "pendulum.xml"
window = 1.0

[[commands]]
actuator = "motor"
column = "torque"
unit = "N m"

[[measurements]]
name = "angle"
column = "angle"
target = "joint:hinge.position"
unit = "rad"

[[logs]]
file = "log.csv"
span = [0.0, 5.0]

[[logs]]
file = "log.csv"
name = "rest"
use = "holdout"
span = [5.01, 8.0]
window = 0.5

[[parameters]]
name = "rod_mass"
target = "body:rod.mass"
bounds = [0.3, 1.0]

[[parameters]]
name = "damping"
target = "joint:hinge.damping"
bounds = [0.0, 0.2]

[structure]
only = ["dry_friction", "spring"]
"""
OWN = """\
from sipe_bayes.core.parameters import Parameter
from sipe_bayes.structure import Extension


def marked(spec):
    spec.worldbody.add_site(name="rub")


class Rub(Extension):
    name, kind, reference = "rub", "joint", "-"

    def sentence(self, site):
        return f"something that rubs at {site}"

    def parameters(self, machine, site):
        return (Parameter(f"{site}.rub", 0.0, machine.joints[site].force, targets=(f"joint:{site}.frictionloss",)),)

    def edit(self, machine, site):
        return marked
"""


def write_lacking(
    folder: Path,
    structure: str = "",
    factors: Mapping[str, float] | None = None,
    target: str = "joint:hinge.frictionloss",
    friction: float = FRICTION,
    edits: Sequence[Edit] = (),
) -> Path:
    """Model, log and configuration in a folder, and ``own.py``; returns the configuration.

    Args:
        folder: where they go.
        structure: the table of that name in place of the configuration's.
        factors: of columns, of which the configuration says nothing.
        target: that has the friction.
        friction: in N m.
        edits: of the machine's own model.
    """
    truth = pendulum(Parameter("dry", 0.0, 0.5, targets=(target,)), edits=edits)
    recorded = log(truth, [0.6, 0.05, friction], 3, steps=800, sd=0.005)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "pendulum.xml").write_text(XML)
    (folder / "own.py").write_text(OWN)
    config = CONFIG[: CONFIG.index("[structure]")] + structure if structure else CONFIG
    (folder / "config.toml").write_text(config)
    torque = np.append(recorded.actions[:, 0], 0.0)
    table = {"time": np.arange(801) * DT, "torque": torque, "angle": recorded.observations[:, 0]}
    for column, factor in (factors or {}).items():
        table[column] = factor * table[column]
    pd.DataFrame(table).to_csv(folder / "log.csv", index=False)
    return folder / "config.toml"
