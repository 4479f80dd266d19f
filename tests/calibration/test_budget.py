"""The budget belongs to the problem: it grows with it, its end blocks, and a larger one goes on in the same folder."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch

from sipe_bayes.calibration.gathered import Marginals, most_probable
from sipe_bayes.calibration.run import run
from sipe_bayes.core.findings import Code, Finding, Findings, Severity, finding
from sipe_bayes.core.parameters import Parameter, ParameterSpace
from sipe_bayes.envs.unknowns import bounded_by_nature
from sipe_bayes.posterior import GaussianMixture, uniform
from sipe_bayes.report.page import render
from tests.problems.calibrations import make_calibration
from tests.problems.made_up_logs import PENDULUM
from tests.problems.swings import swing, write_case


@pytest.mark.usefixtures("unreported")
def test_a_larger_budget_goes_on_in_the_same_folder(tmp_path: Path) -> None:
    config = write_case(tmp_path, swing())
    whole = run(config, budget=4000, out=tmp_path / "whole")
    short = run(config, budget=whole.rollouts // 2, out=tmp_path / "out")
    blocking = {item.code for item in Findings(short.findings).blocking}
    assert blocking & {Code.BUDGET_SPENT, Code.SEARCH_CUT_SHORT, Code.NOT_JUDGED}
    on = run(config, budget=4000, out=tmp_path / "out")
    assert not {item.code for item in on.findings} & {Code.BUDGET_SPENT, Code.SEARCH_CUT_SHORT}
    assert on.rollouts == whole.rollouts
    assert [p.mode for p in on.parameters] == [p.mode for p in whole.parameters]


def test_the_value_lies_within_every_interval() -> None:
    """Of a ridge that two bounds cut off the mode is a corner of the cube."""
    space = ParameterSpace([Parameter("a", low=0.0, high=1.0), Parameter("b", low=0.0, high=1.0)])
    axis = np.array([1.0, 1.0]) / np.sqrt(2)
    covariance = 25.0 * np.outer(axis, axis) + 1e-4 * np.eye(2)
    posterior = GaussianMixture(np.zeros(1), np.array([[3.0, 3.0]]), covariance[None], space)
    low, high = posterior.quantile(torch.tensor([0.05, 0.95], dtype=torch.float64)).numpy()
    assert not ((posterior.mode.numpy() >= low) & (posterior.mode.numpy() <= high)).all()
    theta = most_probable(posterior)
    assert ((theta >= low) & (theta <= high)).all()
    assert abs(theta[0] - theta[1]) < 0.03


def test_what_nature_bounds_is_told_apart_from_a_bound_that_was_chosen(tmp_path: Path) -> None:
    """Friction of which none shows has a one-sided interval from 0 on, and is no warning; a mass of 0.2 kg is one."""
    space = ParameterSpace([
        Parameter("friction", high=0.5, unit="N m", targets=("joint:hinge.frictionloss",)),
        Parameter("mass", low=0.2, high=0.8, unit="kg", targets=("body:rod.mass",)),
    ])  # fmt: skip
    model = mujoco.MjModel.from_xml_string(PENDULUM)
    natural = bounded_by_nature(model, space)
    assert natural == {"friction"}
    posterior = GaussianMixture(np.zeros(1), np.array([[-0.01, -0.01]]), 1e-4 * np.eye(2)[None], space)
    marginals = Marginals.of(posterior, uniform(space), 0, natural)
    codes = {item.code: item.parameters for item in marginals.findings({})}
    assert codes == {Code.AT_PHYSICAL_BOUND: ("friction",), Code.MODE_AT_BOUND: ("mass",)}
    friction, mass = marginals.summaries()
    assert friction.q05 == 0.0
    beside = GaussianMixture(np.zeros(1), np.array([[0.5, 1e-5]]), 4e-10 * np.eye(2)[None], space)
    noticed = Marginals.of(beside, uniform(space), 0, natural).findings({})
    assert [item.code for item in noticed] == [Code.MODE_AT_BOUND]  # pressed there, and sharp
    assert 0.2 < mass.q05 <= mass.mode


def test_findings_of_one_kind_about_many_logs_are_one_line() -> None:
    many = [finding(Code.CHECKS_SKIPPED, log=f"run{k}", checks="agreement", reason=f"run{k}") for k in range(12)]
    kinds = Findings([*many, finding(Code.BUDGET_SPENT, budget=5)]).kinds
    assert len(kinds) == 2
    assert kinds[0].startswith("the budget of 5 rollouts")
    assert kinds[1].endswith("(and so 11 more)")


def test_a_spent_budget_does_not_stand_before_its_cause() -> None:
    """What blocks for another reason and what the model lacks come first, wherever they were noticed."""
    spent, rubs = finding(Code.BUDGET_SPENT, budget=5), Finding(Code.MISFIT, Severity.CAUTION, "it rubs")
    apart = Finding(Code.LOGS_DISAGREE, Severity.BLOCKING, "logs disagree")
    others = Finding(Code.LOG_JUMPS, Severity.CAUTION, "a log jumps"), Finding(Code.RIDGE, Severity.NOTE, "a ridge")
    findings = Findings([*others, spent, rubs, apart])
    expected = ["logs disagree", "it rubs", spent.text, "a log jumps"]
    assert findings.warnings == findings.kinds == expected
    assert findings.doubts == ["logs disagree", spent.text]
    page = render(dataclasses.replace(make_calibration(), findings=tuple(findings)), [])
    places = [page.index(f">{text}") for text in expected]
    assert places == sorted(places)
