"""Examples, studies and benches follow the package: every name that they import is there."""

import ast
import importlib
import importlib.util
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
SCRIPTS = sorted([*(ROOT / "examples").rglob("*.py"), *(ROOT / "tests" / "bench").glob("*.py")])


@pytest.mark.parametrize("path", SCRIPTS, ids=lambda path: path.relative_to(ROOT).as_posix())
def test_imported_names_exist(path: Path) -> None:
    """Also those that a function imports when it runs; optional packages that are not installed aside."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "sipe_bayes":
            module = importlib.import_module(node.module or "")
            for name in (alias.name for alias in node.names):
                inner = hasattr(module, "__path__") and importlib.util.find_spec(f"{node.module}.{name}")
                assert hasattr(module, name) or inner, f"{path}:{node.lineno}: {node.module} has no {name}"
        elif isinstance(node, ast.Import):
            for name in (alias.name for alias in node.names if alias.name.split(".")[0] == "sipe_bayes"):
                importlib.import_module(name)
