"""``sipe.show_results``: what was estimated, as a table and a figure.

One posterior is shown by its marginals, several environments by the SiPE plot.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, cast

import numpy as np
import torch
from numpy.typing import ArrayLike
from rich import box
from rich.console import Console
from rich.table import Table

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.files import write_bytes
from sipe_bayes.posterior import Dirac, Posterior
from sipe_bayes.posterior import prior as default_prior

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from sipe_bayes.core.parameters import ParameterSpace
    from sipe_bayes.diagnostics.scores import Scores

Seeds = Posterior | Sequence[Posterior]
Estimates = Mapping[str, Seeds] | Mapping[str, Mapping[str, Seeds]]
Truth = ArrayLike | Mapping[str, ArrayLike]


def show_results(
    posterior: Posterior | Estimates,
    truth: Truth | None = None,
    path: str | Path | None = None,
    console: Console | None = None,
) -> Figure:
    """Print a table of what was estimated and return a figure of it.

    Of one posterior: each parameter's mean, sd and 90 % interval in its unit, how far it contracted from the prior, and
    the figure of its marginals. Of several environments: accuracy and CRPS skill, and the SiPE plot. What a folder of
    the benchmark's results says, `sipe benchmark report` shows.

    Args:
        posterior: a posterior, or environment -> posterior, or estimator -> environment -> a posterior or those of
            several seeds.
        truth: theta (N,), if it is known; environment -> (N,), where there are several.
        path: where to save the figure, as PNG.
        console: where to print; default standard output.

    Returns:
        The figure.

    Raises:
        ValueError: for a truth that is missing, has another shape or is no theta, and for another path.
    """
    if path is not None and Path(path).suffix.lower() not in ("", ".png"):
        raise ValueError(f"path {str(path)!r}: the figure is saved as PNG; end its name in .png")
    if isinstance(posterior, Mapping):
        figure, table = _several(posterior, truth)
    elif not isinstance(posterior, Posterior):
        raise ValueError(
            f"posterior: expected a Posterior, or environment -> Posterior, got {posterior!r}; "
            "sipe.load_posterior(path) reads one"
        )
    else:
        from sipe_bayes.report.posterior_plots import marginals

        known = None if truth is None else _theta(posterior.space, truth, "truth")
        figure, table = marginals(posterior, truth=known), results_table(posterior, known)
    (console or Console()).print(table)
    if path is not None:
        save_figure(figure, Path(path))
    return figure


def _several(estimates: Estimates, truth: Truth | None) -> tuple[Figure, Table]:
    """The SiPE plot and the table of several environments' estimates, the prior mean among them."""
    from sipe_bayes.diagnostics.scores import score
    from sipe_bayes.report.sipe_plot import BASELINE, estimators, sipe_plot

    nested = {name: value for name, value in estimates.items() if isinstance(value, Mapping)}
    odd = next((name for name in estimates if nested and name not in nested), None)
    if odd is not None:
        raise ValueError(
            f"estimates[{odd!r}]: expected environment -> posterior as of {next(iter(nested))!r}, got a posterior"
        )
    by_estimator: Mapping[str, Mapping[str, object]] = nested or {"estimate": estimates}
    scores: dict[str, dict[str, list[Scores]]] = {}
    for estimator, of in by_estimator.items():
        for name, given in of.items():
            posteriors, known = _seeds(name, given), _truth_of(name, truth)
            if posteriors:
                space = posteriors[0].space
                theta = _theta(space, known, f"truth[{name!r}]")
                center = Dirac(default_prior(space).mean, space)
                scores.setdefault(BASELINE, {})[name] = [score(center, theta)]
            scores.setdefault(estimator, {})[name] = [score(posterior, theta) for posterior in posteriors]
    figure = sipe_plot(scores)
    return figure, _sipe_table({name: scores[name] for name in [*estimators(scores), BASELINE]})


def _seeds(name: str, given: object) -> list[Posterior]:
    seeds = [given] if isinstance(given, Posterior) else given
    if not isinstance(seeds, list | tuple) or not all(isinstance(p, Posterior) for p in seeds):
        raise ValueError(
            f"estimates[{name!r}]: expected a Posterior or a list of those of several seeds, got {given!r}"
        )
    return list(seeds)


def _truth_of(environment: str, truth: Truth | None) -> ArrayLike:
    if not isinstance(truth, Mapping) or environment not in truth:
        got = ", ".join(truth) if isinstance(truth, Mapping) else type(truth).__name__
        raise ValueError(
            f"truth: the SiPE plot needs environment -> theta, with {environment}, got {got}; "
            f"sipe.make_task({environment!r}).theta(variant) has it"
        )
    return truth[environment]


def _theta(space: ParameterSpace, truth: Truth, name: str, beyond: float = 5.0) -> FloatArray:
    """A truth as theta; raises ValueError for one more than ``beyond`` ranges from the middle: it must be in units."""
    try:
        theta = np.asarray(space.check_shape(cast(ArrayLike, truth)))
    except ValueError as error:
        raise ValueError(f"{name}: {error}; give theta, space.normalise(values) of values in units") from None
    if (np.abs(theta - 0.5) > beyond).any():
        raise ValueError(
            f"{name} {theta.tolist()}: expected theta, 0 and 1 at the bounds; space.normalise(values) makes it of "
            "values in units"
        )
    return theta


def _table(*names: str) -> Table:
    """A table without rows, whose first two columns hold text."""
    table = Table(box=box.SIMPLE, header_style="bold", padding=(0, 1, 0, 0))
    for k, name in enumerate(names):
        table.add_column(name, justify="left" if k < 2 else "right", no_wrap=k >= 2, overflow="fold")
    return table


def _sipe_table(scores: Mapping[str, Mapping[str, Sequence[Scores]]]) -> Table:
    from sipe_bayes.report.sipe_plot import MODES, over_seeds

    table = _table("estimator", "environment", "accuracy", "min", "max", "CRPS skill")
    for estimator, of in scores.items():
        for environment in of:
            accuracy = [over_seeds(of, [environment], "accuracy", mode)[0] for mode in MODES]
            skill = over_seeds(of, [environment], "CRPS skill", "mean")[0]
            table.add_row(estimator.replace("_", " "), environment, *(f"{value:.3f}" for value in (*accuracy, skill)))
    return table


def results_table(posterior: Posterior, truth: ArrayLike | None = None, draws: int = 4000) -> Table:
    """The table that ``show_results`` prints.

    Args:
        posterior: over N parameters.
        truth: theta (N,), if it is known.
        draws: from which mean and sd in units are taken.
    """
    space = posterior.space
    values = posterior.values(draws, generator=torch.Generator().manual_seed(0))
    low, high = (space.values(q) for q in posterior.quantile([0.05, 0.95]).numpy())
    contraction = 1 - posterior.stddev.numpy() / default_prior(space).stddev.numpy()
    known = [] if truth is None else ["truth"]
    table = _table("parameter", "unit", "mean", "sd", "90 % interval", "contraction", *known)
    true_values = None if truth is None else np.asarray(space.values(np.asarray(truth, float)))
    for j, parameter in enumerate(space):
        mean, sd = float(values[:, j].mean()), float(values[:, j].std())
        interval, share = f"{low[j]:.4g} to {high[j]:.4g}", f"{100 * contraction[j]:.0f} %"
        row = [parameter.name, parameter.unit, f"{mean:.4g}", f"{sd:.2g}", interval, share]
        table.add_row(*row, *([] if true_values is None else [f"{true_values[j]:.4g}"]))
    return table


def save_figure(figure: Figure, path: Path) -> None:
    """Write a figure as a PNG file, whole or not at all."""
    from sipe_bayes.report.drawing import png

    write_bytes(path, png(figure))
