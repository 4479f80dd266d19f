"""What moves in a picture of a log beside its simulations, simulated from measured starts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.trajectory import Trajectories, Trajectory
from sipe_bayes.diagnostics.evaluate import measured_starts
from sipe_bayes.likelihood import BoundLikelihood, Segments, estimate_states
from sipe_bayes.report.video import Motion
from sipe_bayes.simulation.simulator import Simulator


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
    windows = BoundLikelihood(replace(settings, fit=None), simulator, Trajectories.stack(log))
    starts = measured_starts(windows, np.stack(list(theta.values())))
    simulated = {}
    for name, one, start in zip(theta, theta.values(), starts, strict=True):
        begin = windows.states(one[None], start[None])[0]
        result = simulator.rollout(one[None], windows.actions, begin, windows.dt, windows.names)
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
