"""Links in place equal the compiled model of an edited MJCF, for every field; what is attached moves as documented."""

from __future__ import annotations

import copy
from typing import Any

import mujoco
import numpy as np
import pytest

from sipe_bayes.envs.assets import gymnasium_asset
from sipe_bayes.envs.target import TargetError
from sipe_bayes.envs.tasks.links import Links
from tests.problems.lengthened import compiled, differences, edited, read

ARM = """
<mujoco>
  <worldbody>
    <body name="upper" pos="0 0 1" quat="1 .2 0 .1">
      <joint name="shoulder" type="ball" pos="0.1 0 0.02"/>
      <geom name="upper" type="capsule" fromto="0.1 0 0 0.5 0 0.1" size="0.04"/>
      <geom name="spike" type="capsule" fromto="0.3 0.05 0.05 0.3 0.3 0.1" size="0.02"/>
      <geom name="knob" type="sphere" pos="0.3 0.34 0.11" size="0.05"/>
      <site name="mark" pos="0.52 0.05 0.1"/>
      <site name="tip" pos="0.3 0.33 0.1"/>
      <camera name="eye" pos="0 0 .3"/>
      <body name="lower" pos="0.6 0 0.15" quat="1 0 .5 0">
        <joint name="elbow" axis="0 1 0" pos="-0.1 0 0"/>
        <geom name="lower" type="capsule" pos="0.2 0 0" quat="1 0 1 0" size="0.03 0.2" density="700"/>
        <body name="weld" pos="0.45 0 0"><geom name="ball" type="sphere" size="0.06" density="2000"/></body>
      </body>
      <body name="side" pos="0.3 0.36 0.1"><joint/><geom name="side" type="capsule" size="0.02 0.1"/></body>
    </body>
  </worldbody>
  <actuator><motor joint="elbow" gear="3"/></actuator>
</mujoco>
"""
SOURCES = {
    "arm": ARM,
    "half_cheetah": str(gymnasium_asset("half_cheetah.xml")),
    "hopper": str(gymnasium_asset("hopper.xml")),
    "humanoid": str(gymnasium_asset("humanoid.xml")),
}


def named_links(model: Any) -> list[str]:
    kinds = {int(mujoco.mjtGeom.mjGEOM_CAPSULE): "length", int(mujoco.mjtGeom.mjGEOM_SPHERE): "radius"}
    return [f"link:{model.geom(g).name}.{kinds[int(t)]}" for g, t in enumerate(model.geom_type) if int(t) in kinds]


def written(model: Any, links: Links, factors: dict[str, float]) -> Any:
    """``model`` with the factors of some targets written in place."""
    for spec, factor in factors.items():
        target = links.target(spec)
        target.write(model, factor * target.value)
    links.refresh(model)
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return model


@pytest.mark.parametrize("name", SOURCES)
def test_in_place_equals_compiled(name: str) -> None:
    published, rng = compiled(read(SOURCES[name])), np.random.default_rng(0)
    links, used = Links(published), copy.copy(published)
    specs = named_links(published)
    for _ in range(8):
        factors = dict(zip(specs, rng.uniform(0.3, 1.7, len(specs)), strict=True))
        geoms = {spec.split(":")[1].split(".")[0]: factor for spec, factor in factors.items()}
        reference = compiled(edited(SOURCES[name], geoms))
        for model in (copy.copy(published), used):  # used: written to before
            found = differences(written(model, links, factors), reference)
            assert max(found.values()) < 1e-10, {k: v for k, v in found.items() if v > 1e-10}
    found = differences(written(used, links, dict.fromkeys(specs, 1.0)), published)
    assert max(found.values()) == 0, {k: v for k, v in found.items() if v > 0}


def test_some_bodies_alone() -> None:
    """Links of chosen bodies leave the mass of the others to whoever else writes it."""
    published = compiled(read(ARM))
    lower = int(published.body("lower").id)
    links, model = Links(published, [lower]), copy.copy(published)
    model.body_mass[1] = 7.0
    written(model, links, {"link:lower.length": 1.2})
    assert model.body_mass[1] == 7.0
    with pytest.raises(TargetError, match="no link 'uper'"):
        links.target("link:uper.length")


def test_what_is_attached_stays_joined() -> None:
    """Twice the length: the far joint moves by the old length along the link, offsets sideways stay."""
    published = compiled(read(ARM))
    model = written(copy.copy(published), Links(published), {"link:upper.length": 2.0})
    axis = np.array([0.4, 0, 0.1])
    start, end = model.geom_pos[0] - axis, model.geom_pos[0] + axis
    stays = np.array([0.1, 0, 0]) + (np.array([0, 0, 0.02]) @ axis / (axis @ axis)) * axis  # nearest to the shoulder
    np.testing.assert_allclose(end - stays, 2 * (np.array([0.5, 0, 0.1]) - stays), atol=1e-12)
    np.testing.assert_allclose(start - stays, 2 * (np.array([0.1, 0, 0]) - stays), atol=1e-12)
    moved = end - np.array([0.5, 0, 0.1])
    np.testing.assert_allclose(model.body_pos[2] - published.body_pos[2], moved, atol=1e-12)
    np.testing.assert_allclose(model.site_pos[0] - published.site_pos[0], moved, atol=1e-12)
    np.testing.assert_array_equal(model.cam_pos, published.cam_pos)
    np.testing.assert_array_equal(model.jnt_pos, published.jnt_pos)


BAD = [
    ("link:lowr.length", ["lowr", "lower"]),
    ("link:lower.width", ["link:lower.width", "length"]),
    ("link:lower.radius", ["capsule", "length"]),
    ("link:ball.length", ["sphere", "radius"]),
]


@pytest.mark.parametrize(("spec", "words"), BAD)
def test_wrong_targets(spec: str, words: list[str]) -> None:
    with pytest.raises(TargetError) as caught:
        Links(compiled(read(ARM))).target(spec)
    for word in words:
        assert word in str(caught.value)


def test_bodies_that_do_not_follow_from_their_geoms() -> None:
    spec = read(ARM)
    spec.geom("ball").type = mujoco.mjtGeom.mjGEOM_BOX
    spec.geom("ball").size[:] = 0.1
    model = compiled(spec)
    assert "link:ball.length" not in named_links(model)
    with pytest.raises(TargetError, match="capsules and spheres"):
        Links(model, [int(model.body("weld").id)])
    spec = read(ARM)
    spec.geom("spike").density = 3000
    with pytest.raises(TargetError, match="one density"):
        Links(compiled(spec))
