"""Units and signs by trying them: every combination of what the names leave open, by short simulations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sipe_bayes.calibration.init.draft import (
    Answer,
    Draft,
    Question,
    Reading,
    Scale,
    answered,
    is_tried,
    questions,
    turned,
    unit_words,
)
from sipe_bayes.calibration.init.machine import Machine
from sipe_bayes.calibration.init.ranking import DECIDED, Case, Layout, Ranking, fitted, named_answers, ranked, rivals_of
from sipe_bayes.calibration.init.trials import Trial, followed
from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.inference.recorded import Tell, silent

AGAINST = np.log(2.0)  # of the logarithm of misses, from which a simulation is believed against a name
_USELESS = 0.9  # of a straight line's miss, from which no simulation tells anything
_HARDLY = 1.1  # times the miss: as well
_DOUBLED = 2.0  # times the miss, below which what the model lacks may decide for the wrong unit
_NAMED = 3  # units that are named where they miss more


def decide(
    draft: Draft,
    machine: Machine,
    trial: Trial,
    layout: Layout,
    ranking: Ranking | None = None,
    tell: Tell = silent,
) -> Draft:
    """The draft with the units and signs with which simulations miss least, their evidence and what stays open.

    Args:
        draft: of the trial.
        machine: what of it logs hold.
        trial: windows of the logs.
        layout: where the draft's readings are in it.
        ranking: of the same, where it is known.
        tell: called with how far it is.
    """
    asked = questions(draft, machine)
    if not asked:
        return draft
    case = Case(draft, machine, trial, layout, trial.theta, tell)
    ranking = ranking or ranked(case, asked)
    flies = bool(trial.simulator.environment.rotations) and not machine.flies  # contacts are not seen in short windows
    rivals = [] if flies else rivals_of(ranking)
    if rivals:
        ranking, theta = fitted(case, asked, ranking, rivals)
        case = replace(case, theta=theta)
    readings = list(answered(draft.readings, asked, ranking.answers[ranking.best]))
    base = case.misses([readings])[0]
    if base.min() > _USELESS:
        return _by_names(draft, asked)
    if any(reading.turning not in (0, reading.sign) for reading in readings):  # the gyro is mounted otherwise
        alone = [replace(reading, turning=0) for reading in draft.readings]
        return decide(_read_as(draft, alone, draft.doubts), machine, trial, layout, None, tell)
    for q in range(len(asked)):
        readings = _with_evidence(case, asked, ranking, q, readings, base)
    readings = _against_names(case, readings, base)
    doubts = [*draft.doubts, *_mirrored(asked, ranking, readings)]
    if ranking.left:
        doubts.append(
            f"too many columns to try all of their units and signs: {ranking.left} changes were not simulated, and "
            "what they would change stands as the names have it"
        )
    return _read_as(draft, readings, doubts)


def _by_names(draft: Draft, asked: Sequence[Question]) -> Draft:
    """The draft as names have it, where simulations tell nothing."""
    text = "no simulation follows these logs better than a straight line does, so units and signs stand on names alone"
    doubts = [*draft.doubts, f"{text}; look at the model and at what drives it"]
    readings = answered(draft.readings, asked, named_answers(asked))
    counting = [reading for reading in readings if reading.scales and reading.factor != 1]
    for factor in dict.fromkeys(reading.factor for reading in counting):
        names = ", ".join(repr(reading.match.column) for reading in counting if reading.factor == factor)
        doubts.append(f"{names}: {1 / factor:g} counts a turn is a guess; write what the encoder has")
    return _read_as(draft, readings, doubts)


def _read_as(draft: Draft, readings: Sequence[Reading], doubts: Sequence[str]) -> Draft:
    measured = len(draft.measurements)
    return replace(
        draft, measurements=tuple(readings[:measured]), commands=tuple(readings[measured:]), doubts=tuple(doubts)
    )


def _mirrored(asked: Sequence[Question], ranking: Ranking, readings: Sequence[Reading]) -> list[str]:
    """Signs that may be turned round together."""
    groups: dict[frozenset[int], float] = {}
    best = ranking.best
    for q, question in enumerate(asked):
        row = ranking.nearest(q, turned(ranking.answers[best][q])) if question.of_sign else None
        if row is None or ranking.tells(best, row):
            continue
        group = frozenset(k for k in ranking.changed(row, ranking.answers[best]) if asked[k].of_sign)
        groups[group] = ranking.times(best, row)
    out = []
    for group in sorted(groups, key=sorted):
        names = " and ".join(repr(readings[asked[k].readings[0]].match.column) for k in sorted(group))
        if len(group) > 1:
            miss = f"({max(1.0, groups[group]):.3g} times the miss)"
            out.append(f"all moves alike with {names} turned round together {miss}: only how they go together is known")
    return out


def _with_evidence(
    case: Case,
    asked: Sequence[Question],
    ranking: Ranking,
    q: int,
    readings: list[Reading],
    base: FloatArray,
) -> list[Reading]:
    """What speaks for the answer to a question, or that nothing does."""
    question, answer = asked[q], ranking.answers[ranking.best][q]
    others = [a for a in question.answers if a != answer]
    sets = [answered(readings, [question], [other]) for other in others]
    misses = case.misses(sets)
    clearer = (np.minimum(misses, 1.0) / np.minimum(base, 1.0)).max(axis=1)
    clearer = np.minimum(np.log(clearer), followed(misses) - followed(base))
    ratios = (misses / base)[:, base < 1].max(axis=1)
    out, rivals, rejected = list(readings), list[tuple[Scale, float]](), list[tuple[Scale, float]]()
    for other, alone, ratio in zip(others, clearer, ratios, strict=True):
        together, times = ranking.gap(q, other), f"{ratio:.2g}"
        row = ranking.nearest(q, other)
        open_ = row is not None and not ranking.tells(ranking.best, row)
        note, doubt, instead = "", "", ""
        if isinstance(other, Scale):
            if together < ranking.decided or ratio < _DOUBLED:
                rivals.append((other, float(1.0 if together < ranking.decided else ratio)))
            else:
                rejected.append((other, float(ratio)))
        elif alone < ranking.decided and open_:
            doubt, instead = "its sign does not show in these logs", f"sign = {other}"
        elif open_:
            note = (
                f"sign {answer}: alone it can not be turned ({times} times the miss), but all moves alike where "
                "the others that belong to it are turned too"
            )
        else:
            shows = alone >= ranking.decided or not out[question.readings[0]].turning
            reasons = ["a gyro turns with it"] if out[question.readings[0]].turning else []
            reasons += [_turned_round(asked, ranking, q, row, readings, times)] if shows else []
            note = f"sign {answer}: {'; '.join(reasons)}"
        _put(out, question, note, doubt, instead)
    if rejected:
        _put(out, question, missing_more(answer, rejected), "", "")
    if rivals:
        _put(out, question, "", as_well(answer, rivals), "")
        for k in question.readings:
            out[k] = replace(out[k], instead=(*out[k].instead, *(y for x, _ in rivals for y in out[k].lines_of(x))))
    return out


def _turned_round(
    asked: Sequence[Question], ranking: Ranking, q: int, row: int | None, readings: Sequence[Reading], alone: str
) -> str:
    """What a sign that is turned misses: by itself, and with those that go with it where that was tried."""
    text = f"turned round, simulated windows miss {alone} times as much"
    group = [] if row is None else [k for k in ranking.changed(row, ranking.answers[ranking.best]) if asked[k].of_sign]
    if row is None or len(group) < 2:
        return text
    names = " and ".join(repr(readings[asked[k].readings[0]].match.column) for k in group if k != q)
    return f"{text}; together with {names} {ranking.times(ranking.best, row):.2g} times"


def missing_more(answer: Answer, others: Sequence[tuple[Scale, float]]) -> str:
    """That others are wrong, each with its misses over those of the answer, in one line."""
    times = sorted({f"{ratio:.2g}" for _, ratio in others}, key=float)
    more = f"{' to '.join(dict.fromkeys((times[0], times[-1])))} times as much"
    if len(others) <= _NAMED:
        return f"{answer}: read as {' or '.join(str(other) for other, _ in others)}, simulated windows miss {more}"
    return f"{answer}: with {len(others)} other usual counts a {others[0][0].unit}, simulated windows miss {more}"


def as_well(answer: Answer, rivals: Sequence[tuple[Scale, float]]) -> str:
    """That others may be right, each with its misses over those of the answer."""
    counts = isinstance(answer, Scale) and answer.factor != 1 and all(other.unit == answer.unit for other, _ in rivals)
    names = [f"{1 / other.factor:g}" if counts else str(other) for other, _ in sorted(rivals, key=lambda one: one[1])]
    most = max(ratio for _, ratio in rivals)
    if most < _HARDLY:
        how = f"follow the log as well with {'either' if len(rivals) == 1 else 'any'}"
    else:
        how = f"miss {'only' if len(rivals) == 1 else 'at most'} {most:.2g} times as much with another"
    return f"{answer} or {', '.join(names)}? simulations {how}"


def _put(out: list[Reading], question: Question, note: str, doubt: str, instead: str) -> None:
    """Into the question's readings, where there is any."""
    for k in question.readings:
        out[k] = replace(
            out[k],
            notes=(*out[k].notes, *([note] if note else [])),
            doubts=(*out[k].doubts, *([doubt] if doubt else [])),
            instead=(*out[k].instead, *instead.splitlines()),
        )


def _against_names(case: Case, readings: list[Reading], base: FloatArray) -> list[Reading]:
    """Units that stand in names, held against simulations with others."""
    out = list(readings)
    for k, reading in enumerate(readings):
        label = reading.match.label
        if not label.unit or reading.match.quaternion or not is_tried(case.draft, reading):
            continue
        others = [u for u in unit_words(reading, case.machine) if u != reading.unit]
        sets = [[replace(r, unit=u) if i == k else r for i, r in enumerate(readings)] for u in others]
        if not sets:
            continue
        gaps = followed(case.misses(sets)) - followed(base)
        best = int(np.argmin(gaps))
        note = f"{reading.unit}, as its name says"
        if gaps[best] < -AGAINST:
            text = f"its name says {reading.unit}, but simulations follow it far better in {others[best]}"
            out[k] = replace(
                reading, doubts=(*reading.doubts, text), instead=(*reading.instead, f'unit = "{others[best]}"')
            )
        else:
            agrees = "; simulations agree" if gaps[best] > DECIDED else ""
            out[k] = replace(reading, notes=(note + agrees, *reading.notes))
    return out
