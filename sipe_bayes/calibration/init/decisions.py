"""Units, signs, zeros and frames that names leave open: the alternative with which the model explains most forces.

A set of readings is scored in nats by one regression of the joints' forces. A set-point goes with the position that
follows it, and the sign and unit of a force are those of its coefficient. An alternative that is ``DECIDED`` nats
better than all others is taken; where others are as good, what the names say stays, and is asked.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

import mujoco
import numpy as np

from sipe_bayes.calibration.init.draft import (
    Answer,
    Draft,
    Question,
    Reading,
    Scale,
    actuator_of,
    apply_answers,
    is_tried,
    questions,
    turned,
    unit_words,
)
from sipe_bayes.calibration.init.regression import SERVOS, Assumption, Outcome, Regression
from sipe_bayes.calibration.machine import Drive, Joint, Machine
from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.telling import Tell, silent
from sipe_bayes.core.units import find_unit

DECIDED = 3.0
"""Nats, by which an alternative has to be better, so that the logs decide."""
GYRO_WORDS = ("rad/s", "deg/s")
_EXPLAINED = 0.5  # of the forces, what may be left where the logs alone tell a zero, a frame, a sign against a name
_NEAR, _FAR = np.log(3.0), np.log(5.0)  # of the logarithm of a ratio: the same; another unit, or a model far off

Readings = Sequence[Reading]
Answers = tuple[Answer, ...]


def scale_of(reading: Reading) -> float:
    """What a column is multiplied by to be SI in the model's direction."""
    return reading.sign * reading.factor * find_unit(reading.unit).factor


@dataclass
class Case:
    """A draft, the regression of its logs, and where its readings are in it.

    Args:
        draft: of positions and commands.
        model: as it is given.
        machine: what of it logs hold.
        regression: of logs as the draft reads them.
        channels: of each reading; empty where the regression has none.
        commands: number of each reading's actuator; None of measurements.
        count: independent numbers of each degree of freedom; by the motion to begin with.
        minus: pairs of channels, the second of which is taken off the first.
        tell: how far it is.
        known: outcomes of assumptions that were tried.
    """

    draft: Draft
    model: mujoco.MjModel
    machine: Machine
    regression: Regression
    channels: tuple[tuple[int, ...], ...]
    commands: tuple[int | None, ...]
    count: float
    minus: tuple[tuple[int, int], ...] = ()
    tell: Tell = silent
    known: dict[Assumption, Outcome] = field(default_factory=dict)

    def outcome(self, readings: Readings) -> Outcome:
        """What the regression says of other units, signs and zeros than the draft's."""
        given = self.regression.given
        observed, driven, zeros, rests = map(list, (given.observed, given.driven, given.zeros, given.rests))
        for k, (now, then) in enumerate(zip(readings, self.draft.readings, strict=True)):
            factor, zero = scale_of(now) / scale_of(then), scale_of(now) * (now.zero - then.zero)
            for channel in self.channels[k]:
                observed[channel], zeros[channel] = observed[channel] * factor, zero
            if (command := self.commands[k]) is not None:
                driven[command], rests[command] = driven[command] * factor, zero
        assumption = Assumption(tuple(observed), tuple(driven), tuple(zeros), tuple(rests), self.minus)
        if assumption not in self.known:
            self.known[assumption] = self.regression.fit(assumption, every=False)
        return self.known[assumption]

    def nats(self, outcome: Outcome) -> float:
        """What speaks against readings: the smaller the better."""
        return self.count * outcome.unexplained + outcome.far_off

    def score(self, readings: Readings) -> float:
        """What speaks against readings, with what speaks against the sizes of motions."""
        return self.nats(self.outcome(readings)) + self.odd_sizes(readings)

    def drive(self, k: int) -> Drive | None:
        """What the actuator of a reading is given; None of measurements."""
        command = self.commands[k]
        return None if command is None else self.regression.drives[command]

    def dof(self, k: int) -> int:
        """The degree of freedom of a joint's reading."""
        return int(self.regression.simulator.model.joint(self.draft.readings[k].joint).dofadr[0])

    def explains_nothing(self, outcome: Outcome) -> bool:
        """Whether hardly any force is explained, though not every joint follows a set-point against friction."""
        known, served = self.regression.known, {self.dof(place) for place, _ in self.ties.values()}
        return not known.any() or bool(outcome.miss[known].min() > 0.9 and {*np.flatnonzero(known)} - served)

    @cached_property
    def positions(self) -> dict[int, Joint]:
        """Joints of the readings that are their positions."""
        named = {f"joint:{joint.name}.position": joint for joint in self.machine.joints}
        targets = [reading.match.target for reading in self.draft.readings]
        return {k: named[target] for k, target in enumerate(targets) if target in named and self.channels[k]}

    @cached_property
    def series(self) -> FloatArray:
        """All logs' measurements (n, O), SI as the draft reads them."""
        return np.concatenate([log.observations for log in self.regression.logs])

    @cached_property
    def quantiles(self) -> FloatArray:
        """The least, the middle and the largest (3, O) of these."""
        return np.asarray(np.nanquantile(self.series, (0.0, 0.5, 1.0), axis=0))

    @cached_property
    def ties(self) -> dict[int, tuple[int, float]]:
        """Set-points with the place of the position that follows each, and how many times it they are, SI."""
        out, places = dict[int, tuple[int, float]](), {r.match.target: k for k, r in enumerate(self.draft.readings)}
        kinds = {Drive.POSITION: "position", Drive.VELOCITY: "velocity"}
        for k, command in enumerate(self.commands):
            actuator = actuator_of(self.machine, self.draft.readings[k].match.target)
            if command is None or actuator is None or actuator.joint is None:
                continue
            place = places.get(f"joint:{actuator.joint.name}.{kinds.get(self.regression.drives[command])}")
            if place is not None and self.channels[place]:
                share, times = _follow(self.regression, command, self.channels[place][0])
                if share > 0.5:
                    out[k] = place, times
        return out

    def odd_sizes(self, readings: Readings) -> float:
        """Nats against turns by the dozen, motions below a degree or a millimetre, and those beyond a joint's range."""
        odd = 0.0
        for k, (now, then) in enumerate(zip(readings, self.draft.readings, strict=True)):
            for channel in self.channels[k]:
                factor, angular = scale_of(now) / scale_of(then), find_unit(now.unit).dimension == "angle"
                low, middle, high = (abs(factor) * self.quantiles[:, channel]).tolist()
                size = max(-low, high)
                odd += (size > (40.0 if angular else 20.0)) + (size < (0.02 if angular else 0.002))
                odd += angular and abs(middle) > np.pi
                reach = self.positions[k].reach if k in self.positions else None
                if reach is not None:
                    values, span = self.series[:, channel] * factor, reach[1] - reach[0]
                    values, room = values - scale_of(now) * (now.zero - then.zero), 0.1 * span
                    beyond = float(np.mean((values < reach[0] - room) | (values > reach[1] + room)))
                    odd += 6 * (beyond + 0.7 * (high - low < 0.02 * span))
        return odd


def _follow(regression: Regression, command: int, channel: int) -> tuple[float, float]:
    """The share of a set-point's variance that a position explains, and how many times the position it is.

    Whichever position comes up to a quarter of the time later in which the motion goes to and fro. It goes the other
    way only where that explains clearly more.
    """
    best = {1: (0.0, 0.0), -1: (0.0, 0.0)}
    for late in range(int(min(0.3 / regression.logs[0].dt, regression.period / 4)) + 1):
        parts = []
        for log in regression.logs:
            if len(log) > late + 20:
                pair = np.stack([log.actions[: len(log) - late, command], log.observations[late:-1, channel]])
                parts += [own - own.mean(1, keepdims=True) for own in np.array_split(pair, 10, axis=1)]
        alike = [abs(float(a @ b)) / np.sqrt(max(float((a @ a) * (b @ b)), 1e-30)) for a, b in parts]
        most = np.argsort(alike)[-max(1, int(0.6 * len(parts))) :]  # a drive may be off for a while
        one, other = np.concatenate([parts[k] for k in most], axis=1) if parts else np.zeros((2, 1))
        if (size := float((one @ one) * (other @ other))) > 0:
            sign, times = (1 if one @ other > 0 else -1), float(np.sqrt((one @ one) / (other @ other)))
            best[sign] = max(best[sign], (float(one @ other) ** 2 / size, sign * times))
    return best[-1] if best[-1][0] > best[1][0] + 0.3 else best[1]


@dataclass
class Search:
    """Answers that were tried, with the nats that are no forces' and the outcome of each."""

    case: Case
    asked: list[Question]
    tried: dict[Answers, tuple[float, Outcome]] = field(default_factory=dict)

    @property
    def best(self) -> Answers:
        """Least nats; servos flipped against their names only where the model then explains them."""
        return min(filter(self._is_believed, self.tried), key=self.nats)

    def _is_believed(self, answers: Answers) -> bool:
        served, miss = {place for place, _ in self.case.ties.values()}, self.tried[answers][1].miss
        flipped = {q.readings[0] for q, a in zip(self.asked, answers, strict=True) if q.of_sign and a != q.answers[0]}
        return all(miss[self.case.dof(k)] < _EXPLAINED for k in flipped & served)

    @property
    def outcome(self) -> Outcome:
        """Of the best answers."""
        return self.tried[self.best][1]

    def nats(self, answers: Answers) -> float:
        """What speaks against answers."""
        against, outcome = self.tried[answers]
        return against + self.case.nats(outcome)

    def readings(self, answers: Answers) -> list[Reading]:
        """With the answers, set-points as the positions that follow them."""
        return _with_tied(self.case, apply_answers(self.case.draft.readings, self.asked, answers))

    def add(self, some: Sequence[Answers]) -> None:
        """Try those that were not; other answers than those of the names are unlikely."""
        for answers in some:
            if answers not in self.tried:
                readings = self.readings(answers)
                unlikely = 0.7 * sum(a != q.answers[0] for q, a in zip(self.asked, answers, strict=True))
                self.tried[answers] = unlikely + self.case.odd_sizes(readings), self.case.outcome(readings)

    def run(self) -> Search:
        """Try all combinations, or where they are many those that changes of one answer or of two signs lead to."""
        self.add([tuple(question.answers[0] for question in self.asked)])
        few = np.prod([float(len(question.answers)) for question in self.asked]) <= 64
        self.add(list(itertools.product(*(question.answers for question in self.asked))) if few else [])
        for turn in range(0 if few else 12):
            self.case.tell(f"round {turn + 1}")
            now = self.best
            self.add(self.single_changes())
            if self.best == now:
                self.add(self.flipped_pairs())
            if self.best == now:
                break
        self.case.count = self.case.regression.independent(self.outcome)
        return self

    def single_changes(self) -> list[Answers]:
        """The best answers with another one to one question."""
        now = self.best
        return [(*now[:q], a, *now[q + 1 :]) for q, one in enumerate(self.asked) for a in one.answers if a != now[q]]

    def flipped_pairs(self) -> list[Answers]:
        """The best answers with two signs flipped, and with all."""
        signs, now = [q for q, question in enumerate(self.asked) if question.of_sign], self.best
        return [_flip(now, group) for group in (*itertools.islice(itertools.combinations(signs, 2), 40), signs)]

    def rival(self, question: int, answer: Answer) -> tuple[float, Answers]:
        """By how many nats of the logs the best combination with another answer is worse, and the nearest of these."""
        best, rows = self.best, [answers for answers in self.tried if answers[question] == answer]
        gaps = {a: self.case.nats(self.tried[a][1]) - self.case.nats(self.outcome) for a in rows}
        changes = {a: sum(x != y for x, y in zip(a, best, strict=True)) for a in rows}
        near = [a for a in rows if gaps[a] < DECIDED]
        row = min(near, key=lambda a: (changes[a], gaps[a])) if near else min(rows, key=lambda a: gaps[a])
        return min(gaps.values()), row

    def flipped(self, other: Answers) -> tuple[int, ...]:
        """Places of the readings whose signs are flipped in other answers, commands by their coefficients."""
        here, there = self.outcome, self.tried[other][1]
        pairs = zip(self.asked, other, self.best, strict=True)
        signs = [k for one, a, b in pairs if one.of_sign and a != b for k in one.readings]
        sure = (np.abs(here.gains) > DECIDED * here.errors) & (here.gains * there.gains < 0)
        driven = [k for k, c in enumerate(self.case.commands) if c is not None and sure[c]]
        return tuple(sorted({*signs, *driven, *(k for k, (place, _) in self.case.ties.items() if place in signs)}))

    def mirrored(self) -> list[tuple[int, ...]]:
        """Places of readings whose signs may be flipped together, and of what drives them."""
        rivals = [self.rival(q, turned(self.best[q])) for q, one in enumerate(self.asked) if one.of_sign]
        groups = [self.flipped(row) for gap, row in rivals if gap < DECIDED]
        return list(dict.fromkeys(group for group in groups if len(group) > 1))


def _flip(answers: Answers, group: Sequence[int]) -> Answers:
    """Answers with the signs of some questions flipped."""
    return tuple(turned(a) if q in group else a for q, a in enumerate(answers))


def _with_tied(case: Case, readings: Readings) -> list[Reading]:
    """Set-points in the unit and the direction of the position that follows them."""
    out = list(readings)
    for k, (place, times) in case.ties.items():
        own, then = readings[place], case.draft.readings
        raw = abs(times * scale_of(then[place]) / scale_of(then[k]))  # of what the columns say
        if own.scale in (*own.shares, *own.scales) and abs(np.log(raw)) < _NEAR and not out[k].match.label.unit:
            out[k] = replace(out[k], scales=own.scales, shares=own.shares, reach=own.reach).read_as(own.scale)
        elif not out[k].match.label.unit and (words := unit_words(out[k], case.machine)):
            fits = {word: abs(np.log(abs(scale_of(own)) / (raw * find_unit(word).factor))) for word in words}
            out[k] = out[k].read_as(Scale(min(fits, key=lambda w: fits[w])))
        sign = int(np.sign(times)) * then[k].sign * then[place].sign * own.sign
        out[k] = replace(out[k].turned_to(sign), zero=out[k].zero)
        if own.ends is None and own.zero:
            out[k] = replace(out[k], zero=float(f"{own.zero * scale_of(own) / scale_of(out[k]):.6g}"))
    return out


def search_answers(case: Case) -> Search:
    """What names leave open, tried; with springs at all joints where little is explained without them."""
    asked = questions(case.draft, case.machine)
    open_ = [tuple(k for k in q.readings if k not in case.ties and case.drive(k) in (None, *SERVOS)) for q in asked]
    asked = [replace(question, readings=own) for question, own in zip(asked, open_, strict=True) if own]
    search = Search(case, asked).run()
    left = search.outcome.miss[case.regression.known]
    if len(left) and left.max() > _EXPLAINED:
        case.regression.springs = True
        sprung = Search(replace(case, known={}), asked).run()
        sprung.case.count = case.count
        believed = sprung.outcome.miss[case.regression.known].max() < _EXPLAINED
        if believed and search.nats(search.best) - sprung.nats(sprung.best) > 6 * len(left):
            return sprung
        case.regression.springs = False
    return search


def decide(search: Search) -> Draft:
    """The draft with the units and signs that explain most, their evidence, and what stays open."""
    case, draft, outcome = search.case, search.case.draft, search.outcome
    if case.explains_nothing(outcome):
        readings = _with_tied(case, draft.readings)
        text = "the model explains nothing of these logs, so units and signs stand on names alone"
        doubts = (*draft.doubts, f"{text}; look at the model and at what drives it", *list_guesses(readings))
        return replace(draft.with_readings(readings), doubts=doubts)
    readings = search.readings(search.best)
    search.add(search.single_changes())
    search.add(search.flipped_pairs())
    for q in range(len(search.asked)):
        _say_evidence(search, q, readings)
    for k, (place, times) in case.ties.items():
        own, then = readings[place], draft.readings
        ratio = times * scale_of(readings[k]) / scale_of(then[k]) / (scale_of(own) / scale_of(then[place]))
        far = f"it is {ratio:.3g} times {own.match.column!r}, which follows it: look at both units"
        far = far if abs(np.log(max(abs(ratio), 1e-9))) > _NEAR else ""
        readings[k] = readings[k].add_evidence(f"sign and unit as of {own.match.column!r}, which follows it", far)
    measured = {reading.match.target for reading in readings}
    for k, command in enumerate(case.commands):
        actuator = actuator_of(case.machine, readings[k].match.target)
        if command is None or actuator is None:
            continue
        if case.drive(k) not in SERVOS:
            gain, error = float(outcome.gains[command]), float(outcome.errors[command])
            readings[k] = _as_force(case, readings[k], gain, error, actuator.one_way)
        elif case.drive(k) == Drive.POSITION and k not in case.ties and actuator.joint is not None:
            text = f"the position of {actuator.joint.name} does not follow it; if it is a torque, make it a <motor>"
            text = text if f"joint:{actuator.joint.name}.position" in measured else ""
            readings[k] = readings[k].add_evidence(doubt=text)
    columns = [reading.match.column for reading in readings]
    together = tuple(tuple(columns[k] for k in group) for group in search.mirrored())
    pairs = "; ".join(" and ".join(map(repr, group)) for group in together)
    text = f"sign ambiguity: the logs fit equally well with {'each of ' * (len(together) > 1)}{pairs} flipped together"
    return replace(
        draft.with_readings(readings),
        doubts=(*draft.doubts, *[text] * bool(together)),
        together=together,
        tied=tuple((columns[place], columns[k]) for k, (place, _) in case.ties.items()),
    )


def list_guesses(readings: Readings) -> list[str]:
    """What is said of encoders' counts that nothing tells."""
    counting = [reading for reading in readings if reading.scales and reading.factor != 1]
    groups = {r.factor: [repr(o.match.column) for o in counting if o.factor == r.factor] for r in counting}
    text = "counts a turn is a guess; write what the encoder has"
    return [f"{', '.join(names)}: {1 / factor:g} {text}" for factor, names in groups.items()]


def _say_evidence(search: Search, q: int, readings: list[Reading]) -> None:
    """What speaks for the answer to a question, or that nothing does, into the readings."""
    question, answer = search.asked[q], search.best[q]
    rivals, rejected = list[tuple[Scale, float]](), list[tuple[Scale, float]]()
    note, doubt, sign = "", "", ""
    for other in (a for a in question.answers if a != answer):
        gap, row = search.rival(q, other)
        times = float((search.tried[row][1].miss / search.outcome.miss).max())
        if isinstance(other, Scale) and isinstance(answer, Scale):
            near = abs(np.log(_size(other) / _size(answer))) < np.log(1.12)  # no model is right enough
            (rivals if gap < DECIDED or near else rejected).append((other, times))
        elif gap >= DECIDED:
            note = f"sign {answer}: flipped, {times:.2g} times as much of the joints' forces is left unexplained"
        elif len(search.flipped(row)) > 1:
            beside = "all moves alike where the others that belong to it are turned too"
            note = f"sign {answer}: alone it can not be turned, but {beside}"
        else:
            doubt, sign = "its sign does not show in these logs", f"sign = {other}"
    note = missing_more(answer, rejected) if rejected else note
    doubt = as_well(answer, rivals) if rivals else doubt
    for k in question.readings:
        lines = [line for scale, _ in rivals for line in readings[k].lines_of(scale)]
        readings[k] = readings[k].add_evidence(note, doubt, *lines, *[sign] * bool(sign))


def _size(scale: Scale) -> float:
    return abs(scale.factor * find_unit(scale.unit).factor)


def missing_more(answer: Answer, others: Sequence[tuple[Scale, float]]) -> str:
    """That others are wrong, each with what it leaves over what the answer leaves, in one line."""
    times = sorted({f"{ratio:.2g}" for _, ratio in others}, key=float)
    more = f"{' to '.join(dict.fromkeys((times[0], times[-1])))} times as much of the joints' forces is left"
    if len(others) <= 3:
        return f"{answer}: read as {' or '.join(str(other) for other, _ in others)}, {more}"
    return f"{answer}: with {len(others)} other usual counts a {others[0][0].unit}, {more}"


def as_well(answer: Answer, rivals: Sequence[tuple[Scale, float]]) -> str:
    """That others may be right."""
    counts = isinstance(answer, Scale) and answer.factor != 1 and all(other.unit == answer.unit for other, _ in rivals)
    some = [other for other, _ in sorted(rivals, key=lambda one: one[1])]
    names = [f"{1 / x.factor:g}" + f" with 0 at {x.zero:g}" * bool(x.zero) if counts else str(x) for x in some]
    return f"{answer} or {', '.join(names)}? the model explains the log as well with either"


def _as_force(case: Case, reading: Reading, gain: float, error: float, one_way: bool) -> Reading:
    """A force or voltage by its coefficient, which is one where unit and sign are right and the model is."""
    shares = reading.factor != 1 or reading.scales or reading.supply  # whose size the gain takes
    words = list(dict.fromkeys((reading.unit, *(() if shares else unit_words(reading, case.machine)))))
    now, named = reading.unit, bool(reading.match.label.unit)
    if abs(gain) < DECIDED * error or not gain:
        if not one_way:
            reading = reading.add_evidence("", "its sign does not show in these logs", f"sign = {-reading.sign}")
        open_ = f"{' or '.join(words)}? these logs do not say" if len(words) > 1 and not named else ""
        return reading.add_evidence(doubt=open_)
    if not one_way:
        sign = int(np.sign(gain)) * reading.sign
        reading = replace(reading, sign=sign).add_evidence(f"sign {sign}: so the joints' forces follow it")
    times = {word: abs(gain) * find_unit(now).factor / find_unit(word).factor for word in words}
    off = {word: abs(float(np.log(ratio))) for word, ratio in times.items()}
    best = min(off, key=lambda word: off[word])
    if named and off[now] > _FAR and off[now] - off[best] > _FAR:
        return _with_named_unit(reading, best, "the joints' forces follow it far better")
    if named:
        return reading.add_evidence(f"{now}, as its name says; the joints' forces are {abs(gain):.2g} times it")
    if len(words) < 2:
        return reading
    rivals = [word for word in words if word != best and off[word] - off[best] < _NEAR]
    doubt = f"{best} or {', '.join(rivals)}? neither is far from the model's forces" if rivals else ""
    note = f"{best}: the joints' forces are {times[best]:.2g} times it"
    return replace(reading, unit=best).add_evidence(note, doubt, *(f'unit = "{word}"' for word in rivals))


class Zero(NamedTuple):
    """A zero of a joint's column: its place, that of a set-point that has it too, SI, why it may be, and the sign."""

    k: int
    follower: int | None
    value: float
    why: str = ""
    sign: int = 1
    unsure: float = 0.0

    @property
    def places(self) -> tuple[int, ...]:
        """Of the columns that have it."""
        return (self.k,) if self.follower is None else (self.k, self.follower)

    def put(self, readings: Readings) -> list[Reading]:
        """Columns that read the value, in the model's direction, where the joint is at 0."""
        out, turn = list(readings), self.sign * readings[self.k].sign
        for place in self.places:
            one = replace(out[place], sign=out[place].sign * turn)
            out[place] = replace(one, zero=float(f"{self.value / scale_of(one):.6g}"), unsure=self.unsure)
        return out


def find_zeros(case: Case) -> Draft:
    """The draft with the zeros of joints' columns with which the model explains clearly more.

    First what the model names (``ref``, keyframes, a body's place in the world) is tried, then of joints of which
    little is explained a grid over the range of each, both with either sign.
    """
    followers, joints = {place: k for k, (place, _) in case.ties.items()}, dict(case.positions)
    readings = list(case.draft.readings)
    now = case.outcome(readings)
    lost = {k: float(now.miss[case.dof(k)]) for k in joints}
    shown = sorted((k for k in joints if lost[k] > 0.3), key=lambda k: -lost[k])[:8]
    zeros = [Zero(k, followers.get(k), *one) for k, joint in joints.items() for one in _named(case.model, joint)]
    for k in shown:
        grid = _grid(case, k)
        zeros += [Zero(k, followers.get(k), v) for v in grid]
        if grid and k in followers:  # of the encoder alone, by which it is off the set-points
            zeros.append(Zero(k, None, _apart(case, k, followers[k])))
    while True:
        here = case.score(readings)
        groups: dict[tuple[bool, int, int | None], list[Zero]] = {}
        for zero, sign in itertools.product((zero for zero in zeros if zero.k in joints), (1, -1)):
            alone = zero.k if zero.follower is None and zero.k in followers else None
            turn = sign * readings[zero.k].sign
            if alone is None or turn == 1:  # alone a column keeps the direction of its set-points
                groups.setdefault((bool(zero.why), turn, alone), []).append(zero._replace(sign=sign))
        best = [min(own, key=lambda one: case.score(one.put(readings))) for own in groups.values()]
        best = [zero if zero.why else _refine(case, readings, zero) for zero in best]
        named = [zero for zero in best if zero.why and here - _cost(case, readings, zero) > DECIDED]
        best = sorted(named or best, key=lambda one: _cost(case, readings, one))
        if not best or abs(best[0].value) < 0.05 or here - _cost(case, readings, best[0]) <= DECIDED:
            break
        zero, put = best[0], best[0].put(readings)
        then, dof = case.outcome(put), case.dof(zero.k)
        if not zero.why and then.miss[dof] > min(_EXPLAINED, now.miss[dof] / 1.5):
            break
        times = f"without it, {float((now.miss / then.miss).max()):.2g} times as much of the joints' forces is left"
        for place in zero.places:
            named_zero = f"zero {put[place].zero:g}, {zero.why}: {times}"
            found_zero = f"zero {put[place].zero:.3g}, which these logs alone tell: {times}"
            put[place] = put[place].add_evidence(*(named_zero, "") if zero.why else ("", found_zero))
        readings, now = put, then
        del joints[zero.k]
    return case.draft.with_readings(readings)


def _cost(case: Case, readings: Readings, zero: Zero) -> float:
    """What speaks against a zero: one that nothing names is as unlikely as a flipped sign."""
    unlikely = (not zero.why) + (zero.sign != readings[zero.k].sign)
    return case.score(zero.put(readings)) + DECIDED * unlikely


def _refine(case: Case, readings: Readings, zero: Zero) -> Zero:
    """A zero of a grid looked for once more around itself, twice; unsure by two steps of the last grid."""
    low, high = _range(case.model, case.positions[zero.k])
    for width in (0.1 * (high - low), 0.025 * (high - low)):
        steps = np.linspace(-width, width, 9).tolist()
        around = [zero._replace(value=zero.value + step, unsure=0.5 * width) for step in steps]
        zero = min(around, key=lambda one: case.score(one.put(readings)))
    return zero


def _apart(case: Case, k: int, follower: int) -> float:
    """By how much, SI, a position is usually off its set-point."""
    logs, channel, command = case.regression.logs, case.channels[k][0], case.commands[follower]
    return float(np.median(np.concatenate([log.observations[:-1, channel] - log.actions[:, command] for log in logs])))


def _range(model: mujoco.MjModel, joint: Joint) -> tuple[float, float]:
    """The joint's, else a turn or the model's size about where it rests."""
    rest, reach = float(model.qpos0[model.joint(joint.name).qposadr[0]]), np.pi if joint.hinge else model.stat.extent
    return joint.reach or (rest - float(reach), rest + float(reach))


def _grid(case: Case, k: int) -> list[float]:
    """Zeros that put the log's motion anywhere in the joint's range; none of a column whose zero is a share's."""
    joint, own = case.positions[k], case.series[:, case.channels[k][0]]
    if case.draft.readings[k].ends or (joint.hinge and np.ptp(own) < 0.2):  # which shows no change of gravity
        return []
    values = float(np.median(own)) - np.linspace(*_range(case.model, joint), 11)
    wraps = joint.hinge and joint.reach is None
    return ((values + np.pi) % (2 * np.pi) - np.pi if wraps else values).tolist()


def _named(model: mujoco.MjModel, joint: Joint) -> list[tuple[float, str]]:
    """Zeros that the model names, with why."""
    data, own = mujoco.MjData(model), model.joint(joint.name)
    mujoco.mj_kinematics(model, data)
    rest = float(model.qpos0[own.qposadr[0]])
    keys = [model.key(i) for i in range(model.nkey)]
    named = {-float(key.qpos[own.qposadr[0]]): f"the keyframe {key.name!r} is at 0" for key in keys}
    named |= {-rest: "the model's ref is at 0"}
    if not joint.hinge:
        height = float(data.xanchor[own.id] @ data.xaxis[own.id]) - rest
        named |= {height: f"where the body {joint.body!r} is in the world"}
    return [(value, why) for value, why in named.items() if abs(value) > 1e-6]


def find_absolute_angles(search: Search) -> list[str]:
    """What is to be said of columns that the model explains far better with the angle of the link before taken off."""
    case, here, doubts = search.case, search.outcome.miss, []
    model = case.model
    bodies = {int(model.joint(joint.name).bodyid[0]): k for k, joint in case.positions.items() if joint.hinge}
    for body, k in bodies.items():
        parent, dof = int(model.body_parentid[body]), case.dof(k)
        while parent and parent not in bodies:
            parent = int(model.body_parentid[parent])
        if not parent or here[dof] < 0.1:
            continue
        before = bodies[parent]
        apart = ((case.channels[k][0], case.channels[before][0]),)
        there = Search(replace(case, minus=apart, known={}), search.asked)
        pair = [q for q, one in enumerate(search.asked) if one.of_sign and {k, before} & {*one.readings}]
        there.add([search.best, *search.single_changes()])
        for group in (*([q] for q in pair), pair):
            there.add([_flip(there.best, group)])
        then = float(there.outcome.miss[dof])
        better = search.nats(search.best) - there.nats(there.best)
        if better > 2 * DECIDED and then < min(_EXPLAINED, here[dof] / 1.5):
            one, other = (case.draft.readings[place].match.column for place in (k, before))
            doubts.append(
                f"{one!r} looks like the angle of a link against the world, not of a joint: with {other!r} taken off, "
                f"{here[dof] / then:.2g} times less of the joints' forces is left; log the difference, or write it as "
                "a column of its own"
            )
    return doubts


def check_named_units(case: Case, readings: Readings) -> tuple[Reading, ...]:
    """Readings whose name has a unit, held against the others of its kind."""
    out, now = list(readings), case.nats(case.outcome(readings))
    for k, reading in enumerate(readings):
        if reading.match.label.unit and is_tried(case.draft, reading) and case.channels[k]:
            scores = {reading.unit: now - 2 * DECIDED}  # from which the name is not believed
            for word in unit_words(reading, case.machine):
                there = [*readings[:k], replace(reading, unit=word), *readings[k + 1 :]]
                scores.setdefault(word, case.nats(case.outcome(there)))
            best = min(scores, key=lambda word: scores[word])
            out[k] = _with_named_unit(reading, best, "the model explains far more of it")
    return tuple(out)


def _with_named_unit(reading: Reading, unit: str, but: str) -> Reading:
    """A reading in the unit of its name, and what speaks for another one."""
    if unit == reading.unit:
        return replace(reading, notes=(f"{unit}, as its name says", *reading.notes))
    return reading.add_evidence("", f"its name says {reading.unit}, but {but} in {unit}", f'unit = "{unit}"')


def check_gyros(case: Case, gyros: Readings) -> dict[str, Reading]:
    """Gyros in the unit in which they turn as the measured positions do, by target; named ones are held against it."""
    out = {}
    outcome = case.outcome(case.draft.readings)
    for reading, gyro, left in zip(gyros, case.regression.gyros, outcome.gyros, strict=True):
        words = GYRO_WORDS if len(gyro.factors) > 1 else (reading.unit,)
        best = words[int(np.argmin(left))]
        if left.min() > 0.4:
            text = f"it does not turn as what is measured does ({100 * left.min():.0f} % is left): how is it mounted?"
            out[reading.match.target] = reading.add_evidence(doubt=text)
        elif reading.match.label.unit and best != reading.unit:
            out[reading.match.target] = _with_named_unit(reading, best, "it turns as fast as what is measured")
        else:
            notes = (f"{best}: as fast as what is measured turns", *reading.notes)
            out[reading.match.target] = replace(reading, unit=best, notes=notes)
    return out
