"""Friction of a cable that its model lacks is told from that of the joints that it moves."""

from __future__ import annotations

import numpy as np
import pytest

from sipe_bayes.core.parameters import Parameter
from sipe_bayes.core.trajectory import Trajectories, Trajectory
from sipe_bayes.envs.mjcf import MjcfEnvironment
from sipe_bayes.simulation.simulator import Simulator
from sipe_bayes.structure import Restriction, discover
from tests.problems.tendons import FINGER

SLACK = FINGER.replace(' damping="4" frictionloss=".3"', "")
ATTRIBUTES = {"tendon_dry_friction": ("frictionloss", 0.8), "tendon_viscous_friction": ("damping", 10.0)}
RIVALS = ("dry_friction", "viscous_friction", *ATTRIBUTES)


@pytest.mark.parametrize("name", ATTRIBUTES)
def test_what_a_cable_lacks_is_told_from_what_its_joints_lack(name: str) -> None:
    attribute, size = ATTRIBUTES[name]
    mass = Parameter("mass", 0.02, 0.08, targets=("body:proximal.mass",))
    own = Parameter("own", 0.0, 2 * size, targets=(f"tendon:flexor.{attribute}",))
    channels = ["joint:mcp.position", "joint:pip.position"]
    truth, plain = (
        Simulator(MjcfEnvironment.build(SLACK, parameters, ["drive"], channels), 1)
        for parameters in ([mass, own], [mass])
    )
    time = 0.01 * np.arange(300)[:, None]
    actions = 0.8 + 0.5 * np.sin(4 * time) + 0.3 * np.sin(11 * time + 1) * (np.floor(time) % 3 > 0)
    run = truth.rollout(np.array([[1 / 3, 0.5]]), actions, truth.default_state(), 0.01)
    seen = run.observations[0] + 1e-3 * np.random.default_rng(0).standard_normal(run.observations[0].shape)
    log = Trajectory(seen, actions, 0.01, name="a", channels=truth.environment.channels)
    structures = discover(plain, Trajectories.stack([log]), restriction=Restriction(only=RIVALS))
    print(structures.table())
    assert structures.best.labels == (f"{name}:flexor",)
    value = np.asarray(structures.posterior_of(structures.best).values(1000))[:, 1]
    print(value.mean(), value.std())
    assert abs(value.mean() - size) < 4 * value.std()
