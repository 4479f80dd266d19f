"""Through impacts the posterior is of the windows that the model follows, and what it lacks is asked of these."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scipy.stats

from sipe_bayes.calibration.checks.fitted import Fit
from sipe_bayes.calibration.checks.lacking import AskedWindows, asked_windows
from sipe_bayes.core.findings import Code, Severity, finding
from sipe_bayes.core.parameters import Parameter
from sipe_bayes.core.trajectory import Trajectories, Trajectory
from sipe_bayes.diagnostics.evaluate import best_starts
from sipe_bayes.diagnostics.misfit.missing_physics import missing_physics
from sipe_bayes.diagnostics.misfit.misspecification import misfit
from sipe_bayes.envs.mjcf import MjcfEnvironment
from sipe_bayes.inference.laplace.estimator import Laplace
from sipe_bayes.inference.laplace.options import FollowedTuning, GrowingTuning, LaplaceOptions, LaplaceTuning
from sipe_bayes.inference.laplace.strategy import SearchProblem
from sipe_bayes.inference.laplace.windows import followed_posterior
from sipe_bayes.inference.laplace.windows.followed import (
    FOLLOWED,
    FollowedLook,
    agreement,
    followed_at,
    followed_windows,
    onward,
    regrown,
)
from sipe_bayes.inference.laplace.windows.followed_posterior import doubted
from sipe_bayes.inference.laplace.windows.growing_windows import Doubt, scatter_finding
from sipe_bayes.inference.laplace.windows.state import Followed, WindowOptimum, WindowState
from sipe_bayes.inference.mcmc import MCMC
from sipe_bayes.likelihood.noise import Noise
from sipe_bayes.likelihood.quadratic_prior import QuadraticPrior
from sipe_bayes.likelihood.settings import Segments
from sipe_bayes.likelihood.windows import Linearisation, Windows
from sipe_bayes.posterior import GaussianMixture, prior
from sipe_bayes.simulation.simulator import Simulator

BUFFERS = """<mujoco><option timestep=".005"/><worldbody>
<body name="ram"><joint name="ram" type="slide" axis="1 0 0" damping="2" frictionloss="{friction}"/>
<geom type="box" size=".05 .05 .05" mass=".8"/></body>
<body name="block" pos=".14 0 0"><joint name="block" type="slide" axis="1 0 0" damping="1" stiffness="30"/>
<geom type="box" size=".05 .05 .05" mass=".5"/></body></worldbody>
<actuator><motor name="push" joint="ram" gear="4"/></actuator></mujoco>"""
TRUTH, NOISE, DT = np.array([0.4, 0.6]), np.array([3e-4, 3e-4]), 0.01
CHANNELS = ("joint:ram.position", "joint:block.position")


def machine(friction: float = 0.0) -> Simulator:
    """A ram that strikes a sprung block."""
    unknown = [
        Parameter("ram_damping", 0.5, 4.0, targets=("joint:ram.damping",)),
        Parameter("block_mass", 0.2, 1.0, targets=("body:block.mass",)),
    ]
    return Simulator(
        MjcfEnvironment.build(BUFFERS.format(friction=friction), unknown, ["push"], CHANNELS), num_threads=1
    )


def recorded(friction: float = 0.0, seed: int = 0, count: int = 4) -> Trajectories:
    """Logs of 1.2 s."""
    engine, random, logs = machine(friction), np.random.default_rng(seed), []
    for k in range(count):
        tones = np.sin(2 * np.pi * random.uniform(0.5, 2.0, 3) * DT * np.arange(120)[:, None] + random.uniform(0, 6, 3))
        command = tones.mean(1, keepdims=True)
        clean = engine.rollout(TRUTH[None], command[None], engine.default_state()[None], DT).observations[0]
        noisy = clean + NOISE * random.standard_normal(clean.shape)
        logs.append(Trajectory(noisy, command, DT, name=f"log {k}", channels=CHANNELS))
    return Trajectories.stack(logs)


def everything(logs: Trajectories, theta: np.ndarray = TRUTH) -> Fit:
    """All windows of logs, from their best starts."""
    white, windows = Noise(NOISE, np.zeros(2)), Windows(Segments(0.2, "white"), machine(), logs)
    return Fit(windows, theta, white, best_starts(windows, theta, white), False)


def look_at(fit: Fit, tuning: FollowedTuning = FOLLOWED) -> FollowedLook | Doubt:
    """What is followed of it."""
    believed = QuadraticPrior.of(prior(fit.windows.simulator.space))
    return followed_windows(fit.windows, fit.theta, fit.starts, fit.noise, believed, tuning)


def changed(logs: Trajectories, samples: list[tuple[int, slice, float]]) -> Trajectories:
    """Logs of which some samples of the block are so many metres off."""
    observations = logs.observations.copy()
    for log, where, by in samples:
        observations[log, where, 1] += by
    return replace(logs, observations=observations)


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


def test_few_windows_without_jumps_are_few_and_those_of_another_motion_lost() -> None:
    """Where simulations jump in all: what they leave is noise, or it hides a motion that the model does not have."""
    logs, rough = recorded(), FollowedTuning(differs=1e-9, matters=1e-9)
    assert look_at(everything(logs), rough) is Doubt.FEW
    observations = logs.observations.copy()
    observations[..., 1] += 4 * NOISE[1] * np.sin(0.8 * np.arange(121))
    other = everything(replace(logs, observations=observations))
    assert look_at(other, rough) is Doubt.LOST
    assert look_at(other, replace(rough, loose=100.0)) is Doubt.FEW


def test_lost_windows_are_followed_again_from_starts_that_are_looked_for_anew() -> None:
    """Of starts far off those that are found again; the others stay, and what it took is counted."""
    given = everything(recorded())
    windows, far = given.windows, given.starts.copy()
    lost = np.arange(0, 24, 3)
    far[lost] += [0.02, 0.02, 0.5, 0.5]
    before = windows.rollouts
    again = regrown(windows, lost, TRUTH, far, given.noise)
    kept = np.setdiff1d(np.arange(24), lost)
    np.testing.assert_array_equal(again[kept], given.starts[kept])
    left = (windows.residuals(TRUTH[None], again[None])[0][0] / NOISE) ** 2
    assert (left.sum((1, 2))[lost] < scipy.stats.chi2.isf(1e-4, 40)).all()
    assert 4 * 20 < windows.rollouts - before < 4 * 300  # of a third of the windows, on beginnings
    np.testing.assert_array_equal(regrown(windows, lost[:0], TRUTH, far, given.noise), far)


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


def test_a_budget_that_ends_meanwhile_leaves_the_scatter() -> None:
    """All but a few rollouts of what the fit takes by itself: groups have been fitted, the windows not all chosen."""
    tuning = LaplaceTuning(growing=GrowingTuning(rough=1.0001))
    logs = changed(recorded(), [(0, slice(28, 40), 0.02), (2, slice(68, 80), 0.02)])
    whole = Laplace(machine(), likelihood=Segments(0.2, "white"), tuning=tuning)
    whole.fit(logs)
    method = Laplace(machine(), likelihood=Segments(0.2, "white"), tuning=tuning, budget=whole.rollouts - 40)
    method.fit(logs)
    (noticed,) = method.findings
    assert noticed.code is Code.SCATTER
    assert str(Doubt.UNASKED) in noticed.text


def test_groups_of_windows_that_are_lost_block() -> None:
    """What misses alike is off alike."""
    estimates = np.random.default_rng(0).normal(0.5, 0.01, (8, 2))
    severities = {why: scatter_finding(estimates, GrowingTuning(), why).severity for why in Doubt}
    assert severities.pop(Doubt.LOST) is Severity.BLOCKING
    assert set(severities.values()) == {Severity.NOTE}


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
