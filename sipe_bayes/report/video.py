"""A moving picture of a log beside its simulations: the machine as measured, the model as given, the calibrated model.

MuJoCo renders it, which wants a backend of OpenGL: without a screen EGL or OSMesa, named by MUJOCO_GL before MuJoCo is
imported.
"""

from __future__ import annotations

import io
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import mujoco
import numpy as np
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.trajectory import Trajectories, Trajectory
from sipe_bayes.diagnostics.evaluate import measured_starts
from sipe_bayes.likelihood.settings import Segments
from sipe_bayes.likelihood.starts import estimate_states
from sipe_bayes.likelihood.windows import Windows
from sipe_bayes.report.colours import DEFAULT, MEASURED, POSTERIOR
from sipe_bayes.simulation.simulator import Simulator

Picture = NDArray[np.uint8]
SUFFIXES = (".gif", ".webp", ".mp4")
_GHOST = 0.45  # opacity of the machine as measured
_AMBIENT = 0.5  # light from everywhere, so that colours are told apart
_ROOM = 1.15  # of the picture over what moves in it


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


def motion(
    simulator: Simulator, settings: Segments, log: Trajectory, theta: dict[str, FloatArray], channel: int, label: str
) -> Motion:
    """Simulate a log from measured starts, a new one with every window.

    Args:
        simulator: of the model.
        settings: which windows.
        log: the log.
        theta: (N,) by label.
        channel: the one whose signal is drawn.
        label: what stands beside it.
    """
    windows = Windows(replace(settings, fit=None), simulator, Trajectories.stack(log))
    starts = measured_starts(windows, np.stack(list(theta.values())))
    simulated = {}
    for name, one, start in zip(theta, theta.values(), starts, strict=True):
        result = simulator.rollout(one[None], windows.actions, windows.states(start), windows.dt, windows.names)
        own = windows.owned
        simulated[name] = (_stitched(result.states, own), _stitched(result.observations, own)[:, channel])
    return Motion(
        log.dt * np.arange(len(log) + 1, dtype=np.float64),
        label,
        estimate_states(simulator, log),
        log.observations[:, channel],
        simulated,
    )


def _stitched(values: FloatArray | None, owned: NDArray[np.bool_]) -> FloatArray:
    """Samples (T+1, K) of windows (W, L, K), each from the window that owns it."""
    if values is None:
        raise ValueError("video: the simulation recorded no states")
    return values[owned]


class Stage:
    """Renders one model in several poses at once.

    Args:
        spec: of the model; one without a sky gets a white one.
        width: of the picture, pixels.
        height: of the picture, pixels.
        camera: of the model; by default the picture holds all that moves, seen from where most is seen to move.

    Raises:
        ValueError: for an unknown camera.
        RuntimeError: where no backend of OpenGL is there.
    """

    def __init__(self, spec: mujoco.MjSpec, width: int, height: int, camera: str | None = None) -> None:
        if not any(t.type == mujoco.mjtTexture.mjTEXTURE_SKYBOX for t in spec.textures):
            sky, builtin = mujoco.mjtTexture.mjTEXTURE_SKYBOX, mujoco.mjtBuiltin.mjBUILTIN_FLAT
            spec.add_texture(name="white sky", type=sky, builtin=builtin, rgb1=[1, 1, 1], width=8, height=48)
        spec.visual.headlight.ambient = [_AMBIENT] * 3
        self.model = spec.compile()
        self.model.vis.global_.offwidth, self.model.vis.global_.offheight = width, height
        self.data = mujoco.MjData(self.model)
        cameras = [self.model.camera(i).name for i in range(self.model.ncam)]
        if camera is not None and camera not in cameras:
            raise ValueError(f"--camera {camera}: the model has {', '.join(cameras) or 'none'}; leave it out")
        self.camera: mujoco.MjvCamera | str = camera or mujoco.MjvCamera()
        try:
            self.renderer = mujoco.Renderer(self.model, height, width)
        except Exception as error:  # each backend has its own
            reason = " ".join(f"{type(error).__name__}: {error}".split())
            remedy = "set MUJOCO_GL to egl or osmesa and install libegl1 or libosmesa6"
            raise RuntimeError(f"video: OpenGL cannot be used here ({reason}); {remedy}") from None

    def frame(self, states: FloatArray) -> None:
        """Choose the view that holds all that moves in the states (F, S)."""
        if isinstance(self.camera, str):
            return
        moving = self._moving()
        places, sizes = [], self.model.geom_rbound[moving]
        for state in states[:: max(1, len(states) // 200)]:
            self._pose(state)
            places.append(self.data.geom_xpos[moving].copy())
        points = np.array(places)
        low, high = (points - sizes[:, None]).min((0, 1)), (points + sizes[:, None]).max((0, 1))
        spread, size = points.std(axis=0).sum(axis=0), high - low
        along_x = bool(spread[0] >= spread[1])  # most moves there: look along y
        mujoco.mjv_defaultFreeCamera(self.model, self.camera)
        self.camera.lookat = (low + high) / 2
        self.camera.azimuth, self.camera.elevation = 90.0 if along_x else 180.0, -12.0
        reach, depth = float(max(size[1 - along_x], size[2])), float(size[int(along_x)])
        self.camera.distance = _ROOM * reach / (2 * np.tan(np.radians(self.model.vis.global_.fovy) / 2)) + depth / 2

    def _moving(self) -> NDArray[np.intp]:
        """Geoms of bodies that are not welded to the world; all where none moves."""
        moving = np.flatnonzero(self.model.body_weldid[self.model.geom_bodyid] != 0)
        return moving if len(moving) else np.arange(self.model.ngeom)

    def _pose(self, state: FloatArray) -> None:
        self.data.qpos[:] = np.nan_to_num(state[1 : 1 + self.model.nq])
        mujoco.mj_forward(self.model, self.data)

    def draw(self, poses: list[tuple[FloatArray, str, float]]) -> Picture:
        """A picture (height, width, 3) of the machine in several (state (S,), colour, opacity).

        The first of them stands in its scene.
        """
        scene = self.renderer.scene
        for k, (state, colour, opacity) in enumerate(poses):
            self._pose(state)
            if not k:
                self.renderer.update_scene(self.data, self.camera)
                first = 0
            else:
                first = scene.ngeom
                kinds = int(mujoco.mjtCatBit.mjCAT_DYNAMIC)
                options, pert = mujoco.MjvOption(), mujoco.MjvPerturb()
                mujoco.mjv_addGeoms(self.model, self.data, options, pert, kinds, scene)
            self._paint(first, colour, opacity)
        return np.asarray(self.renderer.render(), np.uint8).copy()

    def _paint(self, first: int, colour: str, opacity: float) -> None:
        """Colour what moves among the scene's geoms from ``first`` on."""
        moving = set(self._moving().tolist())
        for i in range(first, self.renderer.scene.ngeom):
            geom = self.renderer.scene.geoms[i]
            if geom.objtype == mujoco.mjtObj.mjOBJ_GEOM and geom.objid in moving:
                geom.matid = -1
                geom.rgba[:] = [*to_rgb(colour), opacity]

    def close(self) -> None:
        """Give OpenGL's context back."""
        self.renderer.close()


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
            ghost = (shown.measured[k], MEASURED, _GHOST)
            seen = stage.draw([(states[k], colours[label], 1.0), ghost])
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
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, 1.25), ncols=3, frameon=False)
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
            imageio.mimwrite(path, [np.asarray(f) for f in frames], fps=frames_per_second, macro_block_size=2)
        except ImportError:
            raise ImportError("--out: an mp4 wants `pip install imageio-ffmpeg`; or write a .gif or .webp") from None
        return
    first, *others = frames
    settings = {"quality": 70, "method": 4} if path.suffix == ".webp" else {"optimize": True}
    duration = round(1000 / frames_per_second)
    first.save(path, save_all=True, append_images=others, duration=duration, loop=0, **settings)
