"""Panels of one or two parameters, the same in every figure that shows draws of a posterior over its prior."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Rectangle
from numpy.typing import NDArray

from sipe_bayes.core.parameters import Parameter
from sipe_bayes.report.drawing import DEFAULT, POSTERIOR, PRIOR, _short, _ticks, unit_text

if TYPE_CHECKING:
    from sipe_bayes.posterior import Posterior

FloatArray = NDArray[np.float64]

DRAWS = 8000


def draws(posterior: Posterior, n: int = DRAWS) -> FloatArray:
    """Fixed-seed draws theta (n, N)."""
    import torch

    values = posterior.values(n, generator=torch.Generator().manual_seed(0))
    return np.clip(posterior.space.normalise(values), 0.0, 1.0)


def density(theta: FloatArray, grid: FloatArray) -> FloatArray:
    """Density (G,) at ``grid`` (G,) of draws theta (M,) in [0, 1]: Gaussian kernels, reflected at both
    bounds, so that nothing leaks past them and an edge is not rounded off."""
    q25, q75 = np.quantile(theta, (0.25, 0.75))
    sd = float(theta.std())
    width = 0.9 * (min(sd, (q75 - q25) / 1.349) or sd) * len(np.unique(theta)) ** -0.2
    low, high = theta[theta < 5 * width], theta[theta > 1 - 5 * width]
    points = np.concatenate([theta, -low, 2 - high])
    kernels = np.exp(-(((grid[:, None] - points) / width) ** 2) / 2)
    return kernels.sum(1) / (len(theta) * width * np.sqrt(2 * np.pi)) * ((grid >= 0) & (grid <= 1))


def correlation(theta: FloatArray) -> FloatArray:
    """Correlation matrix (N, N) of draws theta (M, N); 0 where one of the two does not vary."""
    deviation = theta - theta.mean(0)
    sd = deviation.std(0)
    scaled = np.divide(deviation, sd, out=np.zeros_like(deviation), where=sd > 1e-12)
    return np.asarray(scaled.T @ scaled / len(theta))


def _view(theta: FloatArray, default: float | None = None) -> tuple[float, float]:
    """The part of [0, 1] to show: where the draws are, and the default if it is not far."""
    low, high = (float(q) for q in np.quantile(theta, (0.002, 0.998)))
    span = max(high - low, 1e-6)
    view_low, view_high = low - 0.3 * span, high + 0.3 * span
    if default is not None and low - 1.5 * span < default < high + 1.5 * span:
        view_low, view_high = min(view_low, default - 0.1 * span), max(view_high, default + 0.1 * span)
    if view_high - view_low > 0.6:
        return 0.0, 1.0
    return max(view_low, 0.0), min(view_high, 1.0)


def _scale(parameter: Parameter, view: tuple[float, float]) -> str:
    wide = parameter.scale == "log" and parameter.value(view[1]) > 5 * parameter.value(view[0])
    return "log" if wide else "linear"


def _prior_density(prior: Posterior, name: str, grid: FloatArray) -> FloatArray:
    marginal = prior.marginal([name])
    if marginal.has_density:
        return np.exp(marginal.log_prob(grid[:, None]).numpy())
    return density(draws(marginal)[:, 0], grid)


def _prior_strip(ax: Axes, interval: FloatArray, default: float | None) -> None:
    """The whole prior range as a bar above the panel; ends are the bounds."""
    bar: dict[str, Any] = {"transform": ax.transAxes, "clip_on": False, "lw": 0}
    ax.add_patch(Rectangle((0, 1.05), 1, 0.055, color=PRIOR, alpha=0.35, **bar))
    width = max(interval[1] - interval[0], 0.006)
    ax.add_patch(Rectangle((min(interval[0], 1 - width), 1.05), width, 0.055, color=POSTERIOR, **bar))
    if default is not None:
        ax.plot([default] * 2, [1.03, 1.125], color=DEFAULT, transform=ax.transAxes, clip_on=False, lw=1.6)


def _axis_range(parameter: Parameter, theta: FloatArray) -> tuple[str, tuple[float, float]]:
    """Scale and limits of an axis that shows the draws."""
    view = _view(theta)
    return _scale(parameter, view), (float(parameter.value(view[0])), float(parameter.value(view[1])))


def _pair(ax: Axes, parameters: tuple[Parameter, Parameter], theta: FloatArray, default: list[float | None]) -> None:
    x, y = (p.value(theta[:2000, k]) for k, p in enumerate(parameters))
    ax.scatter(x, y, s=3, color=POSTERIOR, alpha=0.2, lw=0)
    (x_scale, x_limits), (y_scale, y_limits) = (_axis_range(p, theta[:, k]) for k, p in enumerate(parameters))
    ax.set(xscale=x_scale, yscale=y_scale, xlim=x_limits, ylim=y_limits)
    if default[0] is not None and default[1] is not None:
        ax.plot(default[0], default[1], "+", color=DEFAULT, ms=9, mew=1.8)


def _diagonal(ax: Axes, parameter: Parameter, theta: FloatArray) -> None:
    grid = np.linspace(*_view(theta), 200)
    if np.ptp(theta) < 1e-9:
        ax.axvline(parameter.value(theta[0]), color=POSTERIOR)
    else:
        height = density(theta, grid)
        ax.fill_between(parameter.value(grid), height, color=POSTERIOR, alpha=0.3, lw=0)
        ax.plot(parameter.value(grid), height, color=POSTERIOR, lw=1.2)
        ax.set_ylim(0, 1.08 * height.max())
    scale, limits = _axis_range(parameter, theta)
    ax.set(xscale=scale, xlim=limits)


def _pair_in_prior(ax: Axes, theta: FloatArray, before: FloatArray, strength: float) -> None:
    ax.scatter(before[:, 0], before[:, 1], s=4, color=PRIOR, alpha=0.35, lw=0)
    ax.scatter(theta[:1000, 0], theta[:1000, 1], s=3, color=POSTERIOR, alpha=0.3, lw=0)
    ax.set_xlim(0, 1)
    ax.set_ylim(0, 1)
    box = {"facecolor": "white", "alpha": 0.85, "edgecolor": "none", "pad": 1.5}
    weight = "bold" if abs(strength) >= 0.8 else "normal"
    number = f"{strength:+.2f}" if abs(strength) >= 0.005 else "0.00"
    ax.text(0.96, 0.95, number, transform=ax.transAxes, ha="right", va="top", bbox=box, fontweight=weight)


def _pair_frame(ax: Axes, parameters: tuple[Parameter, Parameter], i: int, j: int, size: int) -> None:
    """Labels on the outer panels only; frames in the upper half, whose axes are the prior's bounds."""
    if i < j:
        ax.set_xticks([])
        ax.set_yticks([])
        ax.spines[:].set_visible(True)
        ax.spines[:].set_color(PRIOR)
        return
    length, font = (26, 9.0) if size < 6 else (15, 8.0) if size < 8 else (14, 7.5)
    _ticks(ax.xaxis, 3)
    if i > j:
        _ticks(ax.yaxis, 3)
    else:
        ax.set_yticks([])
        ax.spines["left"].set_visible(False)
    ax.tick_params(axis="x", rotation=90 if size > 4 else 0, labelbottom=i == size - 1)
    ax.tick_params(axis="y", labelleft=j == 0 and i > j)
    if i == size - 1:
        ax.set_xlabel(_axis_name(parameters[0], length), fontsize=font)
    if j == 0 and i > 0:
        ax.set_ylabel(_axis_name(parameters[1], length), fontsize=font)


def _axis_name(parameter: Parameter, length: int) -> str:
    """Name, log of a nuisance parameter and unit, each on lines of its own."""
    name, bracket, log = parameter.name.partition("[")
    unit = unit_text(parameter.unit)
    parts = [_wrapped(name, length), _wrapped(bracket + log, length), f"[{unit}]" if unit else ""]
    return "\n".join(part for part in parts if part)


def _wrapped(name: str, length: int) -> str:
    """``name`` on at most two lines, broken after an underscore where one comes late enough."""
    if len(name) <= length:
        return name
    cut = name.rfind("_", length // 3, length) + 1 or length
    return f"{name[:cut]}\n{_short(name[cut:], length)}"
