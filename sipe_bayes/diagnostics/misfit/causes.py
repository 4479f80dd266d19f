"""The few pieces of the library that the evidence keeps, to first order: causes of what a model leaves of the logs.

In the linear model of ``misfit.probed_logs`` each column has a normal prior whose precision is where the evidence is
greatest, infinite for most of them (sparse Bayesian learning: M. Tipping, A. Faul, "Fast marginal likelihood
maximisation for sparse Bayesian models", AISTATS 2003, https://proceedings.mlr.press/r4/tipping03a.html).

Deviations:

- A column is taken only where it raises the log evidence by ``gain``, and ``causes`` at most: there are dozens, and a
  dozen of them together would explain anything.
- The noise is estimated anew with the columns that were taken, in turns.
- Gains that differ between logs are not taken: they would explain why logs differ, which the spread is to hold.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sipe_bayes.core.arrays import BoolArray, FloatArray, IntArray
from sipe_bayes.core.options import Options, option
from sipe_bayes.core.thresholds import THRESHOLDS
from sipe_bayes.diagnostics.misfit.probed_logs import FLAT_PRECISION, MISFIT, ProbedLogs, oddness, remembering
from sipe_bayes.likelihood import Noise
from sipe_bayes.posterior import Particles


@dataclass(frozen=True)
class CauseOptions(Options):
    """How causes are taken from the library."""

    gain: float = option(2.0, "of the log evidence, below which a cause is not taken", "nats", least=0)
    causes: int = option(4, "columns that are taken at most: a dozen small ones together explain anything", least=1)
    rounds: int = option(3, "in which causes and noise are estimated in turn", least=1)
    most: int = option(300, "steps of the search for causes", least=1)


CAUSES = CauseOptions()
_NOTHING = 1e-150  # information of a column that moves nothing: its square is no number


@dataclass(frozen=True)
class Causes:
    """Columns of the library that the evidence keeps, to first order.

    Args:
        kept: (A,) their numbers.
        step: (N + A,) of theta and of their sizes.
        covariance: (A, A) of their sizes.
        response: (N, A) of theta to them.
        noise: (C,) with them.
        memory: (C,) of what they leave.
    """

    kept: IntArray
    step: FloatArray
    covariance: FloatArray
    response: FloatArray
    noise: Noise
    memory: FloatArray

    @classmethod
    def of(cls, logs: ProbedLogs, options: CauseOptions = CAUSES) -> Causes:
        """In turns with the noise."""
        windows, n = logs.windows, logs.windows.num_theta
        noise, memory = logs.noise, logs.memory
        usable = np.array([not probe.by_log for probe in logs.probes], bool)
        prior, prior_pull = FLAT_PRECISION * np.eye(logs.count), np.zeros(logs.count)
        prior[:n, :n], prior_pull[:n] = logs.inner, logs.pull
        for _ in range(options.rounds):
            normal = logs.rows.normal(logs.residual, remembering(noise, memory))
            arrow = windows.eliminate(normal, logs.count, logs.starts)
            precision, gradient = arrow.precision + prior, arrow.gradient + prior_pull
            alpha = sparse(precision, gradient, n, usable, logs.one_sided, options)
            kept = np.flatnonzero(np.isfinite(alpha))
            columns = np.concatenate([np.arange(n), n + kept])
            among, beliefs = np.ix_(columns, columns), np.diag(np.concatenate([np.zeros(n), alpha[kept]]))
            covariance = np.linalg.inv(precision[among] + beliefs)
            pulls = windows.pulls(beliefs + prior[among], prior_pull[columns], logs.starts)
            noise = windows.estimate_noise(windows.moments(logs.lin(columns)), noise, pulls, logs.coloured)
            noise = Noise(np.maximum(noise.sd, windows.rounding), noise.tau)
            step = covariance @ gradient[columns]
            whole = np.zeros(logs.count)
            whole[columns] = step
            memory = logs.memory_of(logs.left(logs.residual, whole, arrow.blocks(whole)), noise)
        response = -np.linalg.solve(precision[:n, :n], precision[:n, n + kept])
        return cls(kept, step, covariance[n:, n:], np.asarray(response), noise, memory)

    def sizes(self, logs: ProbedLogs) -> FloatArray:
        """Of all K columns, zero of those not kept."""
        sizes = np.zeros(len(logs.probes))
        sizes[self.kept] = self.step[logs.windows.num_theta :]
        return sizes

    def explain(self, logs: ProbedLogs, seed: int) -> bool:
        """Whether what they leave passes for noise, by the null of the check of the residuals."""
        arrow = logs.windows.eliminate(logs.rows.normal(logs.residual, self.noise), logs.count, logs.starts)
        step = np.concatenate([self.step[: logs.windows.num_theta], self.sizes(logs)])
        seen = logs.whiteness(logs.left(logs.residual, step, arrow.blocks(step)), self.noise)
        null = logs.null(seed, MISFIT.simulated)[:, len(logs.probes) :]
        odd, largest = oddness(seen, null)
        return bool((1 + (largest >= odd.max()).sum()) / (1 + len(null)) > THRESHOLDS.misfit)

    def widened(self, logs: ProbedLogs, further: Particles, random: np.random.Generator) -> Particles:
        """With what is not known of their sizes, and what they trade with theta."""
        theta = further.theta.numpy()
        away = random.multivariate_normal(np.zeros(len(self.kept)), self.covariance, len(theta))
        sizes = np.tile(self.sizes(logs), (len(theta), 1))
        sizes[:, self.kept] += away
        theta = theta + away @ self.response.T + logs.traded(sizes)
        return Particles(np.clip(theta, 0, 1), further.space, weights=further.weights.numpy())


def sparse(
    precision: FloatArray,
    gradient: FloatArray,
    plain: int,
    usable: BoolArray,
    one_sided: BoolArray,
    options: CauseOptions = CAUSES,
) -> FloatArray:
    """Precisions of the priors of K columns beside others at the maximum of the evidence, infinite of those left out.

    Columns are taken, changed and dropped one at a time, each time the one that raises the evidence most (Tipping and
    Faul 2003, section 4; s and q as there).

    Args:
        precision: (P + K, P + K) of all columns' likelihood.
        gradient: (P + K,), so that the flat optimum is precision^-1 gradient.
        plain: P, columns that are always in.
        usable: (K,) those that may be taken.
        one_sided: (K,) those whose size may not be negative.
        options: of the search.

    Returns:
        (K,).
    """
    size = np.diag(precision)[plain:]
    usable = usable & (size > _NOTHING)
    alpha = np.full(len(size), np.inf)
    for _ in range(options.most):
        kept = np.flatnonzero(np.isfinite(alpha))
        columns = np.concatenate([np.arange(plain), plain + kept])
        beliefs = np.diag(np.concatenate([np.zeros(plain), alpha[kept]]))
        covariance = np.linalg.inv(precision[np.ix_(columns, columns)] + beliefs)
        cross = precision[plain:][:, columns]
        s = size - np.einsum("ki,ij,kj->k", cross, covariance, cross)
        q = gradient[plain:] - cross @ (covariance @ gradient[columns])
        own = alpha[kept] / (alpha[kept] - s[kept])
        s[kept], q[kept] = own * s[kept], own * q[kept]
        s = np.maximum(s, 1e-12 * np.maximum(size, 1e-300))
        better = (q**2 > s) & (s > 1e-5 * size) & usable & ~(one_sided & (q < 0))
        best = np.where(better, s**2 / np.where(better, q**2 - s, 1.0), np.inf)
        gain = _evidence(best, s, q)
        weak = kept[gain[kept] < options.gain]
        if len(weak):
            alpha[weak[np.argmin(gain[weak])]] = np.inf
            continue
        taken = np.isfinite(alpha)
        room = taken.sum() < options.causes
        new = np.where(room & (gain >= options.gain), gain, 0.0)
        rise = np.where(taken, gain - _evidence(alpha, s, q), new)
        k = int(rise.argmax())
        if rise[k] < 1e-3:
            break
        alpha[k] = best[k]
    return alpha


def _evidence(alpha: FloatArray, s: FloatArray, q: FloatArray) -> FloatArray:
    """Log evidence that each column adds with these priors (K,); 0 of one that is left out."""
    inside = np.isfinite(alpha)
    own = np.where(inside, alpha, 1.0)
    return np.where(inside, 0.5 * (np.log(own / (own + s)) + q**2 / (own + s)), 0.0)
