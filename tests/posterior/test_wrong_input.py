"""Wrong input and broken files are refused in one line."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from sipe_bayes.posterior import (
    Dirac,
    GaussianMixture,
    IndependentPrior,
    NoDensityError,
    Particles,
    load_posterior,
    uniform,
)
from tests.problems.posteriors import single, space_of

EYE = np.eye(2)[None]
TWO = space_of(2)
WRONG_INPUT: list[tuple[Callable[[], object], type[Exception], str]] = [
    (lambda: Particles([[0.5, 0.5]], TWO, sample_stats={"lp": [1.0]}), ValueError, "sample_stats: expected chains"),
    (
        lambda: Dirac([0.5, 0.5], TWO).to_inference_data(10, log_likelihood={"x": np.zeros((1, 9))}),
        ValueError,
        "log_likelihood: expected x",
    ),
    (
        lambda: Dirac([0.5, 0.5], TWO).to_inference_data(prior=uniform(space_of(1))),
        ValueError,
        "prior: expected one over",
    ),
    (lambda: Dirac([0.5], TWO), ValueError, r"theta: expected shape \(2\), got \(1,\)"),
    (lambda: Dirac([0.5, 1.5], TWO), ValueError, r"theta: expected theta in \[0, 1\].*normalise"),
    (lambda: Dirac([0.5, math.nan], TWO), ValueError, "theta: expected finite"),
    (lambda: Dirac("abc", TWO), ValueError, "theta: expected an array of numbers"),
    (lambda: Dirac([0.5, 0.5], ["a", "b"]), TypeError, "space: expected a ParameterSpace, got list"),
    (lambda: Dirac([0.5, 0.5], TWO).log_prob([0.5, 0.5]), NoDensityError, "smoothed"),
    (lambda: Dirac([0.5, 0.5], TWO).smoothed(0.0), ValueError, "bandwidth: expected a positive"),
    (lambda: Particles(np.empty((0, 2)), TWO), ValueError, "at least one row"),
    (
        lambda: Particles(np.ones((4, 2)), TWO, weights=[1, 1, 1, -1]),
        ValueError,
        "weights: expected non-negative",
    ),
    (lambda: Particles(np.ones((4, 2)), TWO, weights=[0, 0, 0, 0]), ValueError, "positive sum"),
    (lambda: Particles(np.ones((4, 2)), TWO, weights=[1, 1]), ValueError, "weights: expected shape"),
    (
        lambda: Particles(np.ones((4, 2)), TWO, chains=3),
        ValueError,
        "chains: expected a divisor of the 4 rows",
    ),
    (
        lambda: Particles(np.ones((2, 2)), TWO, weights=[1, 2], chains=2),
        ValueError,
        "chains: expected equal weights",
    ),
    (lambda: Particles(np.ones((4, 2)), TWO).smoothed("scott"), ValueError, "scott.*give a number"),
    (
        lambda: Particles(np.ones((4, 2)), TWO).smoothed("silverman"),
        ValueError,
        "bandwidth: expected.*silverman",
    ),
    (lambda: GaussianMixture([0.0], [[0.5]], EYE, TWO), ValueError, "means: expected shape"),
    (lambda: GaussianMixture([0.0, 0.0], [[0.5, 0.5]], EYE, TWO), ValueError, "log_weights: expected shape"),
    (
        lambda: GaussianMixture([-math.inf], [[0.5, 0.5]], EYE, TWO),
        ValueError,
        "log_weights: expected at least one",
    ),
    (lambda: GaussianMixture([0.0], [[0.5, 0.5]], np.eye(2), TWO), ValueError, "covariances: expected shape"),
    (
        lambda: single([0.5, 0.5], [[1, 2], [2, 1]]),
        ValueError,
        "positive definite.*eigenvalue -1 in component 0",
    ),
    (lambda: single([0.5, 0.5], [[1, 1], [1, 1]]), ValueError, "positive definite"),
    (lambda: single([0.5, 0.5], [[1, 0.5], [0, 1]]), ValueError, "covariances: expected symmetric"),
    (lambda: single([0.5, 0.5], [[1, 0], [0, 0]]), ValueError, "positive variances"),
    (lambda: IndependentPrior([0.5, 0.5], [1.0, 0.0], TWO), ValueError, "sd: expected 2 positive"),
    (lambda: uniform(TWO).log_prob([0.5]), ValueError, r"theta: expected shape \(\.\.\., 2\), got \(1,\)"),
    (lambda: uniform(TWO).quantile(1.5), ValueError, r"q: expected.*\[0, 1\].*1.5"),
    (lambda: uniform(TWO).marginal("p0"), TypeError, r"write \['p0'\]"),
    (lambda: uniform(TWO).marginal(["mass"]), KeyError, "no parameter 'mass'"),
]


@pytest.mark.parametrize("case", range(len(WRONG_INPUT)))
def test_wrong_input(case: int) -> None:
    call, exception, words = WRONG_INPUT[case]
    with pytest.raises(exception, match=words) as caught:
        call()
    assert "\n" not in str(caught.value)


def test_broken_files(tmp_path: Path) -> None:
    path = tmp_path / "posterior"
    header, tensors = tmp_path / "posterior.json", tmp_path / "posterior.safetensors"

    def refused(exception: type[Exception], words: str) -> None:
        with pytest.raises(exception, match=words) as caught:
            load_posterior(path)
        assert "\n" not in str(caught.value)
        assert str(tmp_path) in str(caught.value)

    refused(FileNotFoundError, "no such file")
    uniform(TWO).save(path)
    good_header, good_tensors = header.read_text(), tensors.read_bytes()
    tensors.write_bytes(good_tensors[:-3])
    refused(ValueError, "checksum.*save it again")
    tensors.write_bytes(good_tensors)
    header.write_text(good_header[:40])
    refused(ValueError, "cannot be read as a posterior's header.*save it again")
    header.write_text("[]")
    refused(ValueError, "expected an object of JSON")
    header.write_text(good_header.replace("IndependentPrior", "Cauchy"))
    refused(ValueError, r"expected one of \[.*'Dirac'.*got 'Cauchy'")
    header.write_text(good_header.replace('"family": "IndependentPrior"', '"family": "GaussianMixture"'))
    refused(ValueError, "cannot be read as a posterior.*save it again")
    header.write_text(good_header)
    tensors.unlink()
    refused(FileNotFoundError, "posterior.safetensors")
