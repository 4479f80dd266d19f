"""A moving picture inside a page, rendered in a process of its own: where OpenGL is missing, it may end its process.

``python -m sipe_bayes.report.interactive.clips FOLDER`` is that process.
"""

from __future__ import annotations

import base64
import os
import subprocess
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import mujoco
import numpy as np

from sipe_bayes.core.files import scratch
from sipe_bayes.report.video import Motion, pictures, save
from sipe_bayes.simulation.rendering import Stage

_MODEL, _MOTION, _CLIP = "model.mjb", "motion.npz", "clip.webp"
_SECONDS, _FRAMES, _WIDTH = 8.0, 12.0, 260  # of a clip: its length, pictures a second, pixels of each machine
_PATIENCE = 120  # s that rendering may take
_OFF = ("disable", "disabled", "off", "false", "0")  # values of MUJOCO_GL that MuJoCo understands so


@dataclass(frozen=True)
class Clip:
    """An animated WebP file and what is to be seen in it; without content, why there is none."""

    text: str
    content: bytes = b""

    @property
    def source(self) -> str:
        """It inside a page."""
        return "data:image/webp;base64," + base64.b64encode(self.content).decode("ascii")


def make_clip(model: mujoco.MjModel, shown: Motion, log: str) -> Clip:
    """Render the first seconds of a log beside its simulations, or say why not.

    Args:
        model: of the machine.
        shown: what moves.
        log: its name.
    """
    backend = os.environ.get("MUJOCO_GL", "")
    if backend.lower() in _OFF:
        return Clip(f"No moving picture: MUJOCO_GL={backend}.")
    headless = sys.platform == "linux" and not os.environ.get("DISPLAY")
    environment = {**({"MUJOCO_GL": "egl"} if headless else {}), **os.environ}
    with scratch() as folder:
        mujoco.mj_saveModel(model, str(folder / _MODEL))
        _write(shown, folder / _MOTION)
        command = [sys.executable, "-m", __name__, str(folder)]
        try:
            done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=_PATIENCE)
        except subprocess.TimeoutExpired:
            return Clip(f"No moving picture: rendering took longer than {_PATIENCE} s; sipe video has time.")
        if done.returncode:
            reason = (done.stderr.strip().splitlines() or [f"exit code {done.returncode}"])[-1]
            remedy = "" if "MUJOCO_GL" in reason else "; set MUJOCO_GL to egl or osmesa, install libegl1 or libosmesa6"
            return Clip(f"No moving picture, OpenGL cannot be used here: {reason[:300]}{remedy}.")
        seconds = min(_SECONDS, float(shown.time[-1] - shown.time[0]))
        text = f"The first {seconds:.3g} s of {log}: the machine as measured in grey, "
        text += " and ".join(
            f"{label} in {colour}" for label, colour in zip(shown.simulated, ("orange", "blue"), strict=False)
        )
        text += ". Simulations start anew from the log where they jump; sipe video makes longer pictures."
        return Clip(text, (folder / _CLIP).read_bytes())


def _write(shown: Motion, path: Path) -> None:
    """Store the first seconds of what moves."""
    kept = shown.time - shown.time[0] <= _SECONDS
    labels = list(shown.simulated)
    states, signals = zip(*shown.simulated.values(), strict=True)
    np.savez(
        path,
        time=shown.time[kept],
        texts=np.array([shown.label, *labels]),
        measured=shown.measured[kept],
        signal=shown.signal[kept],
        states=np.stack(states)[:, kept],
        signals=np.stack(signals)[:, kept],
    )


def _read(path: Path) -> Motion:
    with np.load(path, allow_pickle=False) as of:
        label, *labels = of["texts"].tolist()
        simulated = dict(zip(labels, zip(of["states"], of["signals"], strict=True), strict=True))
        return Motion(of["time"], label, of["measured"], of["signal"], simulated)


def _render(folder: Path) -> None:
    stage = Stage(mujoco.MjModel.from_binary_path(str(folder / _MODEL)), _WIDTH, _WIDTH)
    shown = _read(folder / _MOTION)
    shown = replace(shown, time=shown.time - shown.time[0])
    try:
        save(pictures(stage, shown, _FRAMES, 1.0), folder / _CLIP, _FRAMES)
    finally:
        stage.close()


if __name__ == "__main__":
    _render(Path(sys.argv[1]))
