"""Extensions with states of their own, planted at a middle size: a search over a handful of names finds each.

One log each at fixed seeds; rates over many are measured by examples/studies/discover.py.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from sipe_bayes.core.parameters import Parameter
from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.envs.mjcf import Edit
from sipe_bayes.structure import Restriction, discover
from sipe_bayes.structure.extensions.actuator.lag import FilteredCommand
from tests.problems.pendulums import log, pendulum


@dataclass(frozen=True)
class Plant:
    """An effect at the pendulum, with the names that it must be told from."""

    label: str
    sizes: dict[str, float]
    rivals: tuple[str, ...]
    edits: tuple[Edit, ...] = ()


PLANTED = [
    Plant("lag:motor", {"actuator:motor.lag": 0.05}, ("offset", "dry_friction"), (FilteredCommand("motor", 0.6),)),
]


@pytest.mark.parametrize("plant", PLANTED, ids=lambda plant: plant.label)
def test_what_is_planted_is_found_and_its_size_is_right(plant: Plant) -> None:
    extra = [Parameter(t.rpartition(".")[2], 0.0, 2 * size, targets=(t,)) for t, size in plant.sizes.items()]
    machine = pendulum(*extra, edits=plant.edits)
    recorded = log(machine, [0.6, 0.08, *plant.sizes.values()], 5)
    names = (plant.label.partition(":")[0], *plant.rivals)
    structures = discover(pendulum(), Trajectories.stack([recorded]), restriction=Restriction(only=names))
    print(structures.table())
    assert structures.best.labels == (plant.label,)
    values = np.asarray(structures.posterior_of(structures.best).values(1000))
    truth = np.array([0.6, 0.08, *plant.sizes.values()])
    print(values.mean(0), values.std(0), truth)
    assert (np.abs(values.mean(0) - truth) < 4 * values.std(0)).all()
