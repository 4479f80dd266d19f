"""Changes of files: of their bytes, and of what they hold, so that no checksum hides what is behind it."""

from __future__ import annotations

import copy
import json
import random
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

Arrays = dict[str, np.ndarray]
Read = Callable[[], object]
Change = Callable[[random.Random], Read]
Target = Callable[[Path], Change]

DEEP = "lists in lists: "  # a text that stands for them, so that nothing here is nested
CLAIMS = (b"\xff", b"\x00", b"\x7f", b"\x80", b"9", b"-", b"\n", b'"', b"[", b"{", b"<", b"&")
NASTY: tuple[Any, ...] = (
    *(None, True, False, "", " ", "x" * 3000, "\x00", "\ud7ff", "é\n\t", "nan", "../../etc/passwd", "/dev/null"),
    *(0, 1, -1, 2, 7, 10**6, 10**9, 2**31, 2**63, 10**30, -(10**30), 10**400),
    *(0.0, -0.0, 1e-300, 5e-324, 1e308, -1e308, float("inf"), float("-inf"), float("nan"), 0.5, 1.5),
    *([], {}, [[]], [None], {"": None}, [1, "a"], [0.0] * 50),
)
"""What stands in place of a value."""


def written(text: str) -> bytes:
    """A text of JSON or TOML as a file has it: with lone surrogates, and what stands for lists in lists written out."""
    deep = re.sub(f'"{DEEP}([0-9]+)"', lambda word: "[" * int(word[1]) + "]" * int(word[1]), text)
    return deep.encode("utf-8", "surrogatepass")


def of_bytes(data: bytes, chance: random.Random) -> bytes:
    """Cut, with bytes set to what is often a claim, with a piece twice, without one, or with noise."""
    some = bytearray(data)
    for _ in range(chance.choice([1, 1, 1, 2, 8])):
        if not some:
            break
        at, size = chance.randrange(len(some)), chance.choice([1, 1, 2, 4, 8, 64])
        how = chance.choice(["cut", "set", "set", "noise", "number", "repeat", "drop"])
        if how == "cut":
            del some[at:]
        elif how == "set":
            some[at : at + size] = chance.choice(CLAIMS) * size
        elif how == "noise":
            some[at : at + size] = chance.randbytes(size)
        elif how == "number":
            width = chance.choice([2, 4, 8])
            some[at : at + width] = (2 ** (8 * width - chance.choice([1, 2]))).to_bytes(width, "little")
        elif how == "repeat":
            some[at:at] = some[at : at + size] * chance.choice([1, 2, 50])
        else:
            del some[at : at + size]
    return bytes(some)


def of_text(text: str, chance: random.Random) -> str:
    """As bytes, or a word in place of another."""
    words = text.split(" ")
    if chance.random() < 0.5:
        return of_bytes(text.encode(), chance).decode("utf-8", "surrogateescape")
    words[chance.randrange(len(words))] = str(chance.choice(NASTY))
    return " ".join(words)


def of_data(plain: Any, chance: random.Random) -> Any:
    """Data of JSON or TOML with a value that is another, gone, twice, or nested."""
    plain = copy.deepcopy(plain)
    for _ in range(chance.choice([1, 1, 2])):
        places = list(_places(plain))
        if not places:
            return chance.choice(NASTY)
        inside, key = chance.choice(places)
        how = chance.random()
        if how < 0.6:
            inside[key] = copy.deepcopy(chance.choice(NASTY))
        elif how < 0.75:
            del inside[key]
        elif how < 0.8:
            inside[key] = f"{DEEP}{chance.choice([3, 200, 2000, 100_000])}"
        elif how < 0.9:
            other, at = chance.choice(places)
            inside[key] = copy.deepcopy(other[at]) if _has(other, at) else None
        elif isinstance(inside, list):
            inside.insert(key, copy.deepcopy(inside[key]))
        else:
            inside[f"{key}x"] = inside.pop(key)
    return plain


def _has(inside: Any, key: Any) -> bool:
    return key in inside if isinstance(inside, dict) else key < len(inside)


def _places(plain: Any) -> Any:
    keys = list(plain) if isinstance(plain, dict) else range(len(plain)) if isinstance(plain, list) else ()
    for key in keys:
        yield plain, key
        yield from _places(plain[key])


def of_arrays(arrays: Mapping[str, np.ndarray], chance: random.Random) -> Arrays:
    """Arrays of which one has another shape, type or numbers, another name, or is gone."""
    some = {name: np.array(array) for name, array in arrays.items()}
    for _ in range(chance.choice([1, 1, 2])):
        if not some:
            break
        name = chance.choice(sorted(some))
        array = some[name]
        how = chance.choice(["drop", "rename", "shape", "shape", "type", "numbers", "numbers", "numbers"])
        if how == "drop":
            del some[name]
        elif how == "rename":
            some[f"{name}x"] = some.pop(name)
        elif how == "shape":
            some[name] = _shaped(array, chance)
        elif how == "type" and array.dtype.kind in "fiub":
            with np.errstate(all="ignore"):
                some[name] = np.nan_to_num(array.astype(float)).astype(
                    chance.choice(["f2", "f4", "f8", "i1", "i8", "u1", "?"])
                )
        elif array.size and array.dtype.kind in "fiub":
            with np.errstate(all="ignore"):
                flat = array.reshape(-1)
                values = [np.nan, np.inf, -np.inf, 1e308, -1.0, 0.0, 1e-320] if array.dtype.kind == "f" else [-1, 0, 77]
                start = chance.randrange(flat.size)
                flat[start : start + chance.choice([1, 1, flat.size])] = np.array(chance.choice(values)).astype(
                    array.dtype
                )
    return some


def _shaped(array: np.ndarray, chance: random.Random) -> np.ndarray:
    shapes = [array[None], array.reshape(-1), np.concatenate([array.reshape(-1)] * 2)]
    if array.ndim:
        shapes += [array[:0], array[:-1], array[:1], array.T]
    if array.ndim and array.size:
        shapes += [np.repeat(array, 2, axis=-1), array[..., 0]]
    return np.ascontiguousarray(chance.choice(shapes))


def text_of(plain: Any) -> bytes:
    """JSON, lone surrogates and all."""
    return written(json.dumps(plain))


def changed_json(plain: Any, chance: random.Random) -> bytes:
    """The data changed, or its text."""
    if chance.random() < 0.25:
        return of_bytes(text_of(plain), chance)
    return text_of(of_data(plain, chance))
