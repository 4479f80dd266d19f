"""A pendulum swings as fast about either of two distances from its centre of mass: both are kept, and no third one."""

from __future__ import annotations

import numpy as np
import pytest

from sipe_bayes.core.findings import Code
from sipe_bayes.core.parameters import Parameter
from sipe_bayes.core.trajectory import Trajectory
from sipe_bayes.envs.mjcf import MjcfEnvironment
from sipe_bayes.inference.laplace import Laplace
from sipe_bayes.simulation.simulator import Simulator

MODEL = """
<mujoco><option timestep="0.005" integrator="implicitfast"/><worldbody><body name="rod">
<inertial pos="0 0 -0.3" mass="1" diaginertia="0.04 0.04 0.04"/><joint name="hinge" axis="0 1 0"/>
</body></worldbody></mujoco>
"""
GYRATION = 0.2  # m, so that the centre of mass at c and at GYRATION^2 / c do the same to the period


def fitted(low: float, high: float, given: float, truth: float, restarts: int = 2) -> Laplace:
    bounds = Parameter("com", low, high, targets=("body:rod.com_z",))
    xml = MODEL.replace("-0.3", str(given))
    simulator = Simulator(MjcfEnvironment.build(xml, [bounds], [], ["joint:hinge.position"]), num_threads=1)
    start = simulator.default_state()
    start[1] = 1.0
    seen = simulator.rollout(simulator.space.normalise(np.array([truth])), np.zeros((400, 0)), start, dt=0.01)
    noise = 0.003 * np.random.default_rng(0).standard_normal(seen.observations[0].shape)
    method = Laplace(simulator, restarts=restarts)
    method.fit(Trajectory(seen.observations[0] + noise, np.zeros((400, 0)), 0.01, name="log"))
    return method


@pytest.mark.parametrize(("given", "truth"), [(-0.35, -0.1), (-0.11, -0.37)])
def test_both_are_found(given: float, truth: float) -> None:
    method = fitted(-0.5, -0.08, given, truth)
    assert method.state is not None
    estimates = sorted(method.space.values(optimum.theta)[0] for optimum in method.state.search.optima)
    np.testing.assert_allclose(estimates, sorted((truth, GYRATION**2 / truth)), rtol=0.1)
    assert Code.SEPARATE_OPTIMA in [item.code for item in method.findings]


def test_where_there_is_one_no_other_is_found() -> None:
    method = fitted(-0.5, -0.21, -0.35, -0.3)
    assert method.state is not None
    assert len(method.state.search.optima) == 1
    assert not method.findings


def test_one_start_looks_for_no_other() -> None:
    method = fitted(-0.5, -0.08, -0.35, -0.1, restarts=1)
    assert method.state is not None
    assert len(method.state.search.points) == 1
