"""A spring and a cart whose parameters mujoco.sysid can be asked for as well: models, logs, and what it finds."""

from __future__ import annotations

import contextlib
import io
from functools import cache
from types import SimpleNamespace
from typing import Any

import mujoco
import mujoco.rollout
import numpy as np

from sipe_bayes.core.arrays import FloatArray

DT, STEPS = 0.002, 1000
SPRING = 100.0, 0.5  # stiffness, damping of the truth
GEAR, MASS = 2.0, 0.8  # of the truth; only their ratio shows
NOISE = 1e-3  # m

# a model's own value is where mujoco.sysid is started, and what ours takes as the model as given
SPRING_XML = """
<mujoco><option timestep="0.002"/><worldbody><body name="block"><joint name="slide" type="slide" axis="1 0 0"
stiffness="{stiffness}" damping="{damping}"/><geom size="0.05" mass="0.1"/></body></worldbody>
<actuator><motor name="motor" joint="slide"/></actuator><sensor><jointpos name="x" joint="slide"/></sensor></mujoco>
"""
CART_XML = """
<mujoco><option timestep="0.002"/><worldbody><body name="cart"><joint name="slide" type="slide" axis="1 0 0"/>
<geom size="0.05" mass="{mass}"/></body></worldbody>
<actuator><motor name="motor" joint="slide" gear="{gear}"/></actuator>
<sensor><jointpos name="x" joint="slide"/></sensor></mujoco>
"""
SPRING_UNKNOWNS = (
    ("stiffness", "joint:slide.stiffness", 10.0, 1e6, "log"),
    ("damping", "joint:slide.damping", 0.05, 5.0, "log"),
)
CART_STARTS = ((0.5, 0.25), (0.5, 3.0), (2.0, 1.0))  # gear, mass


def cart_unknowns(scale: str) -> tuple[tuple[str, str, float, float, str], ...]:
    return ("gear", "actuator:motor.gear", 0.2, 8.0, scale), ("mass", "body:cart.mass", 0.1, 4.0, scale)


def forces(time: FloatArray) -> FloatArray:
    return np.sin(2 * np.pi * 1.3 * time) + 0.6 * np.sin(2 * np.pi * 3.1 * time + 0.4)


@cache
def log(xml: str, seed: int = 0) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Time (T+1,), force (T+1,) and position (T+1,) with white noise, from rest."""
    model = mujoco.MjModel.from_xml_string(xml)
    time = np.arange(STEPS + 1) * DT
    force = forces(time)
    state, _ = mujoco.rollout.rollout(model, mujoco.MjData(model), np.zeros(3), force[:-1, None])
    position = np.concatenate([[0.0], state[0, :, 1]])
    return time, force, position + NOISE * np.random.default_rng(seed).standard_normal(STEPS + 1)


def spring_log() -> tuple[FloatArray, FloatArray, FloatArray]:
    return log(SPRING_XML.format(stiffness=SPRING[0], damping=SPRING[1]))


def cart_log() -> tuple[FloatArray, FloatArray, FloatArray]:
    return log(CART_XML.format(gear=GEAR, mass=MASS))


def rival(xml: str, table: tuple[FloatArray, ...], unknowns: tuple[Any, ...]) -> SimpleNamespace:
    """What mujoco.sysid finds: start and value, by parameter. Raises what it raises."""
    from mujoco import sysid

    time, force, position = table
    spec = mujoco.MjSpec.from_string(xml)
    model, params = spec.compile(), sysid.ParameterDict()
    for name, target, low, high, _ in unknowns:
        start, write = _modifier(spec, target)
        params.add(sysid.Parameter(name, start, low, high, modifier=write))
    # sensordata of the state before a step carry the time after it, as mujoco.rollout returns them
    measured = sysid.TimeSeries.from_names(time[1:], position[:-1, None], model)
    state = sysid.create_initial_state(model, np.zeros(1), np.zeros(1), np.zeros(0))
    control = sysid.TimeSeries(time, force[:, None])
    sequence = sysid.ModelSequences("model", spec, "log", state, control, measured)
    residual = sysid.build_residual_fn(models_sequences=[sequence])
    start = params.as_vector()
    with contextlib.redirect_stdout(io.StringIO()):  # it reports its steps whether asked to or not
        best, _ = sysid.optimize(params, residual, verbose=False)
    return SimpleNamespace(start=start, value=best.as_vector())


def _modifier(spec: Any, target: str) -> tuple[float, Any]:
    """A parameter's value in the model and what writes it, for mujoco.sysid."""
    if target == "joint:slide.stiffness":
        return spec.joint("slide").stiffness[0], lambda s, p: s.joint("slide").stiffness.__setitem__(0, p.value[0])
    if target == "joint:slide.damping":
        return spec.joint("slide").damping[0], lambda s, p: s.joint("slide").damping.__setitem__(0, p.value[0])
    if target == "actuator:motor.gear":
        return spec.actuator("motor").gear[0], lambda s, p: s.actuator("motor").gear.__setitem__(0, p.value[0])
    return spec.geoms[0].mass, lambda s, p: setattr(s.geoms[0], "mass", p.value[0])
