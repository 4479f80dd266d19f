"""A delay of all that one instrument measures, as a piece that a model may lack."""

from __future__ import annotations

import numpy as np
import pytest

from sipe_bayes.core.parameters import Parameter
from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.envs.channels import Channel
from sipe_bayes.envs.mjcf import MjcfEnvironment
from sipe_bayes.likelihood import Segments
from sipe_bayes.likelihood.windows import Windows
from sipe_bayes.simulation.simulator import Simulator
from sipe_bayes.structure.extension import extended, members, placements
from sipe_bayes.structure.machine import machine_of
from sipe_bayes.structure.registry import get_extension

BLIMP = """<mujoco><option timestep="0.01"/><worldbody><body name="hull" gravcomp="1"><freejoint/>
  <geom type="ellipsoid" size=".4 .2 .2" mass=".5"/><site name="nose" pos=".4 0 0"/></body></worldbody>
  <actuator><motor name="push" site="nose" gear="0 1 0 0 0 0"/></actuator>
  <sensor><framepos name="nose" objtype="site" objname="nose"/></sensor></mujoco>"""
POSE = ("hull.position", "hull.orientation")


@pytest.mark.parametrize("named", [True, False])
def test_the_pose_of_a_body_comes_late_as_a_whole(named: bool) -> None:
    """Never a part of an orientation; the numbers of a sensor together and by themselves."""
    pose = [Channel(f"body:{what}", what if named else "") for what in POSE]
    tip = [Channel(f"sensor:nose[{i}]", f"nose_{'xyz'[i]}" if named else "") for i in (0, 1)]
    mass = Parameter("mass", 0.3, 1.0, targets=("body:hull.mass",))
    environment = MjcfEnvironment.build(BLIMP, [mass], ["push"], [*pose, *tip])
    simulator, pushes = Simulator(environment, 1), np.random.default_rng(0).normal(0, 0.2, (50, 1))
    log = simulator.rollout(np.array([0.3]), pushes, simulator.default_state(), dt=0.02)[0]
    windows = Windows(Segments(), simulator, Trajectories.stack([log]))
    placed = list(placements(get_extension("sensor_delay"), machine_of(windows, np.array([0.3]), windows.no_starts())))
    orientation = [name for name in environment.channels if "orientation" in name]
    sizes = sorted(len(members(one.site)) for one in placed)
    assert sizes == [1, 1, 1, 1, 1, 2, 6]
    assert not any(members(one.site) == (name,) for one in placed for name in orientation)
    whole = max(placed, key=lambda one: len(members(one.site)))
    first, last = environment.channels[0], environment.channels[5]
    assert whole.sentence == f"a delay of the measurements {first} to {last}"
    late = extended(environment, [whole])
    sensing = late.sensing(np.array([0.5, 0.04]))
    np.testing.assert_array_equal(sensing.delay, [0.04] * 6 + [0.0] * 2)
