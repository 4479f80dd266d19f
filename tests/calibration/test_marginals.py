"""What is said of intervals that end at a bound, and of values that differ between logs."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import numpy as np
import pytest

from sipe_bayes.calibration.gathered import Marginals, no_rigid_bodies
from sipe_bayes.calibration.init.validate import validate_config
from sipe_bayes.calibration.run import run
from sipe_bayes.core.findings import Code
from sipe_bayes.core.parameters import Parameter, ParameterSpace
from sipe_bayes.envs.mjcf import MjcfEnvironment
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


RAFT = """<mujoco><worldbody><body name="hull"><joint name="yaw" axis="0 0 1"/>
  <inertial pos="0 0 0" mass="9" diaginertia="{across} {across} .2"/></body></worldbody></mujoco>"""


@pytest.mark.parametrize(
    ("across", "middle", "share"), [(0.1, 0.2, 50), (0.1, 0.35, 100), (0.1, 0.1, 0), (2.0, 0.35, 0)]
)
def test_a_posterior_that_no_rigid_body_can_have_is_told(across: float, middle: float, share: int) -> None:
    """Of moments .1, .1 and .2 the last is as large as it can be, about an axis that alone matters."""
    moment = Parameter("moment", 0.0, 1.0, targets=("body:hull.inertia_zz",))
    environment = MjcfEnvironment.build(RAFT.format(across=across), [moment], [], ["joint:yaw.position"])
    normal = GaussianMixture([0.0], np.array([[middle]]), np.array([[[0.02**2]]]), environment.space)
    noticed = no_rigid_bodies(environment, normal, 0)
    assert [one.code for one in noticed] == [Code.NO_RIGID_BODY] * (share > 0)
    assert all(abs(float(one.text.split("in ")[1].split(" %")[0]) - share) <= 3 for one in noticed)
    before = no_rigid_bodies(environment, normal, 0, prior=True)  # of which half and less is as usual
    assert [one.text.split(" no ")[0][-5:] for one in before] == ["prior"] * (share > 60)


MOMENT = """
[[parameters]]
name = "moment"
target = "body:cart.inertia_zz"
bounds = [0.002, {high}]
"""


@pytest.mark.parametrize(("high", "odd"), [(0.1, True), (0.01, False)])
def test_a_prior_that_hardly_any_body_has_is_told_before_the_fit(config: Path, high: float, odd: bool) -> None:
    """A ball's moments are .004 each, of which the third is .008 at most; by the check and ahead of a calibration."""
    config.write_text(config.read_text() + MOMENT.format(high=high))
    assert any("of the prior no rigid body has it" in line for line in validate_config(config).odd) == odd
    lines: list[str] = []
    run(config, budget=40, out=config.parent / "out", tell=lines.append)
    assert any("of the prior no rigid body has it" in line for line in lines) == odd


@pytest.mark.parametrize(("moved", "sd", "known"), [(0.0, 0.01, True), (0.015, 0.01, True), (0.03, 0.008, False)])
def test_what_was_weighed_is_not_asked_to_be_determined(moved: float, sd: float, known: bool) -> None:
    """But where the logs say something else than the prior, which they have not made much narrower."""
    weighed = Parameter("mass", 0.0, 1.0, targets=("body:cart.mass",), prior_mean=0.5, prior_sd=0.01)
    space = ParameterSpace([weighed, Parameter("gain", 0.0, 1.0, targets=("actuator:drive.gain",))])
    normal = GaussianMixture([0.0], np.array([[0.5 + moved, 0.5]]), np.diag([sd**2, 0.28**2])[None], space)
    own = Marginals.of(normal, prior(space), 0)
    assert [one.known for one in own.summaries()] == [known, False]
    asked = [one.parameters for one in own.findings({}) if one.code is Code.NOT_DETERMINED]
    assert asked == ([] if known else [("mass",)]) + [("gain",)]


def test_intervals_of_a_model_that_got_what_it_lacked_stand_apart() -> None:
    """What else a model may lack goes around the plain interval."""
    space = ParameterSpace([Parameter("mass", 0.0, 8.0, targets=("body:cart.mass",), unit="kg")])
    own = marginals(space, [0.5])
    further = GaussianMixture([0.0], np.array([[0.2]]), np.array([[[0.01**2]]]), space)
    ((low, high),) = [one.further for one in own.summaries(further) if one.further is not None]
    np.testing.assert_allclose(low, 8 * (0.2 - 0.01645), rtol=1e-3)
    assert high > 8 * 0.5
