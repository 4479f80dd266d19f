"""Do the logs agree? Each is fitted by itself; estimates that differ by more than their uncertainty are an alarm.

With m_k and L_k the optimum and information of log k (starts and its own nuisance parameters marginalised) and mu the
combined estimate, Q = sum_k (m_k - mu)' L_k (m_k - mu) is chi-square with (K - 1) x (determined directions) degrees of
freedom when the logs agree (Cochran's test). The parameter named is the one whose freedom to differ between logs lowers
Q most: the most economical explanation, not merely the largest shift. Where even that leaves the logs in disagreement, the
text says that no single parameter explains it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy.stats
from numpy.typing import NDArray

from sipe_bayes.inference.laplace import Laplace
from sipe_bayes.likelihood import Segments
from sipe_bayes.parameters import ParameterSpace
from sipe_bayes.simulator import Simulator
from sipe_bayes.state_space import StateSpace
from sipe_bayes.trajectory import Trajectories

FloatArray = NDArray[np.float64]

LEVEL = 0.01  # false alarms where logs agree
_BUDGET = 5000  # rollouts for each log
_DETERMINED = 12.0  # information of a uniform prior: directions with less are not tested


@dataclass(frozen=True)
class LogEstimate:
    """One log by itself: mean (N,) and information (N, N) in theta."""

    name: str
    mean: FloatArray
    information: FloatArray


@dataclass(frozen=True)
class Disagreement:
    """p: of Cochran's Q under agreement; parameter: its most economical explanation; p_left: the same with that parameter
    free in every log; per_log: (log, value, sd) in the parameter's unit."""

    p: float
    parameter: str
    p_left: float
    per_log: tuple[tuple[str, float, float], ...]

    def text(self, unit: str) -> str:
        """In words."""
        parts = ", ".join(f"{log} says {value:.4g} ± {sd:.2g}" for log, value, sd in self.per_log)
        if self.p_left < LEVEL:
            return (
                f"the logs disagree (p = {self.p:.1g}) and no single parameter explains it: the model lacks something that "
                f"differs between them; {self.parameter} explains most ({parts} {unit})"
            )
        return (
            f"the logs disagree about {self.parameter} (p = {self.p:.1g}): {parts} {unit}; "
            "give it per_log = true, model what changed, or leave a log out"
        )


def compare_logs(
    simulator: Simulator,
    likelihood: Segments | StateSpace,
    trajectories: Trajectories,
    theta: FloatArray,
    seed: int = 0,
    tell: Callable[[str], object] = lambda _: None,
) -> tuple[Disagreement | None, list[str]]:
    """Fit each log by itself, from theta (N,), and compare; and the names of logs that could not be fitted alone. tell: told
    what is being done."""
    estimates, skipped = [], []
    for trajectory in trajectories if len(trajectories) > 1 else ():
        tell(f"checking log {trajectory.name} by itself")
        alone = Laplace(simulator, likelihood=likelihood, seed=seed, initial=theta, budget=_BUDGET)
        try:
            alone.fit(trajectory)
        except ValueError:  # LinAlgError is one
            skipped.append(trajectory.name)
            continue
        estimates.append(LogEstimate(trajectory.name, *alone.information()))
    return disagreement(simulator.space, estimates), skipped


def disagreement(space: ParameterSpace, logs: list[LogEstimate]) -> Disagreement | None:
    """The disagreement of two or more logs, or None. Only parameters shared by all logs are compared."""
    shared = [j for j, p in enumerate(space) if p.log is None]
    if len(logs) < 2 or not shared:
        return None
    means = [log.mean[shared] for log in logs]
    informations = [_marginal(log.information, shared) for log in logs]
    q, _ = _scatter(means, informations, None)
    total = sum(informations)
    directions = [int((np.linalg.eigvalsh(i) > _DETERMINED).sum()) for i in [*informations, total]]
    freedom = sum(directions[:-1]) - directions[-1]
    if freedom < 1:
        return None
    p = float(scipy.stats.chi2.sf(q, freedom))
    if p > LEVEL:
        return None
    gains = [q - _scatter(means, informations, j)[0] for j in range(len(shared))]
    worst = int(np.argmax(gains))
    left, values = _scatter(means, informations, worst)
    p_left = float(scipy.stats.chi2.sf(left, max(1, freedom - len(logs) + 1)))
    parameter = space[shared[worst]]
    per_log = []
    for log, (theta, sd) in zip(logs, values, strict=True):
        slope = float(parameter.value(theta + 1e-6) - parameter.value(theta - 1e-6)) / 2e-6
        per_log.append((log.name, float(parameter.value(theta)), sd * slope))
    return Disagreement(p, parameter.name, p_left, tuple(per_log))


def _marginal(information: FloatArray, kept: list[int]) -> FloatArray:
    """Information about ``kept`` with the other parameters marginalised."""
    other = [j for j in range(len(information)) if j not in kept]
    block = information[np.ix_(kept, kept)]
    if not other:
        return block
    cross = information[np.ix_(kept, other)]
    ridge = 1e-9 * np.eye(len(other))
    return block - cross @ np.linalg.solve(information[np.ix_(other, other)] + ridge, cross.T)


def _scatter(
    means: list[FloatArray], informations: list[FloatArray], own: int | None
) -> tuple[float, list[tuple[float, float]]]:
    """Smallest Q with all parameters common but ``own``, and (estimate, sd) of ``own`` in each log."""
    n, k = len(means[0]), len(means)
    common = [j for j in range(n) if j != own]
    size = len(common) + (k if own is not None else 0)
    matrix, right, square = 1e-9 * np.eye(size), np.zeros(size), 0.0
    for i, (mean, information) in enumerate(zip(means, informations, strict=True)):
        design = np.zeros((n, size))
        design[common, np.arange(len(common))] = 1.0
        if own is not None:
            design[own, len(common) + i] = 1.0
        matrix += design.T @ information @ design
        right += design.T @ information @ mean
        square += float(mean @ information @ mean)
    covariance = np.linalg.inv(matrix)
    solution = covariance @ right
    q = square - float(right @ solution)
    if own is None:
        return q, []
    return q, [
        (float(solution[len(common) + i]), float(np.sqrt(covariance[len(common) + i, len(common) + i])))
        for i in range(k)
    ]
