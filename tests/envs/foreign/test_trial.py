"""What a model file does to MuJoCo is one line; what it includes stays in its folder; a sound one costs one process."""

from __future__ import annotations

import subprocess
import time
from pathlib import Path

import pytest

import sipe_bayes as sipe
from sipe_bayes.core.parameters import Parameter
from sipe_bayes.envs.foreign import trial
from sipe_bayes.envs.foreign.load import ModelError, compile_spec, load_spec
from sipe_bayes.simulation.simulator import Simulator
from tests.problems.swings import MODEL

MANY = "<worldbody><replicate count='100000000' offset='0 0 1'><geom size='0.1'/></replicate></worldbody>"
BODY = "<worldbody><body><joint/><geom size='.1'/></body></worldbody>"


@pytest.fixture(autouse=True)
def _limits(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(trial.TRUST_MODELS)
    monkeypatch.setenv("SIPE_MODEL_SECONDS", "1")
    monkeypatch.setenv("SIPE_MODEL_GIB", "4")


def refusal(path: Path) -> str:
    """What a model file ends in."""
    began = time.monotonic()
    with pytest.raises(ModelError) as caught:
        compile_spec(load_spec(str(path)), str(path))
    assert time.monotonic() - began < 15  # the processor may be busy; alone it takes two seconds
    text = str(caught.value)
    assert "\n" not in text
    assert str(path) in text
    return text


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (
            f'<size nuserdata="1000000000"/>{BODY}',
            "takes more than 4 GiB of memory; make it smaller, or",
        ),
        (f'<size nuser_body="2000000000"/>{BODY}', "cannot be compiled by MuJoCo within 4 GiB"),
        (MANY, "takes MuJoCo longer than 1 s for 5 steps; make"),
        (f'<option timestep="0"/>{BODY}', "expected a timestep of at least 1e-06 s, got 0; correct <option timestep>"),
    ],
)
def test_a_model_that_breaks_mujoco_is_one_line(content: str, words: str, tmp_path: Path) -> None:
    (tmp_path / "model.xml").write_text(f"<mujoco>{content}</mujoco>")
    assert words in refusal(tmp_path / "model.xml")
    assert [file.name for file in tmp_path.iterdir()] == ["model.xml"]  # no MUJOCO_LOG.TXT


def test_a_crash_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The process ends as by a fault of memory, wherever the next version has one."""
    (tmp_path / "model.xml").write_text(MODEL + "<!-- crashes -->")
    run = subprocess.run

    def crash(command: list[str], **settings: object) -> object:
        shot = "import os, signal; os.kill(os.getpid(), signal.SIGSEGV)"
        return run([command[0], "-c", shot], **settings)  # type: ignore[call-overload]

    monkeypatch.setattr(subprocess, "run", crash)
    assert "crashes MuJoCo (exit code -11); make it smaller or simpler" in refusal(tmp_path / "model.xml")


@pytest.mark.parametrize("element", ["include\n", "INCLUDE x='>'", 'include y="/>" '])
@pytest.mark.parametrize("name", ["../part.xml", "..&#47;part.xml", "{folder}/part.xml", "link.xml", "inner/up.xml"])
def test_includes_stay_in_the_folder(element: str, name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    own = tmp_path / "own"
    (own / "inner").mkdir(parents=True)
    (tmp_path / "part.xml").write_text("<mujoco><option/></mujoco>")
    (own / "link.xml").symlink_to(tmp_path / "part.xml")
    (own / "inner" / "up.xml").write_text('<mujoco><include file="../../part.xml"/></mujoco>')
    path = own / "model.xml"
    path.write_text(f'<mujoco>{BODY}<{element} file = "{name.format(folder=tmp_path)}"/></mujoco>')
    assert "from outside its folder" in refusal(path)
    if (element, name) == ("include\n", "../part.xml"):
        monkeypatch.setenv(trial.TRUST_MODELS, "1")
        load_spec(str(path))


def test_a_sound_model_is_tried_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    own = tmp_path / "model.xml"
    own.write_text(MODEL.replace("<worldbody>", '<include file="part.xml"/><worldbody>'))
    (tmp_path / "part.xml").write_text("<mujoco><option/></mujoco>")
    count, run = [0], subprocess.run

    def counted(*given: object, **settings: object) -> object:
        count[0] += 1
        return run(*given, **settings)  # type: ignore[call-overload]

    monkeypatch.setattr(subprocess, "run", counted)
    for _ in range(3):
        load_spec(str(own))
    assert count == [1]
    (tmp_path / "part.xml").write_text("<mujoco><option /></mujoco>")
    load_spec(str(own))
    assert count == [2]
    load_spec(MODEL)  # a text is its caller's own
    assert count == [2]


def test_a_control_step_of_too_many_physics_steps_is_refused() -> None:
    mass = Parameter("mass", 0.1, 1.0, targets=("body:rod.mass",))
    model, measured = MODEL.replace("0.005", "0.00001"), ["joint:hinge.position"]
    environment = sipe.MjcfEnvironment.build(model, [mass], ["motor"], measured)
    with pytest.raises(ValueError, match=r"more than 10000 physics steps of 1e-05 s; raise the model's timestep"):
        Simulator(environment, 1).physics_steps(1.0)
