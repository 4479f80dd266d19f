"""How noisy samples are before anything is fitted: beside recorded states, or by their roughness.

States count as exact. Where they are measurements themselves, from which the channels were made, nothing tells their
noise: state it (``noise_sd``), or leave the states out.
"""

from __future__ import annotations

import numpy as np
from scipy.stats import chi2

from sipe_bayes.core.arrays import BoolArray, FloatArray
from sipe_bayes.core.rotations import between
from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.likelihood.noise import NORMAL_MAD
from sipe_bayes.likelihood.settings import Segments, StateSpace
from sipe_bayes.likelihood.starts import left_by_smoothing, smoothed
from sipe_bayes.simulation.callable_simulator import CallableSimulator
from sipe_bayes.simulation.simulator import Simulator

_ROUNDING = 1e-6  # of the largest sample: trajectories are kept in single precision at places
_ENOUGH = 10  # differences of a channel that tell their sd to a quarter
_FALSE_ALARM = 1e-3  # with which roughness is corrected by fewer


def noise_level(
    trajectories: Trajectories, likelihood: Segments | StateSpace, simulator: Simulator | CallableSimulator
) -> FloatArray:
    """Sd (O,) of each channel's noise in its unit.

    As ``likelihood.noise_sd`` states it. Else, where states are recorded, the sd of what channels differ from what they
    show, none where they show the same; of a few states alone that only scales the roughness, where it does not fit.
    Else the robust sd of what local quadratics over 60 ms leave of the samples.

    Raises:
        ValueError: where the settings state another number of sds than there are channels.
    """
    count = trajectories.observations.shape[2]
    stated = likelihood.noise_sd or (None,) * count
    if len(stated) != count:
        raise ValueError(f"noise_sd: expected {count} values, one for each channel, got {len(stated)}")
    estimated = _roughness(trajectories)
    if trajectories.states is not None and isinstance(simulator, Simulator):
        estimated = _beside_states(_differences(trajectories, trajectories.states, simulator), trajectories, estimated)
    return np.array([estimated[c] if sd is None else sd for c, sd in enumerate(stated)])


def states_throughout(trajectories: Trajectories) -> bool:
    """Whether the state of every sample is recorded, and not of none or the first alone."""
    states = trajectories.states
    return states is not None and int(np.isfinite(states[..., 0]).sum()) == int((trajectories.length + 1).sum())


def _differences(trajectories: Trajectories, states: FloatArray, simulator: Simulator) -> FloatArray:
    """Samples less what the recorded states (R, T+1, S) show (R, T+1, O); NaN where nothing tells that."""
    seen, environment = trajectories.observations, simulator.environment
    shown = np.full(seen.shape, np.nan)
    if not environment.needs_derived:
        shown = environment.observe(simulator.model, states, None, environment.recorded_goals(seen[:, :1]))
    for channel, column in enumerate(environment.state_columns(simulator.model)):
        if column is not None:
            shown[..., channel] = states[..., column]
    off = seen - shown
    for triple in environment.rotations:
        channels = list(triple)
        off[..., channels] = between(seen[..., channels], shown[..., channels])
    return off


def _beside_states(off: FloatArray, trajectories: Trajectories, rough: FloatArray) -> FloatArray:
    """Sd (O,) by differences (R, T+1, O) and roughness (O,)."""
    seen = trajectories.observations
    largest = np.maximum(1.0, np.abs(np.where(np.isfinite(seen), seen, 0.0)).max((0, 1)))
    known, differs = np.isfinite(off).sum((0, 1)), (np.abs(off) > _ROUNDING * largest).any((0, 1))
    if not differs.any() and (known.any() or states_throughout(trajectories)):
        return np.zeros(len(known))  # what the states do not show is as exact as what they do
    rough = _corrected(off, known, differs, rough)
    # about the mean: a sensor's bias is none of the noise
    about = off - np.nansum(off, (0, 1)) / np.maximum(known, 1)
    own = np.sqrt(np.nansum(about**2, (0, 1)) / np.maximum(known - 1, 1))
    return np.where((known > 0) & ~differs, 0.0, np.where(known >= _ENOUGH, own, rough))


def _corrected(off: FloatArray, known: FloatArray, differs: BoolArray, rough: FloatArray) -> FloatArray:
    """Roughness (O,), scaled where the channels' few differences together do not fit it: slow noise is smooth."""
    few = differs & (known < _ENOUGH) & (rough > 0)
    total, count = float((np.nansum(off**2, (0, 1))[few] / rough[few] ** 2).sum()), int(known[few].sum())
    if not count or min(chi2.cdf(total, count), chi2.sf(total, count)) > _FALSE_ALARM / 2:
        return rough
    return np.where(few, rough * np.sqrt(total / count), rough)


def _roughness(trajectories: Trajectories) -> FloatArray:
    """Robust sd (O,) of what smoothing leaves."""
    left = []
    for trajectory in trajectories:
        series = trajectory.observations
        finite, filled = np.isfinite(series), np.zeros(series.shape)
        for c, seen in enumerate(finite.T):
            if seen.any():
                filled[:, c] = np.interp(np.arange(len(series)), np.flatnonzero(seen), series[seen, c])
        share = left_by_smoothing(len(series), trajectory.dt)
        if share > 0:
            left.append(np.where(finite, filled - smoothed(filled, trajectory.dt), np.nan) / np.sqrt(share))
    if not left:  # too short for any
        return np.zeros(trajectories.observations.shape[2])
    return np.nan_to_num(NORMAL_MAD * np.nanmedian(np.abs(np.concatenate(left)), axis=0))
