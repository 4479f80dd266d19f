"""Models that are written, compared with what was to be written."""

from __future__ import annotations

from pathlib import Path

import mujoco

from sipe_bayes.core.parameters import Parameter
from sipe_bayes.envs.export import differing_fields, write_edited
from sipe_bayes.envs.mjcf import MjcfEnvironment


def test_a_body_whose_principal_axes_may_be_any_is_written(tmp_path: Path) -> None:
    """Of a cross of two bars the file's six digits turn them; another inertia is seen all the same."""
    bars = "".join(f'<geom type="box" size=".09 .01 .005" mass="{{0}}" euler="0 0 {angle}"/>' for angle in (45, -45))
    cross = f'<mujoco><worldbody><body name="frame"><freejoint/>{bars}</body></worldbody></mujoco>'
    mass = Parameter("mass", 0.001, 1.0, targets=("body:frame.mass",))
    write_edited(
        MjcfEnvironment.build(cross.format(0.004), [mass], [], ["body:frame.position"]), tmp_path / "cross.xml"
    )
    models = [mujoco.MjModel.from_xml_string(cross.format(kg)) for kg in (0.004, 0.00401)]
    assert "the inertia of bodies" in differing_fields(*models)
