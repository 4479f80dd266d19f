"""Units and signs by trying them: every combination of what the names leave open, by short simulations."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

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
from sipe_bayes.calibration.init.fits import fit
from sipe_bayes.calibration.init.machine import Machine
from sipe_bayes.calibration.init.trials import Assumption, Trial, followed
from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.units import find_unit

AGAINST = np.log(2.0)  # of the logarithm of misses, from which a simulation is believed against a name
_MOST = 300  # combinations that are all simulated; beyond, one question after the other
_CLEAR = np.log(1.5)  # of the logarithm of misses, from which a nominal simulation decides
_DECIDED = np.log(1.12)  # and one whose unknowns are fitted
_USELESS = 0.9  # of a straight line's miss, from which no simulation tells anything
_POOR = 0.7  # of a straight line's miss, beyond which the nominal model tells nothing
_BELIEVED = 0.3  # up to which it decides
_FAR = np.log(4.0)  # behind the best, up to which combinations are fitted
_SAME = np.log(1.02)
_HARDLY = 1.1  # times the miss: as well
_DOUBLED = 2.0  # times the miss, below which what the model lacks may decide for the wrong unit
_NAMED = 3  # units that are named where they miss more
_FITTED = 4  # units, and combinations of signs with each, that are fitted where the nominal model does not decide
_FIRST_DELAYS = (0, 1, 2, 4)


@dataclass(frozen=True)
class Layout:
    """Where a draft's readings are in a trial: channels of each measurement, number of each command."""

    channels: tuple[tuple[int, ...], ...]  # of each reading; empty where the trial has none
    commands: tuple[int | None, ...]
    minus: tuple[tuple[int, int], ...] = ()  # as assumptions have it

    def assumption(self, trial: Trial, draft: Draft, readings: Sequence[Reading]) -> Assumption:
        """What other units, signs and zeros mean for what was read as the draft says."""
        observed, driven = list(trial.given.observed), list(trial.given.driven)
        zeros, rests = [0.0] * len(observed), [0.0] * len(driven)
        for k, (now, then) in enumerate(zip(readings, draft.readings, strict=True)):
            factor, zero = scale_of(now) / scale_of(then), scale_of(now) * (now.zero - then.zero)
            for channel in self.channels[k]:
                observed[channel] *= factor
                zeros[channel] = zero
            command = self.commands[k]
            if command is not None:
                driven[command] *= factor
                rests[command] = zero
        return replace(
            trial.given,
            observed=tuple(observed),
            driven=tuple(driven),
            minus=self.minus,
            zeros=tuple(zeros) if any(zeros) else (),
            rests=tuple(rests) if any(rests) else (),
        )


@dataclass(frozen=True)
class Case:
    """A draft with its windows; theta (N,): the unknowns with which they are simulated."""

    draft: Draft
    machine: Machine
    trial: Trial
    layout: Layout
    theta: FloatArray

    def assumption(self, readings: Sequence[Reading]) -> Assumption:
        """What other readings mean for the windows."""
        return self.layout.assumption(self.trial, self.draft, readings)

    def misses(self, sets: Sequence[Sequence[Reading]]) -> FloatArray:
        """What simulations miss in each channel with each set of readings (H, C)."""
        return self.trial.misses([self.assumption(readings) for readings in sets], self.theta)


def scale_of(reading: Reading) -> float:
    """What a column is multiplied by to be SI in the model's direction."""
    return reading.sign * reading.factor * find_unit(reading.unit).factor


@dataclass(frozen=True)
class Ranking:
    """Answers that were tried (H tuples), the logarithm of what each misses in all channels together (H,).

    Args:
        answers: to all questions.
        scores: the smaller the better.
        decided: by how much a simulation has to be better than another one, so that it tells.
        named: the answers of the names, against which the model as given has to tell; None where it is fitted.
    """

    answers: list[tuple[Answer, ...]]
    scores: FloatArray
    decided: float
    named: tuple[Answer, ...] | None = None

    @property
    def best(self) -> int:
        """Which misses least, or of those that the model as given does not tell from it, the nearest to the names."""
        if self.named is None:
            return int(np.argmin(self.scores))
        near = np.flatnonzero(self.scores < self.scores.min() + self.decided)
        apart = [sum(a != b for a, b in zip(self.answers[i], self.named, strict=True)) for i in near]
        return int(min(zip(apart, self.scores[near], near, strict=True))[2])

    def gap(self, question: int, answer: Answer) -> float:
        """By how much the best combination with another answer to a question is worse."""
        other = [s for a, s in zip(self.answers, self.scores, strict=True) if a[question] == answer]
        return float(min(other) - self.scores[self.best]) if other else np.inf


def _unlikely(asked: Sequence[Question], answers: Sequence[Answer]) -> float:
    """What speaks against turned signs and units that are not the likeliest: they have to be better by it."""
    return sum(q.against for q, a in zip(asked, answers, strict=True) if a != q.answers[0])


def decide(draft: Draft, machine: Machine, trial: Trial, layout: Layout) -> Draft:
    """The draft with the units and signs with which simulations miss least, their evidence and what stays open."""
    asked = questions(draft, machine)
    if not asked:
        return draft
    case = Case(draft, machine, trial, layout, trial.theta)
    ranking = ranked(case, asked)
    thrust = any(actuator.thrust for actuator in machine.actuators)
    flies = bool(trial.simulator.environment.rotations) and not thrust  # contacts are not seen in short windows
    rivals = [] if flies else _rivals(ranking, len(trial.given.observed))
    if rivals:
        ranking, theta = _fitted(case, asked, ranking, rivals)
        case = replace(case, theta=theta)
    readings = list(answered(draft.readings, asked, ranking.answers[ranking.best]))
    base = case.misses([readings])[0]
    if base.min() > _USELESS:
        return _by_names(draft, asked)
    if any(reading.turning not in (0, reading.sign) for reading in readings):  # the gyro is mounted otherwise
        alone = [replace(reading, turning=0) for reading in draft.readings]
        return decide(_read_as(draft, alone, draft.doubts), machine, trial, layout)
    for q in range(len(asked)):
        readings = _with_evidence(case, asked, ranking, q, readings, base)
    readings = _against_names(case, readings, base)
    doubts = [*draft.doubts, *_mirrored(asked, ranking, readings)]
    return _read_as(draft, readings, doubts)


def _by_names(draft: Draft, asked: Sequence[Question]) -> Draft:
    """The draft as names have it, where simulations tell nothing."""
    text = "no simulation follows these logs better than a straight line does, so units and signs stand on names alone"
    doubt = f"{text}; look at the model and at what drives it"
    return _read_as(draft, answered(draft.readings, asked, _named(asked)), [*draft.doubts, doubt])


def _read_as(draft: Draft, readings: Sequence[Reading], doubts: Sequence[str]) -> Draft:
    measured = len(draft.measurements)
    return replace(
        draft, measurements=tuple(readings[:measured]), commands=tuple(readings[measured:]), doubts=tuple(doubts)
    )


def _named(asked: Sequence[Question]) -> tuple[Answer, ...]:
    return tuple(question.answers[0] for question in asked)


def _mirrored(asked: Sequence[Question], ranking: Ranking, readings: Sequence[Reading]) -> list[str]:
    """Signs that may be turned round together."""
    groups: list[frozenset[int]] = []
    for q, question in enumerate(asked):
        other = turned(ranking.answers[ranking.best][q])
        if not question.of_sign or ranking.gap(q, other) >= ranking.decided:
            continue
        rows = [i for i, a in enumerate(ranking.answers) if a[q] == other]
        nearest = ranking.answers[min(rows, key=lambda i: float(ranking.scores[i]))]
        pairs = zip(nearest, ranking.answers[ranking.best], strict=True)
        groups.append(frozenset(k for k, (a, b) in enumerate(pairs) if a != b and asked[k].of_sign))
    out = []
    for group in sorted(set(groups), key=sorted):
        names = " and ".join(repr(readings[asked[k].readings[0]].match.column) for k in sorted(group))
        if len(group) > 1:
            out.append(f"all moves alike with {names} turned round together: only how they go together is known")
    return out


def ranked(case: Case, asked: Sequence[Question]) -> Ranking:
    """All combinations, or where they are too many the best that changing one or two answers at a time leads to."""
    count = int(np.prod([len(q.answers) for q in asked]))
    if count <= _MOST:
        combinations = list(itertools.product(*(q.answers for q in asked)))
        return _tried(case, asked, combinations)
    seen: dict[tuple[Answer, ...], float] = {}
    now = _named(asked)
    for _ in range(4):
        around = [now, *_neighbours(now, asked)]
        fresh = [a for a in around if a not in seen]
        if not fresh:
            break
        tried = _tried(case, asked, fresh)
        seen |= dict(zip(tried.answers, tried.scores.tolist(), strict=True))
        now = min(seen, key=lambda a: seen[a])
    return Ranking(list(seen), np.array(list(seen.values())), _CLEAR, _named(asked))


def _neighbours(now: tuple[Answer, ...], asked: Sequence[Question]) -> list[tuple[Answer, ...]]:
    """Combinations in which one answer is another, or two signs are turned."""
    out = []
    for q, question in enumerate(asked):
        out += [(*now[:q], answer, *now[q + 1 :]) for answer in question.answers if answer != now[q]]
    signs = [q for q, question in enumerate(asked) if question.of_sign]
    for a, b in itertools.combinations(signs, 2):
        both = list(now)
        both[a], both[b] = turned(now[a]), turned(now[b])
        out.append(tuple(both))
    return out


def _tried(case: Case, asked: Sequence[Question], answers: list[tuple[Answer, ...]]) -> Ranking:
    sets = [answered(case.draft.readings, asked, a) for a in answers]
    misses = np.concatenate([case.misses(sets[i : i + 64]) for i in range(0, len(sets), 64)])
    scores = followed(misses) + np.array([_odd_sizes(case, readings) for readings in sets])
    scores += [_unlikely(asked, a) for a in answers]
    return Ranking(answers, scores, _CLEAR, _named(asked))


def _odd_sizes(case: Case, readings: Sequence[Reading]) -> float:
    """A little against sizes that are rare: turns by the dozen, and motions of less than a degree or a millimetre."""
    odd = 0.0
    for k, (now, then) in enumerate(zip(readings, case.draft.readings, strict=True)):
        for channel in case.layout.channels[k]:
            size = max(float(np.nanmax(np.abs(log.observations[:, channel]))) for log in case.trial.logs)
            size *= abs(scale_of(now) / scale_of(then))
            angular = find_unit(now.unit).dimension == "angle"
            odd += 0.1 * (size > (40.0 if angular else 20.0)) + 0.1 * (size < (0.02 if angular else 0.002))
    return odd


def _rivals(ranking: Ranking, channels: int) -> list[int]:
    """Combinations to be fitted: none where the model as given decides, else of each unit those that miss little more.

    A model that is far off follows a log no better with its signs right, and near to rest most machines are linear.
    """
    order = [int(i) for i in np.argsort(ranking.scores, kind="stable")]
    behind, best = ranking.scores - ranking.scores[order[0]], float(ranking.scores[order[0]])
    if best <= channels * np.log(_BELIEVED) and (behind[behind < _CLEAR] <= _SAME).all():
        return []
    units: dict[tuple[Scale, ...], list[int]] = {}
    for i in order:
        if behind[i] < _FAR or best > channels * np.log(_POOR):
            units.setdefault(tuple(a for a in ranking.answers[i] if isinstance(a, Scale)), []).append(i)
    return [i for same in list(units.values())[:_FITTED] for i in same[:_FITTED]]


def _fitted(case: Case, asked: Sequence[Question], ranking: Ranking, rivals: list[int]) -> tuple[Ranking, FloatArray]:
    """The ranking with the model's unknowns fitted to the rivals, and these of the best.

    The others stay as far behind the worst of the rivals as they were.
    """
    scores, thetas = [], []
    for i in rivals:
        readings = answered(case.draft.readings, asked, ranking.answers[i])
        assumption = case.assumption(readings)
        miss, theta = fitted_miss(case.trial, assumption, rounds=3)
        scores.append(miss + _odd_sizes(case, readings) + _unlikely(asked, ranking.answers[i]))
        thetas.append(theta)
    rest = [i for i in range(len(ranking.answers)) if i not in rivals]
    shifted = ranking.scores[rest] + max(scores) - float(ranking.scores[rivals].max())
    answers = [ranking.answers[i] for i in (*rivals, *rest)]
    return Ranking(answers, np.array([*scores, *shifted.tolist()]), _DECIDED), thetas[int(np.argmin(scores))]


def fitted_miss(trial: Trial, assumption: Assumption, rounds: int) -> tuple[float, FloatArray]:
    """The logarithm of what all channels together miss from measured starts, the unknowns fitted, and these (N,).

    Starts stay: where they may move as well, motions that are read as tiny fit anything.
    """
    left = fit(trial, assumption, _FIRST_DELAYS, rounds)
    misses = trial.misses([replace(assumption, delay=left.best)], left.theta)
    return float(followed(misses[0])), left.theta


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
    clearer = followed(misses) - followed(base)
    ratios = (misses / base)[:, base < 1].max(axis=1)
    out, rivals, rejected = list(readings), list[tuple[Scale, float]](), list[tuple[Scale, float]]()
    for other, alone, ratio in zip(others, clearer, ratios, strict=True):
        together, times = ranking.gap(q, other), f"{ratio:.2g}"
        note, doubt, instead = "", "", ""
        if isinstance(other, Scale):
            if together < ranking.decided or ratio < _DOUBLED:
                rivals.append((other, float(1.0 if together < ranking.decided else ratio)))
            else:
                rejected.append((other, float(ratio)))
        elif alone < ranking.decided and together < ranking.decided:
            doubt, instead = "its sign does not show in these logs", f"sign = {other}"
        elif together < ranking.decided:
            note = (
                f"sign {answer}: alone it can not be turned ({times} times the miss), but all moves alike where "
                "the others that belong to it are turned too"
            )
        else:
            shows = alone >= ranking.decided or not out[question.readings[0]].turning
            reasons = ["a gyro turns with it"] if out[question.readings[0]].turning else []
            reasons += [f"turned round, simulated windows miss {times} times as much"] if shows else []
            note = f"sign {answer}: {'; '.join(reasons)}"
        _put(out, question, note, doubt, instead)
    if rejected:
        _put(out, question, missing_more(answer, rejected), "", "")
    if rivals:
        _put(out, question, "", as_well(answer, rivals), "")
        for k in question.readings:
            out[k] = replace(out[k], instead=(*out[k].instead, *(y for x, _ in rivals for y in out[k].lines_of(x))))
    return out


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
            agrees = "; simulations agree" if gaps[best] > _DECIDED else ""
            out[k] = replace(reading, notes=(note + agrees, *reading.notes))
    return out
