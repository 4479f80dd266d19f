"""What is thought of a calibration, from codes and numbers, and in which words."""

import dataclasses
import math

import pytest

from sipe_bayes.core.findings import Code, Finding, Findings, Severity
from sipe_bayes.diagnostics.prior_predictive import OutsidePrior
from sipe_bayes.diagnostics.records import BandCoverage, ChannelScore, Comparison
from sipe_bayes.diagnostics.result import Calibration, ParameterSummary
from sipe_bayes.report import page as report
from sipe_bayes.report import verdicts as judged
from sipe_bayes.report.words import significant
from tests.problems.calibrations import BETTER, LACKS, Page, make_calibration, noticed, with_chains


@pytest.fixture(scope="module")
def calibration() -> Calibration:
    return make_calibration()


@pytest.mark.parametrize(
    ("value", "sd", "text"),
    [
        (0.69751, 0.00301, "0.6975"),
        (0.00301, 0.00301, "0.0030"),
        (123.456, 7.0, "123.5"),
        (123456.0, 2300.0, "123500"),
        (-0.0001, 0.5, "0.00"),
        (3.213e-5, 1.1e-6, "3.21e-5"),
        (0.0999, 0.0996, "0.10"),
        (9.80665, 0.0, "9.807"),
        (math.nan, 1.0, "–"),
    ],
)
def test_significant_digits_follow_the_uncertainty(value: float, sd: float, text: str) -> None:
    assert significant(value, sd) == text


def parameter(contraction: float = 0.9, nuisance: bool = False) -> ParameterSummary:
    return ParameterSummary("mass", "kg", (), 1, 0.1, 0.9, 1, 1.1, 1, 1, contraction, nuisance)


KNOWN = dataclasses.replace(parameter(0.05), known=True)


def of_mass(*codes: Code) -> Findings:
    return Findings(noticed(code, "mass") for code in codes)


@pytest.mark.parametrize(
    ("summary", "codes", "tone", "words"),
    [
        (parameter(0.9), (), "good", "determined"),
        (parameter(0.5), (), "fair", "weakly determined"),
        (parameter(0.05), (Code.NOT_DETERMINED,), "bad", "not determined"),
        (parameter(0.99), (Code.MODE_AT_BOUND,), "bad", "at a bound"),
        (parameter(0.0), (Code.NO_EFFECT, Code.NOT_DETERMINED), "bad", "changes nothing, not determined"),
        (parameter(0.99), (Code.LOGS_DISAGREE,), "bad", "disagrees between logs"),
        (parameter(0.99), (Code.MODE_AT_BOUND, Code.MISFIT), "bad", "at a bound, model lacks something"),
        (parameter(0.99), (Code.AT_PHYSICAL_BOUND,), "good", "none shows"),
        (parameter(0.99), (Code.AT_PHYSICAL_BOUND, Code.MISFIT), "bad", "model lacks something"),
        (parameter(0.99), (Code.DEAD_RANGE,), "fair", "part of its range changes nothing"),
        (dataclasses.replace(parameter(1.0), sd=0.0), (), "fair", "a point without uncertainty"),
        (KNOWN, (), "good", "as known beforehand"),
        (dataclasses.replace(KNOWN, further=(0.8, 1.2)), (), "good", "as known beforehand"),
        (dataclasses.replace(KNOWN, further=(0.0, 2.0)), (), "fair", "weakly determined"),
        (dataclasses.replace(KNOWN, contraction=-0.5), (), "fair", "weakly determined"),
        (dataclasses.replace(KNOWN, contraction=0.9), (), "good", "determined"),
    ],
)
def test_verdict_on_a_parameter(summary: ParameterSummary, codes: tuple[Code, ...], tone: str, words: str) -> None:
    found = judged.parameter_verdict(summary, of_mass(*codes))
    assert found.tone == tone
    assert words in found.text
    other = judged.parameter_verdict(dataclasses.replace(summary, name="other"), of_mass(*codes))
    assert other == judged.parameter_verdict(summary, Findings())


def test_a_member_of_a_ridge_is_determined_only_with_the_others() -> None:
    def seen(contraction: float, *codes: Code, members: tuple[str, ...] = ("mass", "length")) -> judged.Verdict:
        findings = [noticed(Code.RIDGE, *members), *of_mass(*codes)]
        return judged.parameter_verdict(parameter(contraction), Findings(findings))

    for codes in ((), (Code.NOT_DETERMINED,)):
        found = seen(0.3, *codes)
        assert (found.tone, found.text) == ("fair", "only with length")
    assert seen(0.9).text == "determined"
    assert seen(0.3, Code.MODE_AT_BOUND).text == "at a bound"
    assert seen(0.0, Code.NO_EFFECT, Code.NOT_DETERMINED).tone == "bad"
    assert seen(0.3, Code.NOT_DETERMINED, members=("a", "b")).tone == "bad"


def scores(*pairs: tuple[float, float]) -> list[ChannelScore]:
    return [ChannelScore("log", f"c{i}", "rad", ours, default) for i, (ours, default) in enumerate(pairs)]


WORSE = Comparison(1 / 3.1, 1 / 3.7, 1 / 2.6, 1e-6, 10)
ALIKE = Comparison(1.1, 0.8, 1.5, 0.6, 10)


@pytest.mark.parametrize(
    ("rows", "comparison", "tone", "words"),
    [
        (
            scores((0.1, 0.31)),
            BETTER,
            "good",
            "better than the model you had: its error is 3.1 times smaller (95 % interval 2.6 to",
        ),
        (
            scores((0.31, 0.1)),
            WORSE,
            "bad",
            "WORSE than the model you had: its error is 3.1 times larger (95 % interval 2.6 to 3.7",
        ),
        (
            scores((0.1, 0.11)),
            ALIKE,
            "bad",
            "NOT shown that the calibrated model is better than the model you had: its error is 1.1 times smaller",
        ),
        (scores((0.1, 9.0), (0.3, 0.2)), BETTER, "fair", "but it is larger in log (c1)"),
        (scores((0.1, 0.102)), Comparison(1.02, 1.01, 1.03, 0.01, 10), "fair", "1.02 times smaller"),
        (scores((0.1, math.nan)), None, "fair", "cannot be compared"),
        (scores((math.nan, 0.1)), None, "bad", "no finite error in log (c0)"),
        ([], None, "fair", "No log was held out"),
    ],
)
def test_verdict_on_the_prediction(
    rows: list[ChannelScore], comparison: Comparison | None, tone: str, words: str
) -> None:
    found = judged.prediction(rows, comparison)
    assert found.tone == tone
    assert words in found.text
    assert (comparison is None) == ("t-test" not in found.text)


def test_a_calibration_that_does_not_help_says_so_first(calibration: Calibration) -> None:
    for comparison, first in ((WORSE, "WORSE"), (ALIKE, "NOT shown"), (BETTER, "may be trusted")):
        found = dataclasses.replace(calibration, comparison=comparison)
        assert first in judged.verdicts(found)[0].text
        page = Page(report.render(found, [])).text
        assert page.index(first) < page.index("90 % interval")


def test_what_the_model_lacks_is_among_the_first_sentences(calibration: Calibration) -> None:
    assert judged.lack(calibration) is None
    found = judged.lack(dataclasses.replace(calibration, misfit=LACKS))
    assert found is not None
    assert found.tone == "bad"
    assert "drag at hinge (40 % of the residual of angle_0, p = 0.005)" in found.text
    both = dataclasses.replace(LACKS, share={**LACKS.share, "angle_1": 0.9})  # the warning names the same channel
    assert judged.lack(dataclasses.replace(calibration, misfit=both)) == found
    small = judged.lack(
        dataclasses.replace(calibration, misfit=dataclasses.replace(LACKS, share={"angle_0": 0.04}, shift={}))
    )
    assert small is not None
    assert small.tone == "fair"
    assert "something small" in small.text
    assert judged.lack(dataclasses.replace(calibration, misfit=dataclasses.replace(LACKS, p=0.2))) is None
    strange = dataclasses.replace(calibration, outside=[OutsidePrior(0.01, "train_0", "angle_0", 1.0)], misfit=LACKS)
    assert strange.to_dict()["outside_prior"][0]["log"] == "train_0"
    assert strange.to_dict()["misfit"]["matters"]


def test_what_the_model_lacks_says_where_values_would_be(calibration: Calibration) -> None:
    """P1 is at 0.35 of [1, 2], sd 0.03; what moves by less than a sd is not named, nor where nothing can be told."""
    lacks = judged.lack(dataclasses.replace(calibration, misfit=LACKS))
    assert lacks is not None
    assert lacks.text.endswith("tries it. With it, to first order, p1 would be about 1.44, not 1.35 kg m^2.")
    both = judged.lack(dataclasses.replace(calibration, misfit=dataclasses.replace(LACKS, shift={"p1": 15, "p2": -2})))
    assert both is not None
    assert "p1 would be about 1.8, not 1.3 kg m^2 and p2 would be about 1.64, not 1.70 kg m^2" in both.text
    far = judged.lack(dataclasses.replace(calibration, misfit=dataclasses.replace(LACKS, shift={"p1": 30, "p2": -2})))
    assert far is not None  # a straight line says nothing of where so long a way ends
    assert far.text.endswith("only a fit tells: to first order p1 would leave the bounds.")
    coloured = judged.lack(dataclasses.replace(calibration, misfit=dataclasses.replace(LACKS, shift={})))
    assert coloured is not None
    assert "would" not in coloured.text
    tied = judged.lack(dataclasses.replace(calibration, misfit=dataclasses.replace(LACKS, alike=2)))
    assert tied is not None  # with which of the two is open
    assert tied.text.endswith("tries it.")
    impacts = dataclasses.replace(calibration, findings=(noticed(Code.MISFIT_NOT_ASKED, severity=Severity.NOTE),))
    assert judged.lack(impacts) == judged.Verdict(
        "fair",
        "It was not asked whether the model lacks something: bodies touch in most segments.",
    )


def test_headline_counts_without_nuisance_parameters() -> None:
    good, weak, nuisance = parameter(0.9), parameter(0.5), parameter(0.9, nuisance=True)

    def seen(*values: ParameterSummary) -> judged.Verdict:
        return judged.headline(values, Findings())

    words = "1 of 2 values may be trusted within their intervals: mass; the table says why not the others."
    assert seen(good, weak, nuisance).text == words
    assert seen(good, good).text == "All 2 values may be trusted within their intervals."
    assert seen(good).tone == "good"
    words = "All 2 values may be trusted within their intervals, if the model lacks nothing."
    impacts = Findings([noticed(Code.MISFIT_NOT_ASKED, severity=Severity.NOTE)])
    assert judged.headline([good, good], impacts) == judged.Verdict("fair", words)
    assert "intervals, if the model lacks nothing: mass;" in judged.headline([good, weak], impacts).text
    assert seen(weak, weak).tone == "bad"
    assert seen(nuisance).tone == "fair"
    doubts = Findings(doubt(text) for text in ("the chains have not mixed", "another", "a third"))
    for values in ([good, weak], [weak]):
        words = "the chains have not mixed; another; and 1 more, among the warnings"
        expected = judged.Verdict("bad", f"No value may be trusted within its interval yet: {words}.")
        assert judged.headline(values, doubts) == expected
    spent = Findings([doubt("the budget ran out: give more", Code.BUDGET_SPENT), doubt("another")])
    brief = judged.headline([good], spent, brief=True).text
    assert brief == "No value may be trusted within its interval yet: another (and 1 more, among the warnings)."
    brief = judged.headline([good], Findings(list(spent)[:1]), brief=True).text
    assert brief == "No value may be trusted within its interval yet: the budget ran out."
    assert judged.parameter_verdict(good, Findings()).tone == "good"
    assert judged.parameter_verdict(good, doubts).tone == "fair"
    assert judged.parameter_verdict(weak, doubts).text == "weakly determined; doubted above"


def test_values_that_hang_on_numbers_that_no_log_tells_are_trusted_only_if_these_are_right() -> None:
    """A stiffness is known but for a mass that only impacts tell; the other values are known without it."""
    mass, other = parameter(0.9), dataclasses.replace(parameter(0.9), name="stiffness")
    untold = Findings([noticed(Code.UNTOLD, "stiffness", severity=Severity.NOTE)])
    expected = judged.Verdict("fair", "determined; see note")
    assert judged.parameter_verdict(other, untold) == expected
    assert judged.parameter_verdict(mass, untold).tone == "good"
    if_right = "if the numbers that no log tells are right"
    words = f"All 2 values may be trusted within their intervals, stiffness only {if_right}."
    assert judged.headline([mass, other], untold) == judged.Verdict("fair", words)
    assert judged.headline([other, other], untold).text.endswith(f"intervals, {if_right}.")
    few = judged.headline([mass, other, dataclasses.replace(parameter(0.5), name="weak")], untold)
    assert few.text.startswith(
        f"2 of 3 values may be trusted within their intervals, stiffness only {if_right}: mass and "
    )
    weak = dataclasses.replace(other, contraction=0.5)
    assert judged.parameter_verdict(weak, untold).text == "weakly determined"


def test_a_model_that_lacks_something_is_used_for_what_it_can_do() -> None:
    """Values whose wider interval still determines them, bands with what they hold; other doubts come first.

    The prior's 90 % are 3.1 wide, half of it 1.6.
    """
    narrow = dataclasses.replace(parameter(0.9), further=(0.5, 1.5))
    wide = dataclasses.replace(parameter(0.9), name="damping", further=(0.2, 2.2))
    misfits = [noticed(Code.MISFIT, name) for name in ("mass", "damping")]
    lacks = Findings([noticed(Code.LOGS_DISAGREE, "mass", severity=Severity.BLOCKING), *misfits])
    assert judged.parameter_verdict(narrow, lacks) == judged.Verdict("fair", "within the first interval")
    assert judged.parameter_verdict(wide, lacks).tone == "bad"
    held = BandCoverage(0.88, 0.03, 20, {"angle": (0.02, "rad")})
    expected = (
        "Use it to predict: its 90 % bands hold 88 ± 3 % of the held-out samples (± 0.02 rad in angle); mass "
        "within the intervals with what the model lacks; damping not at all."
    )
    assert judged.headline([narrow, wide], lacks, held) == judged.Verdict("fair", expected)
    off = judged.headline([narrow, wide], lacks, dataclasses.replace(held, share=0.6))
    assert off.text.startswith("Do not rely on its bands: those of 90 % hold 60 ± 3 %")
    cautious = judged.headline([narrow, wide], lacks, dataclasses.replace(held, share=0.99, error=0.004))
    assert cautious.text.startswith("Use it to predict, within less than its bands: those of 90 % hold 99 ± 0.4 %")
    worse = judged.headline([narrow, wide], lacks, held, better=False).text
    assert worse.startswith("Its 90 % bands hold 88 ± 3 % of the held-out samples")
    assert judged.headline([wide], lacks).text == "It does not tell how well it predicts; damping not at all."
    doubted = Findings([*lacks, doubt("the chains have not mixed", Code.NOT_MIXED)])
    assert "yet: the chains have not mixed" in judged.headline([narrow, wide], doubted, held).text
    assert "doubted above" in judged.parameter_verdict(narrow, doubted).text


def doubt(text: str, code: Code = Code.SEARCH_SPREAD) -> Finding:
    return noticed(code, severity=Severity.BLOCKING, text=text)


def test_doubts_come_first_and_mixing_is_said_once(calibration: Calibration) -> None:
    unmixed = doubt("the chains have not mixed", Code.NOT_MIXED)
    found = dataclasses.replace(with_chains(calibration, 1.4), comparison=BETTER, findings=(unmixed,))
    texts = [v.text for v in judged.verdicts(found)]
    assert texts[0].endswith("yet: the chains have not mixed.")
    assert not any("NOT mixed" in text for text in texts)
    texts = [v.text for v in judged.verdicts(dataclasses.replace(found, findings=(doubt("another"),)))]
    assert any("NOT mixed" in text for text in texts)
    assert "doubted above" in report.render(found, [])


def test_where_nothing_is_seen_to_be_missing_values_are_trusted_and_what_would_not_show_is_named(
    calibration: Calibration,
) -> None:
    plain = dataclasses.replace(parameter(0.9), name="p0")
    values = [dataclasses.replace(plain, further=(plain.q05, plain.q95 + 0.2 * (plain.q95 - plain.q05)))]
    quiet = dataclasses.replace(
        calibration, parameters=values, causes=("delay", "drag", "a spring"), findings=(), misfit=None
    )
    assert judged.parameter_verdict(values[0], Findings()) == judged.Verdict("good", "determined")
    assert judged.headline(values, Findings()).tone == "good"
    said = judged.between_logs(quiet)
    assert said is not None
    words = "at most 20 % wider than the plain ones, allow for what would not show, most of all delay, drag and others."
    assert said.text.endswith(words)
    assert "with what the model may lack" in report.render(quiet, [])
    seen = dataclasses.replace(quiet, findings=(noticed(Code.SMALL_MISFIT),))
    assert "with what the model lacks" in report.render(seen, [])
    assert "hold what differs" in str(judged.between_logs(seen))
