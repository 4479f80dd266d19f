"""Intervals for a model that lacks something: causes taken by exact evidence, truths held where the model is wrong."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.stats

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.parameters import Parameter
from sipe_bayes.core.trajectory import Trajectories, Trajectory
from sipe_bayes.diagnostics.agreement import parts_of
from sipe_bayes.diagnostics.misfit.causes import sparse
from sipe_bayes.diagnostics.misfit.missing_physics import MissingPhysics, missing_physics
from sipe_bayes.diagnostics.misfit.probed_logs import ProbedLogs
from sipe_bayes.inference import get_estimator
from sipe_bayes.likelihood import Noise, Segments, bind
from sipe_bayes.posterior import prior
from tests.problems.pendulums import log, pendulum

FRICTION = Parameter("coulomb", 0.0, 0.1, targets=("joint:hinge.frictionloss",))


def regression(seed: int, size: float) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """40 samples of one plain column and three others, of which the first has the size: columns, y, J'J and J'y."""
    random = np.random.default_rng(seed)
    columns = random.standard_normal((40, 4))
    y = columns @ np.array([1.0, size, 0.0, 0.0]) + random.standard_normal(40)
    return columns, y, columns.T @ columns, columns.T @ y


def test_the_precisions_are_at_the_maximum_of_the_exact_evidence() -> None:
    """Of the normal density of y, with a plain column of next to no prior; beside it and without it no higher."""
    columns, y, precision, gradient = regression(1, 1.5)
    alpha = sparse(precision, gradient, 1, np.ones(3, bool), np.zeros(3, bool))

    def evidence(alpha: FloatArray) -> float:
        own = columns[:, 1:] @ np.diag(np.where(np.isfinite(alpha), 1 / alpha, 0.0)) @ columns[:, 1:].T
        covariance = np.eye(40) + 1e8 * np.outer(columns[:, 0], columns[:, 0]) + own
        return float(scipy.stats.multivariate_normal.logpdf(y, cov=covariance))

    assert np.isfinite(alpha).tolist() == [True, False, False]
    at = evidence(alpha)
    for factor in (0.7, 1.4):
        assert evidence(alpha * factor) < at
    assert at - evidence(np.full(3, np.inf)) > 2
    for other in (1, 2):
        for scale in np.geomspace(0.1, 1e3, 9):
            assert evidence(np.where(np.arange(3) == other, scale, alpha)) < at + 2


def test_columns_that_may_not_be_taken_or_would_be_negative_stay_out() -> None:
    _, _, precision, gradient = regression(1, -1.5)
    everyone, nobody = np.ones(3, bool), np.zeros(3, bool)
    assert np.isfinite(sparse(precision, gradient, 1, everyone, nobody))[0]
    assert not np.isfinite(sparse(precision, gradient, 1, everyone, everyone))[0]
    assert not np.isfinite(sparse(precision, gradient, 1, nobody, nobody)).any()


def test_a_column_that_moves_nothing_is_left_out_without_a_warning() -> None:
    """Its gradient is rounding: 1e-20 is far more than the square of an information of zero."""
    with np.errstate(divide="raise", invalid="raise", over="raise"):
        alpha = sparse(np.diag([4.0, 0.0, 9.0]), np.array([1.0, 1e-20, 30.0]), 1, np.ones(2, bool), np.zeros(2, bool))
    assert np.isfinite(alpha).tolist() == [False, True]


def of_logs(logs: list[Trajectory], doubted: bool) -> tuple[MissingPhysics, FloatArray, FloatArray]:
    """With plain 90 % intervals (2, 2) and these, of rod mass and damping alone."""
    simulator, recorded = pendulum(), Trajectories.stack(logs)
    method = get_estimator(simulator, "laplace", restarts=1, candidates=0)
    posterior = method.fit(recorded)
    theta = posterior.mode.numpy()
    noise = Noise(np.array(method.diagnostics["noise_sd"]), np.array(method.diagnostics["noise_tau"]))
    probed = ProbedLogs(bind(method.likelihood, simulator, recorded), theta, noise)
    seen = missing_physics(probed, posterior, prior(simulator.space), doubted)
    assert seen is not None
    return seen, *(p.quantile([0.05, 0.95]).numpy() for p in (posterior, seen.further))


@pytest.mark.parametrize("logs", [1, 3])
def test_truths_are_held_where_the_model_lacks_dry_friction(logs: int) -> None:
    """The plain intervals, a fifth as wide or less, do not hold the damping; the cause is named, among others."""
    truth = np.array([0.6, 0.08])
    recorded = [log(pendulum(FRICTION), [*truth, 0.04], seed, name=f"log {seed}") for seed in range(2, 2 + logs)]
    seen, plain, wide = of_logs(recorded, doubted=True)
    theta = pendulum().space.normalise(truth)
    print(theta, plain, wide, seen.causes, seen.explained)
    assert not plain[0, 1] <= theta[1] <= plain[1, 1]
    assert ((wide[0] <= theta) & (theta <= wide[1])).all()
    assert any("friction" in cause for cause in seen.causes)


def test_of_a_right_model_they_are_not_far_wider_and_hold_the_truth() -> None:
    recorded = [log(pendulum(), [0.6, 0.08], seed, name=f"log {seed}") for seed in range(6)]
    theta = pendulum().space.normalise(np.array([0.6, 0.08]))
    for doubted, most in ((True, 6), (False, 1.3)):  # a further log alone knows a sixth of six
        seen, plain, wide = of_logs(recorded, doubted)
        print(plain, wide, seen)
        assert ((wide[0] <= theta) & (theta <= wide[1])).all()
        assert (wide[1] - wide[0] < most * (plain[1] - plain[0])).all()
        assert len(seen.causes) == 3  # that would move the values most
        assert seen.explained != doubted


def test_a_single_log_stands_in_pieces_of_whole_windows() -> None:
    one = log(pendulum(), [0.6, 0.08], 3)
    parts = parts_of(bind(Segments(0.5), pendulum(), Trajectories.stack([one])))
    assert [name for name, _ in parts] == [one.name] * 5
    assert np.concatenate([piece for _, piece in parts]).tolist() == list(range(8))
    both = parts_of(
        bind(Segments(0.5), pendulum(), Trajectories.stack([one, log(pendulum(), [0.6, 0.08], 4, name="b")]))
    )
    assert [(name, len(piece)) for name, piece in both] == [(one.name, 8), ("b", 8)]
