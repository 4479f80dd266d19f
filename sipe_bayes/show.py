"""``sipe.show_results``: what was estimated, as a table and a figure."""

from __future__ import annotations

import os
import uuid
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from rich import box
from rich.console import Console
from rich.table import Table

from sipe_bayes.posterior import Posterior
from sipe_bayes.posterior import prior as default_prior

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_DRAWS = 4000


def show_results(
    posterior: Posterior, truth: Any = None, path: str | Path | None = None, console: Console | None = None
) -> Figure:
    """Print each parameter's mean, sd and 90 % interval in its unit and how far it contracted from the prior; return the figure
    of its marginals.

    truth: (N,) in theta, if it is known. path: where to save the figure, as PNG. Raises ValueError for another shape."""
    from sipe_bayes.diagnostics.posterior_plots import marginals

    known = None if truth is None else posterior.space.check_shape(truth)
    figure = marginals(posterior, truth=known)
    (console or Console()).print(results_table(posterior, known))
    if path is not None:
        _save(figure, Path(path))
    return figure


def results_table(posterior: Posterior, truth: Any = None) -> Table:
    """The table that ``show_results`` prints."""
    space = posterior.space
    values = posterior.values(_DRAWS, generator=torch.Generator().manual_seed(0))
    low, high = (space.values(q) for q in posterior.quantile([0.05, 0.95]).numpy())
    contraction = 1 - posterior.stddev.numpy() / default_prior(space).stddev.numpy()
    table = Table(box=box.SIMPLE, header_style="bold", padding=(0, 1, 0, 0))
    names = [
        "parameter",
        "unit",
        "mean",
        "sd",
        "90 % interval",
        "contraction",
        *(["truth"] if truth is not None else []),
    ]
    for k, name in enumerate(names):
        table.add_column(name, justify="left" if k < 2 else "right", no_wrap=k >= 2, overflow="fold")
    true_values = None if truth is None else space.values(truth)
    for j, parameter in enumerate(space):
        mean, sd = float(values[:, j].mean()), float(values[:, j].std())
        row = [
            parameter.name,
            parameter.unit,
            f"{mean:.4g}",
            f"{sd:.2g}",
            f"{low[j]:.4g} to {high[j]:.4g}",
            f"{100 * contraction[j]:.0f} %",
        ]
        table.add_row(*row, *([] if true_values is None else [f"{np.asarray(true_values)[j]:.4g}"]))
    return table


def _save(figure: Figure, path: Path) -> None:
    """Write a PNG file atomically."""
    from sipe_bayes.diagnostics.plots import png

    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{uuid.uuid4().hex}")
    try:
        temporary.write_bytes(png(figure))
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
