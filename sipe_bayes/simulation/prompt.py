"""Open loops of models with delayed commands, many times faster: the delay is applied to the commands beforehand.

MuJoCo keeps the commands that a delayed actuator still has to obey in the state, hundreds of numbers beside a dozen,
and returns them for every physics step. Where only observations are wanted, as in a likelihood, the commands are known
beforehand and are delayed once: with a delay d and steps of h seconds, u(k - d / h) acts in step k, interpolated
linearly, as MuJoCo does (``short_delays``). The model that is stepped has no history, and no contacts where the caller
knows that nothing touches.
"""

from __future__ import annotations

import mujoco
import numpy as np

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.simulation.device import Processor
from sipe_bayes.simulation.engine import Engine, Run
from sipe_bayes.simulation.model_pool import ModelPool
from sipe_bayes.simulation.short_delays import ShortDelays
from sipe_bayes.simulation.simulator import Simulator

_CONTACTS = int(mujoco.mjtDisableBit.mjDSBL_CONTACT)


class PromptSimulator(Simulator):
    """A Simulator for ``rollout`` alone, whose states end before the histories; starts are those of ``full``.

    Args:
        full: the Simulator that it stands for, which counts what is simulated.
        contacts: whether bodies may touch.
    """

    def __init__(self, full: Simulator, contacts: bool) -> None:
        self.full, self.environment, self.num_threads, self.device = full, full.environment, full.num_threads, "cpu"
        self.model, self.audit = _without_history(full), None
        self.model.opt.disableflags |= 0 if contacts else _CONTACTS
        self.engine = _PromptEngine(full.engine, self.model)
        self.runs = Processor(self.engine)
        self.pool: ModelPool = self.runs.pool()
        self.diverged = self.control_steps = 0

    @property
    def state_size(self) -> int:
        """S, of the starts."""
        return self.full.state_size

    @property
    def recorded_size(self) -> int:
        """Numbers of the states that it returns."""
        return self.engine.physics_size

    def count(self, steps: int, diverged: int) -> None:
        """Count control steps and diverged simulations."""
        self.full.count(steps, diverged)


def prompt(simulator: Simulator, contacts: bool = True) -> Simulator:
    """A faster Simulator for open loops of which only observations count; the same one where there is nothing to gain.

    Args:
        simulator: of the model.
        contacts: whether bodies may touch.
    """
    engine, model, environment = simulator.engine, simulator.model, simulator.environment
    if type(simulator) is not Simulator or simulator.device != "cpu" or environment.stepwise or environment.data_fields:
        return simulator
    buffers = sum(2 + 2 * int(model.actuator_history[b.actuator, 0]) for b in engine.short_delays.buffers)
    if engine.laws or engine.firmware or buffers != model.nhistory or not hasattr(environment, "spec"):
        return simulator
    touches = contacts or bool(model.opt.disableflags & _CONTACTS) or not model.ngeom
    return simulator if not buffers and touches else PromptSimulator(simulator, contacts)


def _without_history(full: Simulator) -> mujoco.MjModel:
    """The compiled model without command histories."""
    if not full.model.nhistory:
        model = full.pool.fresh()
    else:
        spec = full.environment.spec()  # type: ignore[attr-defined]
        for actuator in spec.actuators:
            actuator.nsample, actuator.delay = 0, 0.0
        model = spec.compile()
        model.actuator_delay[:] = full.model.actuator_delay
    model.opt.disableflags = full.model.opt.disableflags
    model.opt.timestep = full.model.opt.timestep
    return model


class _PromptEngine(Engine):
    """Runs models without histories on commands that are delayed beforehand."""

    def __init__(self, full: Engine, model: mujoco.MjModel) -> None:
        super().__init__(full.environment, model, full.num_threads)
        self._late = ShortDelays(full.model)

    def inputs(self, run: Run) -> tuple[FloatArray, FloatArray]:
        """Starts (B, S) without histories, and the controls (B, P, U) that act in each physics step."""
        _, controls = super().inputs(run)
        start = np.ascontiguousarray(run.start[:, : self.physics_size])
        if not self._late:
            return start, controls
        distinct: dict[int, FloatArray] = {id(m): m.actuator_delay.copy() for m in run.models}
        delays = np.stack([distinct[id(m)] for m in run.models]) / run.timesteps[:, None]
        steps, rows = np.arange(controls.shape[1]), np.arange(len(start))[:, None]
        for buffer in self._late.buffers:
            order = np.argsort(run.start[:, buffer.stamped], axis=1, kind="stable")
            past = np.take_along_axis(run.start[:, buffer.values], order, axis=1)
            line = np.concatenate([past, controls[:, :, buffer.control]], axis=1)
            place = np.maximum(past.shape[1] + steps - delays[:, buffer.actuator, None], 0.0)
            low = np.minimum(np.floor(place + 1e-9).astype(np.int64), line.shape[1] - 1)
            share = np.clip(place - low, 0.0, 1.0)
            high = np.minimum(low + 1, line.shape[1] - 1)
            controls[:, :, buffer.control] = (1 - share) * line[rows, low] + share * line[rows, high]
        return start, controls
