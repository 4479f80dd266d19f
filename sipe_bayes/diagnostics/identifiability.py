"""What the data cannot say: parameters that change nothing, ranges that are dead, directions left open.

A ridge is a direction of small posterior variance among parameters of large variance: a smallest principal component of
the correlation matrix, described as a sum or, in logarithms, as a product (gear / mass), whichever is the narrower.
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


def dead_ranges(windows: BoundLikelihood, theta: FloatArray) -> dict[str, list[tuple[float, float]]]:
    """Where parameters change no fitted channel, the others at theta (N,): pieces [a, b] of [0, 1] of each such one.

    Costs five rollouts a parameter and log, or of many windows those of some; none may diverge.
    """
    names, few = list(windows.simulator.space.names), windows.spread_over(400)  # control steps
    if len(few) < windows.num_windows:
        names = [name for name in names if _dead(windows.part(few), theta, name)]
    return {name: pieces for name in names if (pieces := _dead(windows, theta, name))}


def _dead(windows: BoundLikelihood, theta: FloatArray, name: str) -> list[tuple[float, float]]:
    """``dead_ranges`` of one parameter."""
    batch = np.tile(theta, (len(GRID), 1))
    batch[:, windows.simulator.space.names.index(name)] = GRID
    predicted, valid = windows.predict(batch, np.tile(windows.no_starts(), (len(GRID), 1, 1)))
    with np.errstate(invalid="ignore"):
        change = np.abs(np.diff(predicted, axis=0)) / np.maximum(windows.spread, 1e-12)
    most = np.where(windows.observed, change, 0.0).max(axis=(1, 2, 3))
    idle = valid[1:] & valid[:-1] & (most < THRESHOLDS.no_effect)
    ends = np.flatnonzero(np.diff(np.concatenate([[False], idle, [False]]))).reshape(-1, 2)
    return [(GRID[first], GRID[last]) for first, last in ends.tolist()]


def ridges(space: ParameterSpace, draws: FloatArray, contraction: Sequence[float]) -> list[Ridge]:
    """Combinations that are determined while their members are not, by draws (n, N) of the posterior in units.

    ``contraction`` (N,) is each parameter's 1 - sd / prior sd.
    """
    spread = draws.std(0)
    moving = np.flatnonzero(spread > 1e-12 * np.maximum(np.abs(draws.mean(0)), 1e-300))
    if len(moving) < 2:
        return []
    steady = np.abs(np.sign(draws).sum(0)) == len(draws)
    logarithms = np.where(steady, np.log(np.maximum(np.abs(draws), 1e-300)), draws)
    seen: list[Ridge] = []
    for view in (logarithms[:, moving], draws[:, moving]):
        eigenvalues, vectors = np.linalg.eigh(np.corrcoef(view.T))
        for vector in vectors.T[eigenvalues <= 3 * THRESHOLDS.ridge]:
            members = [int(moving[i]) for i in _members(vector)]
            ridge, named = _describe(space, draws, members, contraction), {n for r in seen for n in r.parameters}
            fresh = [j for j in members if space[j].name not in named]
            if 0 < len(fresh) < len(members) and (ridge is None or set(ridge.parameters) <= named):
                one = next(j for j in members if j not in fresh)  # of those that go together, the others follow
                ridge = _describe(space, draws, sorted([one, *fresh]), contraction)
            if ridge is not None and not any(set(ridge.parameters) <= set(other.parameters) for other in seen):
                seen.append(ridge)
    return seen


def _members(loadings: FloatArray) -> IntArray:
    return np.flatnonzero(np.abs(loadings) > THRESHOLDS.ridge_member * np.abs(loadings).max())


def _describe(
    space: ParameterSpace, draws: FloatArray, members: list[int], contraction: Sequence[float]
) -> Ridge | None:
    """The best determined combination of the members; None if not far better known, or each is well known by itself."""
    if len(members) < 2 or all(contraction[j] > THRESHOLDS.well_determined for j in members):
        return None
    chosen = draws[:, members]
    views = {"sum": chosen}
    if (np.abs(np.sign(chosen).sum(0)) == len(chosen)).all():  # nobody changes sign: products have logarithms
        views = {"product": np.log(np.abs(chosen)), **views}
    narrowest = {kind: np.linalg.eigh(np.corrcoef(x.T)) for kind, x in views.items()}
    kind = min(narrowest, key=lambda one: float(narrowest[one][0][0]))
    x, (eigenvalues, vectors) = views[kind], narrowest[kind]
    if eigenvalues[0] > THRESHOLDS.ridge:
        return None
    loadings = np.abs(vectors[:, 0])
    kept, largest = (
        _members(loadings),
        int(np.argmax(loadings > (1 - 1e-9) * loadings.max())),
    )  # of equal ones the first
    weights = vectors[:, 0] / x.std(0)
    weights = weights[kept] / weights[largest]
    names, units = ([getattr(space[members[k]], what) for k in kept] for what in ("name", "unit"))
    unknown = [n for n, k in zip(names, kept, strict=True) if contraction[members[k]] <= THRESHOLDS.well_determined]
    if not unknown:
        return None
    combined = x[:, kept] @ weights
    value, width = float(combined.mean()), float(combined.std())
    if kind == "product":
        size, sign = float(np.exp(value)), float(np.prod(np.sign(chosen[0, kept])))
        unit = _product(units, weights).replace(" / ", "/").replace(" * ", " ")
        return Ridge(tuple(names), _product(names, weights), sign * size, size * width, unit, tuple(unknown))
    unit = space[members[largest]].unit
    return Ridge(tuple(names), _sum(names, weights, units, unit), value, width, unit, tuple(unknown))


def _product(names: Sequence[str], weights: FloatArray) -> str:
    """Names, or units of which some are empty, with their powers."""
    rows = [(n, w, n if abs(abs(w) - 1) < 0.05 else f"{n}^{abs(w):.2g}") for n, w in zip(names, weights, strict=True)]
    above, below = ([factor for n, w, factor in rows if n and sign * w > 0] for sign in (1, -1))
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
