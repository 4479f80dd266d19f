"""TOML written, which Python itself only reads."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping


def to_toml(data: Mapping[str, object]) -> str:
    """A TOML document of plain data: tables of text, numbers, flags, lists and tables, keys in the order given.

    Args:
        data: the whole document. A list of tables becomes ``[[key]]``, with tables in it on one line each.

    Raises:
        TypeError: for what TOML has no word for.
    """
    plain = {k: v for k, v in data.items() if not isinstance(v, Mapping) and not _is_tables(v)}
    parts = [_lines(plain)] if plain else []
    for key, value in data.items():
        if isinstance(value, Mapping):
            parts.append(f"[{_key(key)}]\n{_lines(value)}")
        elif _is_tables(value):
            assert isinstance(value, list | tuple)
            parts += [f"[[{_key(key)}]]\n{_lines(row)}" for row in value]
    return "\n".join(parts)


def _is_tables(value: object) -> bool:
    return isinstance(value, list | tuple) and bool(value) and all(isinstance(row, Mapping) for row in value)


def _lines(table: Mapping[str, object]) -> str:
    return "".join(f"{_key(key)} = {_value(value)}\n" for key, value in table.items())


def _key(key: str) -> str:
    bare = key and all(c.isascii() and (c.isalnum() or c in "-_") for c in key)
    return key if bare else _text(key)


def _text(value: str) -> str:
    # a basic string takes what JSON takes, but no bare delete character
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")


def _value(value: object) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return _text(value)
    if isinstance(value, int):
        return str(value)
    if isinstance(value, float):
        return repr(float(value)) if math.isfinite(value) else {"inf": "inf", "-inf": "-inf"}.get(str(value), "nan")
    if isinstance(value, list | tuple):
        return f"[{', '.join(_value(item) for item in value)}]"
    if isinstance(value, Mapping):
        return f"{{{', '.join(f'{_key(k)} = {_value(v)}' for k, v in value.items())}}}"
    raise TypeError(f"TOML has no word for {value!r}")
