"""Units, signs and zeros that names leave open: those with which the model explains most of the joints' forces.

Readings of positions are tried; a set-point goes with the position that follows it, and the sign and unit of a force
are those of its coefficient. What the logs do not tell stays as the names have it, and is asked.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import mujoco
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
from sipe_bayes.calibration.init.regression import Assumption, Outcome, Regression
from sipe_bayes.calibration.machine import Drive, Joint, Machine
from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.telling import Tell, silent
from sipe_bayes.core.units import find_unit

DECIDED = 3.0
"""Nats, by which a reading has to be better, so that the logs decide."""
_UNLIKELY = 0.7  # against another answer than that of the names
_ALL, _PAIRS, _ROUNDS = 64, 40, 12  # combinations that are all tried; pairs of signs, and rounds, beyond
GYRO_WORDS = ("rad/s", "deg/s")
_ALIKE = np.log(1.12)  # sizes of units that no model is right enough to tell apart
_TURNS = 0.4  # of a gyro's rates, up to which it turns with what is measured
_FOLLOWS = 0.5  # share of a set-point's variance, from which a position follows it
_SHORTEST = 20  # samples of a log, beside a delay
_PARTS, _ALIKE_PARTS = 10, 0.6  # of a log, and how many of these are to go alike
_AGAINST = 0.3  # of a set-point's variance, by which it has to be told that a position goes the other way
_LATEST = 0.3  # s, of a position behind its set-point
_USELESS = 0.9  # of the forces, what is left where the model explains nothing
_LITTLE, _HARDLY = 0.02, 0.7  # of a joint's range, and what a motion that small counts as
_OUTSIDE, _BEYOND = 6.0, 0.1  # nats against samples beyond a joint's range, by a share of which it may be off
_NEAR, _FAR = np.log(3.0), np.log(5.0)  # of the logarithm of a ratio: the same; another unit, or a model far off
_ZEROS, _FINER = 11, 9  # zeros that are tried over the range of a joint, and around the best
_ZERO_GAIN, _LEAST_ZERO = 6.0, 0.05  # nats and rad or m, from which a zero is believed
_TIMES = 1.5  # of what is left, from which a frame is another one
_WELL = 0.1  # of the forces, up to which no other frame is tried
_EXPLAINED = 0.5  # of the forces, what may be left with a zero that the logs alone tell
_SPRUNG = 6.0  # nats for each joint, from which springs are believed
_BELIEVED, _LOOKED = 0.3, 8  # of the forces, up to which no zero is looked for; joints of which the grids are tried
_LEAST_MOTION = 0.2  # rad, of a hinge whose zero the logs may tell
_UNSURE = 2.0  # steps of the finest grid
_SAID = 3  # units that are named

Readings = Sequence[Reading]
Answers = tuple[Answer, ...]


def scale_of(reading: Reading) -> float:
    """What a column is multiplied by to be SI in the model's direction."""
    return reading.sign * reading.factor * find_unit(reading.unit).factor


@dataclass(frozen=True)
class Case:
    """A draft, the regression of its logs, and where its readings are in it.

    Args:
        draft: of positions and commands.
        machine: what of it logs hold.
        regression: of logs as the draft reads them.
        channels: of each reading; empty where the regression has none.
        commands: number of each reading's actuator; None of measurements.
        minus: pairs of channels, the second of which is taken off the first.
        tell: how far it is.
        ties: what ``tied_of`` found.
        count: independent numbers of each degree of freedom, the last one; by the motion where there is none.
    """

    draft: Draft
    machine: Machine
    regression: Regression
    channels: tuple[tuple[int, ...], ...]
    commands: tuple[int | None, ...]
    minus: tuple[tuple[int, int], ...] = ()
    tell: Tell = silent
    count: list[float] = field(default_factory=list)
    ties: list[dict[int, tuple[int, float]]] = field(default_factory=list)
    _known: dict[Assumption, Outcome] = field(default_factory=dict)

    def outcome(self, readings: Readings) -> Outcome:
        """What the regression says of other units, signs and zeros than the draft's."""
        given = self.regression.given
        observed, driven, zeros = list(given.observed), list(given.driven), [0.0] * len(given.observed)
        rests = [0.0] * len(driven)
        for k, (now, then) in enumerate(zip(readings, self.draft.readings, strict=True)):
            factor = scale_of(now) / scale_of(then)
            for channel in self.channels[k]:
                observed[channel] *= factor
                zeros[channel] = scale_of(now) * (now.zero - then.zero)
            if (command := self.commands[k]) is not None:
                driven[command] *= factor
                rests[command] = scale_of(now) * (now.zero - then.zero)
        shifts = (tuple(own) if any(own) else () for own in (zeros, rests))
        assumption = Assumption(tuple(observed), tuple(driven), next(shifts), self.minus, next(shifts))
        if assumption not in self._known:
            self._known[assumption] = self.regression.fit(assumption, every=False)
        return self._known[assumption]

    def nats(self, outcome: Outcome) -> float:
        """What speaks against readings: the smaller the better."""
        return (self.count or [self.regression.count])[-1] * outcome.unexplained + outcome.far_off

    def drive(self, k: int) -> Drive | None:
        """What the actuator of a reading is given; None of measurements."""
        command = self.commands[k]
        return None if command is None else self.regression.drives[command]


def tied_of(case: Case) -> dict[int, tuple[int, float]]:
    """Set-points with the place of the position that follows each, and how many times the position it is, in SI."""
    if not case.ties:
        case.ties.append(_ties(case))
    return case.ties[0]


def _ties(case: Case) -> dict[int, tuple[int, float]]:
    draft, out = case.draft, dict[int, tuple[int, float]]()
    joints = {f"actuator:{a.name}": f"joint:{a.joint.name}." for a in case.machine.actuators if a.joint is not None}
    kinds = {Drive.POSITION: "position", Drive.VELOCITY: "velocity"}
    places = {r.match.target: k for k, r in enumerate(draft.readings)}
    for k, reading in enumerate(draft.readings):
        command, drive = case.commands[k], case.drive(k)
        place = places.get(joints.get(reading.match.target, "") + kinds.get(drive, "")) if drive in kinds else None
        if command is None or place is None or not case.channels[place]:
            continue
        times, share = _ratio(case.regression, command, case.channels[place][0])
        if share > _FOLLOWS:
            out[k] = place, times
    return out


def _ratio(regression: Regression, command: int, channel: int) -> tuple[float, float]:
    """How many times a position its set-point is, and the share of its variance that this explains.

    Whichever position comes up to a quarter of the time later in which the motion goes to and fro.
    """
    along, against = (0.0, 0.0), (0.0, 0.0)
    most = int(min(_LATEST / regression.logs[0].dt, regression.period / 4))
    for late in range(most + 1):
        logs = [log for log in regression.logs if len(log) > late + _SHORTEST]
        if not logs:
            continue
        pairs = [(log.actions[: len(log) - late, command], log.observations[late:-1, channel]) for log in logs]
        one, other = _alike_most(pairs)
        size = float((one @ one) * (other @ other))
        if size <= 0:
            continue
        share, times = float(one @ other) ** 2 / size, float(np.sqrt((one @ one) / (other @ other)))
        if one @ other > 0:  # of the spreads, which noise of either does not shrink
            along = max(along, (share, times))
        else:
            against = max(against, (share, -times))
    share, times = against if against[0] > along[0] + _AGAINST else along
    return times, share


def _alike_most(pairs: Sequence[tuple[FloatArray, FloatArray]]) -> tuple[FloatArray, FloatArray]:
    """The parts of two series, each less its mean, that go most alike: a drive may be off for a while."""
    parts = [
        (a - a.mean(), b - b.mean())
        for own in pairs
        for a, b in zip(*(np.array_split(x, 10) for x in own), strict=True)
    ]
    alike = [abs(float(a @ b)) / np.sqrt(max(float((a @ a) * (b @ b)), 1e-30)) for a, b in parts]
    most = np.argsort(alike)[-max(1, int(_ALIKE_PARTS * len(parts))) :]
    one, other = zip(*(parts[k] for k in most), strict=True)
    return np.concatenate(one), np.concatenate(other)


@dataclass
class Search:
    """Answers that were tried, with the nats and the shares that are left of each."""

    case: Case
    asked: list[Question]
    tied: dict[int, tuple[int, float]]
    tried: dict[Answers, tuple[float, Outcome]] = field(default_factory=dict)  # nats that are no forces', and the rest

    @property
    def named(self) -> Answers:
        """What the names say."""
        return tuple(question.answers[0] for question in self.asked)

    @property
    def best(self) -> Answers:
        """Least nats; servos flipped against their names only where the model then explains them."""
        return min(filter(self._is_believed, self.tried), key=self.nats)

    def _is_believed(self, answers: Answers) -> bool:
        places, miss = {place for place, _ in self.tied.values()}, self.tried[answers][1].miss
        turned_round = (
            q.readings[0] for q, a in zip(self.asked, answers, strict=True) if q.of_sign and a != q.answers[0]
        )
        return all(k not in places or miss[self.dofs[k]] < _EXPLAINED for k in turned_round)

    @cached_property
    def dofs(self) -> dict[int, int]:
        """Degrees of freedom of the positions of joints."""
        model, readings = self.case.regression.simulator.model, self.case.draft.readings
        names = {k: r.match.target[6:].rpartition(".")[0] for k, r in enumerate(readings) if not r.commanded}
        hinges = {joint.name for joint in self.case.machine.joints}
        return {k: int(model.joint(name).dofadr[0]) for k, name in names.items() if name in hinges}

    def nats(self, answers: Answers) -> float:
        """What speaks against answers."""
        against, outcome = self.tried[answers]
        return against + self.case.nats(outcome)

    def readings(self, answers: Answers) -> list[Reading]:
        """With the answers, set-points as the positions that follow them."""
        return _with_tied(self.case, answered(self.case.draft.readings, self.asked, answers), self.tied)

    def add(self, some: Sequence[Answers]) -> None:
        """Try those that were not."""
        for answers in dict.fromkeys(some):
            if answers not in self.tried:
                readings = self.readings(answers)
                outcome = self.case.outcome(readings)
                self.tried[answers] = self._unlikely(answers) + _odd_sizes(self.case, readings), outcome

    def run(self) -> None:
        """All combinations, or where they are many those that changes of one answer or of two signs lead to."""
        self.add([self.named])
        self._run()
        outcome = self.tried[self.best][1]
        self.case.count.append(self.case.regression.independent(outcome))

    def _run(self) -> None:
        if np.prod([float(len(question.answers)) for question in self.asked]) <= _ALL:
            self.add(list(itertools.product(*(question.answers for question in self.asked))))
            return
        for turn in range(_ROUNDS):
            self.case.tell(f"round {turn + 1}")
            now = self.best
            self.add(_singles(now, self.asked))
            if self.best == now:
                self.add(self._turned_together(now))
            if self.best == now:
                break

    def gap(self, question: int, answer: Answer) -> tuple[float, Answers | None]:
        """By how many nats the best combination with another answer is worse, and which that is."""
        rows = [answers for answers in self.tried if answers[question] == answer]
        if not rows:
            return np.inf, None
        best = self.best
        told = {a: self.case.nats(self.tried[a][1]) for a in (*rows, best)}  # by the logs alone
        near = [a for a in rows if told[a] - told[best] < DECIDED]
        row = min(near or rows, key=lambda a: (len(_changed(a, best)) * bool(near), told[a]))
        return float(min(told[a] for a in rows) - told[best]), row

    def together(self, other: Answers) -> list[int]:
        """Places of the readings whose signs are turned in other answers, commands by their coefficients."""
        here, there = self.tried[self.best][1], self.tried[other][1]
        signs = [q for q in _changed(other, self.best) if self.asked[q].of_sign]
        sure = (np.abs(here.gains) > DECIDED * here.errors) & (here.gains * there.gains < 0)
        driven = [k for k, c in enumerate(self.case.commands) if c is not None and sure[c]]
        follow = [k for k, (place, _) in self.tied.items() if any(place in self.asked[q].readings for q in signs)]
        return [*(k for q in signs for k in self.asked[q].readings), *driven, *follow]

    def times(self, other: Answers) -> float:
        """What is left with other answers, in terms of the best, where that is most."""
        here, there = (self.tried[a][1].miss for a in (self.best, other))
        return float((there / here).max())

    def _unlikely(self, answers: Answers) -> float:
        return sum(_UNLIKELY for q, a in zip(self.asked, answers, strict=True) if a != q.answers[0])

    def _turned_together(self, now: Answers) -> list[Answers]:
        signs = [q for q, question in enumerate(self.asked) if question.of_sign]
        groups = [*itertools.islice(itertools.combinations(signs, 2), _PAIRS), signs]
        return [tuple(turned(a) if q in group else a for q, a in enumerate(now)) for group in groups]


def _singles(now: Answers, asked: Sequence[Question]) -> list[Answers]:
    return [(*now[:q], a, *now[q + 1 :]) for q, question in enumerate(asked) for a in question.answers if a != now[q]]


def _changed(answers: Answers, best: Answers) -> list[int]:
    return [q for q, (a, b) in enumerate(zip(answers, best, strict=True)) if a != b]


def _with_tied(case: Case, readings: Readings, tied: dict[int, tuple[int, float]]) -> list[Reading]:
    """Set-points in the unit and the direction of the position that follows them."""
    out = list(readings)
    for k, (place, times) in tied.items():
        own, then = readings[place], case.draft.readings
        raw = abs(times) * abs(scale_of(then[place]) / scale_of(then[k]))  # of what the columns say
        if own.scale in (*own.shares, *own.scales) and abs(np.log(raw)) < _NEAR and not out[k].match.label.unit:
            out[k] = replace(out[k], scales=own.scales, shares=own.shares, reach=own.reach).read_as(own.scale)
        elif not out[k].match.label.unit and (words := unit_words(out[k], case.machine)):
            size = abs(scale_of(own))
            fits = {word: abs(np.log(size / (raw * find_unit(word).factor))) for word in words}
            out[k] = out[k].read_as(Scale(min(fits, key=lambda w: fits[w])))
        sign = int(np.sign(times)) * then[k].sign * then[place].sign * own.sign
        out[k] = replace(out[k].turned_to(sign), zero=out[k].zero)
        if own.ends is None and own.zero:
            out[k] = replace(out[k], zero=float(f"{own.zero * scale_of(own) / scale_of(out[k]):.6g}"))
    return out


def _odd_sizes(case: Case, readings: Readings) -> float:
    """Nats against turns by the dozen, motions of less than a degree or a millimetre, and beyond a joint's range."""
    odd = 0.0
    for now, then, channels in zip(readings, case.draft.readings, case.channels, strict=True):
        for channel in channels:
            size = max(float(np.nanmax(np.abs(log.observations[:, channel]))) for log in case.regression.logs)
            factor = scale_of(now) / scale_of(then)
            size *= abs(factor)
            angular = find_unit(now.unit).dimension == "angle"
            odd += (size > (40.0 if angular else 20.0)) + (size < (0.02 if angular else 0.002))
            odd += (
                angular and abs(float(np.nanmedian(case.regression.logs[0].observations[:, channel])) * factor) > np.pi
            )
            odd += _OUTSIDE * _outside(case, now, factor, scale_of(now) * (now.zero - then.zero), channel)
    return float(odd)


def _outside(case: Case, reading: Reading, factor: float, zero: float, channel: int) -> float:
    """The share of samples beyond the range of a reading's joint, and something where it hardly moves in it."""
    reach = next((j.reach for j in case.machine.joints if reading.match.target == f"joint:{j.name}.position"), None)
    if reach is None:
        return 0.0
    values = np.concatenate([log.observations[:, channel] for log in case.regression.logs]) * factor - zero
    room = _BEYOND * (reach[1] - reach[0])
    hardly = _HARDLY * (np.nanmax(values) - np.nanmin(values) < _LITTLE * (reach[1] - reach[0]))
    return float(np.mean((values < reach[0] - room) | (values > reach[1] + room))) + float(hardly)


def searched(case: Case) -> Search:
    """What names leave open, tried; with springs at all joints where little is explained without them."""
    tied = tied_of(case)
    asked = [_without(question, case, tied) for question in questions(case.draft, case.machine)]
    search = Search(case, [question for question in asked if question.readings], tied)
    search.run()
    left = search.tried[search.best][1].miss[case.regression.known]
    if len(left) and left.max() > _EXPLAINED:
        case.regression.springs = True
        sprung = Search(replace(case, count=[*case.count], _known={}), search.asked, tied)
        sprung.run()
        sprung.case.count[:] = case.count
        believed = sprung.tried[sprung.best][1].miss[case.regression.known].max() < _EXPLAINED
        if believed and search.nats(search.best) - sprung.nats(sprung.best) > _SPRUNG * len(left):
            return sprung
        case.regression.springs = False
    return search


def decide(search: Search) -> Draft:
    """The draft with the units and signs that explain most, their evidence, and what stays open."""
    case, tied, draft = search.case, search.tied, search.case.draft
    outcome = search.tried[search.best][1]
    usable = case.regression.known
    if not usable.any() or outcome.miss[usable].min() > _USELESS:
        return _by_names(case, tied, list(questions(draft, case.machine)))
    readings = search.readings(search.best)
    search.add(_singles(search.best, search.asked))
    search.add(search._turned_together(search.best))
    for q in range(len(search.asked)):
        _with_evidence(search, q, readings)
    _with_ties(case, tied, readings)
    readings = _untied(case, _driven(case, readings, outcome), tied)
    groups = _mirrored(search)
    done = replace(draft.with_readings(readings), doubts=(*draft.doubts, *_said(groups, readings)))
    columns = [tuple(readings[k].match.column for k in group) for group in groups]
    pairs = tuple((readings[place].match.column, readings[k].match.column) for k, (place, _) in tied.items())
    return replace(done, together=tuple(columns), tied=pairs)


def _without(question: Question, case: Case, tied: dict[int, tuple[int, float]]) -> Question:
    """A question without the readings that go with others."""
    free = (None, Drive.POSITION, Drive.VELOCITY)
    return replace(question, readings=tuple(k for k in question.readings if k not in tied and case.drive(k) in free))


def _by_names(case: Case, tied: dict[int, tuple[int, float]], asked: list[Question]) -> Draft:
    """The draft as names have it, where the model tells nothing, set-points with what follows them."""
    draft = case.draft
    text = "the model explains nothing of these logs, so units and signs stand on names alone"
    doubts = [*draft.doubts, f"{text}; look at the model and at what drives it"]
    answers = [question.answers[0] for question in asked]
    readings = _with_tied(case, answered(draft.readings, asked, answers), tied)
    return replace(draft.with_readings(readings), doubts=(*doubts, *guessed(readings)))


def guessed(readings: Readings) -> list[str]:
    """What is said of encoders' counts that nothing tells."""
    counting = [reading for reading in readings if reading.scales and reading.factor != 1]
    out = []
    for factor in dict.fromkeys(reading.factor for reading in counting):
        names = ", ".join(repr(reading.match.column) for reading in counting if reading.factor == factor)
        out.append(f"{names}: {1 / factor:g} counts a turn is a guess; write what the encoder has")
    return out


def _untied(case: Case, readings: Readings, tied: dict[int, tuple[int, float]]) -> list[Reading]:
    """What is said of set-points that no position follows."""
    measured = {reading.match.target for reading in readings}
    out = list(readings)
    for k, reading in enumerate(readings):
        actuator = next((a for a in case.machine.actuators if reading.match.target == f"actuator:{a.name}"), None)
        joint = None if actuator is None or case.drive(k) != Drive.POSITION or k in tied else actuator.joint
        if joint is not None and f"joint:{joint.name}.position" in measured:
            text = f"the position of {joint.name} does not follow it; if it is a torque, make the actuator a <motor>"
            out[k] = replace(reading, doubts=(*reading.doubts, text))
    return out


def _with_evidence(search: Search, q: int, readings: list[Reading]) -> None:
    """What speaks for the answer to a question, or that nothing does, into the readings."""
    question, answer = search.asked[q], search.best[q]
    rivals, rejected = list[tuple[Scale, float]](), list[tuple[Scale, float]]()
    for other in (a for a in question.answers if a != answer):
        gap, row = search.gap(q, other)
        times = 1.0 if row is None else search.times(row)
        if isinstance(other, Scale):
            near = abs(np.log(_size(other) / _size(answer))) < _ALIKE if isinstance(answer, Scale) else False
            (rivals if gap < DECIDED or near else rejected).append((other, times))
        elif gap < DECIDED and row is not None and len(search.together(row)) == 1:
            _put(readings, question, "", "its sign does not show in these logs", f"sign = {other}")
        elif gap < DECIDED and row is not None:
            beside = "all moves alike where the others that belong to it are turned too"
            _put(readings, question, f"sign {answer}: alone it can not be turned, but {beside}", "", "")
        else:
            _put(readings, question, f"sign {answer}: flipped, {times:.2g} times as much of the joints' "
                 "forces is left unexplained", "", "")  # fmt: skip
    if rejected:
        _put(readings, question, missing_more(answer, rejected), "", "")
    if rivals:
        _put(readings, question, "", as_well(answer, rivals), "")
        for k in question.readings:
            lines = tuple(line for scale, _ in rivals for line in readings[k].lines_of(scale))
            readings[k] = replace(readings[k], instead=(*readings[k].instead, *lines))


def _size(scale: Scale) -> float:
    return abs(scale.factor * find_unit(scale.unit).factor)


def missing_more(answer: Answer, others: Sequence[tuple[Scale, float]]) -> str:
    """That others are wrong, each with what it leaves over what the answer leaves, in one line."""
    times = sorted({f"{ratio:.2g}" for _, ratio in others}, key=float)
    more = f"{' to '.join(dict.fromkeys((times[0], times[-1])))} times as much of the joints' forces is left"
    if len(others) <= _SAID:
        return f"{answer}: read as {' or '.join(str(other) for other, _ in others)}, {more}"
    return f"{answer}: with {len(others)} other usual counts a {others[0][0].unit}, {more}"


def as_well(answer: Answer, rivals: Sequence[tuple[Scale, float]]) -> str:
    """That others may be right."""
    counts = isinstance(answer, Scale) and answer.factor != 1 and all(other.unit == answer.unit for other, _ in rivals)
    some = [other for other, _ in sorted(rivals, key=lambda one: one[1])]
    names = [f"{1 / x.factor:g}" + f" with 0 at {x.zero:g}" * bool(x.zero) if counts else str(x) for x in some]
    return f"{answer} or {', '.join(names)}? the model explains the log as well with either"


def _mirrored(search: Search) -> list[tuple[int, ...]]:
    """Places of readings whose signs may be flipped together, and of what drives them."""
    groups = dict[tuple[int, ...], None]()
    for q, question in enumerate(search.asked):
        gap, row = search.gap(q, turned(search.best[q])) if question.of_sign else (np.inf, None)
        if row is not None and gap < DECIDED and len(group := search.together(row)) > 1:
            groups[tuple(sorted(group))] = None
    return list(groups)


def _said(groups: Sequence[Sequence[int]], readings: Readings) -> list[str]:
    pairs = [" and ".join(repr(readings[k].match.column) for k in one) for one in groups]
    each = "" if len(pairs) == 1 else "each of "
    text = f"sign ambiguity: the logs fit equally well with {each}{'; '.join(pairs)} flipped together"
    return [text] if pairs else []


def _put(out: list[Reading], question: Question, note: str, doubt: str, instead: str) -> None:
    """Into the question's readings, where there is any."""
    for k in question.readings:
        out[k] = replace(
            out[k],
            notes=(*out[k].notes, *([note] if note else [])),
            doubts=(*out[k].doubts, *([doubt] if doubt else [])),
            instead=(*out[k].instead, *instead.splitlines()),
        )


def _with_ties(case: Case, tied: dict[int, tuple[int, float]], readings: list[Reading]) -> None:
    """What is said of set-points: whose they are, and how many times their position they are."""
    for k, (place, times) in tied.items():
        own, then = readings[place], case.draft.readings
        ratio = times * scale_of(readings[k]) / scale_of(then[k]) / (scale_of(own) / scale_of(then[place]))
        note = f"sign and unit as of {own.match.column!r}, which follows it"
        doubts = readings[k].doubts
        if abs(np.log(max(abs(ratio), 1e-9))) > _NEAR:
            doubts = (*doubts, f"it is {ratio:.3g} times {own.match.column!r}, which follows it: look at both units")
        readings[k] = replace(readings[k], notes=(*readings[k].notes, note), doubts=doubts)


def _driven(case: Case, readings: list[Reading], outcome: Outcome) -> list[Reading]:
    """Forces and voltages in the direction and the unit of their coefficients."""
    for k, command in enumerate(case.commands):
        drive = case.drive(k)
        if command is None or drive in (Drive.POSITION, Drive.VELOCITY):
            continue
        gain, error = float(outcome.gains[command]), float(outcome.errors[command])
        actuator = next(a for a in case.machine.actuators if f"actuator:{a.name}" == readings[k].match.target)
        readings[k] = _as_force(case, readings[k], gain, error, actuator.one_way)
    return readings


def _as_force(case: Case, reading: Reading, gain: float, error: float, one_way: bool) -> Reading:
    """A command by its coefficient, which is one where unit and sign are right and the model is."""
    if abs(gain) < DECIDED * error or not gain:
        open_ = [] if one_way else ["its sign does not show in these logs"]
        other = tuple(f"sign = {-reading.sign}" for _ in open_)
        told = (*reading.doubts, *open_, *_units_open(case, reading))
        return replace(reading, doubts=told, instead=(*reading.instead, *other))
    notes, doubts, instead = list(reading.notes), list(reading.doubts), list(reading.instead)
    if not one_way:
        sign = int(np.sign(gain)) * reading.sign
        reading = replace(reading, sign=sign)
        notes.append(f"sign {sign}: so the joints' forces follow it")
    now, may_be = reading.unit, _words(case, reading)
    off = {w: abs(float(np.log(abs(gain) * find_unit(now).factor / find_unit(w).factor))) for w in may_be}
    best = min(off, key=lambda word: off[word]) if off else now
    named = bool(reading.match.label.unit)
    if named and off and off[now] > _FAR and off[now] - off[best] > _FAR:
        doubts.append(f"its name says {now}, but the joints' forces follow it far better in {best}")
        instead.append(f'unit = "{best}"')
    elif named or len(may_be) < 2:
        notes.append(f"{now}, as its name says; the joints' forces are {abs(gain):.2g} times it") if named else None
    else:
        rivals = [word for word in may_be if word != best and off[word] - off[best] < np.log(3.0)]
        gain *= find_unit(now).factor / find_unit(best).factor
        reading = reading if best == now else replace(reading, unit=best)
        notes.append(f"{best}: the joints' forces are {abs(gain):.2g} times it")
        if rivals:
            doubts.append(f"{best} or {', '.join(rivals)}? neither is far from the model's forces")
            instead += [f'unit = "{word}"' for word in rivals]
    return replace(reading, notes=tuple(notes), doubts=tuple(doubts), instead=tuple(instead))


def _words(case: Case, reading: Reading) -> tuple[str, ...]:
    """Units that a command may have; one of what is a share of something, whose size the gain takes."""
    if reading.factor != 1 or reading.scales or reading.supply:
        return (reading.unit,)
    return tuple(dict.fromkeys((reading.unit, *unit_words(reading, case.machine))))


def _units_open(case: Case, reading: Reading) -> list[str]:
    words = _words(case, reading)
    return [f"{' or '.join(words)}? these logs do not say"] * (len(words) > 1 and not reading.match.label.unit)


def with_zeros(case: Case, model: mujoco.MjModel) -> Draft:
    """The draft with the zeros of joints' columns with which the model explains clearly more.

    First what the model names (``ref``, keyframes, a body's place in the world) is tried, then a grid over the range of
    each joint, both with either sign.
    """
    draft = case.draft
    joints = {
        k: joint for k, reading in enumerate(draft.readings) for joint in case.machine.joints
        if reading.match.target == f"joint:{joint.name}.position" and case.channels[k]
    }  # fmt: skip
    tied = {place: k for k, (place, _) in tied_of(case).items()}
    readings, now = list(draft.readings), case.outcome(draft.readings)
    dofs = {k: int(model.joint(joint.name).dofadr[0]) for k, joint in joints.items()}
    shown = sorted((k for k in joints if now.miss[dofs[k]] > _BELIEVED), key=lambda k: -now.miss[dofs[k]])[:_LOOKED]
    for _ in range(len(joints)):
        tried = []
        for k, joint in joints.items():
            grid = _grid(case, model, k, joint) if k in shown else np.zeros(0)
            values = [(v, why, tied.get(k)) for v, why in _named(model, joint).items()]
            values += [(float(v), "", tied.get(k)) for v in grid]
            if len(grid) and k in tied:  # of the encoder alone, by which it is off the set-points
                values.append((_apart(case, k, tied[k]), "", None))
            for (value, why, follower), sign in itertools.product(values, (1, -1)):
                put = _put_zero(readings, k, follower, value, sign, 0.0)
                tried.append((_nats_of(case, put), k, why, follower, put))
        here = _nats_of(case, readings)
        named = [one for one in tried if one[2] and here - one[0] > DECIDED]
        best = _best_zero(case, model, joints, readings, named or [one for one in tried if not one[2]])
        if best is None:
            break
        score, k, why, follower, put = best
        then = case.outcome(put)
        gains = here - score > (DECIDED if why else _ZERO_GAIN)
        if not gains or abs(scale_of(put[k]) * put[k].zero) < _LEAST_ZERO:
            break
        if not why and then.miss[dofs[k]] > min(_EXPLAINED, now.miss[dofs[k]] / _TIMES):
            break
        times = float((now.miss / then.miss).max())
        readings, now = _say_zero(put, k, follower, why, times), then
        del joints[k]
    return draft.with_readings(readings)


Tried = tuple[float, int, str, int | None, list[Reading]]
"""Nats, the place of a reading, why it may have a zero, the set-point that has it too, and all readings."""


def _apart(case: Case, k: int, follower: int) -> float:
    """By how much, SI, a position is usually off its set-point."""
    command, channel = case.commands[follower], case.channels[k][0]
    assert command is not None
    parts = [log.observations[:-1, channel] - log.actions[:, command] for log in case.regression.logs]
    return float(np.median(np.concatenate(parts)))


def _nats_of(case: Case, readings: Readings) -> float:
    return case.nats(case.outcome(readings)) + _odd_sizes(case, readings)


def _best_zero(
    case: Case,
    model: mujoco.MjModel,
    joints: dict[int, Joint],
    readings: Readings,
    tried: Sequence[Tried],
) -> Tried | None:
    """The best of some zeros, of a grid looked for once more; with the other sign where that is clearly better."""
    best: Tried | None = None
    for turned_round in (False, True):
        own = [one for one in tried if (one[4][one[1]].sign != readings[one[1]].sign) == turned_round]
        if not own:
            continue
        score, k, why, follower, put = min(own, key=lambda one: one[0])
        if not why:
            score, put = _refined(case, model, joints[k], put, k, follower)
        if best is None or score < best[0] - DECIDED:
            best = score, k, why, follower, put
    return best


def _put_zero(
    readings: Readings, k: int, follower: int | None, value: float, sign: int, unsure: float
) -> list[Reading]:
    """A column that reads ``value`` (SI, in the model's direction) where the joint is at 0, and its set-point alike."""
    out = list(readings)
    turn = sign * out[k].sign
    for place in (k, *([] if follower is None else [follower])):
        one = replace(out[place], sign=out[place].sign * turn)
        out[place] = replace(one, zero=float(f"{value / scale_of(one):.6g}"), unsure=unsure)
    return out


def _refined(
    case: Case, model: mujoco.MjModel, joint: Joint, put: list[Reading], k: int, follower: int | None
) -> tuple[float, list[Reading]]:
    """A zero of a grid looked for once more around itself, twice."""
    low, high = _range(model, joint)
    step = (high - low) / (_ZEROS - 1)
    for width in (step, 2 * step / (_FINER - 1)):
        centre, sign = put[k].zero * scale_of(put[k]), put[k].sign
        unsure = _UNSURE * 2 * width / (_FINER - 1)
        around = [_put_zero(put, k, follower, centre + x, sign, unsure) for x in np.linspace(-width, width, _FINER)]
        put = min(around, key=lambda one: _nats_of(case, one))
    return _nats_of(case, put), put


def _range(model: mujoco.MjModel, joint: Joint) -> tuple[float, float]:
    own = model.joint(joint.name)
    if model.jnt_limited[own.id]:
        return float(model.jnt_range[own.id, 0]), float(model.jnt_range[own.id, 1])
    rest, reach = float(model.qpos0[own.qposadr[0]]), np.pi if joint.hinge else float(model.stat.extent)
    return rest - reach, rest + reach


def _grid(case: Case, model: mujoco.MjModel, k: int, joint: Joint) -> FloatArray:
    """Zeros (n,) that put the log's motion anywhere in the joint's range; none of a column whose zero is a share's."""
    if case.draft.readings[k].ends:
        return np.zeros(0)
    low, high = _range(model, joint)
    channel = case.channels[k][0]
    seen = np.concatenate([log.observations[:, channel] for log in case.regression.logs])
    if joint.hinge and np.ptp(seen) < _LEAST_MOTION:  # from so little no change of gravity shows
        return np.zeros(0)
    usual = float(np.median(seen))
    values = usual - np.linspace(low, high, _ZEROS)
    wraps = joint.hinge and not model.jnt_limited[model.joint(joint.name).id]
    return np.asarray((values + np.pi) % (2 * np.pi) - np.pi if wraps else values)


def _named(model: mujoco.MjModel, joint: Joint) -> dict[float, str]:
    """Zeros that the model names, with why."""
    data, own = mujoco.MjData(model), model.joint(joint.name)
    mujoco.mj_kinematics(model, data)
    at, rest = int(own.qposadr[0]), float(model.qpos0[own.qposadr[0]])
    named = {-float(model.key_qpos[i, at]): f"the keyframe {model.key(i).name!r} is at 0" for i in range(model.nkey)}
    named |= {-rest: "the model's ref is at 0"}
    if not joint.hinge:
        height = float(data.xanchor[own.id] @ data.xaxis[own.id]) - rest
        named |= {height: f"where the body {joint.body!r} is in the world"}
    return {value: why for value, why in named.items() if abs(value) > 1e-6}


def _say_zero(readings: list[Reading], k: int, follower: int | None, why: str, times: float) -> list[Reading]:
    """What speaks for a zero."""
    out = list(readings)
    for place in (k, *([] if follower is None else [follower])):
        zero = f"{out[place].zero:g}, {why}" if why else f"{out[place].zero:.3g}, which these logs alone tell"
        text = f"zero {zero}: without it, {times:.2g} times as much of the joints' forces is left"
        notes, doubts = ((text,), ()) if why else ((), (text,))
        out[place] = replace(
            out[place], notes=(*out[place].notes, *notes), doubts=(*out[place].doubts, *doubts),
        )  # fmt: skip
    return out


def absolute_angles(search: Search, model: mujoco.MjModel) -> list[str]:
    """What is to be said of columns that the model explains far better with the angle of the link before taken off."""
    case, doubts = search.case, []
    of = {r.match.target: (k, case.channels[k][0]) for k, r in enumerate(case.draft.readings) if case.channels[k]}
    here = search.tried[search.best][1].miss
    for own, before in _chained(model, case.machine, {target: channel for target, (_, channel) in of.items()}):
        dof = int(model.joint(own.split(":")[1].rpartition(".")[0]).dofadr[0])
        if here[dof] < _WELL:
            continue
        (k, channel), (_, other) = of[own], of[before]
        there = Search(
            replace(case, minus=((channel, other),), count=[*case.count], _known={}), search.asked, search.tied
        )
        signs = [q for q, question in enumerate(search.asked) if question.of_sign]
        pair = [q for q in signs if {k, of[before][0]} & {*search.asked[q].readings}]
        groups = [(), *((q,) for q in pair), tuple(pair)]
        there.add([search.best, *_singles(search.best, search.asked)])
        there.add([tuple(turned(a) if q in g else a for q, a in enumerate(there.best)) for g in groups])
        better = search.nats(search.best) - there.nats(there.best)
        then = float(there.tried[there.best][1].miss[dof])
        if better > _ZERO_GAIN and here[dof] > _TIMES * then and then < _EXPLAINED:
            column = {r.match.target: r.match.column for r in case.draft.readings}
            doubts.append(
                f"{column[own]!r} looks like the angle of a link against the world, not of a joint: with "
                f"{column[before]!r} taken off, {here[dof] / then:.2g} times less of the joints' forces is left; log "
                "the difference, or write it as a column of its own"
            )
    return doubts


def _chained(model: mujoco.MjModel, machine: Machine, measured: dict[str, int]) -> list[tuple[str, str]]:
    """Position targets of measured hinges, each with that of the nearest measured hinge of a body that carries it."""
    of_body = {
        int(model.joint(j.name).bodyid[0]): f"joint:{j.name}.position"
        for j in machine.joints
        if j.hinge and f"joint:{j.name}.position" in measured
    }
    pairs = []
    for body, target in of_body.items():
        parent = int(model.body_parentid[body])
        while parent and parent not in of_body:
            parent = int(model.body_parentid[parent])
        if parent:
            pairs.append((target, of_body[parent]))
    return pairs


def with_units_of_names(case: Case, readings: Readings) -> tuple[Reading, ...]:
    """Readings whose name has a unit, held against the others of its kind."""
    out, now = list(readings), case.nats(case.outcome(readings))
    for k, reading in enumerate(readings):
        label = reading.match.label
        if not label.unit or reading.match.quaternion or not is_tried(case.draft, reading) or not case.channels[k]:
            continue
        others = [word for word in unit_words(reading, case.machine) if word != reading.unit]
        scores = [case.nats(case.outcome([*out[:k], replace(out[k], unit=w), *out[k + 1 :]])) for w in others]
        best = int(np.argmin(scores)) if others else -1
        if others and now - scores[best] > 2 * DECIDED:
            text = f"its name says {reading.unit}, but the model explains far more of it in {others[best]}"
            line = f'unit = "{others[best]}"'
            out[k] = replace(reading, doubts=(*reading.doubts, text), instead=(*reading.instead, line))
        else:
            out[k] = replace(reading, notes=(f"{reading.unit}, as its name says", *reading.notes))
    return tuple(out)


def with_gyros(case: Case, gyros: Sequence[Reading]) -> dict[str, Reading]:
    """Gyros in the unit in which they turn as the measured positions do, by target; named ones are held against it."""
    out = {}
    outcome = case.outcome(case.draft.readings)
    for reading, gyro, left in zip(gyros, case.regression.gyros, outcome.gyros, strict=True):
        words = GYRO_WORDS if len(gyro.factors) > 1 else (reading.unit,)
        best = int(np.argmin(left))
        if left[best] > _TURNS:
            text = f"it does not turn as what is measured does ({100 * left[best]:.0f} % is left): how is it mounted?"
            out[reading.match.target] = replace(reading, doubts=(*reading.doubts, text))
            continue
        note = f"{words[best]}: as fast as what is measured turns"
        if reading.match.label.unit and words[best] != reading.unit:
            text = f"its name says {reading.unit}, but it turns as fast as what is measured in {words[best]}"
            line = f'unit = "{words[best]}"'
            out[reading.match.target] = replace(
                reading, doubts=(*reading.doubts, text), instead=(*reading.instead, line)
            )
        else:
            out[reading.match.target] = replace(reading, unit=words[best], notes=(note, *reading.notes))
    return out
