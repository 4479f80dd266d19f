"""Extensions with states of their own, planted at a middle size: a search over a handful of names finds each.

One log each at fixed seeds; rates over many are measured by examples/studies/discover.py.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest

from sipe_bayes.core.parameters import Parameter
from sipe_bayes.core.trajectory import Trajectories, Trajectory
from sipe_bayes.envs.internal.elastic import Base, Elastic, Gear, Link
from sipe_bayes.envs.mjcf import Edit, MjcfEnvironment
from sipe_bayes.simulation.simulator import Simulator
from sipe_bayes.structure import Restriction, discover
from sipe_bayes.structure.extensions.sites import FilteredCommand
from tests.problems.machines import MACHINES, environment
from tests.problems.pendulums import XML, log, pendulum


@dataclass(frozen=True)
class Plant:
    """An effect at the pendulum, with the names that it must be told from."""

    label: str
    sizes: dict[str, float]
    rivals: tuple[str, ...]
    rotor: float | None = None  # the motor's inertia, unknown too
    edits: tuple[Edit, ...] = ()


ELASTIC = Elastic(stiffest=200.0, idle=0.02, start=(0.1, 1.0))
PLANTED = [
    Plant(
        "lag:motor", {"actuator:motor.lag": 0.05}, ("offset", "dry_friction"), edits=(FilteredCommand(("motor",), 0.6),)
    ),
    Plant("dead_zone:motor", {"actuator:motor.dead_zone": 0.1}, ("direction_friction", "force_drop")),
    Plant("direction_gain:motor", {"actuator:motor.direction_gain": 0.3}, ("offset", "dead_zone", "force_drop")),
    Plant(
        "power:motor",
        {"actuator:motor.exponent": 1.6, "actuator:motor.exponent_force": 1.0},
        ("force_drop", "dead_zone"),
    ),
    Plant(
        "presliding:hinge",
        {"joint:hinge.presliding_friction": 0.15, "joint:hinge.presliding_range": 0.05},
        ("dry_friction", "quadratic_damping"),
    ),
    Plant(
        "hysteresis:hinge",
        {"joint:hinge.hysteresis_force": 0.2, "joint:hinge.hysteresis_range": 0.3},
        ("dry_friction", "spring"),
    ),
    Plant(
        "gear_compliance:hinge",
        {"joint:hinge.gear.compliance": 0.2, "joint:hinge.gear.compliance_loss": 0.01},
        ("dry_friction", "quadratic_damping"),
        0.03,
        (Gear("hinge", ELASTIC),),
    ),
    Plant(
        "link_compliance:hinge",
        {"joint:hinge.link.compliance": 0.1, "joint:hinge.link.compliance_loss": 0.01},
        ("dry_friction", "quadratic_damping"),
        0.03,
        (Link("hinge", ELASTIC),),
    ),
    Plant(
        "gear_backlash:hinge",
        {"joint:hinge.gear.play": 0.15},
        ("dry_friction", "quadratic_damping"),
        0.03,
        (Gear("hinge", ELASTIC),),
    ),
    Plant(
        "link_backlash:hinge",
        {"joint:hinge.link.play": 0.15},
        ("dry_friction", "quadratic_damping"),
        0.03,
        (Link("hinge", ELASTIC),),
    ),
]
BASE = Base("rod", ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0)), replace(ELASTIC, stiffest=2000.0, inertia=1.0, loss=0.005))


def test_a_base_that_moves_is_found() -> None:
    """One whose resonance is twice as fast as the motion: its mass and its loss show less than its compliance."""
    both = tuple(f"joint:base_{axis}.compliance" for axis in "xy")
    machine = pendulum(Parameter("give", 0.0, 0.02, targets=both), edits=(BASE,))
    recorded = log(machine, [0.6, 0.08, 0.006], 5)
    only = Restriction(only=("base_compliance", "armature"))
    structures = discover(pendulum(), Trajectories.stack([recorded]), restriction=only)
    print(structures.table())
    assert structures.best.labels == ("base_compliance:world",)
    values = np.asarray(structures.posterior_of(structures.best).values(1000))
    print(values.mean(0), values.std(0))
    truth = np.array([0.6, 0.08, 0.006, 1.0, 0.005])
    assert (np.abs(values.mean(0) - truth)[:3] < 4 * values.std(0)[:3]).all()


@pytest.mark.parametrize(
    ("label", "targets", "size", "rival", "steps"),
    [
        ("supply_sag:world", ("actuator:m1.supply_sag", "actuator:m2.supply_sag"), 0.05, "force_drop", 200),
        ("command_limit:m2", ("actuator:m2.command_limit",), 1.8, "offset", 200),
        ("mass:upper", ("body:upper.mass",), 1.3, "armature", 140),
        ("gain:m1", ("actuator:m1.gain",), 1.12, "force_drop", 200),
    ],
)
def test_what_is_planted_at_two_joints_is_found(
    label: str, targets: tuple[str, ...], size: float, rival: str, steps: int
) -> None:
    """By the forces of both together, by a set-point that is not reached, by numbers that the model has wrong."""
    machine = Simulator(environment(MACHINES["double"], [Parameter("planted", 0.0, 2 * size, targets=targets)]), 1)
    rng, time, logs = np.random.default_rng(4), np.arange(steps) * 0.01, []
    for name in ("a", "b"):
        frequencies, phases = rng.uniform(0.3, 1.5, (3, 1, 2)), rng.uniform(0, 6, (3, 1, 2))
        actions = np.sin(2 * np.pi * frequencies * time[:, None] + phases).sum(0)
        seen = machine.rollout(np.array([0.5, 0.5]), actions, machine.default_state(), 0.01).observations[0]
        seen = seen + np.array([0.005, 0.05, 0.005, 0.05]) * rng.standard_normal(seen.shape)
        logs.append(Trajectory(seen, actions, 0.01, name=name, channels=machine.environment.channels))
    plain = Simulator(environment(MACHINES["double"]), 1)
    only = Restriction(only=(label.partition(":")[0], rival))
    structures = discover(plain, Trajectories.stack(logs), restriction=only)
    print(structures.table())
    assert structures.best.labels == (label,)
    value = np.asarray(structures.posterior_of(structures.best).values(1000))[:, 1]
    print(value.mean(), value.std())
    assert abs(value.mean() - size) < 4 * value.std()


@pytest.mark.parametrize("plant", PLANTED, ids=lambda plant: plant.label)
def test_what_is_planted_is_found_and_its_size_is_right(plant: Plant) -> None:
    least = {
        target: size / 9 if target.endswith(("_range", "_loss", "exponent", "exponent_force")) else 0.0
        for target, size in plant.sizes.items()
    }
    extra = [Parameter(t.rpartition(".")[2], least[t], 2 * size, targets=(t,)) for t, size in plant.sizes.items()]
    truth = [0.6, 0.08, *([] if plant.rotor is None else [plant.rotor])]
    own = [Parameter("rotor", 0.0, 0.1, targets=("joint:hinge.armature",))][: len(truth) - 2]
    machine, truth = pendulum(*own, *extra, edits=plant.edits), [*truth, *plant.sizes.values()]
    recorded = log(machine, truth, 5, steps=300)
    names = (plant.label.partition(":")[0], *plant.rivals)
    structures = discover(pendulum(*own), Trajectories.stack([recorded]), restriction=Restriction(only=names))
    print(structures.table())
    assert structures.best.labels == (plant.label,)
    values = np.asarray(structures.posterior_of(structures.best).values(1000))
    print(values.mean(0), values.std(0), truth)
    error = np.abs(values.mean(0) - np.array(truth))
    assert (error < np.maximum(4 * values.std(0), 0.2 * np.array(truth))).all()


def test_a_load_that_one_log_has_is_named() -> None:
    """Not a gain that differs, nor a mass that is wrong in all of them."""
    loaded = {"empty": 0.6, "loaded": 0.9, "empty again": 0.6}
    logs = [
        log(pendulum(), [mass, 0.08], seed, steps=200, name=name) for seed, (name, mass) in enumerate(loaded.items())
    ]
    only = Restriction(only=("log_mass", "log_gain", "mass", "dry_friction"))
    damping = Parameter("damping", 0.0, 0.2, targets=("joint:hinge.damping",))
    unloaded = MjcfEnvironment.build(XML, [damping], ["motor"], ["joint:hinge.position"])
    structures = discover(Simulator(unloaded, 1), Trajectories.stack(logs), restriction=only)
    print(structures.table())
    assert structures.best.labels == ("log_mass:rod",)
    values = np.asarray(structures.posterior_of(structures.best).values(1000))[:, 1:]
    print(values.mean(0), values.std(0))
    assert (np.abs(values.mean(0) - [*loaded.values()]) < 4 * values.std(0)).all()


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize(
    ("label", "target", "edits"),
    [
        ("lag:motor", "actuator:motor.lag", (FilteredCommand(("motor",), 0.6),)),
        ("sensor_filter:joint:hinge.position", "sensor:joint:hinge.position.filter", ()),
    ],
)
def test_a_lag_of_the_command_is_told_from_one_of_the_sensor(
    label: str, target: str, edits: tuple[Edit, ...], seed: int
) -> None:
    """Neither pays for its windows' starts what the other does not."""
    machine = pendulum(Parameter("own", 0.0, 0.2, targets=(target,)), edits=edits)
    recorded = Trajectories.stack([log(machine, [0.6, 0.08, 0.05], seed)])
    structures = discover(pendulum(), recorded, restriction=Restriction(only=("lag", "sensor_filter")))
    print(structures.table())
    assert structures.best.labels == (label,)
