"""Do the logs agree? Each is fitted by itself; estimates that differ by more than their uncertainty are an alarm.

With m_k the optimum of log k and L_k its information (starts and its own nuisance parameters marginalised, directions
of which it says less than a uniform prior left out), Q is the least of sum_k (m_k - mu)' L_k (m_k - mu) over a common
mu. When the logs agree it is chi-square, with as many degrees of freedom as the logs determine directions, each by
itself, less those that they determine together (Cochran's test). Along directions that even together they leave open mu
keeps within the cube, which makes Q smaller than that at most.

The parameter named is the one whose freedom to differ between logs lowers Q most: the most economical explanation, not
merely the largest shift. Where even that leaves the logs in disagreement, no single parameter explains it: named is the
one whose values differ most between the logs, each by itself, or none where only combinations differ. And each log is
left out in turn: where the others agree without one, that one is named.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import scipy.linalg
import scipy.optimize
import scipy.stats

from sipe_bayes.core.arrays import FloatArray, IntArray
from sipe_bayes.core.checkpoint import NOTHING_KEPT, Kept
from sipe_bayes.core.findings import Code, Finding, finding
from sipe_bayes.core.parameters import ParameterSpace
from sipe_bayes.core.telling import Tell, silent
from sipe_bayes.core.thresholds import THRESHOLDS
from sipe_bayes.core.trajectory import Trajectories, Trajectory
from sipe_bayes.inference.laplace import Laplace
from sipe_bayes.likelihood import UNIFORM_PRECISION, BoundLikelihood, Linearisation, Noise, Segments, StateSpace
from sipe_bayes.simulation.simulator import Simulator
from sipe_bayes.structure.discrepancy import LogEstimate

LOG_BUDGET = 5000  # rollouts for each log
_DETERMINED = (1 - THRESHOLDS.not_determined) / math.sqrt(12)  # sd of a log that tells a parameter: of the prior's
_FLAT = 1e-6  # precision that keeps a log's information invertible where it leaves a direction open


@dataclass(frozen=True)
class Disagreement:
    """How logs disagree.

    Args:
        p: of Cochran's Q under agreement.
        parameter: its most economical explanation; where that does not explain it, the one that differs most.
        p_left: the p that is left with the most economical one free in every log.
        per_log: (log, value, sd) in the parameter's unit, of logs that determine it, the other parameters being common
            where it explains the disagreement; on a logarithmic scale half of what lies between the values a sd in
            theta below and above. None where only combinations differ.
        unit: of the parameter.
        odd: the log without which the others agree best, where they do at the same level.
        p_without: how well they agree without it.
        bounds: of the parameter, in its unit: a log that asks for a value beyond them lacks something else.
    """

    p: float
    parameter: str
    p_left: float
    per_log: tuple[tuple[str, float, float], ...]
    unit: str = ""
    odd: str | None = None
    p_without: float = 0.0
    bounds: tuple[float, float] = (-math.inf, math.inf)

    @property
    def finding(self) -> Finding:
        """It as a finding about the parameter."""
        unexplained = self.p_left < THRESHOLDS.logs_disagree
        low, high = self.bounds
        beyond = [value + sd < low or value - sd > high for _, value, sd in self.per_log]
        marks = [" (beyond its bounds)" if out else "" for out in beyond]
        says = ", ".join(
            f"{log} says {value:.4g} ± {sd:.2g}{mark}"
            for (log, value, sd), mark in zip(self.per_log, marks, strict=True)
        )
        estimates = f"{says} {self.unit}".rstrip()
        most = f"{self.parameter} differs most ({estimates})" if says else "only combinations of parameters differ"
        return finding(
            Code.LOGS_DISAGREE_UNEXPLAINED if unexplained else Code.LOGS_DISAGREE,
            parameters=[self.parameter] if says else [],
            p=self.p,
            estimates=estimates,
            most=most,
            without="" if self.odd is None else f"; without {self.odd} the others agree (p = {self.p_without:.1g})",
        )

    @property
    def text(self) -> str:
        """In words."""
        return self.finding.text


@dataclass(frozen=True)
class LogEstimates:
    """What logs say by themselves, and the names of those that could not be fitted alone."""

    estimates: tuple[LogEstimate, ...] = ()
    skipped: tuple[str, ...] = ()


@dataclass(frozen=True)
class _Alone:
    """What one log says, if it could be fitted."""

    estimate: LogEstimate | None


def log_estimates(
    simulator: Simulator,
    likelihood: Segments | StateSpace,
    trajectories: Trajectories,
    theta: FloatArray,
    seed: int = 0,
    tell: Tell = silent,
    kept: Kept = NOTHING_KEPT,
) -> LogEstimates:
    """Fit each log by itself; nothing for a single log.

    Args:
        simulator: of the model.
        likelihood: of the fits.
        trajectories: the logs.
        theta: (N,) where each fit starts.
        seed: of the fits.
        tell: called with what is being done.
        kept: keeps what each log says.
    """
    estimates, skipped, count = [], [], len(trajectories)
    for number, trajectory in enumerate(trajectories if count > 1 else ()):
        where = f"log {trajectory.name} by itself, {number + 1} of {count}"
        tell(where)

        def progress(what: str, done: int, budget: int, where: str = where) -> None:
            tell(f"{where}, {what}")

        method = Laplace(
            simulator, likelihood=likelihood, seed=seed, initial=theta, budget=LOG_BUDGET, progress=progress
        )
        estimate = kept.of(f"log-{number}", _Alone, partial(_alone, method, trajectory)).estimate
        if estimate is None:
            skipped.append(trajectory.name)
        else:
            estimates.append(estimate)
    return LogEstimates(tuple(estimates), tuple(skipped))


def _alone(method: Laplace, log: Trajectory, kept: Kept) -> _Alone:
    try:
        method.fit(log)
    except ValueError:  # LinAlgError is one
        return _Alone(None)
    return _Alone(LogEstimate(log.name, *method.information()))


def linear_estimates(
    windows: BoundLikelihood,
    theta: FloatArray,
    starts: FloatArray,
    noise: Noise,
    lin: Linearisation,
    parts: Sequence[tuple[str, IntArray]],
    memory: FloatArray | None = None,
) -> list[LogEstimate]:
    """What each part of the logs by itself says to first order, with noise of its own; it simulates nothing.

    Args:
        windows: the logs.
        theta: (N,) the estimate from all of them.
        starts: (W, D) there.
        noise: (C,) there, from which that of each log is searched.
        lin: the linearisation at both.
        parts: by ``parts_of``.
        memory: (C,) how many samples tell as much as one of their own; default one.

    Returns:
        One for each part.
    """
    n, estimates, precision = len(theta), [], windows.start_precision
    for name, mine in parts:
        part = windows.part(mine)
        part.start_precision = precision  # of all logs together
        moments, pulls = part.moments(lin.part(mine)), part.pulls(_FLAT * np.eye(n), np.zeros(n), starts[mine])
        own = part.estimate_noise(moments, noise, pulls, bool((noise.tau > 0).any()))
        sd = np.maximum(own.sd, windows.rounding)
        own = Noise(sd if memory is None else sd * np.sqrt(memory), own.tau)
        solved = part.eliminate(moments.normal(own), n, starts[mine])
        step = np.linalg.pinv(solved.precision, rcond=1e-12, hermitian=True) @ solved.gradient
        estimates.append(LogEstimate(name, theta + step, solved.precision))
    return estimates


def disagreement(space: ParameterSpace, logs: Sequence[LogEstimate]) -> Disagreement | None:
    """The disagreement of two or more logs, or None; only parameters shared by all logs are compared."""
    shared = [j for j, p in enumerate(space) if p.log is None]
    if len(logs) < 2 or not shared:
        return None
    roots = [_root(marginal(log.information, shared)) for log in logs]
    sought = [root @ log.mean[shared] for root, log in zip(roots, logs, strict=True)]
    together = _scatter(roots, sought)
    if together.freedom < 1 or together.p > THRESHOLDS.logs_disagree:
        return None
    apart = [_scatter(roots, sought, own=j) for j in range(len(shared))]
    named = int(np.argmin([scatter.q for scatter in apart]))
    p_left, own = apart[named].p, apart[named].own
    if p_left < THRESHOLDS.logs_disagree:
        named, own = _by_themselves(logs, shared)
    parameter, per_log = space[shared[named]], []
    for log, theta, sd in zip(logs, *own, strict=True):
        if sd < _DETERMINED:
            within = float(np.clip(theta, -1.0, 2.0)) if parameter.scale == "log" else float(theta)  # else 1e99
            value, low, high = (float(parameter.value(x)) for x in (within, within - sd, within + sd))
            per_log.append((log.name, value, (high - low) / 2))  # perhaps beyond a bound
    left_out = [_scatter(roots[:k] + roots[k + 1 :], sought[:k] + sought[k + 1 :]) for k in range(len(logs))]
    best = max(range(len(logs)), key=lambda k: left_out[k].p if left_out[k].freedom else -1.0)
    agree = left_out[best].freedom > 0 and left_out[best].p > THRESHOLDS.logs_disagree
    odd, without = (logs[best].name, left_out[best].p) if agree else (None, 0.0)
    bounds = parameter.low, parameter.high
    return Disagreement(together.p, parameter.name, p_left, tuple(per_log), parameter.unit, odd, without, bounds)


def _by_themselves(logs: Sequence[LogEstimate], shared: Sequence[int]) -> tuple[int, _Own]:
    """Which of the shared parameters differs most between logs each by itself, and what each says of it.

    None is known where none differs by more than such values do.
    """
    means = np.stack([log.mean[shared] for log in logs])
    belief = UNIFORM_PRECISION * np.eye(len(shared))
    covariances = [np.linalg.inv(marginal(log.information, shared) + belief) for log in logs]
    sds = np.sqrt([np.diag(covariance) for covariance in covariances])
    weight = np.where(sds < _DETERMINED, 1 / sds**2, 0.0)
    middle = (weight * means).sum(0) / np.maximum(weight.sum(0), 1e-300)
    p = scipy.stats.chi2.sf((weight * (means - middle) ** 2).sum(0), np.maximum((weight > 0).sum(0) - 1, 1))
    most = int(np.argmin(p))
    differs = p[most] * len(shared) < THRESHOLDS.logs_disagree
    return most, (means[:, most], sds[:, most] if differs else np.full(len(logs), np.inf))


def marginal(information: FloatArray, kept: Sequence[int]) -> FloatArray:
    """Information about ``kept`` with the other parameters marginalised."""
    other = [j for j in range(len(information)) if j not in kept]
    block = information[np.ix_(kept, kept)]
    if not other:
        return block
    cross = information[np.ix_(kept, other)]
    ridge = 1e-9 * np.eye(len(other))
    return block - cross @ np.linalg.solve(information[np.ix_(other, other)] + ridge, cross.T)


def _root(information: FloatArray) -> FloatArray:
    """Rows r (R, N) with r' r the information in the R directions of which it says more than a uniform prior."""
    eigenvalues, axes = np.linalg.eigh(information)
    determined = eigenvalues > UNIFORM_PRECISION
    return np.asarray(np.sqrt(eigenvalues[determined])[:, None] * axes[:, determined].T)


_Own = tuple[FloatArray, FloatArray]
"""Of a parameter that each log has by itself: estimates (K,) and their sds (K,), the common ones being known."""


@dataclass(frozen=True)
class _Scatter:
    """Q, its degrees of freedom, and what each log has by itself."""

    q: float
    freedom: int
    own: _Own

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
    return _Scatter(q, len(rows) - int((~weak).sum()), (solution[len(common) :], alone))
