"""What mujoco-warp does not simulate, or not as MuJoCo does: refused by name, with the processor as remedy."""

from __future__ import annotations

import mujoco
import numpy as np

from sipe_bayes.envs.base import Environment
from sipe_bayes.simulation.engine import Engine

_CONTROLS = int(mujoco.mjtState.mjSTATE_CTRL) | int(mujoco.mjtState.mjSTATE_QFRC_APPLIED)


class Unsupported(ValueError):
    """A model that a GPU can not simulate; the message names what, and the remedy."""

    def __init__(self, what: str) -> None:
        super().__init__(f"device: {what}; leave device out, which simulates on the processor")


def check_supported(environment: Environment, engine: Engine) -> None:
    """Raise Unsupported for what is simulated on the processor alone.

    What mujoco-warp itself refuses comes when the model is put on the device.
    """
    model = engine.model
    if environment.stepwise:
        raise Unsupported(
            f"the control of {_name(environment)} has a memory and is computed on the processor between control steps"
        )
    if environment.added:
        raise Unsupported("masses that are added in single logs are written on the processor")
    if engine.firmware:
        raise Unsupported("controllers sampled by firmware are stepped on the processor")
    if engine.laws:
        names = sorted({type(bound.law).__name__ for bound in engine.laws.laws})
        raise Unsupported(f"laws that MJCF has no element for ({', '.join(names)}) are stepped on the processor")
    if environment.control_spec & ~_CONTROLS:
        raise Unsupported("only controls and applied forces are streamed, not mocap bodies")
    if model.nplugin:
        raise Unsupported("mujoco-warp has no plugins, and the model uses some")
    pid = int(mujoco.mjtGain.mjGAIN_PID)
    for index in range(model.nactuator):
        if int(model.actuator_gaintype[index]) == pid:
            name = mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_ACTUATOR, index) or str(index)
            raise Unsupported(f"mujoco-warp has no pid actuators, and {name!r} is one")
    if joined(model) and int(model.opt.integrator) == int(mujoco.mjtIntegrator.mjINT_RK4):
        raise Unsupported(
            "between the stages of a Runge-Kutta step mujoco-warp takes old velocities for connect and weld "
            'constraints; or give the model integrator="implicitfast"'
        )
    if int(model.opt.solver) == int(mujoco.mjtSolver.mjSOL_PGS):
        raise Unsupported('mujoco-warp has no PGS solver, which the model asks for; or give it solver="Newton"')


def joined(model: mujoco.MjModel) -> bool:
    """Whether the model has constraints that join bodies (connect, weld)."""
    kinds = (mujoco.mjtEq.mjEQ_CONNECT, mujoco.mjtEq.mjEQ_WELD)
    return bool(np.isin(model.eq_type, [int(kind) for kind in kinds]).any())


def _name(environment: Environment) -> str:
    return getattr(environment, "name", "") or type(environment).__name__
