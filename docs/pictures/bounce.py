"""Draw what each parameter of a contact does to a bounce, a slide and a rest: docs/pictures/bounce.png.

python docs/pictures/bounce.py
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import matplotlib.pyplot as plt
import mujoco
import numpy as np
from matplotlib.axes import Axes

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.envs.targets import bind
from sipe_bayes.report.colours import CHAINS, STYLE

SCENE = """<mujoco><option timestep="0.0005" cone="elliptic" gravity="{x} 0 {z}"/>
  <default><geom friction="0.3 0 0" solref="0.02 0.3" solimp="0.9 0.95 0.001 0.5 2"/></default>
  <worldbody><geom name="floor" type="plane" size="5 5 .1" friction="0.01 0 0"/>
  <body name="body" pos="0 0 {height}"><freejoint/>{geom}</body></worldbody></mujoco>"""
BALL, BOX = '<geom name="body" size=".03" mass=".2"/>', '<geom name="body" type="box" size=".05 .05 .03" mass=".2"/>'
SLOPE = np.radians(12)


def ball() -> mujoco.MjModel:
    """A ball that falls by 20 cm."""
    return mujoco.MjModel.from_xml_string(SCENE.format(x=0, z=-9.81, height=0.23, geom=BALL))


def box(slope: float = 0.0) -> mujoco.MjModel:
    """A box that lies on the floor, or on a slope."""
    x, z = 9.81 * np.sin(slope), -9.81 * np.cos(slope)
    return mujoco.MjModel.from_xml_string(SCENE.format(x=x, z=z, height=0.03, geom=BOX))


@dataclass(frozen=True)
class Panel:
    """One parameter: what is varied, what is drawn of which motion.

    Args:
        attribute: of the geoms that touch, or ``impratio``.
        values: that are tried.
        unit: theirs.
        make: the scene.
        axis: of the motion that is drawn, 0 along the floor, 2 up.
        speed: m/s along the floor that it begins with.
        seconds: that are simulated.
        says: what to see.
    """

    attribute: str
    values: tuple[float, ...]
    unit: str
    make: Callable[[], mujoco.MjModel]
    axis: int
    speed: float
    seconds: float
    says: str


PANELS = (
    Panel("solref_timeconst", (0.004, 0.02, 0.06), "s", ball, 2, 0, 1.0, "longer: softer, it sinks in"),
    Panel("solref_dampratio", (0.05, 0.3, 1.0), "", ball, 2, 0, 1.0, "less: it bounces higher"),
    Panel("solimp_dmax", (0.5, 0.95, 0.999), "", ball, 2, 0, 1.0, "hardly shows in a bounce"),
    Panel("solimp_width", (0.0005, 0.005, 0.05), "m", ball, 2, 0, 1.0, "hardly shows in a bounce"),
    Panel("margin", (0.0, 0.01, 0.03), "m", ball, 2, 0, 1.0, "more: pushed from afar (both add up)"),
    Panel("friction", (0.1, 0.3, 0.6), "", box, 0, 1.0, 0.6, "more: it stops sooner"),
    Panel("impratio", (0.2, 1.0, 10.0), "", lambda: box(SLOPE), 0, 0, 0.6, "more: at rest on a slope it creeps less"),
)


def motion(panel: Panel, value: float) -> tuple[FloatArray, FloatArray]:
    """Times (n,) in s and places (n,) in mm."""
    model = panel.make()
    names = ["option.impratio"] if panel.attribute == "impratio" else [f"geom:{g}.{panel.attribute}" for g in SIDES]
    for name in names:
        bind(model, name).write(model, value)
    data, places = mujoco.MjData(model), []
    data.qvel[0] = panel.speed
    for _ in range(round(panel.seconds / model.opt.timestep)):
        mujoco.mj_step(model, data)
        places.append(1e3 * data.qpos[panel.axis])
    return model.opt.timestep * np.arange(len(places)), np.array(places)


SIDES = ("body", "floor")


def draw(axes: Axes, panel: Panel) -> None:
    """The motion with each value."""
    for value, colour in zip(panel.values, (CHAINS[4], CHAINS[0], CHAINS[1]), strict=True):
        axes.plot(*motion(panel, value), color=colour, lw=STYLE.curve, label=f"{value:g} {panel.unit}".strip())
    axes.set_title(f"{panel.attribute}\n{panel.says}", fontsize=9, loc="left")
    axes.set_xlabel("s", fontsize=8)
    axes.set_ylabel("height (mm)" if panel.axis == 2 else "way (mm)", fontsize=8)
    axes.tick_params(labelsize=8)
    axes.legend(fontsize=7, frameon=False, loc="upper right" if panel.axis == 2 else "best")
    axes.spines[["top", "right"]].set_visible(False)


def main() -> None:
    """Draw all panels."""
    figure, grid = plt.subplots(2, 4, figsize=(1.25 * STYLE.width, 5.4), layout="constrained")
    for axes, panel in zip(grid.flat, PANELS, strict=False):
        draw(axes, panel)
    grid.flat[-1].set_visible(False)
    figure.savefig(Path(__file__).parent / "bounce.png", dpi=STYLE.dpi)


if __name__ == "__main__":
    main()
