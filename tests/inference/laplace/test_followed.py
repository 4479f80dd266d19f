"""Through impacts the posterior is of the windows that the model follows, and what it lacks is asked of these."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scipy.stats

from sipe_bayes.calibration.checks.lacking import asked_windows
from sipe_bayes.core.findings import Code, finding
from sipe_bayes.diagnostics.misfit.asked_windows import AskedWindows
from sipe_bayes.diagnostics.misfit.missing_physics import missing_physics
from sipe_bayes.diagnostics.misfit.misspecification import misfit
from sipe_bayes.inference.laplace.estimator import Laplace
from sipe_bayes.inference.laplace.options import FollowedTuning, GrowingTuning, LaplaceOptions, LaplaceTuning
from sipe_bayes.inference.laplace.strategy import SearchProblem
from sipe_bayes.inference.laplace.windows import followed_posterior
from sipe_bayes.inference.laplace.windows.followed import (
    FollowedLook,
    agreement,
    followed_at,
    onward,
)
from sipe_bayes.inference.laplace.windows.followed_posterior import doubted
from sipe_bayes.inference.laplace.windows.growing_windows import Doubt
from sipe_bayes.inference.laplace.windows.state import Followed, WindowOptimum, WindowState
from sipe_bayes.inference.mcmc import MCMC
from sipe_bayes.likelihood.noise import Noise
from sipe_bayes.likelihood.quadratic_prior import QuadraticPrior
from sipe_bayes.likelihood.settings import Segments
from sipe_bayes.likelihood.windows import Linearisation, Windows
from sipe_bayes.posterior import GaussianMixture, prior
from tests.problems.buffers import NOISE, TRUTH, changed, everything, look_at, machine, recorded


def test_what_is_not_followed_is_left_out_and_theta_goes_where_the_others_are() -> None:
    logs = recorded()
    whole = everything(logs, TRUTH + np.array([0.03, -0.03]))
    clean = look_at(whole)
    assert isinstance(clean, FollowedLook)
    assert clean.windows.num_windows >= 22  # of 24; in one or two simulations jump
    np.testing.assert_allclose(clean.at.theta, TRUTH, atol=0.04)  # sds of .013 and .017
    # windows that another motion fills, and one sample
    spoiled = changed(logs, [(0, slice(28, 40), 0.02), (2, slice(68, 80), 0.02), (3, slice(50, 51), 0.0025)])
    given = everything(spoiled, TRUTH)
    some = look_at(replace(given, noise=Noise(10 * NOISE, np.zeros(2))))
    assert isinstance(some, FollowedLook)
    kept = {(int(log), int(start)) for log, start in zip(some.windows.log, some.windows.start, strict=True)}
    before = {(int(log), int(start)) for log, start in zip(clean.windows.log, clean.windows.start, strict=True)}
    assert {(0, 20), (2, 60)} <= before - kept
    assert len(before - kept) <= 4  # where theta is a little off, simulations jump in others
    spoiled_one = int(np.flatnonzero((some.windows.log == 3) & (some.windows.start == 40))[0])
    assert np.argwhere(~some.windows.observed[spoiled_one, 1:20]).tolist() == [[9, 1]]
    np.testing.assert_allclose(some.at.noise.sd, NOISE, rtol=0.1)
    np.testing.assert_allclose(some.at.theta, clean.at.theta, atol=0.02)


def test_noise_alone_seldom_leaves_a_window_out_or_sets_groups_apart() -> None:
    """The chance of either is 5 %; of 20 seeds 5 or more would be once in 400. A wrong model's groups are apart."""
    least = FollowedTuning(rounds=1, far=6.0, differs=1e9)
    out, apart = 0, 0
    for seed in range(20):
        logs = recorded(seed=seed)
        whole = everything(logs)
        some = look_at(whole, least)
        out += isinstance(some, Doubt) or some.windows.num_windows < whole.windows.num_windows
        apart += isinstance(some, Doubt) or agreement(some, 8) < 0.05
    assert out < 5
    assert apart < 5
    wrong = look_at(everything(recorded(friction=0.2)))
    assert isinstance(wrong, FollowedLook)
    assert agreement(wrong, 8) < 1e-3


def test_windows_where_simulations_jump_are_left_out() -> None:
    """Where steps of 3e-3 give other slopes than those of a linearisation; all else is followed."""
    given = everything(recorded())
    windows, starts = given.windows, given.starts
    some = look_at(given, FollowedTuning(rounds=1, far=6.0, wider=3e-3))
    assert isinstance(some, FollowedLook)
    kept = {(int(log), int(start)) for log, start in zip(some.windows.log, some.windows.start, strict=True)}
    both = (windows.linearise(TRUTH, starts, with_starts=False, theta_step=step) for step in (None, 3e-3))
    short, wide = (lin.jacobian / NOISE[:, None] for lin in both)
    apart, larger = (np.linalg.norm(x, axis=(1, 2)) for x in (short - wide, np.maximum(abs(short), abs(wide))))
    jumps = ((apart > 0.5 * larger) & (apart > 1)).any(1)
    own = {(int(log), int(start)) for log, start in zip(windows.log[~jumps], windows.start[~jumps], strict=True)}
    assert 0 < jumps.sum() < 4
    assert kept == own


def test_few_windows_say_nothing() -> None:
    given = everything(recorded(count=1))
    assert look_at(given, FollowedTuning(fewest=7, differs=1e9)) is Doubt.FEW
    assert isinstance(look_at(given, FollowedTuning(fewest=6, differs=1e9)), FollowedLook)


def test_a_channel_that_no_followed_window_has_leaves_nothing_to_ask() -> None:
    logs = recorded()
    observations = logs.observations.copy()
    observations[1:, :, 1] = np.nan
    some = look_at(everything(replace(logs, observations=observations)))
    assert isinstance(some, FollowedLook)
    assert np.isfinite(some.at.noise.sd).all()
    observations[0, :, 0] += 0.02 * np.sign(np.sin(np.arange(121)))  # the ram of the only log that has the block
    assert isinstance(look_at(everything(replace(logs, observations=observations))), Doubt)


def test_the_posterior_is_that_of_the_windows_that_are_followed() -> None:
    """Two windows hold another motion; of three seeds' six values chi-square at 1e-3 on either side."""
    gaps, groups = [], []
    for seed in range(3):
        logs = changed(recorded(seed=seed), [(0, slice(28, 40), 0.02), (2, slice(68, 80), 0.02)])
        method = Laplace(machine(), likelihood=Segments(0.2, "white"), seed=seed)
        posterior = method.fit(logs)
        assert method.state is not None
        assert isinstance(method.state.search, WindowState)
        (best,) = method.state.search.optima
        assert best.trims
        assert best.followed is not None
        np.testing.assert_allclose(best.followed.noise.sd, NOISE, rtol=0.15)
        assert method.diagnostics["noise_sd"][1] > 4 * NOISE[1]  # of all windows: what bands of further logs need
        (noticed,) = method.findings
        assert noticed.code is Code.WINDOWS_LEFT_OUT
        assert noticed.text.startswith(f"{24 - len(best.followed.kept)} of 24 windows")
        assert method.fitted_starts(posterior.mean.numpy()).shape == (24, 4)  # type: ignore[union-attr]
        gaps.append((posterior.mean.numpy() - TRUTH) / posterior.stddev.numpy())
        groups.append(np.std(method.state.search.estimates, axis=0) / np.sqrt(8) / posterior.stddev.numpy())
    low, high = scipy.stats.chi2.ppf([1e-3, 1 - 1e-3], 6)
    assert low < float(np.square(gaps).sum()) < high
    assert float(np.median(groups)) > 1.5  # narrower than the scatter of groups that hold these windows, too


def followed_normal(kept: int = 20, mean: float = 0.5, sd: float = 0.01) -> WindowOptimum:
    """That of so many of 24 windows; it stands at .5."""
    counted = np.zeros((24, 3, 1), bool)
    counted[:kept] = True
    theta, one, starts = np.full(2, 0.5), np.ones(1), np.zeros((24, 0))
    at = Followed(counted, theta, starts, Noise(one, np.zeros(1)))
    away = np.full(2, mean)
    return WindowOptimum(theta, away, sd**2 * np.eye(2), 0.0, one, one, starts, np.zeros((24, 0, 2)), followed=at)


@pytest.mark.parametrize(
    ("own", "chance", "noise", "doubt"),
    [
        (followed_normal(), 0.5, "ar1", None),
        (followed_normal(kept=12), 0.5, "ar1", None),
        (followed_normal(kept=11), 0.5, "ar1", Doubt.FEW),
        (followed_normal(mean=0.52), 0.5, "ar1", Doubt.UNSETTLED),  # two sds to go
        (replace(followed_normal(mean=1.1), theta=np.ones(2)), 0.5, "ar1", None),  # pressed against a bound
        (followed_normal(sd=0.2), 0.5, "ar1", Doubt.WIDER),
        (followed_normal(), 1e-4, "ar1", Doubt.APART),
        (followed_normal(), 0.5, "sandwich", Doubt.SANDWICH),
    ],
)
def test_the_followed_optimum_stands_but_for_what_speaks_against_it(
    own: WindowOptimum, chance: float, noise: str, doubt: Doubt | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    simulator = machine()
    problem = SearchProblem(simulator.space, prior(simulator.space), 0, LaplaceOptions(), lambda _: None)
    windows = Windows(Segments(0.2, noise), simulator, recorded())
    monkeypatch.setattr(followed_posterior, "agreement", lambda look, groups: chance)
    whole = followed_normal(sd=0.1)
    scattered = replace(whole, finding=finding(Code.SCATTER, groups=8, lost=0, why=Doubt.UNASKED))
    assert own.followed is not None
    nothing = Linearisation(np.zeros(0), np.zeros(0), True)
    look = FollowedLook(own.followed, windows, nothing, nothing)
    assert doubted(problem, windows, own, scattered, look) is doubt
    if doubt is Doubt.WIDER:  # of all windows, so no scatter
        assert doubted(problem, windows, own, whole, look) is None


def test_what_does_not_stand_leaves_the_scatter_and_says_why() -> None:
    """The optimum may be where the search began: theta tells nothing of which normal it is."""
    tuning = LaplaceTuning(followed=FollowedTuning(most=1.0, rounds=1), growing=GrowingTuning(rough=1.0001))
    logs = changed(recorded(), [(0, slice(28, 40), 0.02), (2, slice(68, 80), 0.02)])
    method = Laplace(machine(), likelihood=Segments(0.2, "white"), tuning=tuning)
    method.fit(logs)
    assert method.state is not None
    assert isinstance(method.state.search, WindowState)
    (best,) = method.state.search.optima
    assert best.followed is not None
    assert not best.trims
    np.testing.assert_array_equal(best.judged_sd, best.sd)
    assert any(f.code is Code.SCATTER and str(Doubt.FEW) in f.text for f in method.findings)


@pytest.mark.parametrize("noise", ["ar1", "sandwich"])
def test_noise_that_remembers_is_fitted_so_as_well(noise: str) -> None:
    """Its sandwich is not made of a part of the windows; what the model lacks is asked of these all the same."""
    method = Laplace(machine(), likelihood=Segments(0.2, noise))
    posterior = method.fit(recorded(seed=2))
    assert method.followed is not None
    assert method.state is not None
    assert isinstance(method.state.search, WindowState)
    (best,) = method.state.search.optima
    assert best.trims == (noise == "ar1")
    assert {f.code for f in method.findings} <= {Code.WINDOWS_LEFT_OUT if best.trims else Code.SCATTER}
    assert (np.abs(posterior.mean.numpy() - TRUTH) < 4 * posterior.stddev.numpy()).all()


def test_what_a_step_simulates_is_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    """By the share of the control steps that is simulated, of some windows or of beginnings; each view rounds up."""
    logs = changed(recorded(), [(0, slice(28, 40), 0.02), (2, slice(68, 80), 0.02)])
    fit = everything(logs, TRUTH + np.array([0.03, -0.03]))
    windows, believed = fit.windows, QuadraticPrior.of(prior(machine().space))
    look = followed_at(windows, fit.theta, fit.starts, fit.noise, believed)
    assert isinstance(look, FollowedLook)
    before, spent, spend = windows.rollouts, [], Windows.spend

    def counting(self: Windows, batch: int) -> None:
        spent.append(batch * len(self.trajectories) * self.steps.sum() / windows.steps.sum())
        spend(self, batch)

    monkeypatch.setattr(Windows, "spend", counting)
    assert onward(windows, look, believed) is not None
    assert sum(spent) <= windows.rollouts - before <= sum(spent) + 20
    assert len(spent) > 20


@pytest.mark.parametrize("friction", [0.0, 0.2])
def test_what_is_missing_is_seen_through_impacts(friction: float) -> None:
    """Both ways: the plain estimate of the damping is far off, the interval with what is missing holds it."""
    logs = recorded(friction)
    some = look_at(everything(logs))
    assert isinstance(some, FollowedLook)
    believed = prior(machine().space)
    probed = AskedWindows.at(some.at, everything(logs).windows, QuadraticPrior.of(believed)).probed()
    sd = np.sqrt(probed.seen.variance)
    looks = misfit(probed, sd)
    assert looks.alarm == (friction > 0)
    assert not looks.searchable
    assert "sipe discover" not in looks.remedy
    plain = GaussianMixture([0.0], (some.at.theta + probed.seen.step[:2])[None], np.diag(sd**2)[None], believed.space)
    missing = missing_physics(probed, plain, believed, looks.alarm)
    assert missing is not None
    low, high = missing.further.quantile([0.002, 0.998]).numpy()
    assert ((low <= TRUTH) & (high >= TRUTH)).all()
    if friction:
        assert "friction" in looks.cause
        assert abs(some.at.theta[0] - TRUTH[0]) > 5 * sd[0]
    else:
        assert (high - low < 1.5 * 5.76 * sd).all()


def test_other_methods_have_their_windows_chosen_and_nothing_is_asked_of_what_slips() -> None:
    """A method that searches by other means tells nothing of windows."""
    given, believed = everything(recorded()), prior(machine().space)
    method = MCMC(machine(), likelihood=Segments(0.2, "white"))
    some = asked_windows(method, given, believed)
    assert some is not None
    assert 22 <= some.windows.num_windows <= some.among == 24
    given.windows.contacts = replace(given.windows.contacts, rough=True, change=False)
    assert given.windows.contacts.slips
    assert asked_windows(method, given, believed) is None
    assert asked_windows(Laplace(machine(), likelihood=Segments(0.2, "white")), given, believed) is None
