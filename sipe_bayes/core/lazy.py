"""Packages whose public names are imported when they are first used."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable
from functools import cache


def exports(package: str) -> tuple[Callable[[str], object], Callable[[], list[str]]]:
    """``__getattr__`` and ``__dir__`` of a package, whose public names are the imports of its first ``if`` block.

    Type checkers and completion read these imports as they stand, under ``if TYPE_CHECKING``.
    """
    module = sys.modules[package]

    @cache
    def sources() -> dict[str, str]:
        """Name -> module that has it."""
        import ast  # by its first use: a package's import is to be instant

        text = module.__loader__.get_source(package)  # type: ignore[union-attr]
        block = next(node for node in ast.parse(text).body if isinstance(node, ast.If))
        imports = (node for node in block.body if isinstance(node, ast.ImportFrom))
        return {alias.name: str(node.module) for node in imports for alias in node.names}

    def get(name: str) -> object:
        if name == "__all__":
            return [*({"__version__"} & vars(module).keys()), *sources()]
        if name.startswith("_") or name not in sources():
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        source = importlib.import_module(sources()[name])
        if not hasattr(source, name):
            importlib.import_module(f"{source.__name__}.{name}")
        setattr(module, name, getattr(source, name))
        return vars(module)[name]

    return get, lambda: [*get("__all__")]  # type: ignore[misc]
