"""Pictures of a log beside its simulations and of the tasks, where a backend of OpenGL is there."""

from __future__ import annotations

import io
import os
import subprocess
import sys
from pathlib import Path

import mujoco
import numpy as np
import pytest
from PIL import Image

from sipe_bayes.report.interactive import clips
from sipe_bayes.report.page import render
from sipe_bayes.report.video import Motion
from tests.problems.calibrations import Page, make_calibration

ROOT = Path(__file__).parents[2]
TRY = "import mujoco; mujoco.Renderer(mujoco.MjModel.from_xml_string('<mujoco/>'), 8, 8)"
XML = """
<mujoco>
  <option timestep="0.002"/>
  <worldbody>
    <body>
      <joint name="hinge" axis="0 1 0"/>
      <geom name="rod" type="capsule" fromto="0 0 0 0 0 -0.4" size="0.03" mass="0.5" rgba="0 1 0 1"/>
    </body>
  </worldbody>
  <actuator><motor name="motor" joint="hinge"/></actuator>
</mujoco>
"""
PENDULUM = """
import numpy as np
import torch
import sipe_bayes as sipe
from pathlib import Path

Path("model.xml").write_text({xml!r})
time = np.arange(60) / 100
angle = 1.2 * np.sin(3 * time)
rows = [f"{{t}},0,{{q}}" for t, q in zip(time, angle)]
Path("log.csv").write_text("\\n".join(["time,torque,angle", *rows]))
Path("c.toml").write_text('''
model = "model.xml"
window = 0.3
[[commands]]
actuator = "motor"
column = "torque"
unit = "N m"
[[measurements]]
column = "angle"
target = "joint:hinge.position"
unit = "rad"
[[logs]]
file = "log.csv"
[[parameters]]
name = "damping"
target = "joint:hinge.damping"
bounds = [0.0, 5.0]
''')
problem = sipe.prepare("c.toml")
sipe.Dirac(torch.tensor([1.0]), problem.environment.space).save("posterior")

import sys
from sipe_bayes.cli.app import main

for more in (["--width", "120", "--fps", "20", "--out", "out.gif"], ["--camera", "x"], ["--log", "x"]):
    sys.argv = ["sipe", "video", "c.toml", "--posterior", "posterior", *more]
    try:
        main()
    except SystemExit as end:
        print("code", end.code)
"""
TASKS = """
import sys
import gymnasium, numpy as np, sipe_bayes
from gymnasium.wrappers import RecordVideo
from pathlib import Path
from sipe_bayes.envs.registry import TASKS

for name in TASKS:
    plain = gymnasium.make(f"sipe/{name}-v0", render_mode="rgb_array")
    env = RecordVideo(plain, "videos", episode_trigger=lambda _: True, name_prefix=name, disable_logger=True)
    env.reset(seed=0)
    for _ in range(2):
        env.step(env.action_space.high)
    first, *_, later = env.recorded_frames
    env.close()
    assert first.shape == later.shape == (480, 480, 3), name
    assert (first != later).any() and (first < 200).any(-1).mean() > 0.003, name
    assert Path(f"videos/{name}-episode-0.mp4").stat().st_size > 2000, name
assert len(TASKS) == len(list(Path("videos").glob("*.mp4"))) == 13
assert sipe_bayes.make("Pendulum").render() is None
"""


def run(command: list[str], folder: Path) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "MUJOCO_GL": "egl", "OMP_NUM_THREADS": "1"}
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)


@pytest.fixture(scope="module")
def opengl(tmp_path_factory: pytest.TempPathFactory) -> None:
    if run([sys.executable, "-c", TRY], tmp_path_factory.mktemp("gl")).returncode:
        pytest.skip("no EGL here")


@pytest.mark.usefixtures("opengl")
def test_the_log_and_both_models_are_seen(tmp_path: Path) -> None:
    """The calibrated model is too damped to fall: grey and blue part, and each window begins together."""
    done = run([sys.executable, "-c", PENDULUM.format(xml=XML)], tmp_path)
    assert done.returncode == 0, done.stderr
    assert [line for line in done.stdout.splitlines() if "code" in line] == ["code 0", "code 2", "code 2"]
    camera, log = (line for line in done.stderr.splitlines() if line.startswith("sipe: "))
    assert "the model has none" in camera
    assert "expected one of log" in log
    with Image.open(tmp_path / "out.gif") as film:
        assert film.n_frames == 12
        assert film.size == (240, 240)
        film.seek(5)
        pixels = [film.convert("RGB").getpixel((x, y)) for x in range(240) for y in range(120)]
    assert sum(r > b + 60 for r, _, b in pixels) > 100  # orange, the model as given
    assert sum(b > r + 60 for r, _, b in pixels) > 100  # blue, the calibrated one
    assert sum(max(p) < 120 for p in pixels) > 100  # the log's ghost


def shown(labels: tuple[str, ...] = ("model as given", "calibrated")) -> Motion:
    """A swing of 20 s; both simulations lag behind."""
    time = np.arange(0, 20, 0.02)
    states = {lag: np.stack([time, np.sin(time - lag), np.cos(time - lag)], 1) for lag in (0.0, 0.5, 0.2)}
    simulated = {label: (states[lag], states[lag][:, 1]) for label, lag in zip(labels, (0.5, 0.2), strict=True)}
    return Motion(time, "angle [rad]", states[0.0], states[0.0][:, 1], simulated)


@pytest.mark.usefixtures("opengl")
def test_a_clip_for_the_report(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MUJOCO_GL", "egl")
    monkeypatch.setattr(clips, "_SECONDS", 1.0)
    clip = clips.make_clip(mujoco.MjModel.from_xml_string(XML), shown(), "<log>")
    assert "first 1 s of <log>" in clip.text
    with Image.open(io.BytesIO(clip.content)) as film:
        assert (film.format, film.n_frames) == ("WEBP", 12)
        film.seek(11)
        pixels = np.asarray(film.convert("RGB"), int)[:260]
    red, _, blue = np.moveaxis(pixels, -1, 0)
    assert (red[:, :260] > blue[:, :260] + 60).sum() > 100  # orange left, blue right
    assert (blue[:, 260:] > red[:, 260:] + 60).sum() > 100
    assert len(clip.content) < 500_000


@pytest.mark.parametrize(("backend", "words"), [("off", "MUJOCO_GL=off"), ("nonsense", "OpenGL cannot be used here")])
def test_without_opengl_the_report_says_so(monkeypatch: pytest.MonkeyPatch, backend: str, words: str) -> None:
    monkeypatch.setenv("MUJOCO_GL", backend)
    clip = clips.make_clip(mujoco.MjModel.from_xml_string(XML), shown(), "log")
    assert not clip.content
    assert words in clip.text
    page = render(make_calibration(), [], clip)
    assert words in Page(page).text
    assert 'class="clip"' not in page


@pytest.mark.usefixtures("opengl")
def test_every_task_is_drawn(tmp_path: Path) -> None:
    done = run([sys.executable, "-c", TASKS], tmp_path)
    assert done.returncode == 0, done.stderr


def test_a_backend_that_is_not_there_is_one_line(tmp_path: Path) -> None:
    command = "import os; os.environ['MUJOCO_GL'] = 'nonsense'; from sipe_bayes.cli.app import main; main()"
    done = run([sys.executable, "-c", command, "video", "c.toml", "--posterior", "posterior"], tmp_path)
    assert done.returncode == 2
    assert "OpenGL" in done.stderr
    assert done.stderr.count("\n") == 1
