"""What the name of a column says: the kind of quantity, its unit, its number, its axis.

Words, units and patterns stand in ``column_names.toml``, a section for each dialect; a user's file extends them.
"""

from __future__ import annotations

import difflib
import functools
import os
import re
import tomllib
from collections import defaultdict
from collections.abc import Collection
from dataclasses import dataclass
from enum import StrEnum, auto
from pathlib import Path

from pydantic import BaseModel, TypeAdapter, ValidationError, ValidationInfo, model_validator

from sipe_bayes.calibration.config_fields import ConfigError, nearest, one_line, problem
from sipe_bayes.core.files import read_text
from sipe_bayes.core.units import UNITS


class Kind(StrEnum):
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
    """What a column's name says."""

    column: str
    kind: Kind
    words: tuple[str, ...]  # of the name, without numbers, units and words of the quantity
    number: int | None  # the last one in it
    stem: str  # the name without that number; columns of one stem are a family
    unit: str = ""  # unit word; "" where it names none
    angular: bool | None = None  # whether it speaks of an angle; None where it says nothing
    last: str = ""  # word before the unit
    axis: str = ""  # "x", "y", "z" or "w"
    vector: str = ""  # the name without that axis; columns of one are its components
    measured: bool = False  # whether it says so, as in tau_measured
    commanded: bool = False  # likewise, as in tau_cmd


_UNITS = (*UNITS, "bar", "mbar", "Pa", "kPa", "MPa")


class Dialect(BaseModel, extra="forbid"):
    """A section of ``column_names.toml``, which says what its keys are."""

    rules: list[tuple[Kind, str]] = []
    words: dict[str, str] = {}
    units: dict[str, str] = {}
    patterns: dict[str, str] = {}

    @model_validator(mode="after")
    def _check(self, info: ValidationInfo) -> Dialect:
        known = info.context or self.words
        for field, given, legal in (("words", self.words, known), ("units", self.units, _UNITS)):
            for key in {*given} - {*legal}:
                raise problem(f"unknown; {nearest(key, legal)}", field, key)
        for pattern, value in self.patterns.items():
            kind, unit, _ = _read_value(value)
            if unit not in (_UNITS if kind is None else ("", *_UNITS)):
                wrong = f"expected a kind, a unit or both, got {value!r}; {nearest(value.partition(' ')[0], Kind)}"
                raise problem(wrong, "patterns", pattern)
        return self


def _read_value(value: str) -> tuple[Kind | None, str, bool]:
    """The kind and unit that a pattern stands for, and whether it is measured."""
    kind, _, unit = value.removesuffix(" measured").partition(" ")
    return (Kind(kind), unit, value.endswith(" measured")) if kind in [*Kind] else (None, value, False)


@dataclass(frozen=True)
class Vocabulary:
    """All sections together: words with their kinds, spellings with their units, patterns and rules in their order."""

    kinds: dict[str, set[str]]
    units: dict[str, str]
    patterns: list[tuple[re.Pattern[str], Kind | None, str, bool]]
    rules: list[tuple[Kind, str]]

    def of(self, *kinds: str) -> set[str]:
        """The words of some kinds."""
        return {word for word, own in self.kinds.items() if own.intersection(kinds)}


@functools.cache
def read_vocabulary() -> Vocabulary:
    """The package's sections, and before them the user's; raises ConfigError for a file that cannot be used."""
    package = Path(__file__).with_suffix(".toml")
    user = Path(os.environ.get("XDG_CONFIG_HOME") or Path.home() / ".config") / "sipe_bayes" / package.name
    given = _read_dialects(package)
    own = _read_dialects(user, {kind for dialect in given for kind in dialect.words}) if user.is_file() else []
    kinds: dict[str, set[str]] = {}
    for dialects in (given, own):
        new: dict[str, set[str]] = defaultdict(set)
        for kind, words in [row for dialect in dialects for row in dialect.words.items()]:
            for word in words.split():
                new[word].add(kind)
        kinds |= new
    spelt = [row for dialect in (*given, *own) for row in dialect.units.items()]
    return Vocabulary(
        kinds,
        {word: unit for unit, words in spelt for word in words.split()},
        [(_compile(text), *_read_value(value)) for part in (*own, *given) for text, value in part.patterns.items()],
        [rule for dialect in (*own, *given) for rule in dialect.rules],
    )


def _read_dialects(path: Path, known: Collection[str] = ()) -> list[Dialect]:
    text = read_text(path, "names of columns", "give a TOML file in UTF-8", ConfigError)
    try:
        return [*TypeAdapter(dict[str, Dialect]).validate_python(tomllib.loads(text), context=known).values()]
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{path}: not valid TOML: {error}; correct that line") from None
    except ValidationError as error:
        raise ConfigError(f"{path}: {one_line(error.errors()[0])}") from None


def _compile(pattern: str) -> re.Pattern[str]:
    """A pattern without capitals is of any letters."""
    text = re.escape(pattern).replace(r"\*", ".*").replace(r"\{joint\}", "(?P<joint>.+)")
    return re.compile(text, re.IGNORECASE if pattern == pattern.lower() else 0)


_GREEK = str.maketrans(
    {"θ": "theta", "τ": "tau", "ω": "omega", "φ": "phi", "ϕ": "phi", "α": "alpha", "β": "beta", "ψ": "psi", "°": "deg"}
)
_PIECE = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+")
_BRACKETED = re.compile(r"[\[(]\s*([^\])\d]*?[/^]?[^\])]*?)\s*[\])]")


def read_name(column: str, own: Collection[str] = ()) -> Label:
    """What a name says; own: words that name something of the model, whatever quantity they are elsewhere."""
    patterns = ((p.fullmatch(column), kind, unit, said) for p, kind, unit, said in read_vocabulary().patterns)
    found, kind, fixed, measured = next((row for row in patterns if row[0]), (None, None, "", False))
    unit, words, numbers = _split_unit(column.translate(_GREEK), own)
    unit = fixed or unit
    named, words = [word for word in words if word in own], [word for word in words if word not in own]
    flags, rest = _find_flags(words, unit)
    kind = kind or next((kind for kind, rule in read_vocabulary().rules if _holds(rule, flags)), Kind.UNKNOWN)
    unit = "" if "gauge" in flags and kind != Kind.OTHER else unit
    axis, vector = _find_axis(column, words)
    turned = {"quat", "quaternion", "orientation", "rotation", f"q{axis}"}
    if axis and kind in (Kind.POSITION, Kind.UNKNOWN) and turned.intersection(words):
        kind = Kind.QUATERNION
    turns = bool(flags & {"in_angle", "in_angular_velocity", "gyro"})
    slides = bool(flags & {"in_length", "in_velocity", "in_force"}) or ("length" in flags and not turns)
    joint = found.groupdict().get("joint") if found else None
    return Label(
        column,
        kind,
        (*rest, *named) if joint is None else tuple(_find_flags(split_words(joint), "")[1] or split_words(joint)),
        numbers[-1] if numbers else None,
        re.sub(r"\d+(?=\D*$)", "#", column) if numbers else column,
        unit,
        False if slides else True if turns or "angle" in flags else None,
        words[-1] if words else "",
        axis,
        vector,
        measured or "measured" in flags,
        "driven" in flags,
    )


def pieces_of(name: str) -> list[str]:
    """Its words and numbers, in small letters."""
    return [piece.lower() for piece in _PIECE.findall(name)]


def split_words(name: str) -> list[str]:
    """Its words, in small letters."""
    return [piece for piece in pieces_of(name) if not piece.isdigit()]


def spell_unit(pieces: list[str]) -> str:
    """The unit that some words of a name spell; "" for none."""
    pieces, units = [piece for piece in pieces if piece != "per"], read_vocabulary().units
    if len(pieces) == 2 and pieces[1] in ("s", "sec", "second"):
        rate = f"{units.get(pieces[0])}/s"
        return rate if rate in UNITS else ""
    return units.get("_".join(pieces), "")


def _split_unit(plain: str, own: Collection[str]) -> tuple[str, list[str], list[int]]:
    """The unit that a name says, and its words and numbers without that."""
    unit = ""
    for match in _BRACKETED.finditer(plain):  # "angle [deg]", "speed (rad/s)"
        if word := spell_unit(re.findall(r"[a-z%]+", match[1].lower())):
            unit, plain = word, plain.replace(match[0], " ")
    unit = unit or ("%" if plain.rstrip().endswith("%") else "")  # valve_%
    words, numbers = split_words(plain), [int(piece) for piece in pieces_of(plain) if piece.isdigit()]
    last = re.split(r"[^A-Za-z]+", plain.rstrip("0123456789_ "))[-1]
    spelt = [(len(_PIECE.findall(last)), [last.lower()])]  # mA, mNm, kN
    for length, pieces in spelt * (spelt[0][0] > 1) + [(n, words[-n:]) for n in (3, 2, 1)]:  # rad_per_s, rad_s, rad
        if unit or len(words) <= length or ({*words[-length:]} <= {*own} and words.count(words[-1]) == 1):
            continue  # position_A1, unlike A1_current_A
        if len(pieces) == len(pieces[0]) == 1 and re.search(rf"[^A-Za-z]{pieces[0]}\d+$", plain, re.IGNORECASE):
            continue  # motor.m1
        if word := spell_unit(pieces):
            unit, words = word, words[:-length]
    return unit, words, numbers


_MARKS = {"format", "gripper", "pulsed", "registers", "short", "side"}  # kinds of words that are no quantities
_WHERE = {"angle", "length", "place"}


def _find_flags(words: list[str], unit: str) -> tuple[set[str], list[str]]:
    """What the rules of ``column_names.toml`` ask for, and the words that say nothing of a quantity."""
    known, flags, rest = read_vocabulary().kinds, set[str](), list[str]()
    for word in words:
        kinds = known.get(word, set()) - _MARKS
        if not kinds and (whole := _find_derived(word)):
            kinds = {"speed"} | (known[whole] & {"angle", "length"})
        flags |= kinds
        if not kinds and "format" not in known.get(word, ()):
            rest.append(word)
    if unit:
        dimension = UNITS[unit].dimension if unit in UNITS else "mass"
        flags |= {f"in_{dimension.replace(' ', '_')}", "quantity"} - ({"quantity"} if unit in ("us", "%") else set())
        flags |= {"gauge"} if dimension == "mass" else {unit}
    if words:
        each = [known.get(word, set()) for word in words]
        flags |= {f"last_{kind}" for kind in each[-1]} | {f"all_{kind}" for kind in set.intersection(*each)}
    if flags & _WHERE and not {"current", "in_current"} <= flags:
        flags |= {"where"} | ({"speed"} if words[0] == "d" else set()) | ({"derived"} if "d" in words[1:] else set())
    flags |= {"speed"} if "dot" in words else set()
    flags |= {"driven"} if flags & {"command", "desired"} else set()
    spoken = {word for word in words if known.get(word, set()) & {*_WHERE, "command"}} - {"p", "a"}
    return flags | ({"spoken"} if spoken else set()), rest


def _holds(rule: str, flags: set[str]) -> bool:
    return all((token.lstrip("!") in flags) != token.startswith("!") for token in rule.split())


def _find_derived(word: str) -> str:
    """The position whose derivative a word is by a mark: dq, qd, thetadot; "" for none."""
    known = read_vocabulary().kinds
    inner = (word.removeprefix("d"), *(word.removesuffix(end) for end in ("dot", "d", "p")))
    return next((one for one in inner if one != word and known.get(one, set()) & _WHERE), "")


def _find_axis(column: str, words: list[str]) -> tuple[str, str]:
    """The axis of a component of a vector or quaternion, as in pos_x, qw, px, and the name without it."""
    last = words[-1] if words else ""
    if not re.fullmatch("[qprvwga]?[xyzw]", last):
        return "", ""
    end = [piece.end() for piece in _PIECE.finditer(column) if piece[0].lower() == last][-1]
    return last[-1], column[: end - 1] + column[end:]


def alike(words: Collection[str], *names: str) -> float:
    """How much of a name of the model stands in a column's words, from 0 to 1, of the likest; spelt shorter counts."""
    out = [0.0]
    for own in map(split_words, names):
        if own and words:
            out.append(sum(max(_compare(a, b) for b in words) for a in own) / len(own))
    return max(out)


@functools.cache
def _compare(a: str, b: str) -> float:
    short, long = sorted((a, b), key=len)
    if a == b:
        return 1.0
    if len(short) >= 2 and long.startswith(short):
        return 0.8
    letters = iter(long)
    if len(short) >= 3 and long[0] == short[0] and all(letter in letters for letter in short):
        return 0.7  # shldr, shoulder
    ratio = difflib.SequenceMatcher(None, a, b).ratio()
    return ratio if ratio >= 0.8 else 0.0
