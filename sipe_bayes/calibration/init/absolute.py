"""Columns that measure from elsewhere than the model: joints from another zero, links against the world."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import mujoco
import numpy as np

from sipe_bayes.calibration.init.draft import Answer, Draft, Question, Reading, answered, questions, turned
from sipe_bayes.calibration.init.fits import fit
from sipe_bayes.calibration.init.machine import Drive, Joint, Machine
from sipe_bayes.calibration.init.ranking import Case, Ranking, are_few, ranked, scale_of, under
from sipe_bayes.core.arrays import FloatArray

_FAR_BETTER = np.log(2.0)  # of the logarithm of misses of all channels together
_BETTER, _CLEAR = np.log(1.3), 3.0  # of the same, where the model names a zero; and standard errors of it
_BELIEVED = 0.3  # of the miss of one channel, up to which it has no zero that is looked for
_FITTED = 3  # zeros with which the unknowns are fitted, those that miss least
_GRID, _FINER = 31, 9  # zeros that are tried over the range of a joint, and twice around the best
_ROUNDS = 4  # of zero and unknowns, each with the other
_UNSURE = 2.0  # steps of the grid, by which a zero may be off that simulations alone tell
_AFFORDED, _FEWER = 2_000_000, 12  # physics steps of all grids, about 40 s with a dozen joints; and windows beyond
_FIT_AFFORDED = 170_000  # of a round of a fit
_NONE = 1e-6  # rad or m

Readings = Sequence[Reading]


@dataclass(frozen=True)
class _Zero:
    """What columns read in SI where a joint is at 0: their places, why that may be, and by how much it may be off."""

    places: tuple[int, ...]
    value: float
    why: str
    unsure: float = 0.0

    def put(self, readings: Readings) -> list[Reading]:
        """The readings with it, each in its column's unit."""
        out = list(readings)
        for k in self.places:
            out[k] = replace(out[k], zero=float(f"{self.value / scale_of(out[k]):.6g}"), unsure=self.unsure)
        return out


def with_zeros(case: Case, model: mujoco.MjModel, ranking: Ranking | None) -> tuple[Draft, list[str]]:
    """The draft with those zeros of joints' columns with which simulations follow the logs clearly better, and doubts.

    First what the model names (a body's place in the world, ``ref``, keyframes) is tried, then a grid over the joint's
    range where no simulation follows the logs well. The unknowns are fitted with and without a zero: a model that is
    off speaks for wrong ones.
    Windows count alike, those with an impact too: contacts tell of a zero.

    Args:
        case: the draft and its windows.
        model: as given.
        ranking: its units and signs; None where all are known.
    """
    draft = case.draft
    joints = {k: j for k, r in enumerate(draft.readings) for j in case.machine.joints if _measures(r, j)}
    near, taken = _nearest(case, ranking), list[tuple[_Zero, float]]()
    channels = len(case.trial.given.observed)
    now = min((_fitted(case, readings) for readings in near), key=lambda one: float(one.missed.mean()))
    left: list[int] = []
    while joints:
        unlike = [k for k in joints if now.misses[case.layout.channels[k][0]] > _BELIEVED]
        looked, left = _afforded(case, sorted(unlike, key=lambda k: -now.misses[case.layout.channels[k][0]]), near)
        best = _first_better(case, model, joints, {k: joints[k] for k in looked}, near, now)
        if best is None:
            break
        zero, then = best
        taken.append((zero, float(np.exp((now.missed - then.missed).mean() / channels))))
        now, near = then, [then.readings]
        del joints[zero.places[0]]
    readings = list(draft.readings)
    for zero, times in taken:
        readings = _with_evidence(zero, times, readings, now.readings)
    measured = len(draft.measurements)
    columns = ", ".join(repr(draft.readings[k].match.column) for k in sorted(left))
    doubts = [f"simulations miss much of {columns}: too many to look for the zeros of all of them"] if left else []
    placed = replace(draft, measurements=tuple(readings[:measured]), commands=tuple(readings[measured:]))
    return placed, doubts


def _afforded(case: Case, joints: list[int], near: Sequence[Readings]) -> tuple[list[int], list[int]]:
    """Joints whose zeros a grid is simulated for, and those for which there is no time."""
    if _costs_little(case, joints, near):
        return joints, []
    count = max(1, _AFFORDED // (_simulated(near[:1]) * case.trial.thinned(_FEWER).steps))
    return joints[:count], joints[count:]


def _costs_little(case: Case, joints: Sequence[int], near: Sequence[Readings]) -> bool:
    """Whether grids of all the joints are simulated with all windows."""
    return len(joints) * _simulated(near) * case.trial.steps <= _AFFORDED


def _simulated(near: Sequence[Readings]) -> int:
    """How often windows are simulated for a joint: with both signs, with and without its set-point, by both cases."""
    return 2 * (4 * len(near) * _GRID + 2 * _FITTED * _FINER)


def _measures(reading: Reading, joint: Joint) -> bool:
    return reading.match.target == f"joint:{joint.name}.position" and len(reading.match.columns) == 1


def _nearest(case: Case, ranking: Ranking | None) -> list[Readings]:
    """The readings with the units and signs that miss least, and with those of the names."""
    asked = questions(case.draft, case.machine)
    if ranking is None:
        return [case.draft.readings]
    best = answered(case.draft.readings, asked, ranking.answers[int(np.argmin(ranking.scores))])
    return [best, *([case.draft.readings] if best != case.draft.readings else [])]


Tried = list[tuple[float, _Zero, Readings]]  # zeros with the readings that have them, and what these miss


@dataclass(frozen=True)
class _Fitted:
    """Readings, the unknowns that fit them (N,), the logarithm of what is missed in each window (W,), and by channel.

    misses: (C,) as of ``Trial.misses``.
    """

    readings: Readings
    theta: FloatArray
    missed: FloatArray
    misses: FloatArray


def _fitted(case: Case, readings: Readings) -> _Fitted:
    assumption = case.assumption(readings)
    left = fit(case.trial, assumption, (0, 1, 2, 4), 3, case.tell, _FIT_AFFORDED)
    late = replace(assumption, delay=left.best)
    nominal, fitted = case.trial.missed([late], case.trial.theta)[0], case.trial.missed([late], left.theta)[0]
    theta, missed = (case.trial.theta, nominal) if nominal.mean() < fitted.mean() else (left.theta, fitted)
    return _Fitted(readings, theta, missed, case.trial.misses([late], theta)[0])


def _first_better(
    case: Case,
    model: mujoco.MjModel,
    joints: dict[int, Joint],
    unlike: dict[int, Joint],
    near: Sequence[Readings],
    now: _Fitted,
) -> tuple[_Zero, _Fitted] | None:
    """The best zero of those named, else of the grids, that is clearly better."""
    cases = [case, replace(case, theta=now.theta)]
    searched = _searched if _costs_little(case, [*unlike], near) else _searched_soon
    for zeros_of, of in ((_named, joints), (searched, unlike)):
        tried: Tried = []
        for n, (k, joint) in enumerate(of.items()):
            case.tell(f"{n} of {len(of)} joints")
            tried += [one for one in zeros_of(cases, model, k, joint, near) if one[0] < now.missed.mean()]
        tried = sorted(tried, key=lambda one: one[0])[:_FITTED]
        after = [(zero, _fitted(case, readings)) for _, zero, readings in tried]
        if not after:
            continue
        zero, then = min(after, key=lambda one: float(one[1].missed.mean()))
        if not zero.why:
            few = case if searched is _searched else replace(case, trial=case.trial.thinned(_FEWER))
            zero, then = _refined(case, few, zero, then)
        better = now.missed - then.missed
        error = float(better.std()) / np.sqrt(len(better))
        if better.mean() > max(_BETTER if zero.why else _FAR_BETTER, _CLEAR * error):
            return zero, then
    return None


def _refined(case: Case, few: Case, zero: _Zero, now: _Fitted) -> tuple[_Zero, _Fitted]:
    """A zero of a grid looked for once more around itself, and the unknowns fitted anew, as long as that is better.

    The grid was simulated with unknowns that had been fitted without it. few: the windows for grids.
    """
    for _ in range(_ROUNDS):
        around = zero.value + zero.unsure * np.linspace(-1, 1, 2 * _FINER - 1)
        zeros = [replace(zero, value=float(value)) for value in around]
        sets: list[Readings] = [one.put(now.readings) for one in zeros]
        best = int(np.argmin(_missed([replace(few, theta=now.theta)], sets)))
        then = _fitted(case, sets[best])
        if not then.missed.mean() < now.missed.mean():
            break
        zero, now = zeros[best], then
    return zero, now


def _missed(cases: Sequence[Case], sets: Sequence[Readings]) -> FloatArray:
    """The logarithm of what is missed with each set of readings (H,), with the unknowns of the better case."""
    assumed = [cases[0].assumption(readings) for readings in sets]
    parts = [assumed[i : i + 32] for i in range(0, len(assumed), 32)]
    trial = cases[0].trial
    each = [np.concatenate([trial.missed(part, case.theta).mean(1) for part in parts]) for case in cases]
    return np.asarray(np.min(each, axis=0))


def _named(cases: Sequence[Case], model: mujoco.MjModel, k: int, joint: Joint, near: Sequence[Readings]) -> Tried:
    """What the model says of where a column may have its zero, with both signs of it."""
    data, own = mujoco.MjData(model), model.joint(joint.name)
    mujoco.mj_kinematics(model, data)
    at, rest = int(own.qposadr[0]), float(model.qpos0[own.qposadr[0]])
    named = {-float(model.key_qpos[i, at]): f"the keyframe {model.key(i).name!r} is at 0" for i in range(model.nkey)}
    named |= {-rest: "the model's ref is at 0"}
    if not joint.hinge:
        height = float(data.xanchor[own.id] @ data.xaxis[own.id]) - rest
        named |= {height: f"where the body {joint.body!r} is in the world"}
    zeros = [_Zero(p, v, why) for v, why in named.items() if abs(v) > _NONE for p in _places(cases[0], k, joint)]
    signed = [_signed(readings, k, sign) for readings in near for sign in (readings[k].sign, turned(readings[k].sign))]
    sets = [(zero, zero.put(readings)) for zero in zeros for readings in signed]
    misses = _missed(cases, [readings for _, readings in sets]).tolist() if sets else []
    best: dict[_Zero, tuple[float, _Zero, Readings]] = {}
    for miss, (zero, readings) in zip(misses, sets, strict=True):
        if zero not in best or miss < best[zero][0]:
            best[zero] = miss, zero, readings
    return list(best.values())


def _searched(cases: Sequence[Case], model: mujoco.MjModel, k: int, joint: Joint, near: Sequence[Readings]) -> Tried:
    """The best zero of a grid that puts the log's motion anywhere in the joint's range, else around its rest."""
    own = model.joint(joint.name)
    reach = np.pi if joint.hinge else float(model.stat.extent)
    low, high = float(model.qpos0[own.qposadr[0]]) - reach, float(model.qpos0[own.qposadr[0]]) + reach
    if model.jnt_limited[own.id]:
        low, high = model.jnt_range[own.id].tolist()
    case = cases[0]
    channel, step = case.layout.channels[k][0], (high - low) / (_GRID - 1)
    usual = float(np.median(np.concatenate([log.observations[:, channel] for log in case.trial.logs])))
    wraps = joint.hinge and not model.jnt_limited[own.id]

    def best(values: FloatArray, places: tuple[int, ...], readings: Readings) -> tuple[float, _Zero, Readings]:
        values = (values + np.pi) % (2 * np.pi) - np.pi if wraps else values
        zeros = [_Zero(places, float(v), "", _UNSURE * step) for v in values]
        sets: list[Readings] = [zero.put(readings) for zero in zeros]
        misses = _missed(cases, sets)
        i = int(np.argmin(misses))
        return float(misses[i]), zeros[i], sets[i]

    coarse: Tried = []
    for readings in (_signed(each, k, sign) for each in near for sign in (each[k].sign, turned(each[k].sign))):
        middle = usual * scale_of(readings[k]) / scale_of(case.draft.readings[k])
        coarse += [best(middle - np.linspace(low, high, _GRID), p, readings) for p in _places(case, k, joint)]
    fine: Tried = []
    for one in sorted(coarse, key=lambda one: one[0])[:_FITTED]:
        for width in (step, 2 * step / (_FINER - 1)):
            one = best(one[1].value + width * np.linspace(-1, 1, _FINER), one[1].places, one[2])
        fine.append(one)
    return fine


def _searched_soon(
    cases: Sequence[Case], model: mujoco.MjModel, k: int, joint: Joint, near: Sequence[Readings]
) -> Tried:
    """The same of few windows, and of the best units alone."""
    few = [replace(case, trial=case.trial.thinned(_FEWER)) for case in cases]
    tried = _searched(few, model, k, joint, near[:1])
    misses = _missed(cases, [readings for _, _, readings in tried]).tolist()
    return [(miss, zero, readings) for miss, (_, zero, readings) in zip(misses, tried, strict=True)]


def _places(case: Case, k: int, joint: Joint) -> list[tuple[int, ...]]:
    """A column alone, and with the set-point of its joint, which a servo counts from the same zero."""
    servos = [f"actuator:{a.name}" for a in case.machine.actuators if a.drive == Drive.POSITION and a.joint == joint]
    follows = [i for i, reading in enumerate(case.draft.readings) if reading.match.target in servos]
    return [(k,), *([(k, *follows)] if follows else [])]


def _signed(readings: Readings, k: int, sign: int) -> Readings:
    return [replace(reading, sign=sign) if i == k else reading for i, reading in enumerate(readings)]


def _with_evidence(zero: _Zero, times: float, readings: Readings, by: Readings) -> list[Reading]:
    """The readings with a zero as the readings ``by`` have it, and what speaks for it."""
    out = list(readings)
    for k in zero.places:
        why = f"zero {by[k].zero:g}, {zero.why}" if zero.why else f"zero {by[k].zero:.3g}, which simulations alone tell"
        evidence = f"{why}: without it, simulated windows miss {times:.2g} times as much"
        doubts = () if zero.why else (evidence,)
        out[k] = replace(
            out[k], zero=by[k].zero, unsure=by[k].unsure, doubts=(*out[k].doubts, *doubts),
            notes=(*out[k].notes, *(() if doubts else (evidence,))),
        )  # fmt: skip
    return out


def absolute_angles(case: Case, model: mujoco.MjModel, ranking: Ranking | None) -> list[str]:
    """What is to be said of columns that simulations follow far better with the angle of the link before taken off.

    Only columns are asked that simulations do not follow well. Units and signs are tried anew for each, since with a
    wrong angle wrong ones may follow it best: of all columns, where these are many of the two and what drives them.

    Args:
        case: the draft and its windows.
        model: as given.
        ranking: its units and signs; None where all are known.
    """
    if ranking is None:
        return []
    draft, machine, layout, doubts = case.draft, case.machine, case.layout, list[str]()
    channel = {r.match.target: layout.channels[k][0] for k, r in enumerate(draft.readings) if layout.channels[k]}
    column, asked = {r.match.target: r.match.column for r in draft.readings}, questions(draft, machine)
    least = int(np.argmin(ranking.scores))
    pairs = [p for p in _chained(model, machine, channel) if ranking.misses[least][channel[p[0]]] > _BELIEVED]
    for k, (own, before) in enumerate(pairs):
        taken_off = replace(layout, minus=((channel[own], channel[before]),))
        part = asked if are_few(asked) else _of_joints(case, asked, (own, before), ranking.answers[least])
        counted = under(case.tell, f"link {k + 1} of {len(pairs)}")
        tried = ranked(replace(case, layout=taken_off, tell=counted), part)
        better = float(ranking.scores[least] - tried.scores.min())
        if better > _FAR_BETTER:
            doubts.append(
                f"{column[own]!r} looks like the angle of a link against the world, not of a joint: with "
                f"{column[before]!r} taken off, simulations miss {np.exp(better / len(case.trial.given.observed)):.2g} "
                "times less; log the difference, or write it as a column of its own"
            )
    return doubts


def _of_joints(
    case: Case, asked: Sequence[Question], targets: Sequence[str], answers: Sequence[Answer]
) -> list[Question]:
    """The questions, of which those are open that are of joints' columns or of what drives these."""
    joints = {f"actuator:{a.name}": f"joint:{a.joint.name}.position" for a in case.machine.actuators if a.joint}
    of = [{joints.get(t := case.draft.readings[k].match.target, t) for k in q.readings} for q in asked]
    return [
        question if own & {*targets} else replace(question, answers=(answer,))
        for question, own, answer in zip(asked, of, answers, strict=True)
    ]


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
