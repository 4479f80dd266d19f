"""The unit of an actuator's number, where the model tells whether it turns or pushes, and what its command is.

What a joint is driven by is a torque at a hinge, a force at a slide. A servo whose gain is minus its bias_position
compares its command with the position, one whose gain is minus its bias_velocity with the velocity. Of all else (a
tendon, a site, a motor whose command may be volts) the words stay: ``force``, ``command``.
"""

from __future__ import annotations

import mujoco
import numpy as np

from sipe_bayes.envs.laws.base import SINGLE

_AT_HINGE = {"force": "N m", "position": "rad", "velocity": "rad/s"}
_AT_SLIDE = {"force": "N", "position": "m", "velocity": "m/s"}
_JOINTS = (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT))
_INTEGRATOR = int(mujoco.mjtDyn.mjDYN_INTEGRATOR)


def actuator_unit(model: mujoco.MjModel, actuator: int, words: str) -> str:
    """``words`` such as ``force/velocity`` in the units of the joint that an actuator drives by itself.

    Args:
        model: that has the actuator.
        actuator: its number.
        words: the unit as it is of any actuator.

    Returns:
        ``N m s/rad`` of ``force/velocity`` at a hinge; what the model does not tell stays a word.
    """
    joint = int(model.actuator_trnid[actuator, 0])
    if int(model.actuator_trntype[actuator]) not in _JOINTS or int(model.jnt_type[joint]) not in SINGLE:
        return words
    hinge = int(model.jnt_type[joint]) == int(mujoco.mjtJoint.mjJNT_HINGE)
    known = _AT_HINGE if hinge else _AT_SLIDE
    top, slash, bottom = words.partition("/")
    if bottom == "command":
        bottom = _compared(model, actuator)
    elif words == "command" and int(model.actuator_dyntype[actuator]) != _INTEGRATOR:
        top = _compared(model, actuator)
    top = known.get(top, top)
    if bottom == "velocity":
        return f"{top} s/{known['position']}"
    if bottom == "force":
        return f"{top}/({known['force']})" if hinge else f"{top}/{known['force']}"
    return top + slash + bottom.replace("position", known["position"])


def _compared(model: mujoco.MjModel, actuator: int) -> str:
    """What a servo's command, or the integral of it, is compared with; ``command`` where it is no servo."""
    fixed = int(model.actuator_gaintype[actuator]) == int(mujoco.mjtGain.mjGAIN_FIXED)
    affine = int(model.actuator_biastype[actuator]) == int(mujoco.mjtBias.mjBIAS_AFFINE)
    gain = float(model.actuator_gainprm[actuator, 0])
    if not (fixed and affine and gain):
        return "command"
    _, of_position, of_velocity = model.actuator_biasprm[actuator, :3].tolist()
    if np.isclose(gain, -of_position):
        return "position"
    return "velocity" if not of_position and np.isclose(gain, -of_velocity) else "command"
