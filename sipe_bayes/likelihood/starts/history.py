"""What delayed actuators, filters and firmware remember where a window starts: the commands before it."""

from __future__ import annotations

import numpy as np

from sipe_bayes.core.arrays import BoolArray, FloatArray, IntArray
from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.envs.internal.states import filtered_commands
from sipe_bayes.simulation.simulator import Simulator

_LONGEST, _FORGOTTEN = 2000, 10.0  # commands, longer than any delay; time constants after which a filter has forgotten


def past_commands(
    simulator: Simulator, trajectories: Trajectories, log: IntArray, start: IntArray, dt: FloatArray
) -> list[FloatArray]:
    """The commands before each start, one row a physics step; before the log its first command.

    Of starts at samples ``start`` (W,) of the logs ``log`` (W,), whose control steps take ``dt`` (W,) seconds.
    """
    slowest = max(
        (float(simulator.model.actuator_dynprm[k, 0]) for k, _ in filtered_commands(simulator.model)), default=0
    )
    longest = np.minimum(np.maximum(np.ceil(_FORGOTTEN * slowest / dt), 1), _LONGEST).astype(np.int64)
    if simulator.model.nhistory:
        longest[:] = _LONGEST
    past = []
    for k, first, seconds, most in zip(log, start, dt, longest, strict=True):
        skip = simulator.physics_steps(float(seconds))[0]
        rows = trajectories.actions[k, max(0, first - most) : first]
        past.append(np.repeat(rows, skip, axis=0) if len(rows) else trajectories.actions[k, :1])
    return past


def with_history(
    simulator: Simulator,
    states: FloatArray,
    past: list[FloatArray],
    dt: FloatArray,
    steps: IntArray | int = 0,
    recorded: BoolArray | bool = False,
) -> FloatArray:
    """States (W, S) with the ``past_commands`` that delayed actuators and filters remember; dt (W,) in seconds.

    They are at time zero, or, where firmware has a clock, ``steps`` (W,) control steps after its start. What filters
    remember is in states that are recorded (W,).
    """
    columns = [column for _, column in filtered_commands(simulator.model)]
    own = states[:, columns].copy()
    states[:, 0] = steps * dt if simulator.engine.firmware else 0.0
    timestep = np.array([simulator.physics_steps(float(seconds))[1] for seconds in dt])
    begun = simulator.environment.history(simulator.model, states, past, timestep)
    begun[:, columns] = np.where(np.reshape(recorded, (-1, 1)), own, begun[:, columns])
    return begun
