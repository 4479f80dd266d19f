"""A hanging arm of which the tip alone is recorded: half-second windows are led astray, longer ones lead back."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import sipe_bayes as sipe
from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.inference.laplace import Laplace, longer_windows
from sipe_bayes.likelihood import bind
from sipe_bayes.likelihood.windows import Windows

TIP, JOINTS = ["sensor:tip[0]", "sensor:tip[2]"], ["joint:shoulder.position", "joint:elbow.position"]
ARM = """<mujoco><option timestep="0.002"/><worldbody><body name="upper" pos="0 0 1">
<joint name="shoulder" axis="0 1 0" damping=".05"/>
<geom type="capsule" fromto="0 0 0 0 0 -.3" size=".02" mass=".5" contype="0" conaffinity="0"/>
<body name="lower" pos="0 0 -.3"><joint name="elbow" axis="0 1 0" damping=".03"/>
<geom type="capsule" fromto="0 0 0 0 0 -.25" size=".015" mass=".3" contype="0" conaffinity="0"/>
<site name="tip" pos="0 0 -.25"/></body></body></worldbody>
<actuator><motor name="first" joint="shoulder"/><motor name="second" joint="elbow"/></actuator>
<sensor><framepos name="tip" objtype="site" objname="tip"/></sensor></mujoco>"""
UNKNOWN = [
    sipe.Parameter("lower_mass", 0.1, 0.6, targets=("body:lower.mass",)),
    sipe.Parameter("shoulder_damping", 0.0, 0.2, targets=("joint:shoulder.damping",)),
    sipe.Parameter("elbow_damping", 0.0, 0.1, targets=("joint:elbow.damping",)),
]
SD, DT, STEPS = 1e-3, 0.01, 300


def arm_log(channels: list[str], seed: int) -> tuple[sipe.Simulator, np.ndarray, sipe.Trajectory]:
    """The simulator, a truth, and three seconds at 100 Hz from a pose that is not the reset's."""
    environment = sipe.MjcfEnvironment.build(ARM, UNKNOWN, ["first", "second"], channels)
    simulator, rng = sipe.Simulator(environment, num_threads=1), np.random.default_rng(seed)
    theta, times = rng.uniform(0.2, 0.8, 3), DT * np.arange(STEPS)
    frequency, phase = rng.uniform(0.5, 2.0, (2, 3)), rng.uniform(0, 6.28, (2, 3))
    waves = np.sin(2 * np.pi * frequency[..., None] * times + phase[..., None]).sum(1)
    actions = (np.array([[0.8], [0.3]]) * waves).T
    state = simulator.default_state()
    state[1:3] = rng.uniform(-0.4, 0.4, 2)
    motion = simulator.rollout(theta, actions[None], state[None], dt=DT).observations[0]
    return simulator, theta, sipe.Trajectory(motion + SD * rng.standard_normal(motion.shape), actions, DT)


def fit(
    simulator: sipe.Simulator, log: sipe.Trajectory, likelihood: sipe.Segments | sipe.StateSpace, theta: np.ndarray
) -> tuple[Any, float]:
    """Where the search ended, and the worst of the errors, in sds."""
    estimator = Laplace(simulator, likelihood=likelihood, seed=0)
    posterior = estimator.fit(log)
    assert estimator.state is not None
    off = np.abs(posterior.mean.numpy() - theta) / posterior.stddev.numpy()
    return estimator.state.search, float(off.max())


def test_windows_come_back() -> None:
    """From a lost search, whose optima and wild samples are gone, to one that follows the log."""
    simulator, theta, log = arm_log(TIP, seed=3)
    search, off = fit(simulator, log, sipe.Segments(), theta)
    assert search.longer
    assert not len(search.wild)
    assert all(one.sd.max() < 1.2 * SD for one in search.optima)
    assert off < 3


def test_a_chain_of_states_comes_back() -> None:
    """Its first optima explain the log by process noise; the one from longer windows is far likelier, and right."""
    simulator, theta, log = arm_log(TIP, seed=3)
    search, off = fit(simulator, log, sipe.StateSpace(), theta)
    assert search.led
    *before, last = search.optima
    assert all(one.absorbed > log.observations.size / 10 for one in before)
    assert last.evidence > max(one.evidence for one in before) + 1000
    assert last.absorbed < 0.01 * log.observations.size
    assert off < 3


def test_nothing_is_asked_where_joints_are_measured(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nor where the search is not lost."""
    monkeypatch.setattr(longer_windows, "trailed", lambda *_: pytest.fail("longer windows were fitted"))
    for channels, seed in ((JOINTS, 3), (TIP, 1)):
        simulator, theta, log = arm_log(channels, seed)
        search, off = fit(simulator, log, sipe.Segments(), theta)
        assert not search.longer
        assert off < 4


def test_windows_take_samples_back() -> None:
    """Masked by the samples of one search, then by the fewer ones of another."""
    simulator, _, log = arm_log(TIP, seed=1)
    windows = bind(sipe.Segments(), simulator, Trajectories.stack([log]))
    assert isinstance(windows, Windows)
    whole, some = windows.observed.copy(), np.array([[0, 70, 0], [0, 200, 1]])
    windows.mask(some)
    assert windows.observed.sum() == whole.sum() - 2
    windows.mask(some[1:])
    assert windows.observed.sum() == whole.sum() - 1
    windows.mask(some[:0])
    np.testing.assert_array_equal(windows.observed, whole)
    assert sum(len(one.index) for one in windows.sequences) == whole.sum()
