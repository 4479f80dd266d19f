"""Where an optimum through contact would lie by other linearisations: its mean is their average, and they scatter.

A linearisation tells where the optimum is by the slopes of every control step. Through contact slopes jump from one
place to the next by more than the noise, and a log posterior linearised afresh a tenth of an sd away differs by ten
nats; so one linearisation says less than its normal claims. As many as ``WideTuning.linearisations`` are therefore
taken at draws from that normal, after a step of the states there, and each has a normal of its own. Their means'
average is the estimate's, their covariance is added to the interval's, and so is what theirs are wider by. Where no
control step jumps nothing is taken: they agree.

Deviation from importance sampling: they count alike. Weights that differ by ten nats from roughness alone would leave
one of them, at random.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.inference.laplace.state_space.chain_draws import blur
from sipe_bayes.inference.laplace.state_space.state import ChainOptimum
from sipe_bayes.inference.laplace.state_space.target import ChainTarget
from sipe_bayes.inference.laplace.strategy import SearchProblem
from sipe_bayes.likelihood.state_space.differences import linearise_by
from sipe_bayes.likelihood.state_space.linearisation import eliminate_states


def linearisations_cost(problem: SearchProblem, coordinates: int) -> int:
    """Rollouts of a log that all of them take; coordinates: of a state (D)."""
    sides = 2 * (len(problem.space) + coordinates) + 1
    return 2 * problem.options.tuning.state_space.wide.linearisations * sides


def scattered(problem: SearchProblem, target: ChainTarget, optimum: ChainOptimum) -> ChainOptimum:
    """An optimum, the target's, with the shift and the scatter of its mean.

    Raises:
        BudgetExhausted: before there are enough of them.
    """
    count = problem.options.tuning.state_space.wide.linearisations
    if not optimum.rough or not optimum.state_step.any() or count < 2:
        return optimum
    rng, root = np.random.default_rng([problem.seed, 3]), np.linalg.cholesky(optimum.covariance)
    normals = []
    for draw in rng.standard_normal((count, len(optimum.theta))):
        normal = _normal(problem, target, np.clip(optimum.theta + root @ draw, 0.0, 1.0))
        normals += [] if normal is None else [normal]
    if len(normals) < count / 2:  # it diverges about there
        return optimum
    means, covariances = (np.stack(of_all) for of_all in zip(*normals, strict=True))
    wider = blur(optimum.covariance, covariances.mean(0))
    return replace(optimum, shift=means.mean(0) - optimum.mean, scatter=np.atleast_2d(np.cov(means.T)) + wider)


def _normal(problem: SearchProblem, target: ChainTarget, theta: FloatArray) -> tuple[FloatArray, FloatArray] | None:
    """Mean (N,) and covariance (N, N) by a linearisation at theta (N,), a step of the states later; None: diverges."""
    chain, optimum = target.chain, target.optimum
    states = target.states(theta[None])[0]
    solved = None
    for _ in range(2):
        states = states if solved is None else chain.moved(states, solved.shift)
        linear = linearise_by(chain, theta, states, optimum.theta_step, optimum.state_step)
        if linear is None:
            return None
        try:
            solved = eliminate_states(linear, optimum.noise)
        except np.linalg.LinAlgError:  # rounding rules there
            return None
    assert solved is not None
    return problem.normal(theta, solved.precision, solved.gradient)
