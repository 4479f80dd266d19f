"""Delays below a physics step: each actuator its own, whatever the batch, also with laws; models stay as they were."""

from __future__ import annotations

import numpy as np
import pytest

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.parameters import Parameter
from sipe_bayes.envs.mjcf import MjcfEnvironment
from sipe_bayes.simulation.short_delays import ShortDelays
from sipe_bayes.simulation.simulator import Simulator

DT = 0.01
XML = f"""
<mujoco>
  <option timestep="{DT}" gravity="0 0 0"/>
  <worldbody>
    <body name="a"><joint name="a" type="slide"/><geom size=".1" mass="1" contype="0" conaffinity="0"/></body>
    <body name="b"><joint name="b" type="slide"/><geom size=".1" mass="2" contype="0" conaffinity="0"/></body>
  </worldbody>
  <actuator>
    <motor name="a" joint="a" ctrlrange="-1 1" ctrllimited="true"/>
    <motor name="b" joint="b"/>
  </actuator>
</mujoco>
"""
LATE = [Parameter(f"{name}.late", 0.0, 0.05, targets=(f"actuator:{name}.delay",)) for name in "ab"]
RUBBING = Parameter("rubbing", 0.0, 1.0, targets=("joint:b.load_friction",))


def two(*more: Parameter) -> Simulator:
    channels = ["joint:a.position", "joint:b.position"]
    return Simulator(MjcfEnvironment.build(XML, [*LATE, *more], ["a", "b"], channels), 1)


def mixed(actions: FloatArray, seconds: tuple[float, float]) -> FloatArray:
    """The commands (T, 2) that arrive as late, linear from one physics step to the next."""
    out = np.empty_like(actions)
    for k, late in enumerate(seconds):
        whole, share = divmod(late / DT, 1.0)
        padded = np.concatenate([np.zeros(int(whole) + 1), actions[:, k]])
        newer, older = padded[1 : 1 + len(actions)], padded[: len(actions)]
        out[:, k] = newer + share * (older - newer)
    return out


@pytest.mark.parametrize("more", [(), (RUBBING,)], ids=["plain", "with a law"])
def test_each_actuator_has_its_own_delay_whatever_the_batch(more: tuple[Parameter, ...]) -> None:
    """Commands beyond the limit of one are mixed before they are clipped, as MuJoCo does beyond a step."""
    simulator = two(*more)
    actions = np.random.default_rng(1).normal(size=(40, 2))
    start, rest = simulator.default_state(), [0.3] * len(more)
    delays = [(0.003, 0.0125), (0.0, 0.004), (0.009, 0.0), (0.02, 0.03), (0.0, 0.0)]
    thetas = simulator.space.normalise(np.array([[*seconds, *rest] for seconds in delays]))
    together = simulator.rollout(thetas, np.tile(actions, (len(delays), 1, 1)), start, dt=DT)
    prompt = simulator.space.normalise(np.array([0.0, 0.0, *rest]))
    for row, theta, seconds in zip(together.observations, thetas, delays, strict=True):
        expected = simulator.rollout(prompt, mixed(actions, seconds)[None], start, dt=DT)
        np.testing.assert_allclose(row, expected.observations[0], atol=1e-12)
        np.testing.assert_array_equal(row, simulator.rollout(theta, actions, start, dt=DT).observations[0])


def test_models_are_as_before_also_where_a_run_fails() -> None:
    simulator = two()
    model = simulator.environment.compile()
    model.actuator_delay[:] = 0.004, 0.02
    start, controls = np.zeros((2, simulator.default_state().shape[-1])), np.ones((2, 3, 2))

    def failing(*_: object) -> tuple[FloatArray, FloatArray]:
        np.testing.assert_array_equal(model.actuator_delay, [0.0, 0.02])
        raise RuntimeError("no more")

    with pytest.raises(RuntimeError, match="no more"):
        ShortDelays(model).advance(failing, [model, model], start, controls, 0, False)
    np.testing.assert_array_equal(model.actuator_delay, [0.004, 0.02])


def test_of_models_without_a_history_nothing_is_asked() -> None:
    assert ShortDelays(two().environment.compile())
    mass = Parameter("mass", 0.5, 2.0, targets=("body:a.mass",))
    plain = MjcfEnvironment.build(XML, [mass], ["a", "b"], ["joint:a.position"])
    assert not ShortDelays(plain.compile())
