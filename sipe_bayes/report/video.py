"""A moving picture of a log beside its simulations: the machine as measured, the model as given, the calibrated model.

What moves in it: `interactive.motion`. What MuJoCo needs to render it: `simulation.rendering`.
"""

from __future__ import annotations

import io
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.report.colours import DEFAULT, MEASURED, POSTERIOR
from sipe_bayes.simulation.rendering import Pose, Stage

SUFFIXES = (".gif", ".webp", ".mp4")
_GHOST = 0.45  # opacity of the machine as measured


@dataclass(frozen=True)
class Motion:
    """What moves in the picture, on one clock.

    Args:
        time: (T+1,) s.
        label: of the signal below the picture.
        measured: states (T+1, S) as the log tells them.
        signal: (T+1,) of the log.
        simulated: by label, states (T+1, S) and signal (T+1,).
    """

    time: FloatArray
    label: str
    measured: FloatArray
    signal: FloatArray
    simulated: dict[str, tuple[FloatArray, FloatArray]]


def pictures(stage: Stage, shown: Motion, frames_per_second: float, speed: float) -> Iterator[Image.Image]:
    """One picture for each frame: each simulation with the log's ghost, and the signal below with where it is."""
    every = [shown.measured, *(states for states, _ in shown.simulated.values())]
    stage.frame(np.concatenate(every))
    width, height = stage.renderer.width, stage.renderer.height
    colours = dict(zip(shown.simulated, (DEFAULT, POSTERIOR), strict=False))
    chart, ends = _chart(shown, colours, width * len(colours), max(120, height // 2))
    for now in np.arange(0.0, shown.time[-1], speed / frames_per_second):
        k = int(np.searchsorted(shown.time, now))
        page = Image.new("RGB", (chart.width, height + chart.height), "white")
        for column, (label, (states, _)) in enumerate(shown.simulated.items()):
            poses = [Pose(states[k], to_rgb(colours[label])), Pose(shown.measured[k], to_rgb(MEASURED), _GHOST)]
            seen = stage.draw(poses)
            page.paste(Image.fromarray(seen), (column * width, 0))
        page.paste(chart, (0, height))
        x = ends[0] + (ends[1] - ends[0]) * now / shown.time[-1]
        ImageDraw.Draw(page).line([(x, height + ends[2]), (x, height + ends[3])], fill="#888888", width=2)
        yield page


def _chart(
    shown: Motion, colours: dict[str, str], width: int, height: int
) -> tuple[Image.Image, tuple[float, float, float, float]]:
    """The signals over time, and where the axes lie: left, right, top, bottom in pixels."""
    figure = Figure(figsize=(width / 100, height / 100), dpi=100, layout="constrained")
    axes = figure.add_subplot()
    axes.plot(shown.time, shown.signal, color=MEASURED, lw=3, alpha=_GHOST, label="log")
    for label, (_, signal) in shown.simulated.items():
        axes.plot(shown.time, signal, color=colours[label], lw=1.4, label=label)
    axes.set(xlabel="time (s)", ylabel=shown.label, xlim=(0, shown.time[-1]))
    axes.spines[["top", "right"]].set_visible(False)
    axes.yaxis.label.set_fontsize("small")
    figure.legend(loc="outside upper center", ncols=3, frameon=False)
    buffer = io.BytesIO()
    figure.savefig(buffer)
    box = axes.get_window_extent()
    image = Image.open(buffer).convert("RGB")
    return image, (box.x0, box.x1, image.height - box.y1, image.height - box.y0)


def save(frames: Iterator[Image.Image], path: Path, frames_per_second: float) -> None:
    """Write a GIF, WebP or MP4 by the path's suffix.

    Raises:
        ValueError: for another suffix.
        ImportError: of an MP4 where imageio-ffmpeg is not installed.
    """
    if path.suffix not in SUFFIXES:
        raise ValueError(f"--out {path}: expected a name that ends in one of {', '.join(SUFFIXES)}")
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix == ".mp4":
        import imageio

        try:
            imageio.mimwrite(path, [_even(f) for f in frames], fps=frames_per_second, macro_block_size=2)
        except ImportError:
            raise ImportError(
                "--out: an mp4 wants `pip install 'sipe-bayes[video]'`; or write a .gif or .webp"
            ) from None
        return
    first, *others = frames
    settings = {"quality": 70, "method": 4} if path.suffix == ".webp" else {"optimize": True}
    duration = round(1000 / frames_per_second)
    first.save(path, save_all=True, append_images=others, duration=duration, loop=0, **settings)


def _even(frame: Image.Image) -> NDArray[np.uint8]:
    """A picture of even width and height, which is what the codec takes."""
    return np.asarray(frame, np.uint8)[: frame.height // 2 * 2, : frame.width // 2 * 2]
