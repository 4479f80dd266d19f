"""Do the logs agree? Estimates of each by itself that differ by more than their uncertainty are an alarm.

With m_k the optimum of log k and L_k its information (starts and its own nuisance parameters marginalised, directions
of which it says less than a uniform prior left out), Q is the least of sum_k (m_k - mu)' L_k (m_k - mu) over a common
mu, within the cube where all leave it open. When the logs agree it is chi-square, with as many degrees of freedom as
the logs determine directions, each by itself, less those that they determine together (Cochran's test).

The parameter named is the one whose freedom to differ between logs lowers Q most; none where even that leaves the logs
in disagreement. Where the others agree without a log, that one is named.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.linalg
import scipy.optimize
import scipy.stats

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.findings import Code, Finding, finding
from sipe_bayes.core.parameters import Parameter, ParameterSpace
from sipe_bayes.core.thresholds import THRESHOLDS
from sipe_bayes.likelihood import UNIFORM_PRECISION
from sipe_bayes.structure.augmented import AtNoise
from sipe_bayes.structure.discrepancy import LogEstimate, parts_of


def linear_estimates(at: AtNoise) -> list[LogEstimate]:
    """What each log by itself says to first order, beside the noise of all; it simulates nothing."""
    n, theta, estimates = at.logs.windows.num_theta, at.logs.theta, []
    for name, mine in parts_of(at.logs.windows):
        precision, gradient = (one[:n] for one in at.of_part(mine))
        step = np.linalg.pinv(precision[:, :n], rcond=1e-12, hermitian=True) @ gradient
        estimates.append(LogEstimate(name, theta + step, precision[:, :n]))
    return estimates


def disagreement(space: ParameterSpace, logs: Sequence[LogEstimate]) -> Finding | None:
    """The disagreement of two or more logs, or None; only parameters shared by all logs are compared."""
    shared = [j for j, p in enumerate(space) if p.log is None]
    if len(logs) < 2 or not shared:
        return None
    roots = [_root(_marginal(log.information, shared)) for log in logs]
    sought = [root @ log.mean[shared] for root, log in zip(roots, logs, strict=True)]
    together = _scatter(roots, sought)
    if together.freedom < 1 or together.p > THRESHOLDS.logs_disagree:
        return None
    left_out = [_scatter(roots[:k] + roots[k + 1 :], sought[:k] + sought[k + 1 :]) for k in range(len(logs))]
    best, without = max(range(len(logs)), key=lambda k: left_out[k].p if left_out[k].freedom else -1.0), ""
    if left_out[best].freedom > 0 and left_out[best].p > THRESHOLDS.logs_disagree:
        without = f"; without {logs[best].name} the others agree (p = {left_out[best].p:.1g})"
    apart = [_scatter(roots, sought, own=j) for j in range(len(shared))]
    named = int(np.argmin([scatter.q for scatter in apart]))
    own, about, most = [], "", (1 - THRESHOLDS.not_determined) / np.sqrt(UNIFORM_PRECISION)  # sd of one that is told
    why = "no single parameter explains it; the model lacks what shows differently in them"
    if apart[named].p >= THRESHOLDS.logs_disagree:
        parameter, estimates = space[shared[named]], zip(logs, apart[named].theta, apart[named].sd, strict=True)
        says = ", ".join(_says(parameter, log.name, *one) for log, *one in estimates if one[1] < most)
        own, about = [parameter.name], f" about {parameter.name}"
        remedy = "give it per_log = true, model what changed, or leave a log out"
        why = f"the others being common, {says} {parameter.unit}".rstrip() + f"; {remedy}"
    return finding(Code.LOGS_DISAGREE, parameters=own, about=about, p=together.p, why=why, without=without)


def _says(parameter: Parameter, log: str, theta: float, sd: float) -> str:
    """What a log says of a parameter, in words; the sd is half of what lies between the values one below and above."""
    theta = float(np.clip(theta, -1.0, 2.0)) if parameter.scale == "log" else float(theta)  # else 1e99
    value, low, high = (float(parameter.value(x)) for x in (theta, theta - sd, theta + sd))
    width = (high - low) / 2
    beyond = value + width < parameter.low or value - width > parameter.high
    return f"{log} says {value:.4g} ± {width:.2g}" + " (beyond its bounds)" * beyond


def _marginal(information: FloatArray, kept: Sequence[int]) -> FloatArray:
    """Information about ``kept`` with the other parameters marginalised."""
    other = [j for j in range(len(information)) if j not in kept]
    cross = information[np.ix_(kept, other)]
    inner = information[np.ix_(other, other)] + 1e-9 * np.eye(len(other))
    return np.asarray(information[np.ix_(kept, kept)] - cross @ np.linalg.solve(inner, cross.T))


def _root(information: FloatArray) -> FloatArray:
    """Rows r (R, N) with r' r the information in the R directions of which it says more than a uniform prior."""
    eigenvalues, axes = np.linalg.eigh(information)
    determined = eigenvalues > UNIFORM_PRECISION
    return np.asarray(np.sqrt(eigenvalues[determined])[:, None] * axes[:, determined].T)


@dataclass(frozen=True)
class _Scatter:
    """Q and its degrees of freedom; theta (K,) and sd (K,) of what each log has by itself, the others being known."""

    q: float
    freedom: int
    theta: FloatArray
    sd: FloatArray

    @property
    def p(self) -> float:
        """1 where there is nothing to compare."""
        return float(scipy.stats.chi2.sf(self.q, self.freedom)) if self.freedom > 0 else 1.0


def _scatter(roots: list[FloatArray], sought: list[FloatArray], own: int | None = None) -> _Scatter:
    """With all parameters common, but ``own``."""
    common = [j for j in range(roots[0].shape[1]) if j != own]
    rows, target = np.take(np.concatenate(roots), common, axis=1), np.concatenate(sought)
    if own is not None:
        rows = np.hstack([rows, scipy.linalg.block_diag(*(root[:, [own]] for root in roots))])
    eigenvalues, axes = np.linalg.eigh(rows.T @ rows)
    weak = eigenvalues <= UNIFORM_PRECISION
    low = np.where(weak, np.minimum(axes, 0).sum(0), -np.inf)
    high = np.where(weak, np.maximum(axes, 0).sum(0), np.inf)
    solution = axes @ scipy.optimize.lsq_linear(rows @ axes, target, (low, high), tol=1e-12).x
    q = float(((rows @ solution - target) ** 2).sum())
    alone = 1 / np.sqrt((rows[:, len(common) :] ** 2).sum(0) + UNIFORM_PRECISION)
    return _Scatter(q, len(rows) - int((~weak).sum()), solution[len(common) :], alone)
