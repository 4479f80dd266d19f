"""Figures that check posteriors: ranks and coverage of a ``CalibrationCheck``, and a log within what a posterior predicts. Arrays
in, one Matplotlib figure out, no pyplot, no state; colours as in ``posterior_plots``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from numpy.typing import NDArray

from sipe_bayes.core.trajectory import Trajectories, Trajectory
from sipe_bayes.diagnostics.coverage import LEVELS, CalibrationCheck, Uniformity
from sipe_bayes.posterior import Posterior
from sipe_bayes.posterior import prior as default_prior
from sipe_bayes.report.drawing import (
    CHAINS,
    DEFAULT,
    MEASURED,
    POSTERIOR,
    PRIOR,
    _figure,
    _line,
    _short,
    _styled,
    _ticks,
    unit_text,
)
from sipe_bayes.simulation.simulator import Simulator

FloatArray = NDArray[np.float64]

_MOST_CHANNELS = 6


@_styled
def rank_check(check: CalibrationCheck) -> Figure:
    """Ranks of the truth, one panel per parameter: the empirical distribution less the uniform one, within the band that a
    calibrated method leaves in one case of a hundred. The diagonal is the zero line; a prior that is returned unchanged
    would lie on it too."""
    columns = min(3, max(2, len(check.names)))
    rows = -(-len(check.names) // columns)
    figure = _figure(1.9 * rows + 0.5)
    grid = figure.add_gridspec(rows, columns)
    most = max(float(np.abs(np.stack([u.curve - LEVELS, u.low - LEVELS, u.high - LEVELS])).max()) for u in check.ranks)
    for j, (name, found) in enumerate(zip(check.names, check.ranks, strict=True)):
        ax = figure.add_subplot(grid[j // columns, j % columns])
        _band(ax, found, LEVELS)
        ax.plot(LEVELS, found.curve - LEVELS, color=POSTERIOR, lw=1.4)
        ax.axhline(0, color=MEASURED, lw=0.9, ls=":")
        ax.set(xlim=(0, 1), ylim=(-1.1 * most, 1.1 * most))
        ax.set_title(f"{_short(name, 26)}: {check.verdict(name)}", fontweight="bold")
        _ticks(ax.xaxis, 5)
        _ticks(ax.yaxis, 5)
        if j % columns == 0:
            ax.set_ylabel("share below, less\nwhat is expected")
        if j + columns >= len(check.names):
            ax.set_xlabel("rank of the truth")
    figure.legend(handles=_check_handles(f"posteriors of {check.truths} truths"), loc="outside upper center", ncols=3)
    return figure


@_styled
def coverage_curve(check: CalibrationCheck) -> Figure:
    """Left, how often central intervals hold the truth against what they say, one line per parameter; right, the same for TARP's
    regions. Below the diagonal: too narrow. Above: too wide."""
    figure = _figure(4.1, 8.6)
    left, right = figure.subplots(1, 2)
    _band(left, check.intervals[0], 0 * LEVELS)
    for k, (name, found) in enumerate(zip(check.names, check.intervals, strict=True)):
        style = ("-", "--", "-.")[k // len(CHAINS) % 3]
        label = f"{_short(name, 22)} ({check.verdict(name)})"
        left.plot(LEVELS, found.curve, color=CHAINS[k % len(CHAINS)], ls=style, lw=1.4, label=label)
    _band(right, check.tarp, 0 * LEVELS)
    right.plot(LEVELS, check.tarp.curve, color=POSTERIOR, lw=1.6)
    for ax, title, what in ((left, "each parameter", "central interval"), (right, "all together (TARP)", "region")):
        ax.plot([0, 1], [0, 1], color=MEASURED, lw=0.9, ls=":")
        ax.set(
            xlim=(0, 1), ylim=(0, 1), aspect="equal", xlabel=f"level of the {what}", ylabel="share that holds the truth"
        )
        ax.set_title(title, fontweight="bold")
    left.legend(loc="upper left", fontsize=7 if len(check.names) < 8 else 5.5)
    figure.legend(handles=_check_handles(f"posteriors of {check.truths} truths"), loc="outside upper center", ncols=3)
    return figure


def _band(ax: Axes, found: Uniformity, base: FloatArray) -> None:
    ax.fill_between(LEVELS, found.low - base, found.high - base, color=PRIOR, alpha=0.35, lw=0)


def _check_handles(label: str) -> list[Any]:
    band = Patch(facecolor=PRIOR, alpha=0.35, label="99 % of calibrated methods stay inside")
    return [_line(POSTERIOR, label), band, _line(MEASURED, "exactly calibrated", ls=":", lw=0.9)]


@dataclass(frozen=True)
class Predictive:
    """What a posterior and the prior say a log would be: time (T+1,) s, measured (T+1, C), channels, units; quantiles
    5, 50, 95 % (3, T+1, C) of posterior and prior, and the model as given (T+1, C). NaN where simulations diverged."""

    name: str
    time: FloatArray
    channels: tuple[str, ...]
    units: tuple[str, ...]
    measured: FloatArray
    posterior: FloatArray
    prior: FloatArray
    default: FloatArray


def predictive(
    simulator: Simulator,
    posterior: Posterior,
    trajectory: Trajectory,
    start: FloatArray,
    prior: Posterior | None = None,
    count: int = 100,
    seed: int = 0,
) -> Predictive:
    """Simulate ``count`` draws of posterior and prior, and the model as given, open loop over a log from its ``start`` (S,)."""
    before = default_prior(posterior.space) if prior is None else prior
    generator = torch.Generator().manual_seed(seed)
    theta = [p.sample((count,), generator=generator).numpy() for p in (posterior, before)]
    rows = np.concatenate([*theta, np.clip(simulator.space.default_theta, 0, 1)[None]])
    motion = simulator.replay(rows, Trajectories.stack(trajectory), start[None])
    seen = np.where(motion.valid[..., None], motion.observations, np.nan)
    bands = [np.nanquantile(seen[k * count : (k + 1) * count], (0.05, 0.5, 0.95), axis=0) for k in range(2)]
    channels = tuple(simulator.environment.channels)
    units = tuple(getattr(simulator.environment, "channel_units", None) or [""] * len(channels))
    return Predictive(
        trajectory.name, trajectory.time, channels, units, trajectory.observations, bands[0], bands[1], seen[-1]
    )


@_styled
def posterior_predictive(found: Predictive, channels: Sequence[str] | None = None) -> Figure:
    """The log over the 90 % bands of posterior and prior and the model as given; the first six channels, or those named. A
    log outside the prior's band cannot be explained by any parameters within the bounds."""
    chosen = list(found.channels[:_MOST_CHANNELS] if channels is None else channels)
    unknown = [c for c in chosen if c not in found.channels]
    if unknown or not chosen:
        raise ValueError(f"channels: expected some of {list(found.channels)}, got {chosen}")
    figure = _figure(1.5 * len(chosen) + 0.8)
    axes: Any = figure.subplots(len(chosen), 1, squeeze=False, sharex=True)
    for ax, name in zip(axes[:, 0], chosen, strict=True):
        _predicted(ax, found, found.channels.index(name))
    axes[-1, 0].set(xlabel="time [s]", xlim=(found.time[0], found.time[-1]))
    handles = [
        _line(MEASURED, "log", lw=1.1),
        _line(POSTERIOR, "posterior, median"),
        Patch(color=POSTERIOR, alpha=0.35, lw=0, label="90 %"),
        Patch(facecolor=PRIOR, alpha=0.35, lw=0, label="prior, 90 %"),
        _line(DEFAULT, "model as given", ls="--"),
    ]
    figure.legend(handles=handles, loc="outside upper center", ncols=5)
    figure.align_ylabels()
    return figure


def _predicted(ax: Axes, found: Predictive, c: int) -> None:
    time = found.time
    ax.fill_between(time, found.prior[0, :, c], found.prior[2, :, c], color=PRIOR, alpha=0.35, lw=0)
    ax.fill_between(time, found.posterior[0, :, c], found.posterior[2, :, c], color=POSTERIOR, alpha=0.35, lw=0)
    ax.plot(time, found.default[:, c], color=DEFAULT, ls="--", lw=1.1)
    ax.plot(time, found.posterior[1, :, c], color=POSTERIOR, lw=1.4)
    ax.plot(time, found.measured[:, c], color=MEASURED, lw=0.9)
    unit = unit_text(found.units[c])
    ax.set_ylabel(found.channels[c].replace("_", " ") + (f"\n[{unit}]" if unit else ""), fontsize=8)
    _ticks(ax.yaxis, 4)
