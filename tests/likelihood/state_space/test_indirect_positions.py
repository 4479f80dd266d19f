"""What `StateSpace` reads off the channels before it filters.

Angles of which cosine and sine are measured, and what nothing tells.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import sipe_bayes as sipe
from sipe_bayes.core.parameters import Parameter
from sipe_bayes.core.trajectory import Trajectories, Trajectory
from sipe_bayes.inference.laplace.estimator import Laplace
from sipe_bayes.likelihood.binding import bind
from sipe_bayes.likelihood.settings import StateSpace
from sipe_bayes.simulation.simulator import Simulator


def swing(truth: np.ndarray, seed: int, steps: int = 100, level: float = 0.01) -> tuple[Simulator, Trajectory]:
    """The benchmark's Pendulum from anywhere on its circle, with its states.

    Of the angle cosine and sine are measured.
    """
    simulator, rng = Simulator(sipe.make_task("Pendulum"), num_threads=1), np.random.default_rng(seed)
    start = simulator.default_state()
    start[1:3] = rng.uniform(-np.pi, np.pi), rng.uniform(-1, 1)
    actions = 2 * np.sin(np.arange(steps)[:, None] * 0.15 + rng.uniform(0, 6)) * rng.uniform(0.3, 1)
    motion = simulator.rollout(truth, actions, start)
    assert motion.states is not None
    clean = motion.observations[0]
    noisy = clean + level * clean.std(0) * rng.standard_normal(clean.shape)
    return simulator, Trajectory(noisy, actions, motion.dt[0], motion.states[0])


def test_an_angle_is_found_from_its_cosine_and_sine() -> None:
    """Within four sds of the noise, all round the circle, without jumps; recorded states are left aside."""
    for seed in range(4):
        simulator, log = swing(np.full(3, 0.5), seed)
        chain = bind(StateSpace(), simulator, Trajectories.stack(replace(log, states=None)))
        angle, true = chain.reference[:, 1], np.asarray(log.states)[:, 1]
        turns = np.round((angle - true) / (2 * np.pi))
        np.testing.assert_array_equal(turns, turns[0])
        assert np.abs(angle - true - 2 * np.pi * turns).max() < 4 * 0.01
        assert chain.determined.all()
        assert (chain.rollouts, chain.setup_rollouts > 30) == (0, True)
        given = bind(StateSpace(), simulator, Trajectories.stack(log))
        np.testing.assert_array_equal(given.reference, chain.reference)


TIPS = """
<mujoco><option timestep="0.01" integrator="implicitfast"/><worldbody>
<body name="one"><joint name="a" axis="0 1 0" damping="0.05"/>
<geom type="capsule" fromto="0 0 0 0 0 -0.5" size="0.01" mass="0.6" contype="0" conaffinity="0"/>{rest}
</body></worldbody>
<actuator><motor name="m" joint="a"/></actuator>
<sensor><framepos name="tip" objtype="site" objname="tip"/></sensor></mujoco>"""
SECOND = """<body name="two" pos="0 0 -0.5"><joint name="b" axis="0 1 0" damping="0.05"/>
<geom type="capsule" fromto="0 0 0 0 0 -0.5"
size="0.01" mass="0.6" contype="0" conaffinity="0"/><site name="tip" pos="0 0 -0.5"/></body>"""


@pytest.mark.parametrize(("links", "seen", "indirect"), [(1, "xz", True), (1, "z", False), (2, "xz", False)])
def test_an_angle_that_is_not_unique_is_not_made_up(links: int, seen: str, indirect: bool) -> None:
    """The place of a rod's tip tells its angle.

    Its height alone leaves two, and two angles move the tip of a second rod together: there nothing is made up, and the
    search goes by the filter as before.
    """
    xml = TIPS.format(rest=SECOND if links == 2 else '<site name="tip" pos="0 0 -0.5"/>')
    unknown = [Parameter("mass", 0.3, 1.0, targets=("body:one.mass",))]
    channels = [f"sensor:tip[{'xyz'.index(axis)}]" for axis in seen]
    simulator = Simulator(sipe.MjcfEnvironment.build(xml, unknown, ["m"], channels), num_threads=1)
    start = simulator.default_state()
    start[1] = 0.4
    actions = 0.5 * np.sin(np.arange(80)[:, None] * 0.2)
    motion = simulator.rollout(np.array([0.5]), actions, start, dt=0.01)
    assert motion.states is not None
    noise = 0.001 * np.random.default_rng(0).standard_normal(motion.observations[0].shape)
    chain = bind(StateSpace(), simulator, Trajectories.stack(Trajectory(motion.observations[0] + noise, actions, 0.01)))
    assert chain.determined[0] == indirect
    if indirect:
        np.testing.assert_allclose(chain.reference[:, 1], motion.states[0, :, 1], atol=0.05)
    else:
        assert not chain.determined[: simulator.model.nv].any()
        assert (chain.reference[1:, 1] == chain.reference[0, 1]).all()


def test_what_no_channel_depends_on_stays_where_it_is() -> None:
    """The half-cheetah's place along the ground: its velocity alone is measured, and that is enough."""
    task = sipe.make_task("HalfCheetahJoints")
    simulator = Simulator(task, num_threads=1)
    log = replace(sipe.demonstrations(task, count=1, steps=20, seed=0)[0], states=None)
    chain = bind(StateSpace(), simulator, Trajectories.stack(log))
    assert (chain.reference[:, 1] == simulator.default_state()[1]).all()
    assert chain.determined.all()


def test_intervals_hold_the_truth_where_cosine_and_sine_are_measured() -> None:
    """Six logs of the Pendulum, truths from the prior.

    Of the 18 intervals of 90 % at least 13 hold the truth (right ones fail with probability 0.6 %, were they
    independent), and the inferred noise is that of the logs.
    """
    rng, covered = np.random.default_rng(5), 0
    for seed in range(6):
        theta = rng.uniform(0, 1, 3)
        simulator, log = swing(theta, 100 + seed)
        estimator = Laplace(simulator, likelihood=StateSpace(), restarts=1, candidates=4)
        low, high = estimator.fit(replace(log, states=None)).quantile([0.05, 0.95]).numpy()
        covered += int(((low <= theta) & (theta <= high)).sum())
        ratio = np.array(estimator.diagnostics["noise_sd"]) / (0.01 * log.observations.std(0))
        assert ((ratio > 0.6) & (ratio < 1.5)).all(), ratio
    print(covered)
    assert covered >= 13, covered
