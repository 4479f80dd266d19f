"""Units and signs of joints' positions by rate gyros, which are in SI or nearly: by kinematics, without simulations.

A gyro's scale may be off by some percent, so that units which are as near to one another stay open. A gyro whose unit
nothing names is read in rad/s and deg/s, of which the units of the positions are to tell; where both do, simulations
choose between the positions' units, and the gyro's follows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import mujoco
import numpy as np

from sipe_bayes.calibration.init.draft import Draft, Reading, Scale
from sipe_bayes.calibration.init.draft import unit_words as words_of
from sipe_bayes.calibration.init.kinematics.gyros import Gyro, Turned, hinges_of
from sipe_bayes.calibration.init.machine import Machine
from sipe_bayes.calibration.init.readings import counts_of
from sipe_bayes.calibration.init.windows import Source, loaded
from sipe_bayes.core.units import find_unit, unit_words

_SCALE = 0.05  # by which a gyro may be off, relative
_EXACT = 0.01  # relative standard error, up to which a factor is believed
_EXPLAINED = 0.8  # share of the rates' variance, from which the gyro is where the model has it
_WORSE = 4.0  # times what the better unit of the gyro leaves, beyond which another one is none
_SMALL = 1e-3  # share that is not explained, up to which two units explain alike
_TILTED = 0.8  # rad, a zero beyond which axes may be turned round


@dataclass(frozen=True)
class Rates:
    """What a gyro says of positions where its columns are in a unit.

    Args:
        gyro: its target.
        unit: of its columns.
        sizes: rad, what each position's column counts in, by its target.
        signs: of the same.
        scales: the units that are as large, the likeliest first, by target; none where no usual one is.
        left: share of the rates' variance that positions do not explain.
    """

    gyro: str
    unit: str
    sizes: dict[str, float]
    signs: dict[str, int]
    scales: dict[str, tuple[Scale, ...]]
    left: float

    @property
    def agrees(self) -> bool:
        """Whether each position has a usual unit."""
        return all(self.scales.values())


def rates_of(
    draft: Draft, model: mujoco.MjModel, machine: Machine, sources: Sequence[Source], folder: Path
) -> list[Rates]:
    """What gyros say of positions that turn them, in each unit that their columns may have; nothing where none does."""
    readings = {r.match.target: r for r in draft.measurements}
    gyros = [name for name, kind in machine.sensors if kind == "gyro" and f"sensor:{name}" in readings]
    out = []
    for name in gyros:
        hinges = hinges_of(model, name) or []
        targets = [f"joint:{model.joint(hinge).name}.position" for hinge in hinges]
        if not targets or any(target not in readings for target in targets):
            continue
        own, members = readings[f"sensor:{name}"], [readings[target] for target in targets]
        part = replace(draft, measurements=(*members, own), commands=())
        gyro = Gyro(model, name, hinges, loaded(part, sources, folder))
        out += _agreeing([_read_in(word, gyro, own, members, machine) for word in _words(own)])
    return out


def _words(gyro: Reading) -> tuple[str, ...]:
    """The units that a gyro's columns may have."""
    named = gyro.match.label.unit
    return (named,) if named in unit_words("angular velocity") else ("rad/s", "deg/s")


def _read_in(word: str, gyro: Gyro, reading: Reading, members: Sequence[Reading], machine: Machine) -> Rates:
    """What a gyro's reading says of positions where it is in a unit."""
    options = [_options(member, machine) for member in members]
    rows = {tuple(_size(own[min(i, len(own) - 1)]) for own in options) for i in range(max(map(len, options)))}
    now = np.array([_of(member) * member.sign for member in members])
    unit = find_unit(word).factor / find_unit(reading.unit).factor
    turned = gyro.turned([np.array(row) / now for row in sorted(rows)], unit)
    signed = {
        member.match.target: (float(size), own)
        for member, own, size, exact in zip(members, options, turned.factors * now, _exact(turned), strict=True)
        if exact
    }
    straight = np.abs(turned.zeros).max() < _TILTED
    return Rates(
        reading.match.target,
        word,
        {target: abs(size) for target, (size, _) in signed.items()},
        {target: int(np.sign(size)) for target, (size, _) in signed.items() if straight},
        {target: tuple(s for s in own if _near(_size(s), abs(size))) for target, (size, own) in signed.items()},
        1 - turned.share,
    )


def _exact(turned: Turned) -> list[bool]:
    """Which factors are believed."""
    if turned.share < _EXPLAINED:
        return [False] * len(turned.errors)
    return [bool(error < _EXACT) for error in turned.errors]


def _agreeing(tried: list[Rates]) -> list[Rates]:
    """Of a gyro's units those that explain its rates, and of these those with usual units of positions, if any."""
    tried = [rates for rates in tried if rates.sizes]
    least = min((rates.left for rates in tried), default=0.0)
    tried = [rates for rates in tried if rates.left <= max(_WORSE * least, _SMALL)]
    return [rates for rates in tried if rates.agrees] or tried


def _options(reading: Reading, machine: Machine) -> tuple[Scale, ...]:
    """What a column may count in, the likeliest first."""
    own = Scale(reading.unit, reading.factor)
    if reading.scales:
        return counts_of(reading.scales)
    named = reading.match.label.unit or reading.factor != 1
    return (own,) if named else tuple(Scale(word) for word in words_of(reading, machine))


def _size(scale: Scale) -> float:
    """SI, one of what a column counts in."""
    return scale.factor * find_unit(scale.unit).factor


def _near(size: float, other: float) -> bool:
    return bool(abs(np.log(size / other)) < _SCALE)


def with_rates(draft: Draft, rates: Sequence[Rates]) -> Draft:
    """The draft with positions in the units and with the signs that gyros leave.

    Columns that are alike have one unit: those of joints that turn no gyro have that of the others.
    """
    readings = {r.match.target: r for r in draft.measurements}
    out = []
    for reading in draft.measurements:
        target = reading.match.target
        direct = [one for one in rates if target in one.sizes]
        like = [_left(one, readings[other]) for one in rates for other in one.sizes if _alike(readings[other], reading)]
        scales = [_left(one, reading) for one in direct] if direct else like
        left = tuple(dict.fromkeys(scale for some in scales for scale in some))
        if left and not reading.match.label.unit:
            reading = replace(reading, unit=left[0].unit, factor=left[0].factor, scales=left)
        signs = {one.signs[target] for one in direct if target in one.signs}
        if len(signs) == 1:
            sign = signs.pop()
            reading = replace(reading, sign=sign, turning=sign)
        out.append(reading)
    return replace(draft, measurements=tuple(out))


def _left(rates: Rates, reading: Reading) -> tuple[Scale, ...]:
    """The likeliest of the units that a gyro leaves to a position; of counts, where none is usual, what it says."""
    target = reading.match.target
    if rates.scales[target]:
        return rates.scales[target][:1]
    return (_measured(rates.sizes[target]),) if reading.scales else ()


def _measured(size: float) -> Scale:
    """Counts a turn to four digits."""
    return Scale("rev", 1 / float(f"{2 * np.pi / size:.4g}"))


def _alike(one: Reading, other: Reading) -> bool:
    """Whether columns have one unit, which no name says."""
    hinges = all(r.match.target.startswith("joint:") and r.match.target.endswith(".position") for r in (one, other))
    unnamed = not one.match.label.unit and not other.match.label.unit
    return hinges and unnamed and (one.unit, one.factor, one.scales) == (other.unit, other.factor, other.scales)


def with_evidence_of(draft: Draft, rates: Sequence[Rates]) -> Draft:
    """The draft, whose positions' units are decided, with what gyros say of them, and the gyros' own units."""
    readings = {r.match.target: r for r in draft.measurements}
    for gyro in dict.fromkeys(one.gyro for one in rates):
        tried = [one for one in rates if one.gyro == gyro]
        chosen = min(
            tried, key=lambda one: max(abs(np.log(_of(readings[at]) / size)) for at, size in one.sizes.items())
        )
        own = readings[gyro]
        name = repr(own.match.column)
        for target, size in chosen.sizes.items():
            reading = _compared(readings[target], size, chosen.scales[target], name)
            readings[target] = _as_it_turns(reading, chosen.signs.get(target, reading.sign), name)
        if own.match.label.unit != chosen.unit:
            columns = " and ".join(repr(r.match.column) for r in draft.measurements if r.match.target in chosen.sizes)
            note = f"{chosen.unit}: as fast as {columns}"
            readings[gyro] = replace(own, unit=chosen.unit, notes=(note, *own.notes))
    return replace(draft, measurements=tuple(readings[r.match.target] for r in draft.measurements))


def _of(reading: Reading) -> float:
    return _size(Scale(reading.unit, reading.factor))


def _as_it_turns(reading: Reading, sign: int, gyro: str) -> Reading:
    """A position with a doubt where simulations have decided against the sign that a gyro speaks for."""
    if sign == reading.sign:
        return reading
    doubt = f"the rates of {gyro} speak for sign {sign}, simulations against it: look at how the gyro is mounted"
    return replace(reading, doubts=(*reading.doubts, doubt), instead=(*reading.instead, f"sign = {sign}"))


def _compared(reading: Reading, size: float, scales: Sequence[Scale], gyro: str) -> Reading:
    """A position with what a gyro says of its unit, and which others it can not tell from it."""
    now = Scale(reading.unit, reading.factor)
    says = f"the rates of {gyro} are {_size(now) / size:.3g} times its slope"
    if now.factor != 1:
        says = f"the rates of {gyro} say {float(f'{2 * np.pi / size:.3g}'):g}"
    others = [scale for scale in scales if scale != now]
    doubt, off = "", f"a gyro may be off by {100 * _SCALE:.0f} %"
    if not scales and _near(_size(now), size):
        doubt = f"{now}, as {says}: no usual number, and {off}; look at the encoder and at what is geared to it"
    elif now not in scales:
        doubt = f"{now}, but {says}: one of the two has another unit, or the gyro is not where the model has it"
    elif others:
        names = ", ".join(f"{1 / other.factor:g}" if other.factor != 1 else other.unit for other in others)
        doubt = f"{now} or {names}? {says}, and {off}"
    if not doubt:
        return replace(reading, notes=(*reading.notes, f"{now}: {says}"))
    lines = reading.lines_of(now)
    instead = tuple(line for other in others for line in reading.lines_of(other) if line not in lines)
    return replace(reading, doubts=(*reading.doubts, doubt), instead=(*reading.instead, *instead))
