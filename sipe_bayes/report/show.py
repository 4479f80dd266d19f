"""``sipe.show_results``: what was estimated, as a table and a figure: one posterior by its marginals, several environments by the
SiPE plot."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from rich import box
from rich.console import Console
from rich.table import Table

from sipe_bayes.core.files import write_bytes
from sipe_bayes.posterior import Dirac, Posterior
from sipe_bayes.posterior import prior as default_prior

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from sipe_bayes.core.parameters import ParameterSpace

Estimates = Mapping[str, Posterior] | Mapping[str, Mapping[str, Posterior | Sequence[Posterior]]]

_DRAWS = 4000
_BEYOND = 5.0  # from the middle, in ranges: no truth is so far out


def show_results(
    posterior: Posterior | Estimates,
    truth: Any = None,
    path: str | Path | None = None,
    console: Console | None = None,
) -> Figure:
    """One posterior: print each parameter's mean, sd and 90 % interval in its unit and how far it contracted from the prior;
    return the figure of its marginals. truth: (N,) in theta, if it is known.

    Estimates of several environments: print accuracy and CRPS skill, return the SiPE plot. They are given as environment ->
    posterior, or as estimator -> environment -> a posterior or those of several seeds; truth: environment -> (N,) in theta.

    path: where to save the figure, as PNG. Raises ValueError for a truth that is missing, has another shape or is no theta, and for
    another path. What a folder of the benchmark's results says, `sipe benchmark report` shows."""
    if path is not None and Path(path).suffix.lower() not in ("", ".png"):
        raise ValueError(f"path {str(path)!r}: the figure is saved as PNG; end its name in .png")
    if isinstance(posterior, Mapping):
        figure, table = _several(posterior, truth)
    elif not isinstance(posterior, Posterior):
        raise ValueError(
            f"posterior: expected a Posterior, or environment -> Posterior, got {posterior!r}; sipe.load_posterior(path) reads one"
        )
    else:
        from sipe_bayes.report.posterior_plots import marginals

        known = None if truth is None else _theta(posterior.space, truth, "truth")
        figure, table = marginals(posterior, truth=known), results_table(posterior, known)
    (console or Console()).print(table)
    if path is not None:
        _save(figure, Path(path))
    return figure


def _several(estimates: Estimates, truth: Any) -> tuple[Figure, Table]:
    """The SiPE plot and the table of several environments' estimates, the prior mean among them."""
    from sipe_bayes.diagnostics.scores import score
    from sipe_bayes.report.sipe_plot import BASELINE, estimators, sipe_plot

    nested = {name: value for name, value in estimates.items() if isinstance(value, Mapping)}
    if nested and len(nested) < len(estimates):
        odd = next(name for name in estimates if name not in nested)
        raise ValueError(
            f"estimates[{odd!r}]: expected environment -> posterior as of {next(iter(nested))!r}, got a posterior"
        )
    by_estimator: Mapping[str, Any] = nested or {"estimate": estimates}
    runs = {
        estimator: {name: _seeds(name, found) for name, found in of.items()} for estimator, of in by_estimator.items()
    }
    scores: dict[str, dict[str, list[Any]]] = {}
    for estimator, of in runs.items():
        for name, posteriors in of.items():
            known = _truth_of(name, truth)
            if posteriors:
                known = _theta(posteriors[0].space, known, f"truth[{name!r}]")
            scores.setdefault(estimator, {})[name] = [score(posterior, known) for posterior in posteriors]
            if posteriors:
                center = Dirac(default_prior(posteriors[0].space).mean, posteriors[0].space)
                scores.setdefault(BASELINE, {})[name] = [score(center, known)]
    figure = sipe_plot(scores)
    return figure, _sipe_table({name: scores[name] for name in [*estimators(scores), BASELINE]})


def _seeds(name: str, found: Any) -> list[Posterior]:
    seeds = [found] if isinstance(found, Posterior) else found
    if not isinstance(seeds, list | tuple) or not all(isinstance(p, Posterior) for p in seeds):
        raise ValueError(
            f"estimates[{name!r}]: expected a Posterior or a list of those of several seeds, got {found!r}"
        )
    return list(seeds)


def _truth_of(environment: str, truth: Any) -> Any:
    if not isinstance(truth, Mapping) or environment not in truth:
        got = ", ".join(truth) if isinstance(truth, Mapping) else type(truth).__name__
        raise ValueError(
            f"truth: the SiPE plot needs environment -> theta, with {environment}, got {got}; "
            f"sipe.make_task({environment!r}).theta(variant) has it"
        )
    return truth[environment]


def _theta(space: ParameterSpace, truth: Any, name: str) -> Any:
    """A truth as theta; raises ValueError for one so many ranges beyond the bounds that it must be in units."""
    try:
        theta = space.check_shape(truth)
    except ValueError as error:
        raise ValueError(f"{name}: {error}; give theta, space.normalise(values) of values in units") from None
    if (np.abs(np.asarray(theta) - 0.5) > _BEYOND).any():
        raise ValueError(
            f"{name} {np.asarray(theta).tolist()}: expected theta, 0 and 1 at the bounds; space.normalise(values) makes it of values in units"
        )
    return theta


def _sipe_table(scores: Mapping[str, Mapping[str, Sequence[Any]]]) -> Table:
    from sipe_bayes.report.sipe_plot import MODES, over_seeds

    table = Table(box=box.SIMPLE, header_style="bold", padding=(0, 1, 0, 0))
    for k, name in enumerate(("estimator", "environment", "accuracy", "min", "max", "CRPS skill")):
        table.add_column(name, justify="left" if k < 2 else "right", no_wrap=k >= 2, overflow="fold")
    for estimator, of in scores.items():
        for environment in of:
            accuracy = [over_seeds(of, [environment], "accuracy", mode)[0] for mode in MODES]
            skill = over_seeds(of, [environment], "CRPS skill", "mean")[0]
            table.add_row(estimator.replace("_", " "), environment, *(f"{value:.3f}" for value in (*accuracy, skill)))
    return table


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
    from sipe_bayes.report.drawing import png

    write_bytes(path, png(figure))
