"""Windows of bodies that tumble: starts through impacts, what a lost window costs, intervals from the scatter."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sipe_bayes.calibration.checks.lacking import groups_apart
from sipe_bayes.core.findings import Code, Findings, Severity
from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.diagnostics.misfit.missing_physics import spread_alone
from sipe_bayes.inference.laplace.estimator import Laplace
from sipe_bayes.inference.laplace.options import GrowingTuning
from sipe_bayes.inference.laplace.windows.energy import LinearisedWindows, WindowEnergy, WindowPoint
from sipe_bayes.inference.laplace.windows.growing_windows import (
    ManyStarts,
    grown_starts,
    grows,
    not_below,
    num_groups,
    scattered,
    told_starts,
)
from sipe_bayes.inference.laplace.windows.state import WindowOptimum
from sipe_bayes.likelihood.noise import Noise
from sipe_bayes.likelihood.quadratic_prior import QuadraticPrior
from sipe_bayes.likelihood.settings import Segments
from sipe_bayes.likelihood.windows import Windows
from tests.problems.bodies import cube, tosses

TUNING, NOISE = GrowingTuning(), 0.004
WHITE = Noise(np.full(6, NOISE), np.zeros(6))
TRUTH = np.array([0.5])


@pytest.fixture(scope="module")
def windows() -> Windows:
    simulator = cube()
    logs, _ = tosses(simulator, 8, 70, seed=5, noise=NOISE)
    return Windows(Segments(None, "white"), simulator, logs)


def chi_square(windows: Windows, starts: np.ndarray) -> np.ndarray:
    residual, _ = windows.residuals(TRUTH[None], starts[None])
    return np.asarray(((residual[0] / NOISE) ** 2).mean((1, 2)))


def test_beginnings_are_the_windows_cut_short(windows: Windows) -> None:
    short = windows.beginnings(20)
    starts = windows.no_starts()
    whole, part = windows.residuals(TRUTH[None], starts[None])[0], short.residuals(TRUTH[None], starts[None])[0]
    np.testing.assert_array_equal(part[0], whole[0][:, :21])
    assert [len(s.index) for s in short.sequences] == [8 * 21] * 6
    assert windows.beginnings(70) is windows
    some = windows.part(np.array([2, 5]))
    np.testing.assert_array_equal(some.residuals(TRUTH[None], some.no_starts()[None])[0][0], whole[0][[2, 5]])


def test_starts_are_found_through_impacts(windows: Windows) -> None:
    """From the measured starts alone nearly every toss ends elsewhere; of beginnings that grow nearly all fit."""
    assert np.median(chi_square(windows, windows.no_starts())) > 20
    found = chi_square(windows, grown_starts(windows, TRUTH, WHITE, TUNING))
    assert np.median(found) < 1.3, found
    assert (found < 3).sum() >= 6, found


def test_first_moments_tell_where_windows_start(windows: Windows) -> None:
    """Velocities of a free flight to the error of a straight line's slope, and later samples change nothing."""
    _, states = tosses(windows.simulator, 8, 70, seed=5, noise=NOISE)
    told, velocity = told_starts(windows, TRUTH, TUNING), slice(8, 14)
    samples = int(TUNING.telling / windows.dt[0]) + 2
    slope = np.sqrt(12) * NOISE / (samples**1.5 * windows.dt[0])
    error = {
        name: np.sqrt(((windows.states(TRUTH[None], starts[None])[0] - states[:, 0])[:, velocity] ** 2).mean())
        for name, starts in (("told", told), ("measured", windows.no_starts()))
    }
    assert error["told"] < 1.3 * slope < 0.5 * error["measured"], (error, slope)
    later = windows.part(np.arange(8))
    later.measured = windows.measured.copy()
    later.measured[:, samples:] += 0.1
    np.testing.assert_allclose(told_starts(later, TRUTH, TUNING), told)


def test_a_window_that_is_lost_does_not_stop_the_others(windows: Windows) -> None:
    """A step that is good for all windows but one is taken by all but that one; a plain step is refused."""
    starts = grown_starts(windows, TRUTH, WHITE, TUNING)
    lin = windows.linearise(TRUTH, starts, with_theta=False)
    energy = WindowEnergy(windows, WHITE, QuadraticPrior(TRUTH, np.zeros((1, 1))))
    moved = starts + 0.0
    moved[1:, 8] += 0.02  # the others stand where a step back is good
    residual = windows.residuals(TRUTH[None], moved[None])[0][0]
    point, moments = WindowPoint(TRUTH, moved, residual), windows.moments(lin, white=True)
    step = starts - moved
    step[0, 3:6] = 2.0  # and one is to tumble otherwise
    plain, many = LinearisedWindows(energy, point, moments), ManyStarts(energy, point, moments, TUNING.shares)
    assert plain.simulated(TRUTH, step)[1] > plain.energy
    taken, after = many.simulated(TRUTH, step)
    assert after < many.energy
    np.testing.assert_allclose(taken.starts[0], moved[0])
    assert (taken.starts[1:, 8] < moved[1:, 8]).sum() >= 5


def test_only_bodies_with_a_measured_pose_grow(windows: Windows) -> None:
    assert grows(windows)
    assert num_groups(windows, TUNING) == 4
    simulator = cube("body:cube.position")
    logs, _ = tosses(simulator, 2, 20, seed=1)
    assert not grows(Windows(Segments(None), simulator, logs))
    assert not grows(Windows(Segments(None, starts="recorded"), windows.simulator, with_states(windows)))


def with_states(windows: Windows) -> Trajectories:
    states = np.zeros((*windows.trajectories.observations.shape[:2], windows.simulator.state_size))
    states[..., 4] = 1.0
    return replace(windows.trajectories, states=states)


def optimum(sd: float) -> WindowOptimum:
    nothing = np.zeros(0)
    return WindowOptimum(
        np.full(2, 0.5),
        np.full(2, 0.5),
        sd**2 * np.eye(2),
        0.0,
        nothing,
        nothing,
        np.zeros((0, 0)),
        np.zeros((0, 0, 2)),
    )


@pytest.mark.parametrize("groups", [4, 8])
def test_the_scatter_of_groups_gives_honest_intervals(groups: int) -> None:
    """Of estimates of known spread: 90 % intervals hold the truth as often, whatever the curvature said.

    Of 2,000 draws, within four standard errors; the estimate of all has the error of the mean, on its own.
    """
    rng, sd, inside = np.random.default_rng(0), 0.05, []
    for _ in range(2000):
        estimates = 0.5 + sd * rng.normal(size=(groups, 2))
        whole = replace(optimum(1e-5), theta=0.5 + sd / np.sqrt(groups) * rng.normal(size=2))
        found = scattered(whole, estimates, TUNING)
        inside.append(np.abs(found.mean - 0.5) < 1.645 * np.sqrt(np.diag(found.covariance)))
    share = float(np.mean(inside))
    assert 0.88 < share < 0.99, share


def test_a_smooth_problem_keeps_its_curvature() -> None:
    rng = np.random.default_rng(0)
    estimates = 0.5 + 0.01 * np.sqrt(8) * rng.normal(size=(8, 2))
    before = optimum(0.01)
    assert scattered(before, estimates, TUNING) is before


@pytest.mark.parametrize("spread", [1e-6, 0.1])
def test_the_scatter_of_what_slips_is_not_believed(spread: float) -> None:
    """Whether the groups agree or not: they may all be off together."""
    estimates = 0.5 + spread * np.random.default_rng(0).normal(size=(8, 2))
    slipped = scattered(optimum(0.01), estimates, TUNING, slips=True)
    assert slipped.finding is not None
    assert slipped.finding.code is Code.SLIPS
    assert slipped.finding.severity is Severity.BLOCKING
    rest = scattered(optimum(0.01), estimates, TUNING)
    np.testing.assert_array_equal(slipped.covariance, rest.covariance)


def test_no_scatter_is_narrower_than_what_the_logs_leave_open() -> None:
    """Searches all end where they began along a direction that no log tells; across it their scatter counts."""
    rng, ridge = np.random.default_rng(2), np.array([1.0, -1.0]) / np.sqrt(2)
    across = np.array([1.0, 1.0]) / np.sqrt(2)
    left_open = replace(optimum(1e-5), covariance=1e-10 * np.eye(2) + 0.3**2 * np.outer(ridge, ridge))
    wide = scattered(left_open, 0.5 + 0.01 * rng.normal(size=(4, 2)), TUNING).covariance
    print(wide)
    assert 0.3**2 < ridge @ wide @ ridge < 0.31**2
    assert 1e-3**2 < across @ wide @ across < 0.03**2


def test_the_wider_of_two_covariances_is_wider_than_both() -> None:
    """In every direction, and no wider than their sum; one that is singular to rounding is no error."""
    rng = np.random.default_rng(3)
    for size in (1, 2, 5):
        for _ in range(20):
            drawn = rng.normal(size=(2, size, size)) * 10.0 ** rng.uniform(-3, 0, (2, size, 1))
            one, other = (each @ each.T + 1e-6 * np.eye(size) for each in drawn)
            wide = not_below(one, other)
            gaps = [np.linalg.eigvalsh(gap).min() for gap in (wide - one, wide - other, one + other - wide)]
            assert min(gaps) > -1e-9 * np.trace(wide)
    ridge = np.array([1.0, -1.0])
    assert np.isfinite(not_below(1e-6 * np.eye(2), np.outer(ridge, ridge))).all()


def test_a_lost_group_counts_for_nothing() -> None:
    rng = np.random.default_rng(1)
    estimates = 0.5 + 0.01 * rng.normal(size=(8, 2))
    estimates[3] = 0.0, 1.0
    found = scattered(optimum(1e-5), estimates, TUNING)
    assert np.abs(found.mean - 0.5).max() < 0.01
    assert np.sqrt(np.diag(found.covariance)).max() < 0.01
    assert found.finding is not None
    assert found.finding.code is Code.SCATTER


def test_a_cube_is_calibrated_through_its_impacts(windows: Windows) -> None:
    """Friction from eight tosses: the truth within three sds, of a few hundredths; interrupted it ends the same."""
    estimator = Laplace(windows.simulator, likelihood=windows.settings, budget=20000, restarts=1, candidates=0)
    posterior = estimator.fit(windows.trajectories)
    assert Code.SCATTER in {item.code for item in estimator.findings}
    assert abs(float(posterior.mean[0]) - 0.5) < 3 * float(posterior.stddev[0])
    assert 1e-4 < float(posterior.stddev[0]) < 0.05
    assert not any(item.severity == "blocking" for item in estimator.findings)
    groups = groups_apart(estimator, posterior)
    assert len(groups) == 4
    apart = spread_alone(groups, estimator.prior, True)
    assert apart is not None
    low, high = apart.further.quantile([0.05, 0.95])[:, 0].tolist()
    assert low < 0.5 < high
    assert high - low > 3.29 * float(posterior.stddev[0])
    estimator.findings = Findings()
    assert groups_apart(estimator, posterior) == []


def test_few_windows_say_that_their_intervals_are_not_to_be_trusted(windows: Windows) -> None:
    few = Trajectories.stack(list(windows.trajectories)[:2])
    estimator = Laplace(windows.simulator, likelihood=windows.settings, budget=20000, restarts=1, candidates=0)
    estimator.fit(few)
    assert Code.SCATTER_UNKNOWN in {item.code for item in estimator.findings}


def test_a_budget_that_ends_early_is_said() -> None:
    """Where it ends among the groups, the curvature's narrow intervals do not stand without a word."""
    simulator = cube()
    logs, _ = tosses(simulator, 8, 30, seed=5, noise=NOISE)
    settings, found = Segments(None, "white"), []
    for short in (0, 60):
        budget = 20000 if not found else found[0].rollouts - short
        estimator = Laplace(simulator, likelihood=settings, budget=budget, restarts=1, candidates=0)
        estimator.fit(logs)
        found.append(estimator)
    codes = [{item.code for item in estimator.findings} for estimator in found]
    assert Code.SEARCH_CUT_SHORT in codes[1] - codes[0], codes
