"""Calibration checks are seen to pass exact posteriors and to fail wide, narrow, shifted and wrongly correlated ones.

Posteriors of a normal mean: truth ~ N(0.5, 0.1) per parameter, datum ~ N(truth, 0.1), so the posterior is N((0.5 +
datum) / 2, 0.1 / sqrt 2), well inside the cube.
"""

from __future__ import annotations

import functools
import json

import numpy as np
import pytest
import torch

from sipe_bayes.core.parameters import Parameter, ParameterSpace
from sipe_bayes.diagnostics.coverage import (
    LEVELS,
    CalibrationCheck,
    check_calibration,
    mass_below,
    tarp_values,
    uniformity,
)
from sipe_bayes.models.sbi_tools import import_sbi
from sipe_bayes.posterior import Dirac, GaussianMixture, Particles, Posterior

SPACE = ParameterSpace([Parameter("mass", 1.0, 2.0, unit="kg"), Parameter("damping", 0.1, 1.0)])
TRUTHS = 300


@functools.cache
def check(
    width: float = 1.0, shift: float = 0.0, correlation: float = 0.0, count: int = TRUTHS, seed: int = 0
) -> CalibrationCheck:
    """Posteriors whose sd is ``width`` times and whose mean is ``shift`` sd off the right one."""
    rng = np.random.default_rng(seed)
    truths = rng.normal(0.5, 0.1, (count, 2))
    means = (0.5 + truths + rng.normal(0, 0.1, (count, 2))) / 2
    sd = 0.1 / np.sqrt(2)
    covariance = (width * sd) ** 2 * np.array([[1, correlation], [correlation, 1]])
    return check_calibration([GaussianMixture([0.0], [m + shift * sd], [covariance], SPACE) for m in means], truths)


def test_exact_posteriors_pass() -> None:
    found = check()
    print(found.sentences())
    assert found.calibrated
    assert [found.verdict(name) for name in found.names] == ["calibrated", "calibrated"]
    assert all("as" in s or "uniform for all" in s for s in found.sentences())
    assert np.abs(found.coverage(0.9) - 0.9).max() < 4 * np.sqrt(0.09 / TRUTHS)


@pytest.mark.parametrize(
    ("settings", "verdict", "words"),
    [
        ({"width": 0.6}, "too narrow", "too narrow"),
        ({"width": 1.7}, "too wide", "too wide"),
        ({"shift": 0.6}, "shifted", "above the median"),
        ({"shift": -0.6}, "shifted", "above the median"),
    ],
)
def test_wrong_posteriors_fail(settings: dict[str, float], verdict: str, words: str) -> None:
    found = check(**settings)
    print(found.sentences())
    assert not found.calibrated
    assert [found.verdict(name) for name in found.names] == [verdict, verdict]
    assert words in " ".join(found.sentences())
    assert found.to_dict()["parameters"][0]["verdict"] == verdict


def test_tarp_sees_what_the_marginals_do_not() -> None:
    """Right marginals, a correlation that is not there: only the joint check fails."""
    found = check(correlation=0.95)
    assert [found.verdict(name) for name in found.names] == ["calibrated", "calibrated"]
    assert found.tarp.p < 0.01
    assert not found.calibrated
    assert "do not hold" in found.sentences()[2]


def test_a_point_is_too_narrow_and_the_prior_passes() -> None:
    rng = np.random.default_rng(1)
    truths = rng.random((60, 2))
    points: list[Posterior] = [Dirac(t, SPACE) for t in np.clip(truths + rng.normal(0, 0.01, truths.shape), 0, 1)]
    assert {check_calibration(points, truths).verdict(name) for name in SPACE.names} == {"too narrow"}
    particles = Particles(rng.random((500, 2)), SPACE)
    assert check_calibration([particles] * 60, truths).calibrated


def test_false_alarms_are_as_rare_as_they_say() -> None:
    """1000 uniform samples of 50.

    P below 0.05 in 50 of them with sd 7, the curve outside the 99 % band in 10 with sd 3; five sd either way fail once
    in 10^6.
    """
    rng = np.random.default_rng(2)
    found = [uniformity(rng.random(50)) for _ in range(1000)]
    assert 15 < sum(u.p < 0.05 for u in found) < 85
    outside = sum(bool(((u.curve < u.low) | (u.curve > u.high)).any()) for u in found)
    assert outside < 27, outside
    assert sum(u.p < 0.01 for u in found) == pytest.approx(outside, abs=6)


def test_many_parameters_can_still_fail() -> None:
    """23 parameters ask for p below 0.0002 of each; a point's are far below what simulation alone resolves."""
    space, rng = ParameterSpace(Parameter(f"p{j}") for j in range(23)), np.random.default_rng(4)
    truths = rng.random((40, 23))
    found = check_calibration([Dirac(np.clip(t + 0.02, 0, 1), space) for t in truths], truths)
    assert {found.verdict(name) for name in space.names} <= {"too narrow", "shifted"}
    assert max(one.p for one in found.ranks) < 1e-6


def test_the_band_holds_the_diagonal_and_narrows() -> None:
    few, many = uniformity(np.linspace(0.01, 0.99, 30)), uniformity(np.linspace(0.001, 0.999, 1000))
    for found in (few, many):
        assert (found.low <= LEVELS).all()
        assert (found.high >= LEVELS).all()
        assert found.p > 0.9
    assert (many.high - many.low).max() < 0.3 * (few.high - few.low).max()


def test_tarp_is_that_of_sbi() -> None:
    """The curve of sbi, on its own levels, is the share of our values at or below them; ours differ within ties."""
    tarp = import_sbi("diagnostics.tarp")
    rng = np.random.default_rng(3)
    truths, references = rng.random((100, 2)), rng.random((100, 2))
    draws = np.clip(truths + rng.normal(0, 0.1, truths.shape), 0, 1)[:, None] + rng.normal(0, 0.1, (100, 400, 2))
    share, level = tarp._run_tarp(
        torch.from_numpy(draws.transpose(1, 0, 2)), torch.from_numpy(truths), torch.from_numpy(references), num_bins=10
    )
    ours = tarp_values(list(draws), truths, references, rng)
    curve = (ours[:, None] <= level.numpy() + 1 / 400).mean(0)
    np.testing.assert_allclose(curve, share.numpy(), atol=0.03)


def test_ranks_are_those_of_sbi() -> None:
    """What sbi counts are the draws below the truth.

    Our masses are these counts, and a share of one draw, in units of all draws and one.
    """
    sbc = import_sbi("diagnostics.sbc")
    rng = np.random.default_rng(5)
    truths, draws = rng.random((30, 2)), rng.random((200, 30, 2))
    theta, seen = torch.from_numpy(truths), torch.zeros(30, 1)
    counts = sbc._run_sbc(theta, seen, torch.from_numpy(draws), "marginals", show_progress_bar=False).numpy()
    ours = np.stack([mass_below(draws[:, i], truths[i], rng) for i in range(30)])
    np.testing.assert_array_equal(np.floor(ours * 201), counts)
    p_values = sbc.check_uniformity_frequentist(torch.from_numpy(counts), 200).numpy()
    assert all((p > 0.01) == (uniformity(column).p > 0.01) for p, column in zip(p_values, ours.T, strict=True))


def test_the_same_seed_gives_the_same_answer_as_plain_data() -> None:
    first, second = check(), check.__wrapped__()
    assert json.dumps(first.to_dict()) == json.dumps(second.to_dict())
    np.testing.assert_array_equal(first.tarp.values, second.tarp.values)


def test_wrong_input() -> None:
    points: list[Posterior] = [Dirac([0.5, 0.5], SPACE)] * 30
    with pytest.raises(ValueError, match="at least 20"):
        check_calibration(points[:5], np.zeros((5, 2)))
    with pytest.raises(ValueError, match=r"expected finite theta \(30, 2\)"):
        check_calibration(points, np.zeros((30, 3)))
    with pytest.raises(ValueError, match="same parameters"):
        check_calibration([*points, Dirac([0.5], SPACE.subset(["mass"]))], np.zeros((31, 2)))
