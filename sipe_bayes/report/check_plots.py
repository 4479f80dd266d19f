"""Figures that check posteriors: ranks and coverage of a ``CalibrationCheck``, and a log in what a posterior predicts.

Arrays in, one Matplotlib figure out, no pyplot, no state; colours as in ``drawing``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.trajectory import Trajectories, Trajectory
from sipe_bayes.diagnostics.coverage import LEVELS, CalibrationCheck, Uniformity
from sipe_bayes.posterior import Posterior
from sipe_bayes.posterior import prior as default_prior
from sipe_bayes.report.colours import CHAINS, DEFAULT, MEASURED, POSTERIOR, PRIOR, STYLE
from sipe_bayes.report.drawing import column_of_panels, new_figure, outer_labels, panel_grid, styled, ticks
from sipe_bayes.report.legends import legend_above, line_handle, shade_handle
from sipe_bayes.report.words import shortened, with_unit
from sipe_bayes.simulation.simulator import Simulator


@styled
def rank_check(check: CalibrationCheck) -> Figure:
    """Ranks of the truth, one panel per parameter: the empirical distribution less the uniform one.

    The band is what a calibrated method leaves in one case of a hundred. The diagonal is the zero line; a prior that is
    returned unchanged would lie on it too.
    """
    figure, axes, columns = panel_grid(len(check.names), 1.9, 0.5)
    most = max(float(np.abs(np.stack([u.curve - LEVELS, u.low - LEVELS, u.high - LEVELS])).max()) for u in check.ranks)
    for ax, name, ranks in zip(axes, check.names, check.ranks, strict=True):
        _band(ax, ranks, LEVELS)
        ax.plot(LEVELS, ranks.curve - LEVELS, color=POSTERIOR, lw=STYLE.curve)
        ax.axhline(0, color=MEASURED, lw=0.9, ls=":")
        ax.set(xlim=(0, 1), ylim=(-1.1 * most, 1.1 * most))
        ax.set_title(f"{shortened(name, 26)}: {check.verdict(name)}", fontweight="bold")
        ticks(ax.xaxis, 5)
        ticks(ax.yaxis, 5)
    outer_labels(axes, columns, "rank of the truth", "share below, less\nwhat is expected")
    legend_above(figure, _check_handles(f"posteriors of {check.truths} truths"), 3)
    return figure


@styled
def coverage_curve(check: CalibrationCheck) -> Figure:
    """Left, how often central intervals hold the truth against what they say; right, the same for TARP's regions.

    Below the diagonal: too narrow. Above: too wide.
    """
    figure = new_figure(4.1, 8.6)
    left, right = figure.subplots(1, 2)
    _band(left, check.intervals[0], 0 * LEVELS)
    for k, (name, interval) in enumerate(zip(check.names, check.intervals, strict=True)):
        style = ("-", "--", "-.")[k // len(CHAINS) % 3]
        label = f"{shortened(name, 22)} ({check.verdict(name)})"
        left.plot(LEVELS, interval.curve, color=CHAINS[k % len(CHAINS)], ls=style, lw=STYLE.curve, label=label)
    _band(right, check.tarp, 0 * LEVELS)
    right.plot(LEVELS, check.tarp.curve, color=POSTERIOR, lw=1.6)
    for ax, title, what in ((left, "each parameter", "central interval"), (right, "all together (TARP)", "region")):
        ax.plot([0, 1], [0, 1], color=MEASURED, lw=0.9, ls=":")
        ax.set(xlim=(0, 1), ylim=(0, 1), aspect="equal")
        ax.set(xlabel=f"level of the {what}", ylabel="share that holds the truth")
        ax.set_title(title, fontweight="bold")
    left.legend(loc="upper left", fontsize=7 if len(check.names) < 8 else 5.5)
    legend_above(figure, _check_handles(f"posteriors of {check.truths} truths"), 3)
    return figure


def _band(ax: Axes, uniform: Uniformity, base: FloatArray) -> None:
    ax.fill_between(LEVELS, uniform.low - base, uniform.high - base, color=PRIOR, alpha=STYLE.prior, lw=0)


def _check_handles(label: str) -> list[Artist]:
    band = Patch(facecolor=PRIOR, alpha=STYLE.prior, label="99 % of calibrated methods stay inside")
    return [line_handle(POSTERIOR, label), band, line_handle(MEASURED, "exactly calibrated", ":", lw=0.9)]


@dataclass(frozen=True)
class Predictive:
    """What a posterior and the prior say a log would be; NaN where simulations diverged.

    Args:
        name: of the log.
        time: (T+1,) s.
        channels: C names.
        units: of each channel.
        measured: (T+1, C).
        posterior: quantiles 5, 50, 95 % (3, T+1, C).
        prior: the same of the prior.
        default: the model as given (T+1, C).
    """

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
    """Simulate draws of posterior and prior, and the model as given, open loop over a log.

    Args:
        simulator: of the log's environment.
        posterior: over the simulator's parameters.
        trajectory: the log.
        start: its first state (S,).
        prior: what was believed before; default what the parameters say.
        count: draws of each.
        seed: of the draws.
    """
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


@styled
def posterior_predictive(predicted: Predictive, channels: Sequence[str] | None = None, most: int = 6) -> Figure:
    """The log over the 90 % bands of posterior and prior and the model as given.

    A log outside the prior's band cannot be explained by any parameters within the bounds.

    Args:
        predicted: what is drawn.
        channels: which ones; default the first.
        most: how many of them by default.

    Raises:
        ValueError: for a channel that is not there.
    """
    chosen = list(predicted.channels[:most] if channels is None else channels)
    unknown = [c for c in chosen if c not in predicted.channels]
    if unknown or not chosen:
        raise ValueError(f"channels: expected some of {list(predicted.channels)}, got {chosen}")
    figure, axes = column_of_panels(len(chosen), 1.5, 0.8)
    for ax, name in zip(axes, chosen, strict=True):
        _predicted(ax, predicted, predicted.channels.index(name))
    axes[-1].set(xlabel="time [s]", xlim=(predicted.time[0], predicted.time[-1]))
    handles = [
        line_handle(MEASURED, "log", lw=1.1),
        line_handle(POSTERIOR, "posterior, median"),
        shade_handle(POSTERIOR, "90 %", STYLE.prior),
        Patch(facecolor=PRIOR, alpha=STYLE.prior, label="prior, 90 %"),
        line_handle(DEFAULT, "model as given", "--"),
    ]
    legend_above(figure, handles, 5)
    figure.align_ylabels()
    return figure


def _predicted(ax: Axes, of: Predictive, c: int) -> None:
    for band, colour in ((of.prior, PRIOR), (of.posterior, POSTERIOR)):
        ax.fill_between(of.time, band[0, :, c], band[2, :, c], color=colour, alpha=STYLE.prior, lw=0)
    ax.plot(of.time, of.default[:, c], color=DEFAULT, ls="--", lw=1.1)
    ax.plot(of.time, of.posterior[1, :, c], color=POSTERIOR, lw=STYLE.curve)
    ax.plot(of.time, of.measured[:, c], color=MEASURED, lw=0.9)
    ax.set_ylabel(with_unit(of.channels[c].replace("_", " "), of.units[c], "\n"), fontsize=8)
    ticks(ax.yaxis, 4)
