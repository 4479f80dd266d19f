"""Pictures of a model, by MuJoCo's renderer.

It wants a backend of OpenGL: without a screen EGL or OSMesa (Debian and Ubuntu: libegl1, libosmesa6), which the
environment variable MUJOCO_GL names before MuJoCo is imported.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from sipe_bayes.core.arrays import FloatArray

Picture = NDArray[np.uint8]
_AMBIENT = 0.5  # light from everywhere, so that colours are told apart


@dataclass(frozen=True)
class Pose:
    """A state (S,) to be drawn; with a colour (red, green, blue from 0 to 1) all that moves has it."""

    state: FloatArray
    colour: tuple[float, float, float] | None = None
    opacity: float = 1.0


def with_sky(spec: mujoco.MjSpec) -> mujoco.MjModel:
    """The model with a white sky, unless it has one of its own: without any MuJoCo paints black behind it."""
    if not any(t.type == mujoco.mjtTexture.mjTEXTURE_SKYBOX for t in spec.textures):
        sky, flat = mujoco.mjtTexture.mjTEXTURE_SKYBOX, mujoco.mjtBuiltin.mjBUILTIN_FLAT
        spec.add_texture(name="white sky", type=sky, builtin=flat, rgb1=[1, 1, 1], width=8, height=48)
    return spec.compile()


class Stage:
    """Renders one model in several poses at once.

    Args:
        model: what is drawn; a copy of it is kept.
        width: of the picture, pixels.
        height: of the picture, pixels.
        camera: of the model; by default one that stands still and looks at its middle, or as ``frame`` chooses.

    Raises:
        ValueError: for an unknown camera.
        RuntimeError: where no backend of OpenGL is there.
    """

    def __init__(self, model: mujoco.MjModel, width: int, height: int, camera: str | None = None) -> None:
        self.model = copy.copy(model)
        self.model.vis.headlight.ambient[:] = _AMBIENT
        self.model.vis.global_.offwidth, self.model.vis.global_.offheight = width, height
        self.data = mujoco.MjData(self.model)
        self.options = mujoco.MjvOption()
        hidden = model.geom_group >= 3  # by MuJoCo's default; shown where a body has no others
        if set(model.geom_bodyid[hidden]) - set(model.geom_bodyid[~hidden]):
            self.options.geomgroup[:] = 1
        self.sky = bool((model.tex_type == mujoco.mjtTexture.mjTEXTURE_SKYBOX).any())
        cameras = [self.model.camera(i).name for i in range(self.model.ncam)]
        if camera is not None and camera not in cameras:
            raise ValueError(f"--camera {camera}: the model has {', '.join(cameras) or 'none'}; leave it out")
        self.camera: mujoco.MjvCamera | str = camera or mujoco.MjvCamera()
        if not isinstance(self.camera, str):
            mujoco.mjv_defaultFreeCamera(self.model, self.camera)
        try:
            self.renderer = mujoco.Renderer(self.model, height, width)
        except Exception as error:  # each backend has its own
            reason = " ".join(f"{type(error).__name__}: {error}".split())
            remedy = "set MUJOCO_GL to egl or osmesa and install libegl1 or libosmesa6"
            raise RuntimeError(f"rendering: OpenGL cannot be used here ({reason}); {remedy}") from None

    def frame(self, states: FloatArray, room: float = 1.15) -> None:
        """Choose the view that holds all that moves in the states (F, S), with as much room around it."""
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
        self.camera.lookat = (low + high) / 2
        self.camera.azimuth, self.camera.elevation = 90.0 if along_x else 180.0, -12.0
        reach, depth = float(max(size[1 - along_x], size[2])), float(size[int(along_x)])
        self.camera.distance = room * reach / (2 * np.tan(np.radians(self.model.vis.global_.fovy) / 2)) + depth / 2

    def _moving(self) -> NDArray[np.intp]:
        """Geoms of bodies that are not welded to the world; all where none moves."""
        bodies = self.model.geom_bodyid
        moving = np.flatnonzero((self.model.body_weldid[bodies] != 0) & (self.model.body_mocapid[bodies] < 0))
        return moving if len(moving) else np.arange(self.model.ngeom)

    def _pose(self, state: FloatArray) -> None:
        self.data.qpos[:] = np.nan_to_num(state[1 : 1 + self.model.nq])
        mujoco.mj_forward(self.model, self.data)

    def draw(self, poses: Sequence[Pose]) -> Picture:
        """A picture (height, width, 3) of the machine in one pose or several; the first stands in its scene."""
        scene = self.renderer.scene
        for k, pose in enumerate(poses):
            self._pose(pose.state)
            first = scene.ngeom if k else 0
            if k:
                moving = int(mujoco.mjtCatBit.mjCAT_DYNAMIC)
                mujoco.mjv_addGeoms(self.model, self.data, self.options, mujoco.MjvPerturb(), moving, scene)
            else:
                self.renderer.update_scene(self.data, self.camera, self.options)
            if pose.colour is not None:
                self._paint(first, (*pose.colour, pose.opacity))
        picture = np.asarray(self.renderer.render(), np.uint8).copy()
        if not self.sky:
            self.renderer.enable_segmentation_rendering()
            picture[np.asarray(self.renderer.render())[:, :, 0] < 0] = 255
            self.renderer.disable_segmentation_rendering()
        return picture

    def _paint(self, first: int, colour: tuple[float, float, float, float]) -> None:
        """Colour what moves among the scene's geoms from ``first`` on."""
        moving = set(self._moving().tolist())
        for i in range(first, self.renderer.scene.ngeom):
            geom = self.renderer.scene.geoms[i]
            if geom.objtype == mujoco.mjtObj.mjOBJ_GEOM and geom.objid in moving:
                geom.matid = -1
                geom.rgba[:] = colour

    def close(self) -> None:
        """Give OpenGL's context back."""
        self.renderer.close()
