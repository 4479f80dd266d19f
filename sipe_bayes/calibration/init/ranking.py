"""Units and signs ranked by what short simulations miss: of combinations of answers, or changes of one or two."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from sipe_bayes.calibration.init.draft import Answer, Draft, Question, Reading, Scale, answered, questions, turned
from sipe_bayes.calibration.init.fits import fit, fit_steps
from sipe_bayes.calibration.init.machine import Machine
from sipe_bayes.calibration.init.trials import Assumption, Trial, followed
from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.units import find_unit
from sipe_bayes.inference.recorded import Tell, silent

DECIDED = np.log(1.12)
"""Of the logarithm of misses, from which a simulation whose unknowns are fitted decides."""
_MOST = 300  # combinations that are all simulated; beyond, one question after the other
_ROUNDS = 8  # of changes, beyond
_AFFORDED = 3_000_000  # physics steps of all simulations of a ranking: about a minute with twenty joints
_CLEAR = np.log(1.5)  # of the logarithm of misses, from which a nominal simulation decides
_POOR = 0.7  # of a straight line's miss, beyond which the nominal model tells nothing
_BELIEVED = 0.3  # up to which it decides
_FAR = np.log(4.0)  # behind the best, up to which combinations are fitted
_SAME = np.log(1.02)
_FITTED = 4  # units, and combinations of signs with each, that are fitted where the nominal model does not decide
_FITS, _FIT = 100_000_000, 100_000  # steps times degrees of freedom of all of these: two minutes; steps of a round
_CLOSE = 12  # combinations of signs that are fitted of those between which it does not decide
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
    """A draft with its windows; theta (N,): the unknowns with which they are simulated; tell: how far it is."""

    draft: Draft
    machine: Machine
    trial: Trial
    layout: Layout
    theta: FloatArray
    tell: Tell = silent

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
        misses: (H, C) of each channel.
        decided: by how much a simulation has to be better than another one, so that it tells.
        named: the answers of the names, against which simulations have to tell.
        sensed: questions of signs that a gyro speaks for.
        left: changes that were too many to be tried.
        fitted: whether the unknowns were.
    """

    answers: list[tuple[Answer, ...]]
    scores: FloatArray
    misses: FloatArray
    decided: float
    named: tuple[Answer, ...]
    sensed: tuple[int, ...]
    left: int = 0
    fitted: bool = False

    @property
    def best(self) -> int:
        """Which misses least, or of those not told from it the nearest to the names; once fitted, of signs alone."""
        least = int(np.argmin(self.scores))
        near = [i for i in range(len(self.scores)) if not self.tells(least, i)]
        if self.fitted:
            near = [i for i in near if self._signs_alone(least, i)]
        return min(near, key=lambda i: (len(self.changed(i, self.named)), self.scores[i]))

    def gap(self, question: int, answer: Answer) -> float:
        """By how much the best combination with another answer to a question is worse."""
        other = [s for a, s in zip(self.answers, self.scores, strict=True) if a[question] == answer]
        return float(min(other) - self.scores[self.best]) if other else np.inf

    def changed(self, row: int, answers: tuple[Answer, ...]) -> list[int]:
        """The questions that a combination answers otherwise."""
        return [q for q, (a, b) in enumerate(zip(self.answers[row], answers, strict=True)) if a != b]

    def tells(self, best: int, other: int) -> bool:
        """Whether a combination is clearly worse: of signs in some channel too, not by a little in each of many.

        Unless a gyro speaks against one of them.
        """
        if self.scores[other] - self.scores[best] < self.decided:
            return False
        if set(self.sensed).intersection(self.changed(other, self.answers[best])):
            return True
        return not self._signs_alone(best, other) or self.times(best, other) >= np.exp(self.decided)

    def _signs_alone(self, best: int, other: int) -> bool:
        return all(isinstance(self.answers[other][q], int) for q in self.changed(other, self.answers[best]))

    def times(self, best: int, other: int) -> float:
        """What a combination misses in terms of the best, in the channel in which that is most."""
        here, there = (np.minimum(self.misses[i], 1.0) for i in (best, other))
        return float((there / here).max())

    def nearest(self, question: int, answer: Answer) -> int | None:
        """The combination with another answer to a question: one that is as good with few changes, else the best."""
        rows = [i for i, a in enumerate(self.answers) if a[question] == answer]
        best = self.best
        alike = [i for i in rows if not self.tells(best, i)]
        if alike:
            return min(alike, key=lambda i: (len(self.changed(i, self.answers[best])), self.scores[i]))
        return min(rows, key=lambda i: float(self.scores[i]), default=None)


def ranked(case: Case, asked: Sequence[Question]) -> Ranking:
    """All combinations, or where they are too many the best that changing a few answers at a time leads to.

    Changes of one answer, and of both signs of a joint, are tried first, and what they gain together; where none gains
    pairs of other signs that single changes do not speak clearly against.
    """
    if are_few(asked):
        return _tried(case, asked, list(itertools.product(*(q.answers for q in asked))))
    search = _Search(case, asked)
    now, joints = named_answers(asked), _pairs_of_joints(case, asked)
    for turn in range(_ROUNDS):
        search.turn = f"round {turn + 1}: "
        around = _neighbours(now, asked, joints)
        search.add([now, *around])
        search.add([_merged(now, around, search.scores)])
        best = search.best
        if best == now:
            unclear = {q for q, question in enumerate(asked) if question.of_sign and search.may(now, q)}
            rest = [pair for pair in itertools.combinations(sorted(unclear), 2) if pair not in joints]
            search.add(_turned(now, rest))
            best = search.best
        if best == now or search.left:
            break
        now = best
    return search.ranking()


def ranked_of(case: Case) -> Ranking | None:
    """What a draft's names leave open of units and signs, ranked; None where that is nothing."""
    asked = questions(case.draft, case.machine)
    return ranked(case, asked) if asked else None


def under(tell: Tell, heading: str) -> Tell:
    """One that says to what it belongs."""
    return lambda what: tell(f"{heading}: {what}")


def are_few(asked: Sequence[Question]) -> bool:
    """Whether all combinations are simulated."""
    return bool(np.prod([float(len(q.answers)) for q in asked]) <= _MOST)


class _Search:
    """Combinations that were tried, and how many were too many."""

    def __init__(self, case: Case, asked: Sequence[Question]) -> None:
        self.scores: dict[tuple[Answer, ...], float] = {}
        self.left = 0
        self.turn = ""
        self._case, self._asked = case, asked
        self._misses: list[FloatArray] = []
        self._most = max(1, _AFFORDED // case.trial.steps)

    @property
    def best(self) -> tuple[Answer, ...]:
        """The combination that misses least."""
        return min(self.scores, key=lambda a: self.scores[a])

    def add(self, answers: Sequence[tuple[Answer, ...]]) -> None:
        """Try those that were not yet, as many as can be afforded."""
        fresh = [a for a in dict.fromkeys(answers) if a not in self.scores]
        some = fresh[: self._most - len(self.scores)]
        self.left += len(fresh) - len(some)
        if some:
            tried = _tried(self._case, self._asked, some, self.turn)
            self.scores |= dict(zip(tried.answers, tried.scores.tolist(), strict=True))
            self._misses.append(tried.misses)

    def may(self, now: tuple[Answer, ...], question: int) -> bool:
        """Whether turning a sign alone is not clearly worse."""
        alone = _turned(now, [(question,)])[0]
        return alone != now and self.scores.get(alone, np.inf) - self.scores[now] < _FAR

    def ranking(self) -> Ranking:
        """All that was tried."""
        scores, named = np.array(list(self.scores.values())), named_answers(self._asked)
        return Ranking(
            list(self.scores), scores, np.concatenate(self._misses), _CLEAR, named, _sensed(self._asked), self.left
        )


def _sensed(asked: Sequence[Question]) -> tuple[int, ...]:
    return tuple(q for q, question in enumerate(asked) if question.sensed)


def named_answers(asked: Sequence[Question]) -> tuple[Answer, ...]:
    """The likeliest answer to each question."""
    return tuple(question.answers[0] for question in asked)


def _pairs_of_joints(case: Case, asked: Sequence[Question]) -> list[tuple[int, ...]]:
    """Questions of the signs of what measures a joint and of what drives it."""
    owners = {f"actuator:{a.name}": f"joint:{a.joint.name}" for a in case.machine.actuators if a.joint is not None}
    of: dict[str, list[int]] = {}
    for q, question in enumerate(asked):
        if question.of_sign:
            target = case.draft.readings[question.readings[0]].match.target
            of.setdefault(owners.get(target, target.rpartition(".")[0] or target), []).append(q)
    return [tuple(pair) for own in of.values() for pair in itertools.combinations(own, 2)]


def _turned(now: tuple[Answer, ...], groups: Sequence[Sequence[int]]) -> list[tuple[Answer, ...]]:
    """Combinations in which the signs of a group are turned."""
    return [tuple(turned(a) if q in group else a for q, a in enumerate(now)) for group in groups]


def _neighbours(
    now: tuple[Answer, ...], asked: Sequence[Question], pairs: Sequence[Sequence[int]]
) -> list[tuple[Answer, ...]]:
    """Combinations in which one answer is another, or two signs are turned."""
    out = []
    for q, question in enumerate(asked):
        out += [(*now[:q], answer, *now[q + 1 :]) for answer in question.answers if answer != now[q]]
    free = [pair for pair in pairs if all(len(asked[q].answers) > 1 for q in pair)]
    return out + _turned(now, free)


def _merged(
    now: tuple[Answer, ...], around: Sequence[tuple[Answer, ...]], scores: dict[tuple[Answer, ...], float]
) -> tuple[Answer, ...]:
    """All changes that gain, at once: the one that gains most first, and none of what another has changed."""
    out = list(now)
    for one in sorted((a for a in around if scores.get(a, np.inf) < scores[now]), key=lambda a: scores[a]):
        places = [q for q, (a, b) in enumerate(zip(one, now, strict=True)) if a != b]
        if all(out[q] == now[q] for q in places):
            for q in places:
                out[q] = one[q]
    return tuple(out)


def _tried(case: Case, asked: Sequence[Question], answers: list[tuple[Answer, ...]], turn: str = "") -> Ranking:
    sets = [answered(case.draft.readings, asked, a) for a in answers]
    parts = []
    for i in range(0, len(sets), 64):
        case.tell(f"{turn}{i} of {len(sets)} ways to read the columns")
        parts.append(case.misses(sets[i : i + 64]))
    misses = np.concatenate(parts)
    scores = followed(misses) + np.array([_odd_sizes(case, readings) for readings in sets])
    scores += [_unlikely(asked, a) for a in answers]
    return Ranking(answers, scores, misses, _CLEAR, named_answers(asked), _sensed(asked))


def _unlikely(asked: Sequence[Question], answers: Sequence[Answer]) -> float:
    """What speaks against turned signs and units that are not the likeliest: they have to be better by it."""
    return sum(q.against for q, a in zip(asked, answers, strict=True) if a != q.answers[0])


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


def rivals_of(ranking: Ranking) -> list[int]:
    """Combinations to be fitted: none where the model as given decides, else of each unit those that miss little more.

    A model that is far off follows a log no better with its signs right, and near to rest most machines are linear.
    Of the likeliest unit all from which the best is not told, those first that change least.
    """
    order = [int(i) for i in np.argsort(ranking.scores, kind="stable")]
    best, channels = order[0], ranking.misses.shape[1]
    behind, least = ranking.scores - ranking.scores[best], float(ranking.scores[best])
    close = [i for i in order if not ranking.tells(best, i)]
    if least <= channels * np.log(_BELIEVED) and (behind[close] <= _SAME).all():
        return []
    units: dict[tuple[Scale, ...], list[int]] = {}
    for i in order:
        if behind[i] < _FAR or least > channels * np.log(_POOR):
            units.setdefault(tuple(a for a in ranking.answers[i] if isinstance(a, Scale)), []).append(i)
    groups = list(units.values())
    close = sorted({*close} & {*groups[0]}, key=lambda i: len(ranking.changed(i, ranking.answers[best])))
    some = [i for same in groups[:_FITTED] for i in same[:_FITTED]]
    return list(dict.fromkeys([best, *close[:_CLOSE], *some]))


def fitted(
    case: Case, asked: Sequence[Question], ranking: Ranking, rivals: Sequence[int]
) -> tuple[Ranking, FloatArray]:
    """The ranking with the model's unknowns fitted to the rivals, and these of the best.

    The others stay as far behind the worst of the rivals as they were, and rivals for which there is no time behind the
    best: what the model as given does not tell of them stays open.
    """
    trial = case.trial
    most = max(2, int(_FITS / (6 * fit_steps(trial, len(_FIRST_DELAYS), _FIT) * trial.simulator.model.nv)))
    rivals, late = rivals[:most], rivals[most:]
    scores, thetas, misses = [], [], []
    for k, i in enumerate(rivals):
        case.tell(f"{k} of {len(rivals)} of them with unknowns fitted")
        readings = answered(case.draft.readings, asked, ranking.answers[i])
        missed, theta = _fitted_misses(case.trial, case.assumption(readings), rounds=3)
        scores.append(float(followed(missed)) + _odd_sizes(case, readings) + _unlikely(asked, ranking.answers[i]))
        thetas.append(theta)
        misses.append(missed)
    worst, rest = int(np.argmax(scores)), [i for i in range(len(ranking.answers)) if i not in rivals]
    shifted = ranking.scores[rest] + max(scores) - float(ranking.scores[list(rivals)].max())
    as_far = ranking.misses[rest] * misses[worst] / ranking.misses[rivals[worst]]
    first, behind = int(np.argmin(scores)), [k for k, i in enumerate(rest) if i in late]
    shifted[behind] = ranking.scores[[rest[k] for k in behind]] + min(scores) - float(ranking.scores[rivals[first]])
    as_far[behind] = ranking.misses[[rest[k] for k in behind]] * misses[first] / ranking.misses[rivals[first]]
    answers = [ranking.answers[i] for i in (*rivals, *rest)]
    all_scores, all_misses = np.array([*scores, *shifted.tolist()]), np.array([*misses, *as_far])
    after = replace(ranking, answers=answers, scores=all_scores, misses=all_misses, decided=DECIDED, fitted=True)
    return after, thetas[first]


def fitted_miss(trial: Trial, assumption: Assumption, rounds: int) -> tuple[float, FloatArray]:
    """The logarithm of what all channels together miss from measured starts, the unknowns fitted, and these (N,).

    Starts stay: where they may move as well, motions that are read as tiny fit anything.
    """
    misses, theta = _fitted_misses(trial, assumption, rounds)
    return float(followed(misses)), theta


def _fitted_misses(trial: Trial, assumption: Assumption, rounds: int) -> tuple[FloatArray, FloatArray]:
    left = fit(trial, assumption, _FIRST_DELAYS, rounds, afforded=_FIT)
    return trial.misses([replace(assumption, delay=left.best)], left.theta)[0], left.theta
