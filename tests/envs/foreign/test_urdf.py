"""URDF without its meshes, and models by the names of packages."""

from __future__ import annotations

import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace

import mujoco
import pytest

from sipe_bayes.envs.foreign.load import ModelError, compile_spec, load_spec
from sipe_bayes.envs.foreign.named import model_file
from sipe_bayes.envs.foreign.urdf import notes_of

URDF = """<robot name="arm"><link name="base"/><link name="upper">
<inertial><mass value="1.5"/><inertia ixx=".01" iyy=".01" izz=".002" ixy="0" ixz="0" iyz="0"/></inertial>
<visual><geometry><mesh filename="package://arm_description/meshes/upper.dae"/></geometry></visual>
<collision><geometry><mesh filename="package://arm_description/meshes/upper.obj"/></geometry></collision>
</link><joint name="shoulder" type="revolute"><parent link="base"/><child link="upper"/><axis xyz="0 1 0"/>
<limit lower="-2" upper="2" effort="10" velocity="3"/></joint></robot>"""
CORNERS = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"


@pytest.mark.parametrize("there", [False, True])
def test_a_urdf_loads_with_and_without_its_meshes(there: bool, tmp_path: Path) -> None:
    package = tmp_path / "arm_description"
    for folder in ("urdf", "meshes"):
        (package / folder).mkdir(parents=True)
    if there:
        (package / "meshes" / "upper.obj").write_text(CORNERS)
    path = package / "urdf" / "arm.urdf"
    path.write_text(URDF)
    spec = load_spec(str(path))
    model = compile_spec(spec, str(path))
    assert model.body("upper").mass == 1.5
    assert (model.ngeom, model.nmesh) == (int(there), int(there))
    *lost, motor = notes_of(spec)
    assert '<motor name="shoulder" joint="shoulder"/>' in motor
    assert [note.split(";")[0] for note in lost] == ["meshes that are not there are left out: upper"] * (not there)


@pytest.mark.parametrize("cut", range(30, len(URDF), 60))
def test_a_urdf_that_is_cut_is_one_line(cut: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "arm.urdf").write_text(URDF[:cut])
    monkeypatch.setenv("SIPE_TRUST_MODELS", "1")  # so that it is tried here
    with pytest.raises(ModelError, match=r"arm.urdf is not valid MJCF") as caught:
        load_spec(str(tmp_path / "arm.urdf"))
    assert "\n" not in str(caught.value)


def test_an_mjcf_keeps_its_meshes(tmp_path: Path) -> None:
    (tmp_path / "m.xml").write_text('<mujoco><asset><mesh name="a" file="a.obj"/></asset></mujoco>')
    with pytest.raises(ModelError, match=r"does not compile: .*a.obj"):
        compile_spec(load_spec(str(tmp_path / "m.xml")), str(tmp_path / "m.xml"))
    assert not notes_of(mujoco.MjSpec())


def test_models_by_name(monkeypatch: pytest.MonkeyPatch) -> None:
    robot = SimpleNamespace(default_model="go2", xml=lambda entry: f"/cache/{entry}.xml")
    menagerie, descriptions = ModuleType("mujoco_menagerie"), ModuleType("robot_descriptions.go2_description")
    menagerie.get = {"unitree_go2": robot}.__getitem__  # type: ignore[attr-defined]
    descriptions.URDF_PATH = "/cache/go2.urdf"  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "mujoco_menagerie", menagerie)
    monkeypatch.setitem(sys.modules, "robot_descriptions", ModuleType("robot_descriptions"))
    monkeypatch.setitem(sys.modules, "robot_descriptions.go2_description", descriptions)
    assert model_file(Path("menagerie:unitree_go2")) == Path("/cache/go2.xml")
    for name in ("robot_descriptions:go2_description", "go2_description"):
        assert model_file(Path(name)) == Path("/cache/go2.urdf")
    for name in ("arm.xml", "C:arm", "robot_descriptions:../arm"):
        assert model_file(Path(name)) == Path(name)
    with pytest.raises(ModelError, match=r"model: menagerie:none cannot be had \(KeyError 'none'\); correct the name"):
        model_file(Path("menagerie:none"))


@pytest.mark.parametrize("package", ["menagerie:arm", "robot_descriptions:arm", "arm_description"])
def test_a_package_that_is_not_there_is_named(package: str) -> None:
    with pytest.raises(ModelError, match=r"needs the package (\w+), .*: pip install (mujoco-menagerie|robot-desc)"):
        model_file(Path(package))
