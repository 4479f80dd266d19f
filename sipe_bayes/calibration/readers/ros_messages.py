"""Numbers of a ROS 2 message by the names of its fields, decoded as its definition says.

The definition travels with the bag, so it is only looked up here and never compiled, and a length that a message claims
is held against the bytes that it has. The encoding is plain CDR: each number aligned to its size, strings and sequences
with their length before them. Object Management Group, Common Object Request Broker Architecture 3.3 (2012), part 2,
section 9.3, https://www.omg.org/spec/CORBA/3.3
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from typing import Any

from sipe_bayes.calibration.readers.base import WIDEST

Fields = Sequence[tuple[str, tuple[int, object]]]
"""Name and description of each field, as rosbags' ``Typesdict`` has them."""

_NUMBERS = {
    **{"bool": "?", "byte": "B", "octet": "B", "char": "B", "int8": "b", "uint8": "B", "int16": "h", "uint16": "H"},
    **{"int32": "i", "uint32": "I", "int64": "q", "uint64": "Q", "float32": "f", "float64": "d"},
}
_BASE, _NAME, _ARRAY = 1, 2, 3  # what a description is; a sequence is the fourth
_MOST = 20_000  # fields of one message, which definitions of definitions could multiply without end
_TIMES = ("builtin_interfaces/msg/Time", "builtin_interfaces/msg/Duration")


class Message:
    """A message's numbers.

    Entries of an array are called as the list of names before it says, as in ``position[elbow]`` of joint states, else
    they are numbered. Times are seconds. Longer arrays than ``WIDEST`` and words are left out.

    Args:
        types: fields of each type that a message may have.
        kind: the message's type.
        data: its bytes.

    Raises:
        ValueError: for bytes that are no such message.
        KeyError: for a type that is not among them.
    """

    def __init__(self, types: Mapping[str, Fields], kind: str, data: bytes) -> None:
        if len(data) < 4 or data[0] or data[1] > 1:
            raise ValueError("a message is not encoded as plain CDR")
        self.numbers: dict[str, float] = {}
        self.stamp = 0  # ns, of the header
        self._types, self._order = types, "<" if data[1] else ">"
        self._data, self._position, self._fields = memoryview(data)[4:], 0, 0
        self._structure(kind, "")

    def _structure(self, kind: str, name: str) -> None:
        if kind in _TIMES:
            seconds, rest = self._number("int32"), self._number("uint32")
            if name == "header.stamp":
                self.stamp = int(seconds) * 10**9 + int(rest)
            self.numbers[name] = seconds + 1e-9 * rest
            return
        labels: Sequence[str] = ()
        for field, (what, detail) in self._types[kind]:
            word = f"{name}.{field}" if name else field
            if what in (_BASE, _NAME):
                self._one(word, what, detail)
            else:
                texts = self._many(word, what, detail, labels)
                labels = texts if texts and field.endswith(("name", "names")) else labels

    def _one(self, word: str, what: int, detail: Any) -> str:
        """One field or entry; returns the text of a string."""
        self._fields += 1
        if self._fields > _MOST:
            raise ValueError(f"a message has more than {_MOST} fields")
        if what == _NAME:
            self._structure(str(detail), word)
        elif detail[0] == "string":
            return self._text()
        else:
            self.numbers[word] = self._number(detail[0])
        return ""

    def _many(self, word: str, what: int, detail: Any, labels: Sequence[str]) -> list[str]:
        """An array; returns the texts of one of strings."""
        (inner, of), claimed = detail
        count = self._room(claimed if what == _ARRAY else int(self._number("uint32")))
        names = labels if len(set(labels)) == len(labels) == count else range(count)
        letter = _NUMBERS.get(of[0]) if inner == _BASE else None
        if letter is not None:
            values = self._take(letter, count) if count else ()
            if count <= WIDEST:
                self.numbers.update((f"{word}[{label}]", value) for label, value in zip(names, values, strict=True))
            return []
        return [self._one(f"{word}[{label}]", inner, of) for label in names]

    def _number(self, base: str) -> float:
        (value,) = self._take(_NUMBERS[base], 1)
        return float(value) if base.startswith("float") else int(value)

    def _take(self, letter: str, count: int) -> tuple[float, ...]:
        size = struct.calcsize(letter)
        self._position += -self._position % size
        start, self._position = self._position, self._position + self._room(size * count)
        return struct.unpack_from(f"{self._order}{count}{letter}", self._data, start)

    def _text(self) -> str:
        length = self._room(int(self._number("uint32")))
        start, self._position = self._position, self._position + length
        return bytes(self._data[start : self._position]).rstrip(b"\0").decode()

    def _room(self, claimed: int) -> int:
        """What is claimed, if there are as many bytes left."""
        left = len(self._data) - self._position
        if claimed > left:
            raise ValueError(f"a message claims {claimed} bytes or entries and has {left} bytes left")
        return claimed
