"""Pictures of a log beside its simulations and of the tasks, where a backend of OpenGL is there."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from PIL import Image

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
from gymnasium.wrappers import RenderCollection
from sipe_bayes.envs.registry import TASKS

for name in TASKS:
    env = gymnasium.make(f"sipe/{name}-v0", render_mode="rgb_array")
    env.reset(seed=0)
    first = env.render()
    for _ in range(8):
        env.step(env.action_space.high)
    later = env.render()
    assert first.shape == later.shape == (480, 480, 3), name
    assert (first != later).any() and (first < 200).any(-1).mean() > 0.003, name
    env.close()
env = RenderCollection(gymnasium.make("sipe/Pendulum-v0", render_mode="rgb_array"))
env.reset(seed=0)
env.step(env.action_space.high)
assert len(env.render()) == 2
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
