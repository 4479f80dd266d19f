"""Noise of the residuals of windows: white or coloured, how residuals are whitened; how noisy samples are beforehand.

Residual model, per channel c and along each log: e_j = a_j e_{j-1} + sqrt(1 - a_j^2) sigma_c z_j, z_j ~ N(0, 1), with
a_j = exp(-gap_j / tau_c) for the time since the previous sample there is (first-order autoregression, which carries
on across windows and across missing samples); e_0 ~ N(0, sigma_c^2). White noise is tau = 0.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from sipe_bayes.core.arrays import BoolArray, FloatArray, IntArray
from sipe_bayes.core.rotations import between
from sipe_bayes.core.smoothing import left_by_smoothing, smoothed
from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.likelihood.sequences import Sequence
from sipe_bayes.likelihood.settings import Segments, StateSpace
from sipe_bayes.likelihood.starts.estimates import are_states
from sipe_bayes.simulation.callable_simulator import CallableSimulator
from sipe_bayes.simulation.simulator import Simulator

NORMAL_MAD = 1.4826  # sd of a normal over the median of its absolute values
_ROUNDING = 1e-6  # of the largest sample: trajectories are kept in single precision at places
_ENOUGH = 10  # differences of a channel, which tell their sd to a quarter
_FALSE_ALARM = 1e-3  # with which roughness is corrected by fewer


@dataclass(frozen=True)
class Noise:
    """Stationary sd (C,) in the channels' units and correlation time tau (C,) in seconds, 0 for white."""

    sd: FloatArray
    tau: FloatArray


def chosen_sd(given: tuple[float | None, ...] | None, channels: list[int], names: tuple[str, ...]) -> FloatArray:
    """Noise sds (C,) of the given ``channels`` of all ``names``, NaN where none is given.

    Raises:
        ValueError: unless there is one, or None, for each of ``names``.
    """
    if given is None:
        return np.full(len(channels), np.nan)
    if len(given) != len(names):
        raise ValueError(
            f"noise_sd: expected one for each of the channels {list(names)}, got {len(given)}; None where unknown"
        )
    return np.array([np.nan if given[c] is None else given[c] for c in channels], float)


def noise_scales(count: int, rotations: Iterable[tuple[int, int, int]]) -> IntArray:
    """Which noise scale (G of them) each of C channels has: the three numbers of a rotation vector share one."""
    owner = np.arange(count)
    for triple in rotations:
        owner[list(triple)] = min(triple)
    return np.unique(owner, return_inverse=True)[1]


def pooled(sd: FloatArray, scales: IntArray) -> FloatArray:
    """Sds (C,), those of one scale at their root mean square."""
    if scales.max(initial=-1) + 1 == len(sd):
        return sd
    return np.asarray(np.sqrt(np.bincount(scales, sd**2) / np.bincount(scales))[scales])


def whiten(residual: FloatArray, sequence: Sequence, sd: float, tau: float) -> FloatArray:
    """Whitened residuals (..., n) of one channel's residual (..., W * L)."""
    a = sequence.coefficients(tau)
    before = np.where(sequence.previous >= 0, residual[..., sequence.previous], 0.0)
    return (residual[..., sequence.index] - a * before) / (sd * np.sqrt(1 - a**2))


def noise_level(
    trajectories: Trajectories, likelihood: Segments | StateSpace, simulator: Simulator | CallableSimulator
) -> FloatArray:
    """Sd (O,) of each channel's noise in its unit.

    As ``likelihood.noise_sd`` states it. Else, where ten states or all of them are recorded, the root mean square of
    what samples differ from what these show; channels that they do not show, or whose sensor is unknown, have none
    where nothing differs. Else the robust sd of what local quadratics over 60 ms leave of the samples, scaled where
    fewer states do not fit that. It takes contact, where a channel jumps from sample to sample, for noise.

    States count as exact: where they are measurements, from which the channels were made, nothing tells their noise.

    Raises:
        ValueError: where the settings state another number of sds than there are channels.
    """
    count = trajectories.observations.shape[2]
    stated = likelihood.noise_sd or (None,) * count
    if len(stated) != count:
        raise ValueError(f"noise_sd: expected {count} values, one for each channel, got {len(stated)}")
    if all(sd is not None for sd in stated):
        return np.array(stated, float)
    estimated, states = _roughness(trajectories), trajectories.states
    if states is not None and isinstance(simulator, Simulator) and are_states(simulator, states):
        off, sensed = _differences(trajectories, states, simulator), bool(simulator.environment.sensed)
        estimated = _beside_states(off, trajectories, estimated, sensed)
    return np.array([estimated[c] if sd is None else sd for c, sd in enumerate(stated)])


def _differences(trajectories: Trajectories, states: FloatArray, simulator: Simulator) -> FloatArray:
    """Samples less what the recorded states (R, T+1, S) show (R, T+1, O); NaN where nothing tells that."""
    seen, environment = trajectories.observations, simulator.environment
    shown = np.full(seen.shape, np.nan)
    if not environment.needs_derived:
        shown = environment.observe(simulator.model, states, None, environment.recorded_goals(seen[:, :1]))
    for channel, column in enumerate(environment.state_columns(simulator.model)):
        if column is not None:
            shown[..., channel] = states[..., column]
    shown[..., list(environment.sensed)] = np.nan
    off = seen - shown
    for triple in environment.rotations:
        channels = list(triple)
        off[..., channels] = between(seen[..., channels], shown[..., channels])
    return off


def _beside_states(off: FloatArray, trajectories: Trajectories, rough: FloatArray, sensed: bool) -> FloatArray:
    """Sd (O,) by differences (R, T+1, O) and roughness (O,); whether something of a sensor is unknown."""
    seen = trajectories.observations
    largest = np.abs(np.where(np.isfinite(seen), seen, 0.0)).max((0, 1))
    known, differs = np.isfinite(off).sum((0, 1)), (np.abs(off) > _ROUNDING * largest).any((0, 1))
    enough = (known >= _ENOUGH) | ((known > 0) & trajectories.states_throughout)
    unshown = not known.any() and not sensed and trajectories.states_throughout
    if not differs.any() and (enough.any() or unshown):
        return np.zeros(len(known))  # what the states do not show is as exact as what they do
    own = np.sqrt(np.nansum(off**2, (0, 1)) / np.maximum(known, 1))
    return np.where(enough, np.where(differs, own, 0.0), _corrected(off, differs & ~enough, rough))


def _corrected(off: FloatArray, few: BoolArray, rough: FloatArray) -> FloatArray:
    """Roughness (O,), of ``few`` scaled where their differences together do not fit it: slow noise is smooth."""
    few = few & (rough > 0)
    seen = np.isfinite(off[..., few])
    total, count = float(np.nansum((off[..., few] / rough[few]) ** 2)), int(seen.sum())
    if not count or min(chi2.cdf(total, count), chi2.sf(total, count)) > _FALSE_ALARM / 2:
        return rough
    return np.where(few, rough * np.sqrt(total / count), rough)


def _roughness(trajectories: Trajectories) -> FloatArray:
    """Robust sd (O,) of what smoothing leaves; zero of what was not measured, or of fewer than five samples."""
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
    sd = np.zeros(trajectories.observations.shape[2])
    for c, rest in enumerate(np.concatenate(left).T if left else ()):
        if np.isfinite(rest).any():
            sd[c] = NORMAL_MAD * np.nanmedian(np.abs(rest))
    return sd
