"""What is said of intervals that end at a bound, and of values that differ between logs."""

from __future__ import annotations

from typing import Literal

import numpy as np
import pytest

from sipe_bayes.calibration.gathered import Marginals
from sipe_bayes.core.findings import Code
from sipe_bayes.core.parameters import Parameter, ParameterSpace
from sipe_bayes.posterior import GaussianMixture, Particles, prior


def marginals(space: ParameterSpace, mean: list[float], natural: frozenset[str] = frozenset()) -> Marginals:
    normal = GaussianMixture([0.0], np.array(mean)[None], np.diag([0.02**2] * len(mean))[None], space)
    return Marginals.of(normal, prior(space), 0, natural)


@pytest.mark.parametrize("scale", ["linear", "log"])
@pytest.mark.parametrize(
    ("mean", "natural", "bound"), [(0.9, False, 8.0), (0.1, False, -1.0), (0.1, True, None), (0.5, False, None)]
)
def test_a_wider_interval_that_is_cut_at_a_bound(
    mean: float, natural: bool, bound: float | None, scale: Literal["linear", "log"]
) -> None:
    """Not where nature sets the bound, nor one that ends within."""
    low = 0.0 if scale == "linear" else 1e-4
    space = ParameterSpace([Parameter("mass", low, 8.0, targets=("body:cart.mass",), unit="kg", scale=scale)])
    own = marginals(space, [mean], frozenset({"mass"} if natural else ()))
    draws = np.clip(mean + 0.2 * np.random.default_rng(0).standard_normal((4000, 1)), 0, 1)
    noticed = own.cut_at_bounds(own.summaries(Particles(draws, space)))
    print([one.text for one in noticed])
    assert [one.code for one in noticed] == [Code.WIDER_AT_BOUND] * (bound is not None)
    assert all(f"bound {low if bound == -1 else bound:g} kg" in one.text for one in noticed)
    assert not own.cut_at_bounds(own.summaries())


@pytest.mark.parametrize(("second", "told"), [(0.7, True), (0.305, False), (0.36, False)])  # sds of .02
@pytest.mark.parametrize("target", ["body:cart.mass", "sensor:x.bias"])
def test_the_mean_of_logs_that_no_log_had(second: float, told: bool, target: str) -> None:
    logs = [Parameter(f"mass[{log}]", 0.0, 10.0, targets=(target,), log=log, unit="kg") for log in ("empty", "loaded")]
    noticed = marginals(ParameterSpace(logs), [0.3, second]).means_of_logs()
    assert not marginals(ParameterSpace(logs[:1]), [0.3]).means_of_logs()
    told &= not target.startswith("sensor:")
    assert [one.code for one in noticed] == [Code.MEAN_OF_LOGS] * told
    assert all("mass differs" in one.text and "the mean, 5 kg" in one.text for one in noticed)
