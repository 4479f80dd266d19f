"""A picture of the columns as a configuration reads them."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from sipe_bayes.calibration.config import load_config
from sipe_bayes.calibration.init.draft import Draft
from sipe_bayes.calibration.logs import load_log
from sipe_bayes.core.units import find_unit

_HEIGHT, _WIDTH = 1.3, 9.0  # inches, of a column


def plot_columns(draft: Draft, path: Path) -> Path:
    """Draw each matched column of the first log over time, set-points over the positions that follow them.

    Args:
        draft: of the configuration.
        path: of the configuration, which has been written.

    Returns:
        The PNG beside it.
    """
    from matplotlib.figure import Figure

    config = load_config(path)
    log, _ = load_log(config, config.logs[0])
    time = log.dt * np.arange(len(log) + 1)
    names = [*config.channels, *(f"command {reading.match.column}" for reading in draft.commands)]
    values = np.concatenate([log.observations, np.concatenate([log.actions, log.actions[-1:]])], axis=1)
    units = [find_unit(m.unit).si for m in config.measurements for _ in m.channels]
    units += [find_unit(reading.unit).si for reading in draft.commands]
    figure = Figure(figsize=(_WIDTH, _HEIGHT * max(2, len(names))), layout="constrained")
    for axes, name, unit, series in zip(
        np.ravel(figure.subplots(len(names), sharex=True, squeeze=False)), names, units, values.T, strict=True
    ):
        axes.plot(time, series, linewidth=0.8)
        axes.set_title(f"{name} [{unit}]", fontsize=8, loc="left")
        axes.tick_params(labelsize=7)
    axes.set_xlabel("time [s]", fontsize=8)
    target = path.with_suffix(".png")
    figure.savefig(target, dpi=110)
    return target
