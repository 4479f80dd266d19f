"""What to think of a calibration: which values can be trusted, whether it predicts, what the model lacks.

Verdicts are decided by the codes and severities of findings and by numbers; words are only what they say.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from sipe_bayes.core.finding_texts import TEXTS
from sipe_bayes.core.findings import Code, Findings
from sipe_bayes.core.thresholds import THRESHOLDS
from sipe_bayes.diagnostics.records import BandCoverage, ChannelScore, Comparison
from sipe_bayes.diagnostics.result import Calibration, ParameterSummary
from sipe_bayes.report.words import listed, number, significant

_ONE = "The one value may be trusted within its interval"
_UNTOLD = "if the numbers that no log tells are right"
_NAMED, _DOUBTS = 3, 2  # parameters and doubts that a sentence lists
_FIVE_TO_95 = 0.9 * math.sqrt(12)  # sds of a uniform prior

_PROBLEMS = (
    Code.MODE_AT_BOUND,
    Code.NO_EFFECT,
    Code.NOT_DETERMINED,
    Code.LOGS_DISAGREE,
    Code.MISFIT,
)
"""Findings for which a parameter's value is not to be trusted, in the order in which its row names them."""
_ALLOWED_FOR = (Code.LOGS_DISAGREE, Code.MISFIT)
"""Those of which the intervals with what the model lacks take account."""
_SEEN = (*_ALLOWED_FOR, Code.SMALL_MISFIT)
"""Those that show that it lacks something; without one its intervals allow for what does not show."""


@dataclass(frozen=True)
class Verdict:
    """What to think of something: a ``tone`` (good, fair or bad) and words."""

    tone: str
    text: str


def parameter_verdict(parameter: ParameterSummary, findings: Findings) -> Verdict:
    """What to think of one parameter: what is wrong with it, else how far the logs determine it.

    One that is poorly determined but belongs to a ridge is determined with the others of it. None is good while a
    finding blocks, or while a number that no log tells would move it.
    """
    verdict = _of_the_logs(parameter, findings)
    if verdict.tone == "good" and _hangs(parameter, findings):
        return Verdict("fair", f"{verdict.text}; see note")
    return verdict


def _hangs(parameter: ParameterSummary, findings: Findings) -> bool:
    """Whether a number that no log tells would move it by more than the logs leave open."""
    return any(parameter.name in item.parameters for item in findings.of(Code.UNTOLD))


def _of_the_logs(parameter: ParameterSummary, findings: Findings) -> Verdict:
    """The same as if all numbers that no log tells were right."""
    codes = {item.code for item in findings.about(parameter.name)}
    on_ridge = [r.parameters for r in findings.of(Code.RIDGE) if parameter.name in r.parameters]
    others = list(dict.fromkeys(n for names in on_ridge for n in names if n != parameter.name))
    shared = bool(others) and parameter.contraction < THRESHOLDS.well_determined and Code.NO_EFFECT not in codes
    if shared:
        codes.discard(Code.NOT_DETERMINED)
    allowed = _ALLOWED_FOR if parameter.further is not None else ()
    problems = [TEXTS[code].row for code in _PROBLEMS if code in codes and code not in allowed]
    if problems:
        return Verdict("bad", ", ".join(problems))
    as_known = parameter.known and -THRESHOLDS.idle < parameter.contraction < THRESHOLDS.well_determined
    if as_known and not _wide(parameter, -THRESHOLDS.well_determined):
        return Verdict("fair" if findings.blocking else "good", "as known beforehand")
    if shared:  # a wider interval that is the prior's says nothing of one alone
        open_ = parameter.further is not None and _wide(parameter)
        return Verdict("bad" if open_ else "fair", f"only with {listed(others)}")
    if not parameter.sd > 0:
        return Verdict("fair", "a point without uncertainty")
    if parameter.further is not None and _lacks(findings):
        return _with_what_is_lacking(parameter, findings)
    if Code.AT_PHYSICAL_BOUND in codes and not findings.blocking:
        return Verdict("good", f"{TEXTS[Code.AT_PHYSICAL_BOUND].row}, at most the upper end")
    partly = f"; {TEXTS[Code.DEAD_RANGE].row}" if Code.DEAD_RANGE in codes else ""
    doubted = "; doubted above" if findings.blocking else ""
    if parameter.contraction < THRESHOLDS.well_determined or _wide(parameter, THRESHOLDS.well_determined):
        return Verdict("fair", "weakly determined" + partly + doubted)
    return Verdict("fair" if partly or doubted else "good", "determined" + partly + doubted)


def _lacks(findings: Findings) -> bool:
    """Whether something is seen to be missing."""
    return bool(findings.of(*_SEEN))


def lacking(findings: Findings) -> str:
    """The verb of what the wider intervals are with: what the model "lacks", or where nothing is seen "may lack"."""
    return "lacks" if _lacks(findings) else "may lack"


def _with_what_is_lacking(parameter: ParameterSummary, findings: Findings) -> Verdict:
    """How far the wider interval determines a parameter."""
    if _wide(parameter):
        return Verdict("bad", "not determined")
    if _doubts(findings, [parameter]):
        return Verdict("fair", "doubted above, not to be used yet")
    return Verdict("fair", "within the first interval")


def _wide(parameter: ParameterSummary, contraction: float = THRESHOLDS.not_determined) -> bool:
    """Whether the wider interval, if there is one, contracts less than so far from the prior's."""
    low, high = parameter.further or (0.0, 0.0)
    prior = _FIVE_TO_95 * parameter.sd / max(1 - parameter.contraction, 1e-12)
    return not (high - low) < (1 - contraction) * prior


def _doubts(findings: Findings, parameters: Sequence[ParameterSummary]) -> list[str]:
    """The texts of findings that block, but for those of which wider intervals take account."""
    wider = any(p.further is not None for p in parameters)
    return [item.text for item in findings.blocking if not (wider and item.code in _ALLOWED_FOR)]


def doubt(calibration: Calibration) -> str | None:
    """Why no value may be used within any of its intervals, the first reason; None where some may."""
    if not calibration.parameters:
        return "the posterior could not be summarised"
    doubts = _doubts(Findings(calibration.findings), calibration.parameters)
    mixing = mixing_verdict(calibration)
    if not doubts and mixing is not None and mixing.tone == "bad":
        return mixing.text.removesuffix(".")
    return doubts[0] if doubts else None


def _use(
    parameters: Sequence[ParameterSummary], findings: Findings, bands: BandCoverage | None, better: bool
) -> Verdict:
    """What a model that lacks something may be used for; better: no held-out log shows that it does not."""
    tones = {p.name: parameter_verdict(p, findings).tone for p in parameters}
    usable, open_ = [n for n, tone in tones.items() if tone != "bad"], [n for n, tone in tones.items() if tone == "bad"]
    text = "It does not tell how well it predicts"
    if bands is not None:
        held = f"hold {100 * bands.share:.0f} ± {number(100 * bands.error, 1)} % of the held-out samples"
        text = f"Use it to predict: its 90 % bands {held}" if better else f"Its 90 % bands {held}"
        off = bands.share - THRESHOLDS.shown_interval
        if abs(off) > 2 * bands.error + THRESHOLDS.band_off:
            narrower = "Use it to predict, within less than its bands" if better else "Its bands are too wide"
            text = f"{narrower if off > 0 else 'Do not rely on its bands'}: those of 90 % {held}"
        widths = list(bands.half.items())[:_DOUBTS]
        half = ", ".join(f"± {number(width, 2)} {unit}".rstrip() + f" in {name}" for name, (width, unit) in widths)
        text += f" ({half})"
    if usable:
        text += f"; {_few(usable)} within the intervals with what the model lacks"
    if open_:
        text += f"; {_few(open_)} not at all"
    return Verdict("fair" if usable else "bad", f"{text}.")


def _few(names: Sequence[str]) -> str:
    return listed(names) if len(names) <= _NAMED + 1 else f"{listed(names[:_NAMED])} and {len(names) - _NAMED} others"


def headline(
    parameters: Sequence[ParameterSummary],
    findings: Findings,
    bands: BandCoverage | None = None,
    brief: bool = False,
    better: bool = True,
) -> Verdict:
    """Which of the parameters, nuisance ones aside, may be trusted; none while a finding blocks.

    Where the model lacks something: what it may be used for.

    Args:
        parameters: all of them.
        findings: about them.
        bands: what those of the held-out logs hold.
        brief: the first of the doubts, without its remedy, where all of them stand beside it.
        better: False where held-out logs show it worse than the model as given, or not better.
    """
    wanted = [p for p in parameters if not p.nuisance]
    if not parameters:
        return Verdict(
            "bad", "The posterior could not be summarised: result.json holds the mean of theta, if there is one."
        )
    if not wanted:
        return Verdict("fair", "Only nuisance parameters were estimated.")
    doubts = _doubts(findings, wanted)
    if doubts and brief:
        others = f" (and {len(doubts) - 1} more, among the warnings)" if len(doubts) > 1 else ""
        return Verdict("bad", f"No value may be trusted within its interval yet: {doubts[0].split(': ')[0]}{others}.")
    if doubts:
        others = f"; and {len(doubts) - _DOUBTS} more, among the warnings" if len(doubts) > _DOUBTS else ""
        first = "; ".join(doubts[:_DOUBTS])
        return Verdict("bad", f"No value may be trusted within its interval yet: {first}{others}.")
    if any(p.further is not None for p in wanted) and _lacks(findings):
        return _use(wanted, findings, bands, better)
    good = [p for p in wanted if _of_the_logs(p, findings).tone == "good"]
    if not good:
        return Verdict("bad", "No value may be trusted within its interval; the table says why.")
    unasked = bool(findings.of(Code.MISFIT_NOT_ASKED, Code.CHECKS_SKIPPED))
    hanging = [p.name for p in good if _hangs(p, findings)]
    conditions = ["if the model lacks nothing"] if unasked else []
    if hanging:
        conditions.append(_UNTOLD if len(hanging) == len(good) else f"{_few(hanging)} only {_UNTOLD}")
    given = f", {' and '.join(conditions)}" if conditions else ""
    if len(good) == len(wanted):
        text = f"All {len(good)} values may be trusted within their intervals" if len(good) > 1 else _ONE
        return Verdict("fair" if conditions else "good", f"{text}{given}.")
    text = f"{len(good)} of {len(wanted)} values may be trusted within their intervals{given}: "
    return Verdict("fair", f"{text}{_few([p.name for p in good])}; the table says why not the others.")


def prediction(scores: Sequence[ChannelScore], comparison: Comparison | None) -> Verdict:
    """Whether the calibrated model foretells held-out logs better than the model as given.

    Args:
        scores: errors on the held-out logs.
        comparison: of these errors; None where they cannot be compared.
    """
    if not scores:
        text = "No log was held out, so nothing here shows how well the model predicts a log it has not seen."
        return Verdict("fair", text)
    lost = [s for s in scores if not math.isfinite(s.rmse)]
    if lost:
        where = listed([f"{s.log} ({s.channel})" for s in lost])
        return Verdict("bad", f"On held-out logs the calibrated model has no finite error in {where}.")
    if comparison is None:
        return Verdict("fair", "On held-out logs the errors of the two models cannot be compared.")
    error = f"{_margin(comparison)}; paired t-test on {comparison.pieces} pieces of the logs, p = {comparison.p:.2g}"
    if comparison.starts is not None:
        share = f"{100 * comparison.starts:.3g} %"
        error += f"; from starts that each model fits, since those measured make {share} of the error"
    error += ")"
    if 1 / THRESHOLDS.same < comparison.ratio < THRESHOLDS.same:
        return Verdict("fair", "On held-out logs the calibrated model and the model you had have the same error.")
    if comparison.verdict == "worse":
        return Verdict(
            "bad", f"On held-out logs the calibrated model is WORSE than the model you had: its error is {error}."
        )
    if comparison.verdict == "not better":
        text = (
            "On held-out logs it is NOT shown that the calibrated model is better than the model you had: its error is "
        )
        return Verdict("bad", f"{text}{error}.")
    alone = comparison.starts is None  # the errors by log are from measured starts
    worse = [f"{s.log} ({s.channel})" for s in scores if alone and s.rmse > THRESHOLDS.alike * s.rmse_default]
    text = f"On held-out logs the calibrated model is better than the model you had: its error is {error}"
    if worse:
        return Verdict("fair", f"{text}; but it is larger in {listed(worse)}.")
    return Verdict("good" if comparison.ratio >= THRESHOLDS.alike else "fair", f"{text}.")


def _margin(comparison: Comparison) -> str:
    """The ratio in words with its 95 % interval, in the direction in which it lies."""
    ratio, low, high = comparison.ratio, comparison.low, comparison.high
    if ratio < 1:
        ratio, low, high = 1 / ratio, 1 / high, 1 / low
    digits = 3 if ratio < THRESHOLDS.alike else 2
    word = "smaller" if comparison.ratio >= 1 else "larger"
    short = 10 ** (digits - 1)  # below it zeros are digits too: 1.0 to 19
    ratio_text, *ends = (f"{x:#.{digits}g}" if 1 <= x < short else number(x, digits) for x in (ratio, low, high))
    return f"{ratio_text} times {word} (95 % interval {' to '.join(ends)}"


def lack(calibration: Calibration) -> Verdict | None:
    """What the model lacks, where that matters; the warnings say more."""
    misfit = calibration.misfit
    if misfit is None and any(f.code is Code.MISFIT_NOT_ASKED for f in calibration.findings):
        return Verdict("fair", "It was not asked whether the model lacks something: bodies touch in most segments.")
    if misfit is None or not misfit.alarm:
        return None
    share = f"{number(100 * misfit.share[misfit.channel], 2)} % of the residual of {misfit.channel}"
    if not misfit.matters:
        return Verdict("fair", f"The model lacks something small: it looks like {misfit.cause} ({share}).")
    text = f"The model lacks something: it looks like {misfit.cause} ({share}, {misfit.p_text})."
    text += " `sipe discover` tries it." if misfit.shift else ""
    if misfit.alike > 1:  # with which of them values would move is open
        return Verdict("bad", text)
    moved = sorted(misfit.moved, key=lambda name: -abs(misfit.shift[name]))[:_DOUBTS]
    beyond = [name for name in misfit.moved if _led_out(calibration, name, misfit.shift[name])]
    if beyond:  # so far off no value is near what a fit with it would give
        text += (
            f" Where values would be with it only a fit tells: to first order {_few(beyond)} would leave the bounds."
        )
    elif moved:
        values = [_would_be(calibration, name, misfit.shift[name]) for name in moved]
        text += f" With it, to first order, {listed(values)}."
    return Verdict("bad", text)


def _led_out(calibration: Calibration, name: str, sds: float) -> bool:
    """Whether a parameter that moves by so many sds comes to be outside its bounds, by more than a sd."""
    posterior, j = calibration.posterior, calibration.posterior.space.names.index(name)
    theta, sd = float(posterior.mode[j]), float(posterior.stddev[j])
    return not -sd <= theta + sds * sd <= 1 + sd


def _would_be(calibration: Calibration, name: str, sds: float) -> str:
    """Where a parameter would be that moves by so many sds, and where it is."""
    posterior = calibration.posterior
    j = posterior.space.names.index(name)
    theta, sd, parameter = float(posterior.mode[j]), float(posterior.stddev[j]), posterior.space[j]
    here, there = (float(parameter.value(x)) for x in (theta, min(max(theta + sds * sd, 0.0), 1.0)))
    new, old = (significant(x, 3 * abs(there - here), here) for x in (there, here))
    return f"{name} would be about {new}, not {old} {parameter.unit}".rstrip()


def mixing_verdict(calibration: Calibration) -> Verdict | None:
    """Whether the Markov chains have mixed, when there are any that say so."""
    rhat = calibration.mixing.get("rhat")
    if rhat is None:
        return None
    if rhat <= THRESHOLDS.mixed:
        return Verdict("good", f"The chains have mixed (largest R-hat {rhat:.3f}).")
    return Verdict("bad", f"The chains have NOT mixed (R-hat {rhat:.2f}): do not use the intervals yet.")


def verdicts(calibration: Calibration, brief: bool = False) -> list[Verdict]:
    """The sentences at the top of the report; the first says so where the calibration does not help.

    brief: without the doubts, where they are told beside it.
    """
    findings = Findings(calibration.findings)
    predicted = prediction(calibration.holdout, calibration.comparison)
    if not calibration.train and findings.of(Code.INTERNAL_ERROR, Code.CHECKS_SKIPPED):
        predicted = Verdict("fair", "The logs were not predicted: a warning says why. The errors are unknown.")
    better = predicted.tone != "bad"
    first = [headline(calibration.parameters, findings, calibration.bands, brief, better), predicted]
    if not better:
        first.reverse()
    mixing = mixing_verdict(calibration)
    if mixing is not None and mixing.tone == "bad" and any(f.code is Code.NOT_MIXED for f in findings.blocking):
        mixing = None  # the headline says it
    return [v for v in (*first, lack(calibration), between_logs(calibration), mixing) if v]


def between_logs(calibration: Calibration) -> Verdict | None:
    """What the intervals with what the model lacks, or may lack, hold, where there are any."""
    if all(p.further is None for p in calibration.parameters):
        return None
    if not _lacks(Findings(calibration.findings)):
        return _allowed_for(calibration)
    single = len({score.log for score in calibration.train}) == 1
    logs = "pieces of the log" if single else "logs"
    text = f"The intervals with what the model lacks hold what differs between the {logs}"
    if not calibration.causes:
        return Verdict("fair", f"{text}, not what all of them miss alike.")
    return Verdict("fair", f"{text} and, to first order, what {listed(_named(calibration))} would move.")


def _allowed_for(calibration: Calibration) -> Verdict:
    """How much wider intervals are for what does not show."""
    pairs = [(p.further, (p.q05, p.q95)) for p in calibration.parameters if p.further is not None]
    wider = max((high - low) / (b - a) if b > a else 1.0 for (low, high), (a, b) in pairs)
    text = f"Nothing is seen to be missing; the first intervals, at most {100 * (wider - 1):.0f} % wider than the plain"
    most = f", most of all {listed(_named(calibration))}" if calibration.causes else ""
    return Verdict("good", f"{text} ones, allow for what would not show{most}.")


def _named(calibration: Calibration) -> list[str]:
    return [*calibration.causes[:_DOUBTS], *["others"] * (len(calibration.causes) > _DOUBTS)]
