"""Wild samples are left out, of a log and of a fit, which is then as good as without; motions and noise lose none."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.findings import Code
from sipe_bayes.core.rotations import aligned, product, quaternions, rotation_vectors
from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.core.wild_samples import jumps, wild_positions
from sipe_bayes.inference.laplace import Laplace
from sipe_bayes.likelihood import Segments, wild_residuals
from sipe_bayes.likelihood.windows import Windows
from tests.problems import pendulums
from tests.problems.bodies import cube, tosses

TIME = np.arange(0, 5, 0.005)
SWING = 0.2 * np.sin(3 * TIME) + 0.05 * np.sin(11 * TIME)


def test_what_came_round_and_wild_samples_are_found() -> None:
    counts = np.round(SWING / 5e-6)
    wrapped = (counts + 2**15) % 2**16 - 2**15  # sixteen bits
    beyond = np.flatnonzero(np.diff(wrapped - counts) != 0)
    assert len(beyond) > 1
    assert jumps(wrapped).tolist() == beyond.tolist()
    wild = SWING.copy()
    wild[300] += 1.0
    assert jumps(wild).tolist() == [299, 300]


@pytest.mark.parametrize(
    "values",
    [
        SWING,
        SWING + np.random.default_rng(0).normal(0, 0.01, len(SWING)),
        np.round(SWING / 0.01) * 0.01,  # a coarse encoder
        np.where(TIME < 4, 0.0, np.sin(40 * (TIME - 4))),  # at rest, then fast
        np.abs(np.sin(7 * TIME)),  # bounces
        np.zeros(1000),
        np.zeros(3),
    ],
)
def test_motions_are_none(values: FloatArray) -> None:
    assert not len(jumps(values))
    assert not wild_positions(values).any()


@pytest.mark.parametrize("length", [1, 2, 15])
def test_what_jumps_away_and_comes_back_is_wild(length: int) -> None:
    values, planted = SWING + np.random.default_rng(1).normal(0, 1e-3, len(SWING)), np.zeros(len(SWING), bool)
    for start, size in ((0, 0.3), (100, 5.0), (300, -0.3), (640, 0.4), (len(SWING) - length, -0.3)):
        planted[start : start + length] = length < 4 or 0 < start < 640  # long ones at an end have no way home
        values[start : start + length] += size * planted[start]
    values[50] = np.nan
    np.testing.assert_array_equal(wild_positions(values), planted)


def test_flips_of_a_body_are_wild_and_signs_are_not() -> None:
    rng, turn = np.random.default_rng(2), np.stack([SWING, 2 * SWING, 5 * TIME], axis=1)
    seen = quaternions(turn + rng.normal(0, 0.01, turn.shape)) * rng.choice([-1.0, 1.0], (len(turn), 1))
    assert not wild_positions(aligned(seen)).any()
    seen[200:210] = product(seen[200:210], quaternions(np.array([[2.0, 0.0, 0.0]])))
    assert np.flatnonzero(wild_positions(aligned(seen))).tolist() == list(range(200, 210))


def test_a_body_that_tumbles_otherwise_than_simulated_is_not_wild() -> None:
    """Its rotation vector wraps at half a turn, there and soon back; a flip of one sample stands out all the same."""
    simulator = cube()
    windows = Windows(Segments(None, "white"), simulator, tosses(simulator, 2, 60, seed=5)[0])
    residual = np.random.default_rng(6).normal(0, 0.003, (2, 61, 6))
    angle = 3.08 + 0.1 * np.exp(-(((np.arange(61) - 30) / 2) ** 2))
    residual[..., 3:] += rotation_vectors(quaternions(angle[:, None] * np.array([0.6, 0.0, 0.8])))
    assert np.abs(np.diff(residual[0], axis=0)).max() > 4
    assert not len(wild_residuals(windows, residual))
    residual[1, 10, 4] += 1.0
    assert wild_residuals(windows, residual).tolist() == [[1, 10, 4]]


def test_so_many_are_no_accidents() -> None:
    values = SWING.copy()
    values[::10] += 5.0
    assert not wild_positions(values).any()


def test_noise_loses_no_sample() -> None:
    """White, coloured and of an encoder that is mostly at rest: 4 x 10^5 samples, each lost once in 10^8."""
    simulator, rng = pendulums.pendulum(), np.random.default_rng(3)
    windows = Windows(Segments(), simulator, Trajectories.stack(pendulums.log(simulator, [0.6, 0.08], 0, steps=20000)))
    shape = windows.observed.shape
    for _ in range(5):
        white = rng.normal(0, 0.01, shape)
        assert not len(wild_residuals(windows, white))
        assert not len(wild_residuals(windows, np.round(white / 0.02) * 0.02))
        coloured = pendulums.coloured(rng, white.size, 0.01, 0.9).reshape(shape)
        assert not len(wild_residuals(windows, coloured + 0.05 * np.sin(0.3 * np.arange(shape[1]))[:, None]))


def test_where_a_short_last_window_starts_is_not_wild_and_what_jumps_within_one_is() -> None:
    """Windows of a model that lacks something end far off; one of two samples has a start of its own, and follows."""
    simulator = pendulums.pendulum()
    recorded = pendulums.log(simulator, [0.6, 0.08], 3, steps=101)
    windows = Windows(Segments(0.5), simulator, Trajectories.stack([recorded]))
    assert windows.steps.tolist() == [50, 50, 1]
    drift = np.linspace(0, 0.5, windows.observed.shape[1]) ** 2 * (windows.steps[:, None] > 1)
    residual = drift[..., None] + np.random.default_rng(0).normal(0, 1e-3, windows.observed.shape)
    assert not len(wild_residuals(windows, residual))
    residual[1, 49] += 3.0  # the sample before the last window
    assert wild_residuals(windows, residual).tolist() == [[0, 99, 0]]


@pytest.mark.parametrize(("every", "wild"), [(25, 1), (100, 2), (0, 4)])
def test_what_follows_a_jump_of_a_command_is_not_wild(every: int, wild: int) -> None:
    """The model follows set-points a little late: off for two samples, and home. Glitches elsewhere are wild.

    Stairs that jump all the time excuse nothing.
    """
    simulator = pendulums.pendulum()
    recorded = pendulums.log(simulator, [0.6, 0.08], 3, steps=400)
    at = np.arange(400)
    command = np.sign(np.sin(np.pi * (at + 0.5) / every)) if every else np.random.default_rng(1).choice([-1, 1], 400)
    logs = Trajectories.stack([replace(recorded, actions=0.1 * command[:, None])])
    windows = Windows(Segments(None), simulator, logs)
    residual = np.random.default_rng(0).normal(0, 1e-3, windows.observed.shape)
    for place in (53, 103, 190, 202):  # the commands jump at multiples of 25 or of 100
        residual[0, place : place + 2] += 1.0
    assert len(wild_residuals(windows, residual)) == 2 * wild


def test_what_a_known_start_ends_is_not_wild() -> None:
    """A simulation that missed an impact is off until the next window begins, at a state that is known."""
    simulator = pendulums.pendulum()
    recorded = Trajectories.stack([pendulums.log(simulator, [0.6, 0.08], 3, steps=100)])
    known = replace(recorded, states=np.zeros((1, 101, simulator.default_state().size)))
    for likelihood, logs, wild in ((Segments(0.04, starts="recorded"), known, 0), (Segments(0.04), recorded, 3)):
        windows = Windows(likelihood, simulator, logs)
        residual = np.random.default_rng(0).normal(0, 1e-3, windows.observed.shape)
        residual[5, 1:4] += 3.0
        assert len(wild_residuals(windows, residual * windows.observed)) == wild


@pytest.mark.parametrize(("share", "size"), [(0.005, 0.15), (0.003, 20.0)])
def test_a_fit_is_as_good_without_wild_samples(share: float, size: float) -> None:
    """Intervals as wide to 5 %, and where they were to .3 sd: what half a percent of the samples says."""
    simulator = pendulums.pendulum()
    clean = pendulums.log(simulator, [0.6, 0.08], 4, steps=2000)
    rng, wild = np.random.default_rng(5), clean.observations.copy()
    rows = np.sort(rng.choice(len(wild), round(share * len(wild)), replace=False))
    wild[rows, 0] += size * rng.choice([-1, 1], len(rows)) * rng.uniform(1, 2, len(rows))
    fits = {}
    for name, seen in (("clean", clean.observations), ("wild", wild)):
        method = Laplace(simulator, restarts=1)
        fits[name] = method, method.fit(replace(clean, observations=seen))
    (plain, before), (robust, after) = fits["clean"], fits["wild"]
    assert not len(plain.result.outliers)
    assert Code.WILD_SAMPLES not in [item.code for item in plain.findings]
    assert robust.result.outliers[:, 1].tolist() == rows.tolist()
    assert [item.code for item in robust.findings] == [Code.WILD_SAMPLES]
    np.testing.assert_allclose(after.stddev, before.stddev, rtol=0.05)
    assert ((after.mean - before.mean).abs() < 0.3 * before.stddev).all()
