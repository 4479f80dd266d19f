"""Functions in MuJoCo's place."""

from __future__ import annotations

import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import sipe_bayes as sipe
from sipe_bayes.inference import ESTIMATORS
from sipe_bayes.inference.amortised.prior_sampling import PriorSampling
from sipe_bayes.inference.laplace import Laplace
from sipe_bayes.inference.registry import estimator_class
from sipe_bayes.inference.search.base import Search
from sipe_bayes.inference.search.discrepancy import StateDifference, channel_scale
from sipe_bayes.likelihood import bind
from tests.problems.quick import SMALL

SPACE = sipe.ParameterSpace([sipe.Parameter("a", low=0.0, high=2.0), sipe.Parameter("b", low=-1.0, high=1.0)])
MATRIX = np.array([[1.0, 0.5], [0.0, 1.0], [1.0, -1.0]])
X = MATRIX @ np.array([0.9, 0.2])
SD = 0.1


def plain(values: np.ndarray) -> np.ndarray:
    return values @ MATRIX.T


def noisy(values: np.ndarray, generator: np.random.Generator) -> np.ndarray:
    return plain(values) + SD * generator.standard_normal((len(values), 3))


def exact() -> tuple[np.ndarray, np.ndarray]:
    """Mean and sd (2,) in physical units."""
    covariance = np.linalg.inv(MATRIX.T @ MATRIX) * SD**2
    return covariance @ MATRIX.T @ X / SD**2, np.sqrt(np.diag(covariance))


@pytest.mark.parametrize("name", list(ESTIMATORS))
def test_every_estimator_takes_an_observed_x(name: str) -> None:
    """Those with a likelihood or a density find the exact posterior, mean to 0.4 sd and sds to 40 %.

    All give something.
    """
    simulator = sipe.CallableSimulator(plain, SPACE, likelihood=SD)
    estimator = sipe.get_estimator(simulator, name, **{"seed": 0, "budget": 1500, **SMALL.get(name, {})})
    posterior = estimator.fit(X)
    values = posterior.values(4000, generator=torch.Generator().manual_seed(0))
    mean, sd = exact()
    print(name, values.mean(0), values.std(0), mean, sd)
    assert estimator.rollouts <= estimator.budget
    if name in ("laplace", "mcmc", "npe", "bayessim"):
        np.testing.assert_array_less(np.abs(values.mean(0) - mean), 0.4 * sd)
        np.testing.assert_allclose(values.std(0), sd, rtol=0.4)
    elif name != "regression":
        np.testing.assert_array_less(np.abs(values.mean(0) - mean), 0.35)


def test_noise_of_a_row_depends_on_theta_and_seed_alone() -> None:
    theta = np.random.default_rng(0).random((5, 2))
    simulator = sipe.CallableSimulator(noisy, SPACE, seed=1)
    log = sipe.Trajectories.stack(simulator.trajectory(X))
    together = simulator.replay(theta, log).observations
    assert np.array_equal(simulator.replay(theta[2:3], log).observations[0], together[2])
    other = sipe.CallableSimulator(noisy, SPACE, seed=2).replay(theta, log).observations
    assert not np.allclose(other[:, 1], together[:, 1])


@pytest.mark.parametrize("units", [(1e3, 1e-3), (1e-9, 1e-9)])
@pytest.mark.parametrize("name", [n for n in ESTIMATORS if n != "mcmc"])
def test_units_of_the_outputs_do_not_matter(name: str, units: tuple[float, float]) -> None:
    """``x = (a, b)`` in units of any size.

    Searches give the same theta to rounding, bayesopt's best point is b's as well, what learns from
    simulations finds both to 0.25, linear regression better. (mcmc goes by laplace's likelihood.)
    """
    values, sd = np.array([0.6, -0.5]), np.array(units)
    simulator = sipe.CallableSimulator(lambda v: v * sd, SPACE, likelihood=SD * sd)
    settings = {"seed": 0, "budget": 400, **SMALL.get(name, {})}
    posterior = sipe.get_estimator(simulator, name, **settings).fit(values * sd)
    found = SPACE.values((posterior.mode if name == "bayesopt" else posterior.mean).numpy())
    print(name, units, found)
    learns = issubclass(estimator_class(name), PriorSampling) and name != "regression"
    np.testing.assert_allclose(found, values, atol=0.25 if learns else 0.06)
    if issubclass(estimator_class(name), Search):
        plain = sipe.get_estimator(sipe.CallableSimulator(lambda v: v, SPACE, likelihood=SD), name, **settings)
        np.testing.assert_allclose(posterior.mean, plain.fit(values).mean, atol=1e-6)


def test_outputs_as_small_as_rounding_are_named() -> None:
    for unit, said in ((1e-14, True), (1e-9, False)):
        fit = sipe.get_estimator(sipe.CallableSimulator(lambda v, u=unit: u * v, SPACE), "abc", budget=100)
        fit.fit(np.array([0.6, -0.5]) * unit)
        assert any("x[0, 1] vary by 6e-15 only" in w for w in fit.warnings) == said, fit.warnings


def test_an_output_that_never_varies_is_left_out_and_all_invalid_is_no_scale() -> None:
    simulator = sipe.CallableSimulator(lambda v: np.column_stack([v[:, 0], np.full(len(v), 7.0), 0 * v[:, 0]]), SPACE)
    windows = bind(
        sipe.Segments(None, starts="recorded"),
        simulator,
        sipe.Trajectories.stack(simulator.trajectory([1.0, 7.0, 0.0])),
    )
    first = windows.simulate(np.random.default_rng(0).random((50, 2)))
    scale = channel_scale(windows, first)
    np.testing.assert_allclose(scale, [first[:, 0, 1, 0].std(), 7.0, 1.0])
    assert np.isfinite(StateDifference(windows, scale)(first)).all()
    first[1:] = np.nan
    np.testing.assert_allclose(channel_scale(windows, first)[1:], [7.0, 1.0])
    assert np.isnan(channel_scale(windows, np.full_like(first, np.nan))).all()


def test_a_learned_reward_of_an_observed_x_is_refused() -> None:
    with pytest.raises(ValueError, match=r'got 1; .*reward="state_difference"'):
        sipe.get_estimator(sipe.CallableSimulator(plain, SPACE), "adr", reward="learned").fit(X)


def with_default(values: np.ndarray, square: bool = False, k: float = 3.0) -> np.ndarray:
    return k * values**2 if square else values


def keyword(values: np.ndarray, scale: float = 1.0, *, rng: np.random.Generator) -> np.ndarray:
    return values + scale * rng.standard_normal(values.shape)


def optional(values: np.ndarray, generator: np.random.Generator | None = None) -> np.ndarray:
    assert generator is not None
    return values + generator.standard_normal(values.shape)


@pytest.mark.parametrize(
    ("fn", "takes"),
    [
        (with_default, False),
        (np.sin, False),
        (functools.partial(np.power, 2.0), False),
        (lambda *v: v[0], False),
        (keyword, True),
        (optional, True),
        (lambda v, g: v + g.standard_normal(v.shape), True),
    ],
)
def test_a_generator_is_told_from_other_arguments(fn: Callable[..., Any], takes: bool) -> None:
    simulator = sipe.CallableSimulator(fn, SPACE)
    assert simulator.noisy == takes
    log = sipe.Trajectories.stack(simulator.trajectory([0.5, 0.5]))
    one, same = (simulator.replay(np.full((2, 2), 0.3), log).observations[:, 1] for _ in "ab")
    np.testing.assert_array_equal(one, same)
    if takes:
        with pytest.raises(ValueError, match="fn's own"):
            sipe.CallableSimulator(fn, SPACE, likelihood=0.1)
    else:
        np.testing.assert_array_equal(one, fn(SPACE.values(np.full((2, 2), 0.3))))


@pytest.mark.parametrize("argument", ["cache", "checkpoint"])
def test_functions_without_a_name_of_their_own_need_one_on_disk(argument: str, tmp_path: Path) -> None:
    """Two lambdas would share simulations, so would partials and objects; a module's function has its own name."""
    for fn in (lambda v: v, functools.partial(with_default, k=2.0)):
        with pytest.raises(ValueError, match=f"name: {argument}= needs one"):
            sipe.get_estimator(sipe.CallableSimulator(fn, SPACE), "abc", **{argument: tmp_path / "a"})
    found = []
    for name, factor in (("one", 1.0), ("two", 2.0)):
        simulator = sipe.CallableSimulator(lambda v, k=factor: k * v, SPACE, name=name)
        fit = sipe.get_estimator(
            simulator, "abc", budget=100, **{argument: tmp_path / f"{name * (argument != 'cache')} c"}
        )
        found.append(fit.fit([0.5, 0.5]).mean)
    assert not torch.equal(*found)
    sipe.get_estimator(sipe.CallableSimulator(plain, SPACE), "abc", **{argument: tmp_path / "c"})
    assert sipe.CallableSimulator(plain, SPACE).name == "tests.simulation.test_callable.plain"


def test_failed_simulations_are_named() -> None:
    def fails(values: np.ndarray) -> np.ndarray:
        return np.where(values[:, :1] > 1.8, np.nan, plain(values))

    estimator = sipe.get_estimator(sipe.CallableSimulator(fails, SPACE, likelihood=SD), "abc", budget=400)
    estimator.fit(X)
    assert any("simulations made fn return NaN or infinity, mostly at high a" in w for w in estimator.warnings)


def test_a_missing_output_is_skipped_where_it_can_be() -> None:
    """``laplace`` told to compare two of three outputs is wider, and right."""
    simulator, mean = sipe.CallableSimulator(plain, SPACE, likelihood=SD), exact()[0]
    missing, two = [X[0], X[1], np.nan], sipe.Segments(None, noise="white", noise_sd=(SD, SD, None), fit=("x0", "x1"))
    whole = sipe.get_estimator(simulator, "laplace").fit(X)
    part = sipe.get_estimator(simulator, "laplace", likelihood=two).fit(missing)
    assert (part.stddev > whole.stddev).all()
    np.testing.assert_allclose(SPACE.values(part.mean.numpy()), mean, atol=0.02)


def always_nan(values: np.ndarray) -> np.ndarray:
    return np.full((len(values), 3), np.nan)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: sipe.CallableSimulator("name", SPACE), "fn: expected a function"),
        (lambda: sipe.CallableSimulator(plain, SPACE, seed="one"), "seed: expected a whole number"),
        (lambda: sipe.CallableSimulator(plain, SPACE, likelihood="small"), "likelihood: expected one sd"),
        (lambda: sipe.CallableSimulator(plain, SPACE).trajectory([np.nan] * 3), "x: expected finite numbers"),
        (lambda: sipe.CallableSimulator(plain, SPACE).trajectory([np.inf, 0, 0]), "x: expected finite numbers"),
        (lambda: sipe.CallableSimulator(plain, SPACE).trajectory("abc"), "x: expected numbers"),
        *(
            (
                lambda n=name: sipe.get_estimator(sipe.CallableSimulator(plain, SPACE, SD), n).fit([0.0, 0.0, np.nan]),
                r"x: .*x(2|\[2\]) is NaN; leave it out of fn",
            )
            for name in ESTIMATORS
        ),
        (
            lambda: sipe.get_estimator(sipe.CallableSimulator(always_nan, SPACE), "abc", budget=50).fit(X),
            "0 of 50 simulations are valid, abc needs 10, the others made fn return NaN or infinity",
        ),
        (
            lambda: sipe.get_estimator(sipe.CallableSimulator(always_nan, SPACE), "bayesopt", budget=8).fit(X),
            "simulations made fn return NaN",
        ),
        (lambda: sipe.get_estimator(sipe.CallableSimulator(noisy, SPACE), "laplace"), "likelihood: laplace needs one"),
        (lambda: sipe.get_estimator(sipe.CallableSimulator(noisy, SPACE), "mcmc"), "likelihood: mcmc needs one"),
        (lambda: sipe.CallableSimulator(noisy, SPACE, likelihood=0.1), "fn's own"),
        (lambda: sipe.CallableSimulator(plain, SPACE, likelihood=-1.0), "one sd above zero"),
        (lambda: sipe.CallableSimulator(lambda v: v[:, 0], SPACE), "expected x"),
        (
            lambda: sipe.get_estimator(sipe.CallableSimulator(plain, SPACE), "abc").fit(np.zeros(2)),
            r"expected shape \(3,\)",
        ),
    ],
)
def test_wrong_input(call: Callable[[], Any], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        call()


def rough(values: np.ndarray, kink: float) -> np.ndarray:
    """A line with kinks as contact makes them, of that size."""
    mix = np.random.default_rng(1).normal(size=(values.shape[1], 30))
    line, phase = (values + 0.5 * values**2) @ mix, np.random.default_rng(0).uniform(size=30)
    return np.asarray(line + kink * (np.abs((line / (2 * kink) + phase) % 1 - 0.5) * 4 - 1))


def chaotic(values: np.ndarray) -> np.ndarray:
    """A line with noise of sd .014 that is another one at every theta."""
    mix, random = np.random.default_rng(1).normal(size=(2, 30)), np.random.default_rng(0)
    return np.asarray(values @ mix + 0.02 * np.sin(values @ random.uniform(1e8, 1e9, size=(2, 30))))


ROUGH = {"kinks": (lambda v: rough(v, 1e-3), 1e-5), "teeth": (lambda v: rough(v, 1e-2), 1e-5), "chaos": (chaotic, 1e-3)}


@pytest.mark.parametrize(("function", "sd"), ROUGH.values(), ids=ROUGH)
def test_a_false_optimum_of_a_rough_function_is_told(function: Any, sd: float) -> None:
    """Each of ten estimates lies within five sds, or a diagnostic says that the residuals are beyond the noise."""
    space = sipe.ParameterSpace(sipe.Parameter(name, low=0.0, high=1.0) for name in "ab")
    for k in range(10):
        truth = np.random.default_rng(100 + k).uniform(0.1, 0.9, size=2)
        estimator = Laplace(sipe.CallableSimulator(function, space, likelihood=sd, name="rough"), seed=k, budget=500)
        posterior = estimator.fit(function(truth[None])[0])
        off = np.abs(posterior.mean.numpy() - truth) / posterior.stddev.numpy()
        print(k, off, [str(item.code) for item in estimator.findings], estimator.rollouts)
        assert (off < 5).all() or estimator.findings.blocking


def test_poll_widens_to_what_fits_as_well() -> None:
    """A contact that is not made below one half.

    The slope seen from there says sd .002, but a tenth below fits as well.
    """
    space = sipe.ParameterSpace([sipe.Parameter("a", low=0.0, high=1.0)])
    simulator = sipe.CallableSimulator(lambda v: 50 * np.maximum(v - 0.5, 0.0), space, likelihood=0.1)
    posterior = Laplace(simulator, initial=np.array([[0.5]])).fit(np.zeros(1))
    assert float(posterior.covariance[0, 0]) ** 0.5 > 0.05
    assert float(posterior.log_prob(torch.tensor([0.4], dtype=torch.float64))) > 0


@pytest.mark.parametrize(("centre", "sd"), [(0.5, 0.0378), (0.5, 0.033), (0.45, 0.0005)])
def test_two_optima_are_kept_apart(centre: float, sd: float) -> None:
    """Theta enters squared: half of the mass lies on either side, and little between, where the search may begin."""
    space, away = sipe.ParameterSpace([sipe.Parameter("a", low=0.0, high=1.0)]), 0.3 if centre == 0.5 else 0.05
    simulator = sipe.CallableSimulator(lambda v: (v - centre) ** 2, space, likelihood=sd)
    for initial in (None, np.array([[0.25], [0.75]])):
        posterior = Laplace(simulator, initial=initial).fit(np.array([away**2]))
        low, lower, upper, high = (float(q) for q in posterior.quantile([0.05, 0.25, 0.75, 0.95])[:, 0])
        width = sd / (2 * away)
        print(low, lower, upper, high, width)
        np.testing.assert_allclose([lower, upper], [centre - away, centre + away], atol=0.6 * width)
        assert centre - away - 2.5 * width < low < lower < upper < high < centre + away + 2.5 * width


def test_a_stated_noise_is_not_taken_for_rounding() -> None:
    """50 readings around 101,325 with an sd of .005 as stated: sd .005 / .1 / sqrt(50), however large the offset."""
    space = sipe.ParameterSpace([sipe.Parameter("a", low=0.0, high=1.0)])
    simulator = sipe.CallableSimulator(lambda v: 101_325 + 0.1 * v, space, likelihood=0.005)
    readings = np.random.default_rng(0).normal(101_325.05, 0.005, size=(50, 1))
    posterior = Laplace(simulator).fit([simulator.trajectory(x) for x in readings])
    assert float(posterior.stddev[0]) == pytest.approx(0.05 / np.sqrt(50), rel=0.05)
