"""The only list of extensions, and how one of the user's own is found."""

from __future__ import annotations

import importlib
import importlib.util
import sys
from pathlib import Path

from sipe_bayes.core.validation import nearest_name
from sipe_bayes.structure.extension import KINDS, Extension
from sipe_bayes.structure.extensions.table import ROWS

EXTENSIONS = tuple(ROWS)
"""Names."""


def get_extension(name: str) -> Extension:
    """One of the registry's, or the user's own: ``package.module:Class`` or ``path/to/file.py:Class``.

    Raises:
        ValueError: for a name that is neither; one line with the remedy.
    """
    if name in ROWS:
        return ROWS[name]
    module, _, kind = name.rpartition(":")
    if not module:
        hint = nearest_name(name, EXTENSIONS) or f"; known are {', '.join(EXTENSIONS)}"
        raise ValueError(f"structure: no extension {name!r}{hint}; one of your own is package.module:Class")
    return _made(module, kind, name)


def _made(module: str, kind: str, name: str) -> Extension:
    try:
        loaded = _from_file(Path(module)) if module.endswith(".py") else importlib.import_module(module)
        made = getattr(loaded, kind)()
    except Exception as error:  # the user's own code may raise anything
        reason = " ".join(f"{type(error).__name__}: {error}".split())
        raise ValueError(f"structure: extension {name!r} cannot be loaded ({reason}); correct it") from None
    if not isinstance(made, Extension):
        raise ValueError(f"structure: {name!r} is no Extension; make it a subclass of sipe_bayes.structure.Extension")
    missing = [word for word in ("name", "kind", "reference") if not isinstance(getattr(made, word, None), str)]
    if missing or made.kind not in KINDS:
        remedy = f"give it a {missing[0]}" if missing else f"its kind is one of {', '.join(KINDS)}, got {made.kind!r}"
        raise ValueError(f"structure: extension {name!r} is not complete; {remedy}")
    return made


def _from_file(path: Path) -> object:
    spec = importlib.util.spec_from_file_location(f"sipe_extension_{path.stem}", path)
    if spec is None or spec.loader is None or not path.is_file():
        raise FileNotFoundError(f"no file {path}")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module
