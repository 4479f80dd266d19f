"""The normal of theta with the noise of a chain of states averaged over, not held at its estimate.

Noise is estimated too small as often as too large, by as much as the log leaves open, and the width of the interval
follows it. Here the logarithms of the noise are drawn from their posterior given the linearisation at the optimum, by
Metropolis steps along the principal axes of its normal, and theta's covariance is that of the normals that go with
them. One linearisation serves all, so that it costs no simulation. The draws follow the posterior's own shape: process
noise that a log hardly shows is bounded above far more sharply than the curvature at its mode says, and a normal there
would widen intervals where there is none.

Deviation: the mean stays where the noise is held. Where a linearisation promises more than the simulation keeps, the
noise is judged by states and theta where they are, as its estimate was.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.inference.laplace.state_space.noise import NoisePosterior, process_penalty
from sipe_bayes.inference.laplace.state_space.options import AverageTuning
from sipe_bayes.inference.laplace.state_space.target import ChainFit
from sipe_bayes.inference.laplace.strategy import SearchProblem
from sipe_bayes.likelihood.block_tridiagonal import Eliminated
from sipe_bayes.likelihood.state_space.chain import Chain
from sipe_bayes.likelihood.state_space.linearisation import integrate


def averaged(problem: SearchProblem, chain: Chain, fit: ChainFit) -> FloatArray:
    """Covariance (N, N) of theta, before truncation, with the noise integrated out."""
    optimum, linear, tuning = fit.optimum, fit.linearisation, problem.options.tuning.state_space
    of_noise = NoisePosterior(
        chain, linear, optimum.noise, problem.quadratic_prior, optimum.theta, optimum.movement, tuning.noise
    )
    of_noise = replace(of_noise, held=of_noise.promised > tuning.wide.tolerance)
    least = of_noise.least[of_noise.free]

    def at(logs: FloatArray) -> tuple[float, Eliminated | None]:
        """Log posterior of the noise, and what goes with it."""
        if (logs < least).any():
            return -np.inf, None
        noise = of_noise.at(logs)
        try:
            done = integrate(linear, noise, of_noise.hold, of_noise.held)
        except np.linalg.LinAlgError:  # so far apart that rounding rules
            return -np.inf, None
        return done.value - process_penalty(noise, optimum.movement, tuning.noise), done.solved

    def normal(solved: Eliminated | None) -> tuple[FloatArray, FloatArray]:
        """Mean and covariance of theta."""
        if solved is None:
            return optimum.mean, optimum.covariance
        return problem.normal(optimum.theta, solved.precision, solved.gradient)

    average, logs = tuning.noise_average, of_noise.start[of_noise.free]
    axes, rng = _axes(of_noise, logs, average), np.random.default_rng([problem.seed, 2])
    here, solved = at(logs)
    beside, means, covariances, taken = normal(solved), [], [], 0
    for draw in range(average.draws):
        proposed = logs + average.step * rng.standard_normal() * axes[draw % len(axes)]
        value, solved = at(proposed)
        if np.log(rng.random()) < value - here:
            logs, here, beside, taken = proposed, value, normal(solved), taken + 1
        means.append(beside[0])
        covariances.append(beside[1])
        if (draw + 1) % (average.draws // 8) == 0:
            sds = np.sqrt([np.diag(one) for one in covariances])
            scatter = max(np.log(sds).std(0).max(), (np.std(means, axis=0) / sds[-1]).max())
            if taken > len(axes) and scatter * np.sqrt(2 * len(axes) / (draw + 1)) < average.exact:
                break
    return _spread(means, covariances)


def _spread(means: list[FloatArray], covariances: list[FloatArray]) -> FloatArray:
    """Covariance (N, N) of a mixture of normals in equal parts."""
    spread = np.array(means) - np.mean(means, axis=0)
    return np.asarray(np.mean(covariances, axis=0) + spread.T @ spread / len(spread))


def _axes(of_noise: NoisePosterior, logs: FloatArray, tuning: AverageTuning) -> FloatArray:
    """Principal axes (F, F) of the noise's normal, as long as its sds, in rows."""
    sides = tuning.difference * np.eye(len(logs))
    rises = [of_noise.loss(logs + side)[1] - of_noise.loss(logs - side)[1] for side in sides]
    curvature = np.array(rises) / (2 * tuning.difference)
    eigenvalues, axes = np.linalg.eigh(0.5 * (curvature + curvature.T))
    return np.asarray(axes.T / np.sqrt(np.maximum(eigenvalues, tuning.least_curvature))[:, None])
