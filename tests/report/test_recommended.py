"""What a policy may be trained under is what the report says to use, and says where that is nothing."""

import dataclasses

import numpy as np
import torch

from sipe_bayes.core.findings import Code, Findings, Severity
from sipe_bayes.diagnostics.result import Calibration
from sipe_bayes.posterior import Particles
from sipe_bayes.report.recommended import recommended
from sipe_bayes.report.verdicts import headline
from sipe_bayes.rl.randomization import Usable
from tests.problems.calibrations import make_calibration, noticed, with_chains

ENDS = torch.tensor([0.05, 0.95], dtype=torch.float64)


def calibration(*findings: Code) -> Calibration:
    """Three parameters, the second of which these findings are about."""
    given = [noticed(code, "p1", severity=Severity.CAUTION) for code in findings]
    return dataclasses.replace(make_calibration(), findings=tuple(given))


def with_further(given: Calibration, widths: float = 0.1) -> Calibration:
    """Beside wider intervals, those of correlated draws that hold the plain ones but for the first parameter's."""
    random = np.random.default_rng(0)
    z = random.standard_normal((2000, 1)) + 0.2 * random.standard_normal((2000, 3))
    theta = np.clip(given.posterior.mean.numpy() + widths * z + [0.1, 0, 0], 0, 1)
    further = Particles(theta, given.posterior.space)
    ends = given.posterior.space.values(further.quantile(ENDS).numpy())
    parameters = [
        dataclasses.replace(p, further=(min(low, p.q05), max(high, p.q95)))
        for p, low, high in zip(given.parameters, *ends, strict=True)
    ]
    return dataclasses.replace(given, parameters=parameters, further=further)


def test_without_a_doubt_or_a_wider_interval_it_is_the_posterior() -> None:
    given = calibration()
    drawn = recommended(given)
    assert drawn.posterior is given.posterior
    assert drawn.plain
    assert set(drawn.names(Usable.PLAIN)) == {"p0", "p1", "p2"}
    assert drawn.remarks() == []


def test_the_wider_intervals_that_are_printed_are_those_that_are_drawn() -> None:
    """Also on the side where theta with what the model lacks does not reach over the plain interval."""
    given = with_further(calibration(Code.MISFIT))
    drawn = recommended(given)
    ends = drawn.posterior.space.values(drawn.posterior.quantile(ENDS).numpy())
    for p, low, high in zip(given.parameters, *ends, strict=True):
        assert p.further is not None
        np.testing.assert_allclose((low, high), p.further, atol=0.01 * (p.further[1] - p.further[0]))
    assert drawn.names(Usable.WIDER) == ("p0", "p1", "p2")
    assert "what the model lacks" in drawn.remarks()[0]
    theta = drawn.posterior.sample((2000,), generator=torch.Generator().manual_seed(1)).numpy()
    assert np.corrcoef(theta[:, 1], theta[:, 2])[0, 1] > 0.8  # 0.96 of what was given


def test_a_value_that_may_not_be_used_is_drawn_from_its_prior() -> None:
    """The others stay as they were, correlations among them included."""
    given = calibration(Code.MODE_AT_BOUND)
    drawn = recommended(given)
    assert drawn.names(Usable.NONE) == ("p1",)
    assert drawn.bases["p1"].reason == "at a bound"
    np.testing.assert_allclose(drawn.posterior.quantile(ENDS).numpy()[:, 1], [0.05, 0.95], atol=0.02)
    np.testing.assert_allclose(drawn.posterior.stddev.numpy()[[0, 2]], given.posterior.stddev.numpy()[[0, 2]], rtol=0.1)
    assert "WARNING, not calibrated, drawn from the prior: p1: at a bound." in drawn.remarks()


def test_the_others_keep_the_ends_that_are_printed() -> None:
    given = with_further(calibration(Code.MISFIT, Code.MODE_AT_BOUND))
    drawn = recommended(given)
    assert drawn.names(Usable.NONE) == ("p1",)
    ends = drawn.posterior.space.values(drawn.posterior.quantile(ENDS).numpy())
    for j in (0, 2):
        np.testing.assert_allclose(ends[:, j], given.parameters[j].further, rtol=1e-3)


def test_while_a_finding_blocks_everything_is_drawn_from_the_prior() -> None:
    """As the headline has it; a misfit that wider intervals allow for is no such finding."""
    spent = noticed(Code.BUDGET_SPENT, severity=Severity.BLOCKING)
    given = with_further(dataclasses.replace(calibration(), findings=(spent,)))
    drawn = recommended(given)
    assert drawn.posterior is given.prior
    assert drawn.names(Usable.NONE) == ("p0", "p1", "p2")
    assert {basis.reason for basis in drawn.bases.values()} == {spent.text}
    assert headline(given.parameters, Findings(given.findings)).tone == "bad"


def test_chains_that_have_not_mixed_are_drawn_from_the_prior() -> None:
    given = with_chains(calibration(), 1.5)
    assert recommended(given).names(Usable.NONE) == ("p0", "p1", "p2")
    assert recommended(with_chains(calibration(), 1.001)).plain
