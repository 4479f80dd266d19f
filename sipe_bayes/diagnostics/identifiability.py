"""What the data cannot say: parameters that change nothing, ranges that are dead, directions left open.

And which one value, measured by other means, would tell most of the rest.

A ridge is a direction of small posterior variance in a space where the parameters one by one have large variance: the
smallest principal components of the posterior's correlation matrix. It is described as a sum or, in logarithms, as a
product (gear / mass, mass * length^2), whichever is the narrower.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sipe_bayes.core.arrays import FloatArray, IntArray
from sipe_bayes.core.parameters import ParameterSpace
from sipe_bayes.core.thresholds import THRESHOLDS
from sipe_bayes.diagnostics.records import Ridge
from sipe_bayes.likelihood import BoundLikelihood

GRID = (0.0, 0.25, 0.5, 0.75, 1.0)  # of theta, where parameters are tried
_SEVERAL = 2  # parameters that a measured value has to tell beside itself
_LOOKED_AT = 400  # control steps: what does something there is not asked again of all windows


def dead_ranges(windows: BoundLikelihood, theta: FloatArray) -> dict[str, list[tuple[float, float]]]:
    """Where parameters change nothing; costs five rollouts a parameter and log, or of many windows those of some.

    Args:
        windows: the logs.
        theta: (N,) where the other parameters stand.

    Returns:
        Parameter -> pieces [a, b] of [0, 1] over which it changes no fitted channel. A piece whose simulation diverges
        is not called dead.
    """
    names = list(windows.simulator.space.names)
    some = windows.spread_over(_LOOKED_AT)
    if len(some) < windows.num_windows:
        names = list(_dead(windows.part(some), theta, names))
    return _dead(windows, theta, names)


def _dead(windows: BoundLikelihood, theta: FloatArray, names: Sequence[str]) -> dict[str, list[tuple[float, float]]]:
    """``dead_ranges`` of some parameters."""
    dead: dict[str, list[tuple[float, float]]] = {}
    scale = np.maximum(windows.spread, 1e-12)
    for name in names:
        j = windows.simulator.space.names.index(name)
        batch = np.tile(theta, (len(GRID), 1))
        batch[:, j] = GRID
        predicted, valid = windows.predict(batch, np.tile(windows.no_starts(), (len(GRID), 1, 1)))
        for k in range(len(GRID) - 1):
            if valid[k] and valid[k + 1]:
                change = np.abs(predicted[k + 1] - predicted[k]) / scale
                if np.where(windows.observed, change, 0.0).max() < THRESHOLDS.no_effect:
                    pieces = dead.setdefault(name, [])
                    goes_on = pieces and pieces[-1][1] == GRID[k]
                    low = pieces.pop()[0] if goes_on else GRID[k]
                    pieces.append((low, GRID[k + 1]))
    return dead


def ridges(space: ParameterSpace, draws: FloatArray, contraction: Sequence[float]) -> list[Ridge]:
    """Combinations that are determined while their members are not.

    Args:
        space: of the N parameters.
        draws: (n, N) of the posterior, in units.
        contraction: (N,) 1 - sd / prior sd of each.
    """
    spread = draws.std(0)
    moving = np.flatnonzero(spread > 1e-12 * np.maximum(np.abs(draws.mean(0)), 1e-300))
    if len(moving) < 2:
        return []
    steady = np.abs(np.sign(draws).sum(0)) == len(draws)
    logarithms = np.where(steady, np.log(np.maximum(np.abs(draws), 1e-300)), draws)
    seen: list[Ridge] = []
    used: list[set[str]] = []
    for view in (logarithms[:, moving], draws[:, moving]):
        eigenvalues, vectors = np.linalg.eigh(np.corrcoef(view.T))
        for value, vector in zip(eigenvalues, vectors.T, strict=True):
            members = [int(moving[i]) for i in _members(vector)]
            if value > 3 * THRESHOLDS.ridge or len(members) < 2:
                continue
            if all(contraction[j] > THRESHOLDS.well_determined for j in members):
                continue
            ridge = _describe(space, draws, members, contraction)
            named = set().union(*used)
            fresh = [j for j in members if space[j].name not in named]
            if 0 < len(fresh) < len(members) and (ridge is None or set(ridge.parameters) <= named):
                one = next(j for j in members if j not in fresh)  # of those that go together, the others follow
                ridge = _describe(space, draws, sorted([one, *fresh]), contraction)
            if ridge is not None and not any(set(ridge.parameters) <= other for other in used):
                used.append(set(ridge.parameters))
                seen.append(ridge)
    return seen


def worth_measuring(
    space: ParameterSpace, draws: FloatArray, contraction: Sequence[float]
) -> tuple[str, tuple[str, ...]] | None:
    """The one parameter whose measured value would determine most of those that are not, and which these are.

    As of a normal, of logarithms where nothing changes sign: what is known of k shrinks by (1 - rho^2)^(1/2), rho its
    correlation with the one that is measured. A mass, which a scale tells, comes before what tells one more.

    Args:
        space: of the N parameters.
        draws: (n, N) of the posterior, in units.
        contraction: (N,) 1 - sd / prior sd of each.

    Returns:
        None where it would be fewer than two others.
    """
    steady = np.abs(np.sign(draws).sum(0)) == len(draws)
    views = draws, np.where(steady, np.log(np.maximum(np.abs(draws), 1e-300)), draws)
    with np.errstate(invalid="ignore", divide="ignore"):
        square = np.nan_to_num(np.maximum(*(np.corrcoef(view.T) ** 2 for view in views)))
    left = 1 - np.asarray(contraction)
    would = left * np.sqrt(np.maximum(1 - square, 0.0)) < 1 - THRESHOLDS.well_determined
    opened = left >= 1 - THRESHOLDS.well_determined
    tells = would & opened & ~np.eye(len(left), dtype=bool)  # row: what is measured
    tells[[p.log is not None for p in space] | ~opened] = False
    mass = np.array([bool(p.targets) and all(target.endswith(".mass") for target in p.targets) for p in space])
    many = tells.sum(1) >= _SEVERAL
    best = int(np.argmax(np.where(many, tells.sum(1) + 1.5 * mass, 0.0)))
    if not many[best]:
        return None
    return space[best].name, tuple(space[k].name for k in np.flatnonzero(tells[best]).tolist())


def _members(loadings: FloatArray) -> IntArray:
    size = np.abs(loadings)
    return np.flatnonzero(size > THRESHOLDS.ridge_member * size.max())


def _describe(
    space: ParameterSpace, draws: FloatArray, members: list[int], contraction: Sequence[float]
) -> Ridge | None:
    """The best determined combination of the members.

    None when it is not far better known than they, or each of them is well known by itself.
    """
    chosen = draws[:, members]
    spaces = [("sum", chosen)]
    if (np.abs(np.sign(chosen).sum(0)) == len(chosen)).all():  # nobody changes sign: products have logarithms
        spaces.insert(0, ("product", np.log(np.abs(chosen))))
    every = ((*_narrowest(x), kind, x) for kind, x in spaces)
    eigenvalue, weights, loadings, kind, x = min(every, key=lambda one: one[0])
    if eigenvalue > THRESHOLDS.ridge:
        return None
    kept = _members(loadings)
    names, units = ([getattr(space[members[k]], what) for k in kept] for what in ("name", "unit"))
    combined = x[:, kept] @ weights[kept]
    if kind == "product":
        sign = np.prod(np.sign(chosen[0, kept]))
        value = float(np.exp(combined.mean()))
        width, text, value = value * float(combined.std()), _product(names, weights[kept]), sign * value
        unit = _product(units, weights[kept]).replace(" / ", "/").replace(" * ", " ")
    else:
        unit = units[int(np.argmax(loadings[kept]))]
        value, width, text = float(combined.mean()), float(combined.std()), _sum(names, weights[kept], units, unit)
    unknown = [
        name for name, k in zip(names, kept, strict=True) if contraction[members[k]] <= THRESHOLDS.well_determined
    ]
    if not unknown:
        return None
    return Ridge(tuple(names), text, float(value), float(width), unit, tuple(unknown))


def _narrowest(x: FloatArray) -> tuple[float, FloatArray, FloatArray]:
    """Smallest eigenvalue of the correlation of x (n, m), its direction in x's units and its loadings."""
    sd = np.maximum(x.std(0), 1e-300)
    eigenvalues, vectors = np.linalg.eigh(np.corrcoef((x / sd).T))
    weights = vectors[:, 0] / sd
    loadings = np.abs(vectors[:, 0])
    return float(eigenvalues[0]), weights / weights[int(np.argmax(loadings))], loadings


def _product(names: Sequence[str], weights: FloatArray) -> str:
    """Names, or units of which some are empty, with their powers."""

    def factor(name: str, power: float) -> str:
        return name if abs(power - 1) < 0.05 else f"{name}^{power:.2g}"

    rows = [(n, w) for n, w in zip(names, weights, strict=True) if n]
    above, below = [factor(n, w) for n, w in rows if w > 0], [factor(n, -w) for n, w in rows if w < 0]
    text = " * ".join(above) or "1"
    return f"{text} / {below[0] if len(below) == 1 else '(' + ' * '.join(below) + ')'}" if below else text


def _sum(names: Sequence[str], weights: FloatArray, units: Sequence[str], unit: str) -> str:
    """Terms that all have ``unit``: a factor has the unit that its parameter lacks."""

    def factor(weight: float, own: str) -> str:
        number = "" if abs(weight - 1) < 5e-4 else f"{weight:.3g} "
        return number if own == unit else f"({number or '1 '}{unit or '1'}/{own or '1'}) "

    rows = zip(names, weights, units, strict=True)
    terms = [f"{'+' if w > 0 else '-'} {factor(abs(w), own)}{n}" for n, w, own in rows]
    return " ".join(terms).removeprefix("+ ")
