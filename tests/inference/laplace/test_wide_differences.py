"""A slope that is mostly jump makes a normal too narrow; differences as long as it is wide mend it, or it is said."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sipe_bayes.core.findings import Code
from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.inference.laplace.estimator import Laplace
from sipe_bayes.inference.laplace.options import LaplaceOptions, LaplaceTuning, WideDifferenceTuning
from sipe_bayes.inference.laplace.strategy import SearchProblem
from sipe_bayes.inference.laplace.windows.energy import updated_noise
from sipe_bayes.inference.laplace.windows.optimum import Ending, judged, summarised, widened
from sipe_bayes.likelihood.noise import Noise
from sipe_bayes.likelihood.settings import Segments
from sipe_bayes.likelihood.windows import Windows
from tests.problems.pendulums import log, pendulum


@pytest.fixture(scope="module")
def fitted() -> tuple[Laplace, Windows, Ending]:
    """A smooth fit of three logs, and where its search ended, linearised anew."""
    simulator = pendulum()
    logs = Trajectories.stack([log(simulator, [0.6, 0.08], seed, name=f"log {seed}") for seed in range(3)])
    method = Laplace(simulator, restarts=1, candidates=0)
    method.likelihood = Segments(None, "white")
    method.fit(logs)
    assert method.state is not None
    (best,) = method.state.search.optima
    windows = Windows(method.likelihood, simulator, logs)
    lin = windows.linearise(best.theta, best.starts)
    moments = windows.moments(lin, white=True)
    noise = Noise(best.sd, best.tau)
    parts = (best.theta, best.starts, noise, moments, lin.residual, lin.jacobian, best.theta, 5, 1.0, 0.0)
    return method, windows, Ending(*parts, tells=True, settled=True, cut_short=False, bettered=None)


def jumpy(windows: Windows, ending: Ending, size: float) -> Ending:
    """With the slope by the first parameter ``size`` times as large by jumps that no other point has."""
    jacobian = ending.jacobian.copy()
    level = np.sqrt((jacobian[..., 0] ** 2).mean())
    jacobian[..., 0] += size * level * np.random.default_rng(0).standard_normal(jacobian.shape[:-1])
    moments = windows.moments(replace(windows.linearise(ending.theta, ending.starts), jacobian=jacobian), white=True)
    return replace(ending, jacobian=jacobian, moments=moments)


def test_a_smooth_normal_stays_as_it_is(fitted: tuple[Laplace, Windows, Ending]) -> None:
    method, windows, ending = fitted
    before = windows.rollouts
    plain, wide = (one(method.problem, windows, ending) for one in (summarised, widened))
    assert (plain.covariance == wide.covariance).all()
    assert windows.rollouts - before == 2 * 2 * 3
    assert wide.finding is None


def test_a_normal_that_jumps_make_narrow_grows_to_its_width(fitted: tuple[Laplace, Windows, Ending]) -> None:
    method, windows, ending = fitted
    right, narrow = (summarised(method.problem, windows, e) for e in (ending, jumpy(windows, ending, 6.0)))
    wide = widened(method.problem, windows, jumpy(windows, ending, 6.0))
    sds = [np.sqrt(np.diag(one.covariance)) for one in (narrow, wide)] / np.sqrt(np.diag(right.covariance))
    print(sds)
    assert sds[0, 0] < 0.4
    assert np.allclose(sds[1], 1.0, atol=0.05)
    assert wide.over(right) < 1.1
    assert wide.finding is None


def test_one_that_is_left_narrow_is_said(fitted: tuple[Laplace, Windows, Ending]) -> None:
    """A single round does not ask the wider one again; the finding sends importance draws, or blocks."""
    method, windows, ending = fitted
    options = LaplaceOptions(tuning=LaplaceTuning(wide=WideDifferenceTuning(rounds=1)))
    problem: SearchProblem = replace(method.problem, options=options)
    wide = widened(problem, windows, jumpy(windows, ending, 6.0))
    assert wide.finding is not None
    assert wide.finding.code is Code.NOT_SMOOTH
    assert wide.unsmooth


def test_what_no_simulation_keeps_counts_neither_for_the_noise_nor_for_the_optimum(
    fitted: tuple[Laplace, Windows, Ending],
) -> None:
    """A slope along the residuals, which promises to explain them all, as at a kink of dry friction."""
    method, windows, ending = fitted
    jacobian = ending.jacobian.copy()
    jacobian[..., 0] = np.abs(jacobian[..., 0]).mean() / ending.noise.sd * ending.residual
    moments = windows.moments(replace(windows.linearise(ending.theta, ending.starts), jacobian=jacobian), white=True)
    promising = replace(ending, jacobian=jacobian, moments=moments)
    at, prior = (ending.noise, ending.theta, ending.starts), method.problem.quadratic_prior
    size = float(np.sqrt((ending.residual[windows.observed] ** 2).mean()))
    believed, held = (updated_noise(windows, moments, *at, prior, False, held).sd[0] / size for held in (False, True))
    print(believed, held)
    assert believed < 0.2
    assert 1.0 <= held < 1.1

    kept, broken = (summarised(method.problem, windows, replace(promising, refused=r)) for r in (0.0, 100.0))
    assert kept.evidence > broken.evidence + 100.0
    judgement = judged(method.problem, windows, broken, None, replace(promising, refused=100.0))
    assert judgement.unsmooth
    assert (judgement.mean == ending.theta).all()
    quiet = judged(method.problem, windows, broken, None, replace(promising, refused=100.0, tells=False))
    assert quiet.finding is not None
    assert quiet.finding.code is Code.KINK
    assert (quiet.covariance == judgement.covariance).all()

    # along the promised way as far as the cube, not across its corner
    n = len(ending.theta)
    way = np.full(n, 0.01)
    way[0] = 10 * (1 - ending.theta[0])
    far = judged(
        method.problem, windows, replace(broken, mean=ending.theta + way), None, replace(promising, refused=100.0)
    )
    np.testing.assert_allclose(far.covariance - broken.covariance, np.outer(way, way) / 100, atol=1e-12)
