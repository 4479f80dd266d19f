"""Noise of residuals: white or coloured, how residuals are whitened; how noisy samples are beforehand.

Per channel c and along each log, e_j = a_j e_{j-1} + sqrt(1 - a_j^2) sigma_c z_j with z_j ~ N(0, 1) and
a_j = exp(-gap_j / tau_c) for the time since the previous sample. This first-order autoregression carries on across
windows and missing samples; e_0 ~ N(0, sigma_c^2). White noise is tau = 0.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from sipe_bayes.core.arrays import BoolArray, FloatArray, IntArray
from sipe_bayes.core.rotations import between
from sipe_bayes.core.smoothing import filled, left_by_smoothing, smoothed
from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.likelihood.sequences import Sequence
from sipe_bayes.likelihood.settings import Segments, StateSpace
from sipe_bayes.likelihood.starts.estimates import are_states
from sipe_bayes.simulation.callable_simulator import CallableSimulator
from sipe_bayes.simulation.simulator import Simulator

NORMAL_MAD = 1.4826  # sd of a normal over the median of its absolute values


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
    """Sd (O,) of each channel's noise in its unit: the first of these that there is.

    1. As ``likelihood.noise_sd`` states it.
    2. Where ten states, or all, are recorded: the root mean square of what samples differ from what these show.
       Channels that they do not show have none where nothing differs.
    3. The robust sd of what local quadratics over 60 ms leave of the samples, scaled where fewer states do not fit
       that. It takes contact, where a channel jumps from sample to sample, for noise.

    States count as exact: where they are measurements, from which the channels were made, nothing tells their noise.

    Raises:
        ValueError: where the settings state another number of sds than there are channels.
    """
    channels = list(range(trajectories.observations.shape[2]))
    stated = chosen_sd(likelihood.noise_sd, channels, simulator.environment.channels)
    if not np.isnan(stated).any():
        return stated
    estimated, states = _roughness(trajectories), trajectories.states
    if states is not None and isinstance(simulator, Simulator) and are_states(simulator, states):
        off = _differences(trajectories, states, simulator)
        estimated = _beside_states(off, trajectories, estimated, bool(simulator.environment.sensed))
    return np.where(np.isnan(stated), estimated, stated)


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
    for channels in map(list, environment.rotations):
        off[..., channels] = between(seen[..., channels], shown[..., channels])
    return off


def _beside_states(off: FloatArray, trajectories: Trajectories, rough: FloatArray, sensed: bool) -> FloatArray:
    """Sd (O,) by differences (R, T+1, O) and roughness (O,); whether something of a sensor is unknown."""
    seen = trajectories.observations
    largest = np.abs(np.where(np.isfinite(seen), seen, 0.0)).max((0, 1))
    known = np.isfinite(off).sum((0, 1))
    differs = (np.abs(off) > 1e-6 * largest).any((0, 1))  # trajectories are kept in single precision at places
    enough = (known >= 10) | ((known > 0) & trajectories.states_throughout)  # ten tell their sd to a quarter
    unshown = not known.any() and not sensed and trajectories.states_throughout
    if not differs.any() and (enough.any() or unshown):
        return np.zeros(len(known))  # what the states do not show is as exact as what they do
    own = np.sqrt(np.nansum(off**2, (0, 1)) / np.maximum(known, 1))
    return np.where(enough, np.where(differs, own, 0.0), _corrected(off, differs & ~enough, rough))


def _corrected(off: FloatArray, few: BoolArray, rough: FloatArray) -> FloatArray:
    """Roughness (O,), of ``few`` scaled where their differences together do not fit it: slow noise is smooth."""
    few = few & (rough > 0)
    total, count = float(np.nansum((off[..., few] / rough[few]) ** 2)), int(np.isfinite(off[..., few]).sum())
    if not count or min(chi2.cdf(total, count), chi2.sf(total, count)) > 5e-4:
        return rough
    return np.where(few, rough * np.sqrt(total / count), rough)


def _roughness(trajectories: Trajectories) -> FloatArray:
    """Robust sd (O,) of what smoothing leaves; zero of what was not measured, or of fewer than five samples."""
    left = []
    for trajectory in trajectories:
        series, share = trajectory.observations, left_by_smoothing(len(trajectory) + 1, trajectory.dt)
        if share > 0:
            known = filled(series)
            left.append(np.where(np.isfinite(series), known - smoothed(known, trajectory.dt), np.nan) / np.sqrt(share))
    sd = np.zeros(trajectories.observations.shape[2])
    for c, rest in enumerate(np.concatenate(left).T if left else ()):
        if np.isfinite(rest).any():
            sd[c] = NORMAL_MAD * np.nanmedian(np.abs(rest))
    return sd
