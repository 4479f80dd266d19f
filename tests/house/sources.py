"""The package's files, and what each of them imports."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

ROOMS = (
    *("core", "envs", "simulation", "models", "posterior", "likelihood", "datasets", "inference", "structure"),
    *("rl", "diagnostics", "report", "calibration", "benchmark", "cli"),
)


@dataclass(frozen=True)
class Module:
    """A Python file: ``path`` relative to the checkout, ``name`` as it is imported."""

    path: str
    name: str
    text: str

    @cached_property
    def tree(self) -> ast.Module:
        return ast.parse(self.text)

    @cached_property
    def lines(self) -> list[str]:
        return self.text.splitlines()

    @property
    def room(self) -> str | None:
        """The folder directly under the package, None for the package itself."""
        parts = self.name.split(".")
        return parts[1] if len(parts) > 1 else None

    @cached_property
    def nodes(self) -> tuple[ast.AST, ...]:
        return tuple(ast.walk(self.tree))


@dataclass(frozen=True)
class House:
    """The Python files under a folder of a checkout, by the names under which they are imported."""

    root: Path
    folder: str = "sipe_bayes"

    @cached_property
    def modules(self) -> dict[str, Module]:
        modules = {}
        for file in sorted((self.root / self.folder).rglob("*.py")):
            path = file.relative_to(self.root).as_posix()
            name = path[: -len(".py")].replace("/", ".").removesuffix(".__init__")
            modules[name] = Module(path, name, file.read_text(encoding="utf-8"))
        return modules

    def imports(self, module: Module) -> Iterator[tuple[str, str, str]]:
        """(module of this house, name taken from it or ``""``, what the file calls it) for each import in a file.

        A text that names one of its modules (``"sipe_bayes.core.units"``, ``"sipe_bayes.core.units:UNITS"``) is an
        import of it too: somebody hands it to importlib.
        """
        for node in module.nodes:
            if isinstance(node, ast.ImportFrom) and node.module and node.module.split(".")[0] == self.folder:
                for alias in node.names:
                    whole, local = f"{node.module}.{alias.name}", alias.asname or alias.name
                    yield (whole, "", local) if whole in self.modules else (node.module, alias.name, local)
            elif isinstance(node, ast.Import):
                for alias in node.names:
                    if alias.name.split(".")[0] == self.folder:
                        yield alias.name, "", alias.asname or ""
            elif isinstance(node, ast.Constant) and isinstance(node.value, str):
                named = re.fullmatch(rf"({self.folder}(?:\.\w+)+)(?::\w+)?", node.value)
                if named and named[1] in self.modules:
                    yield named[1], "", ""

    @cached_property
    def edges(self) -> dict[str, set[str]]:
        """Module -> modules that it imports."""
        return {
            name: {target for target, _, _ in self.imports(module) if target in self.modules} - {name}
            for name, module in self.modules.items()
        }


def upward_imports(house: House) -> list[str]:
    """Imports of a room that comes later, of a room that is none, and of the package itself by one of its rooms."""
    order = {room: k for k, room in enumerate(ROOMS)}
    if "core" not in {module.room for module in house.modules.values()}:
        return ["not these rooms"]
    upward = []
    for name, targets in house.edges.items():
        room = house.modules[name].room
        for target in sorted(targets) if room else ():
            other = house.modules[target].room
            if other != room and (other is None or order.get(other, len(ROOMS)) > order.get(room or "", -1)):
                upward.append(f"{name} imports {target}")
    return upward


def circles(house: House) -> list[list[str]]:
    """Groups of modules each of which reaches every other one of its group by imports."""
    reached = {name: _reached(house.edges, name) for name in house.edges}
    groups = {tuple(sorted(m for m in reached[name] if name in reached[m])) for name in house.edges}
    return sorted(list(group) for group in groups if len(group) > 1)


def _reached(edges: dict[str, set[str]], start: str) -> set[str]:
    reached: set[str] = set()
    waiting = [start]
    while waiting:
        following = edges[waiting.pop()] - reached
        reached |= following
        waiting += following
    return reached


def top_entries(house: House) -> list[str]:
    """What lies directly in the package's folder, caches aside."""
    return sorted(p.name for p in (house.root / house.folder).iterdir() if p.name != "__pycache__")
