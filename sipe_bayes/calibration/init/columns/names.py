"""What the name of a column says: the kind of quantity, its unit, its number, its axis."""

from __future__ import annotations

import difflib
import re
from collections.abc import Collection
from dataclasses import dataclass
from enum import Enum, auto

from sipe_bayes.calibration.init.columns.vocabulary import (
    ABOUT,
    ACCELERATIONS,
    ALONG,
    ANGLES,
    CELLS,
    COMMANDS,
    CURRENTS,
    DESIRED,
    DUTIES,
    EPISODES,
    GREEK,
    GYROS,
    LENGTHS,
    MEASURED,
    OF_NO_JOINT,
    OTHERS,
    PLACES,
    POSITIONS,
    PULSED,
    RATES,
    SPEEDS,
    SUPPLIES,
    TIMES,
    TORQUES,
    TURNS,
    UNITS,
    VOLTAGES,
)


class Kind(Enum):
    """What a column may be, by its name."""

    TIME = auto()
    EPISODE = auto()
    POSITION = auto()
    VELOCITY = auto()
    ACCELERATION = auto()
    COMMAND = auto()
    SETPOINT = auto()  # of a position
    SPEED_SETPOINT = auto()
    TORQUE = auto()  # or force
    CURRENT = auto()
    VOLTAGE = auto()
    DUTY = auto()  # share of the supply
    SUPPLY = auto()  # the voltage of it
    QUATERNION = auto()
    OTHER = auto()  # which no joint has: temperatures, flags
    UNKNOWN = auto()


@dataclass(frozen=True)
class Label:
    """What a column's name says.

    Args:
        column: the name.
        kind: of quantity.
        words: of the name, without numbers, units and words of the quantity.
        number: the last one in it.
        stem: the name without that number; columns of one stem are a family.
        unit: unit word; "" where it names none.
        angular: whether it speaks of an angle; None where it says nothing.
        axis: "x", "y", "z" or "w".
        vector: the name without that axis; columns of one are its components.
        measured: whether it says so, as in ``tau_measured``.
        commanded: whether it says so, as in ``tau_cmd``.
    """

    column: str
    kind: Kind
    words: tuple[str, ...]
    number: int | None
    stem: str
    unit: str = ""
    angular: bool | None = None
    axis: str = ""
    vector: str = ""
    measured: bool = False
    commanded: bool = False


_PIECE = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+")
_GERMAN_DEGREES = re.compile(r"Grad(?![a-z])")
_BRACKETED = re.compile(r"[\[(]\s*([^\])\d]*?[/^]?[^\])]*?)\s*[\])]")


def read_name(column: str, own: Collection[str] = ()) -> Label:
    """What a name says; own: words that name something of the model, whatever quantity they are elsewhere."""
    plain = _GERMAN_DEGREES.sub("deg", column.translate(GREEK))
    unit = ""
    for match in _BRACKETED.finditer(plain):  # "angle [deg]", "speed (rad/s)"
        if word := _unit_of([piece.lower() for piece in re.findall(r"[A-Za-z%]+", match[1])]):
            unit, plain = word, plain.replace(match[0], " ")
    unit = unit or ("%" if plain.rstrip().endswith("%") else "")  # valve_%
    pieces = pieces_of(plain)
    numbers = [int(piece) for piece in pieces if piece.isdigit()]
    words = [piece for piece in pieces if not piece.isdigit()]
    last = re.split(r"[^A-Za-z]+", plain.rstrip("0123456789_ "))[-1]
    parts = len(_PIECE.findall(last))
    if not unit and 1 < parts < len(words) and last.lower() in UNITS:  # mA, mNm, kN
        unit, words = UNITS[last.lower()], words[:-parts]
    if not unit and words[-1:] == ["grad"] and ANGLES & {*words[:-1]}:  # German for degrees
        unit, words = "deg", words[:-1]
    if not unit and len(words) > 1:
        for length in (3, 2, 1):  # rad_per_s, rad_s, rad
            if len(words) > length and not _called(words, length, own) and (word := _unit_of(words[-length:])):
                unit, words = word, words[:-length]
                break
    if len(words) == 1 and words[0] in ("us", "ms", "ns"):
        return Label(column, Kind.TIME, (), None, column, words[0])
    named, words = [word for word in words if word in own], [word for word in words if word not in own]
    flags, rest = _flags(words)
    rest += named
    flags |= {"length"} if words and words[-1] in ALONG | {"px", "py", "pz"} else set()
    flags |= {"angle"} if words and words[-1] in ABOUT else set()
    kind = _kind(flags, unit, words)
    unit = "" if unit in OF_NO_JOINT.values() and kind != Kind.OTHER else unit
    axis = _axis(words)
    if axis and kind in (Kind.POSITION, Kind.UNKNOWN) and _is_quaternion(words):
        kind = Kind.QUATERNION
    turns = unit in ("rad", "deg", "rev", "mrad", "rpm", "rad/s", "deg/s", "rev/s") or bool(GYROS & {*words})
    slides = unit in ("m", "mm", "cm", "um", "m/s", "mm/s", "N") or (bool(flags & {"length"}) and not turns)
    angular = False if slides else True if turns or flags & {"angle"} else None
    number = numbers[-1] if numbers else None
    stem = column if number is None else re.sub(r"\d+(?=\D*$)", "#", column)
    vector = _without_axis(column, words[-1]) if axis else ""
    says = bool(flags & {"measured"}), bool(flags & {"command", "desired"})
    return Label(column, kind, tuple(rest), number, stem, unit, angular, axis, vector, *says)


def _called(words: list[str], length: int, own: Collection[str]) -> bool:
    """Whether the last words are what a joint is called, and not a unit behind that: position_A1, A1_current_A."""
    return {*words[-length:]} <= {*own} and words.count(words[-1]) == 1


def pieces_of(name: str) -> list[str]:
    """Its words and numbers, in small letters."""
    return [piece.lower() for piece in _PIECE.findall(name)]


def _unit_of(pieces: list[str]) -> str:
    """The unit of the last words of a name."""
    pieces = [piece for piece in pieces if piece != "per"]
    if len(pieces) == 2 and pieces[1] in ("s", "sec", "second"):
        return RATES.get(UNITS.get(pieces[0], ""), "")
    if pieces in (["n", "m"], ["newton", "meters"]):
        return "N m"
    if pieces == ["%"]:
        return "%"
    return UNITS.get(pieces[0], "") if len(pieces) == 1 else ""


def _flags(words: list[str]) -> tuple[set[str], list[str]]:
    """Which kinds of words a name has, and the words that are none of these."""
    table = {
        "angle": ANGLES, "length": LENGTHS, "place": PLACES, "speed": SPEEDS, "acceleration": ACCELERATIONS,
        "torque": TORQUES, "command": COMMANDS, "desired": DESIRED, "measured": MEASURED, "current": CURRENTS,
        "voltage": VOLTAGES, "duty": DUTIES, "supply": SUPPLIES, "time": TIMES, "episode": EPISODES,
        "other": OTHERS | TURNS,
    }  # fmt: skip
    flags: set[str] = set()
    rest = []
    for word in words:
        own = {flag for flag, members in table.items() if word in members}
        derived, whole = _derivative_of(word)
        if not own and derived:
            own = {"speed"} | ({"angle"} & _flags([whole])[0]) | ({"length"} & _flags([whole])[0])
        flags |= own
        if not own and word not in ("d", "dot", "joint", "joints", "state", "states", "data", "sensor", "log"):
            rest.append(word)
    if "dot" in words or (words and words[0] == "d" and flags & {"angle", "length", "place"}):
        flags.add("speed")
    if "d" in words[1:] and flags & {"angle", "length", "place"}:
        flags.add("d")  # q_d: desired, or derived
    return flags, rest


def _derivative_of(word: str) -> tuple[bool, str]:
    """Whether a word is a position's with a mark of a derivative, and that position's: dq, qd, thetadot."""
    for before, after in (("d", ""), ("", "dot"), ("", "d"), ("", "p")):
        inner = word[len(before) : len(word) - len(after)]
        if word.startswith(before) and word.endswith(after) and inner in POSITIONS and inner != word:
            return True, inner
    return False, word


def _kind(flags: set[str], unit: str, words: list[str]) -> Kind:
    says = {*words} & (POSITIONS | COMMANDS)
    if unit in OF_NO_JOINT.values() and says <= {"p", "a"} and not flags & {"torque", "desired"}:
        return Kind.OTHER
    current = "current" in flags and (unit in ("A", "mA") or words[-2:] == ["present", "current"])
    place = bool(flags & {"angle", "length", "place"}) and not current
    drive = _driven(flags, place)
    if words and words[-1] in ("time", "stamp", "timestamp"):
        return Kind.TIME
    if CELLS & {*words} and "load" not in words:
        return Kind.OTHER
    if "supply" in flags and not place and not flags & {"current", "torque", "other"} and unit not in ("A", "mA", "%"):
        return Kind.SUPPLY
    of_another = place or flags & {"speed", "current", "voltage", "other"} or unit not in ("", "us", "%")
    if ("duty" in flags and not of_another) or (unit == "us" and words and {*words} <= PULSED):
        return Kind.DUTY
    if drive is not None:
        return drive
    if "episode" in flags and not place and not flags & {"speed", "torque"}:
        return Kind.EPISODE
    if "time" in flags and not place and not flags & {"speed", "torque", "command", "desired"}:
        return Kind.TIME
    if flags & {"acceleration"}:
        return Kind.ACCELERATION
    for flag, kind in (("torque", Kind.TORQUE), ("voltage", Kind.VOLTAGE)):
        if flag in flags:
            return kind
    if "speed" in flags and not (words == ["v"] and unit):
        return Kind.VELOCITY
    if "current" in flags and not place:
        return Kind.CURRENT
    if "other" in flags:
        return Kind.OTHER
    if place:
        return Kind.UNKNOWN if "d" in flags else Kind.POSITION
    by_unit = {**dict.fromkeys(("s", "ms", "us", "ns"), Kind.TIME), "N m": Kind.TORQUE, "mN m": Kind.TORQUE}
    by_unit |= {"rad": Kind.POSITION, "deg": Kind.POSITION, "mm": Kind.POSITION, "rpm": Kind.VELOCITY}
    by_unit |= {"rad/s": Kind.VELOCITY, "deg/s": Kind.VELOCITY, "V": Kind.VOLTAGE, "A": Kind.CURRENT, "N": Kind.TORQUE}
    by_unit |= {"m/s": Kind.VELOCITY, "mm/s": Kind.VELOCITY, "m": Kind.POSITION, "cm": Kind.POSITION}
    by_unit |= {"kN": Kind.TORQUE, "mN": Kind.TORQUE, "mA": Kind.CURRENT}
    return by_unit.get(unit, Kind.OTHER if "measured" in flags and not words else Kind.UNKNOWN)


def _driven(flags: set[str], place: bool) -> Kind | None:
    """The kind of a command or a set-point; None for what is neither."""
    if not flags & {"command", "desired"}:
        return None
    for flag, kind in (("torque", Kind.TORQUE), ("voltage", Kind.VOLTAGE), ("acceleration", Kind.OTHER)):
        if flag in flags:
            return kind
    if "speed" in flags:
        return Kind.SPEED_SETPOINT
    if place:
        return Kind.SETPOINT
    if "current" in flags:
        return Kind.CURRENT
    return Kind.SETPOINT if "desired" in flags else Kind.COMMAND


def _axis(words: list[str]) -> str:
    """The axis of a vector's or quaternion's component: pos_x, qw, px."""
    last = words[-1] if words else ""
    if last in ("x", "y", "z", "w"):
        return last
    return last[-1] if len(last) == 2 and last[-1] in "xyzw" and last[0] in "qprvwga" else ""


def _without_axis(column: str, last: str) -> str:
    """The name without the axis that its last word ends with, whatever unit comes after it."""
    piece = [piece for piece in _PIECE.finditer(column) if piece[0].lower() == last][-1]
    return column[: piece.end() - 1] + column[piece.end() :]


def _is_quaternion(words: list[str]) -> bool:
    last = words[-1]
    return last[0] == "q" or bool({"quat", "quaternion", "orientation", "rotation"} & set(words))


def alike(words: tuple[str, ...], name: str) -> float:
    """How much of a name of the model stands in a column's words, from 0 to 1; spelt shorter counts too."""
    own = [piece for piece in pieces_of(name) if not piece.isdigit()]
    if not own or not words:
        return 0.0
    return sum(max(_similar(mine, word) for word in words) for mine in own) / len(own)


def _similar(a: str, b: str) -> float:
    if a == b:
        return 1.0
    short, long = sorted((a, b), key=len)
    if len(short) >= 2 and long.startswith(short):
        return 0.8
    if len(short) >= 3 and long[0] == short[0] and _in_order(short, long):
        return 0.7  # shldr, shoulder
    ratio = difflib.SequenceMatcher(None, a, b).ratio()
    return ratio if ratio >= 0.8 else 0.0


def _in_order(short: str, long: str) -> bool:
    letters = iter(long)
    return all(letter in letters for letter in short)


def is_exactly(label: Label, name: str) -> bool:
    """Whether a column is called as something of the model, but for words of its quantity and of the log's format."""
    own = pieces_of(name)
    numbers = {label.number} if label.number is not None else set[int]()
    return (
        bool(own)
        and {*own} <= {*pieces_of(label.column)}
        and {*label.words} <= {*own}
        and numbers <= {int(piece) for piece in own if piece.isdigit()}
    )


def number_of(name: str) -> int | None:
    """The last number in a name of the model."""
    numbers = re.findall(r"\d+", name)
    return int(numbers[-1]) if numbers else None


def _speaks(stem: str, *words: str) -> bool:
    return any(word in stem.lower() for word in words)


def _ends(stem: str, letter: str) -> bool:
    """Whether a component's name, without its axis and unit, ends with a letter."""
    pieces = pieces_of(stem)
    units = [piece == "per" or piece.isdigit() or bool(_unit_of([piece])) for piece in pieces]
    while len(pieces) > 1 and pieces[-1] != letter and units[len(pieces) - 1]:
        pieces.pop()
    return pieces[-1:] == [letter]


def is_gyro(label: Label, stem: str) -> bool:
    """Whether a component of a vector with this name is a gyro's."""
    return label.kind == Kind.VELOCITY and (_speaks(stem, "gyro", "omega", "ang") or _ends(stem, "g"))


def is_accelerometer(label: Label, stem: str) -> bool:
    """Whether it is an accelerometer's."""
    return label.kind == Kind.ACCELERATION and (_speaks(stem, "acc", "linear") or _ends(stem, "a"))


def is_turn(label: Label, stem: str, alone: bool = False) -> bool:
    """Whether it is a quaternion's; alone: q[0] to q[3] of a machine without joints are one too."""
    spelt = _speaks(stem, "quat", "orientation") or (alone and pieces_of(stem)[-1:] == ["q"])
    return label.kind == Kind.QUATERNION or (label.number is not None and spelt)


def is_spin(label: Label, stem: str) -> bool:
    """Whether it is an angular velocity's."""
    if label.kind != Kind.VELOCITY:
        return False
    if label.unit.startswith(("rad", "deg", "rev", "rpm")) or label.unit in ("m", "mm", "cm", "m/s", "mm/s", "cm/s"):
        return not label.unit.startswith(("m", "cm"))
    if _speaks(stem, "ang", "omega", "gyro"):
        return True
    if ABOUT & {*pieces_of(label.column)}:
        return not _speaks(stem, "lin")
    return bool({"w", "g"} & {*pieces_of(stem)}) and not _speaks(stem, "vel", "lin")  # beside these `w` is the frame


def two_ways(label: Label, target: str) -> str:
    """Why the velocity of a body that a component's name was taken for may be another one; "" where it is clear."""
    pieces = {*pieces_of(label.column)}
    if label.kind != Kind.VELOCITY or _speaks(label.vector, "ang", "omega"):
        return ""
    if {"gx", "gy", "gz"} & pieces:
        return "a gyro tells it in the body's own axes: if it is one, give the model a <gyro>"
    glued, linear = bool(ABOUT & pieces), _speaks(label.vector, "lin")
    if label.unit or not (linear or _speaks(label.vector, "vel")) or not (glued or ("w" in pieces and not linear)):
        return ""
    other = "linear" if target.endswith("angular_velocity") else "angular"
    return f"or are they its {other} velocity, since `w` is the world as well as a rate?"
