"""What the house measures like: sizes, imports, names. As a command it prints the table for any checkout.

    python tests/house/measures.py [FOLDER]      one line per measure
    python tests/house/measures.py --offenders   what is over a limit, and by how much
    python tests/house/measures.py --tighten     lowers allowance.json and totals.json to what is left; nothing is ever
                                                 added to them

How each is counted: a function's body is what follows its docstring, to its last line. A *named number* is a name in
capitals (with or without a leading underscore) bound in a module's header to an expression that holds a number and no
string. A public signature is that of a function, method or dataclass no part of whose name begins with an underscore
(``__init__`` and other special methods count); an alias of a type that holds ``Any`` counts as ``Any``. Two places are
alike where six or more consecutive lines of code are the same but for indentation, blank lines, comments, docstrings
and imports. Imports inside functions and under ``TYPE_CHECKING`` count like all others.
"""

from __future__ import annotations

import ast
import json
import re
import sys
from collections import Counter, defaultdict
from collections.abc import Iterator
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2]))  # where this is run as a command
from tests.house.sources import House, Module, circles, top_entries, upward_imports

ROOT = Path(__file__).parents[2]
ALLOWANCE, TOTALS = Path(__file__).with_name("allowance.json"), Path(__file__).with_name("totals.json")
BODY_LINES, COLUMNS, ALIKE_LINES = 60, 120, 6
DIALECT = "found told said there lanes refusing read_off poll louder twin glimpse sound lacking".split()  # noqa: SIM905
Function = ast.FunctionDef | ast.AsyncFunctionDef
Offenders = dict[str, int]


# What is over a limit


def modules_per_folder(house: House) -> Counter[str]:
    paths = (Path(module.path) for module in house.modules.values())
    return Counter(path.parent.as_posix() for path in paths if path.name != "__init__.py")


def long_functions(house: House) -> Offenders:
    offenders = {}
    for module in house.modules.values():
        for name, function in functions(module.tree):
            body = function.body[1:] if ast.get_docstring(function) and len(function.body) > 1 else function.body
            size = (body[-1].end_lineno or 0) - body[0].lineno + 1
            if size > BODY_LINES:
                offenders[f"{module.path}:{name}"] = size
    return offenders


def functions(tree: ast.AST, prefix: str = "") -> Iterator[tuple[str, Function]]:
    """Every function and method with its qualified name, inner ones too."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, Function):
            yield prefix + node.name, node
            yield from functions(node, f"{prefix}{node.name}.")
        elif isinstance(node, ast.ClassDef):
            yield from functions(node, f"{prefix}{node.name}.")
        else:
            yield from functions(node, prefix)


def wide_lines(house: House) -> Offenders:
    """Lines over 120 columns in each file that has some."""
    counts = {m.path: sum(len(line) > COLUMNS for line in m.lines) for m in house.modules.values()}
    return {path: count for path, count in counts.items() if count}


def private_imports(house: House) -> Offenders:
    """Names with one leading underscore that a file takes from another one, by import or as its attribute."""
    offenders: Counter[str] = Counter()
    for module in house.modules.values():
        imports = [one for one in house.imports(module) if one[0] != module.name]
        taken = [(target, name or target.split(".")[-1]) for target, name, _ in imports]
        others = {local: target for target, name, local in imports if not name}
        for node in module.nodes:
            if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id in others:
                taken.append((others[node.value.id], node.attr))
        offenders.update(f"{module.path} imports {target}.{name}" for target, name in taken if _is_private(name))
    return dict(offenders)


def _is_private(name: str) -> bool:
    return name.startswith("_") and not name.startswith("__")


def any_in_signatures(house: House) -> Offenders:
    """Public functions, methods and dataclasses with ``Any`` among their types, and how often."""
    offenders, vague = {}, vague_aliases(house)
    for module in house.modules.values():
        names = (
            {"Any"} | vague[module.name] | {local for target, n, local in house.imports(module) if n in vague[target]}
        )
        for name, types in _public_annotations(module.tree):
            if count := sum(_mentions(one, names) for one in types):
                offenders[f"{module.path}:{name}"] = count
    return offenders


def vague_aliases(house: House) -> dict[str, set[str]]:
    """Names in a module's header that stand for types with ``Any`` in them."""
    vague: dict[str, set[str]] = defaultdict(set)
    for module in house.modules.values():
        for node in module.tree.body:
            if isinstance(node, ast.Assign) and isinstance(node.value, ast.Subscript | ast.BinOp | ast.Name):
                names = {target.id for target in node.targets if isinstance(target, ast.Name)}
                vague[module.name] |= names if _mentions(node.value, {"Any"} | vague[module.name]) else set()
    return vague


def _mentions(annotation: ast.expr, names: set[str]) -> bool:
    for node in ast.walk(annotation):
        if isinstance(node, ast.Name) and node.id in names:
            return True
        if (
            isinstance(node, ast.Constant)
            and isinstance(node.value, str)
            and names & set(re.findall(r"\w+", node.value))
        ):
            return True
    return False


def _public_annotations(tree: ast.AST, prefix: str = "") -> Iterator[tuple[str, list[ast.expr]]]:
    """Each public callable's name and the annotations of its arguments, its result or its fields."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, Function) and not _is_private(node.name):
            a = node.args
            arguments = [*a.posonlyargs, *a.args, *a.kwonlyargs, *(x for x in (a.vararg, a.kwarg) if x)]
            annotations = [x.annotation for x in arguments] + [node.returns]
            yield prefix + node.name, [x for x in annotations if x is not None]
        elif isinstance(node, ast.ClassDef) and not _is_private(node.name):
            if any("dataclass" in ast.unparse(d) for d in node.decorator_list):
                yield (
                    prefix + node.name,
                    [
                        n.annotation
                        for n in node.body
                        if isinstance(n, ast.AnnAssign) and isinstance(n.target, ast.Name) and n.target.id[0] != "_"
                    ],
                )
            yield from _public_annotations(node, f"{prefix}{node.name}.")
        elif isinstance(node, ast.If | ast.Try):
            yield from _public_annotations(node, prefix)


# What is counted


def named_numbers(house: House) -> Counter[str]:
    """How many in each file."""
    counts: Counter[str] = Counter()
    for module in house.modules.values():
        for node in module.tree.body:
            if isinstance(node, ast.Assign | ast.AnnAssign) and node.value is not None:
                targets = node.targets if isinstance(node, ast.Assign) else [node.target]
                counts[module.path] += sum(_numbers(target, node.value) for target in targets)
    return +counts


def _numbers(target: ast.expr, value: ast.expr) -> int:
    if isinstance(target, ast.Tuple):
        values = value.elts if isinstance(value, ast.Tuple) else [value] * len(target.elts)
        return sum(_numbers(t, v) for t, v in zip(target.elts, values, strict=True))
    if not isinstance(target, ast.Name) or not re.fullmatch(r"_?[A-Z][A-Z0-9_]*", target.id):
        return 0
    constants = [type(n.value) for n in ast.walk(value) if isinstance(n, ast.Constant)]
    return int(str not in constants and bool({int, float} & set(constants)))


def docstring_lines(house: House) -> int:
    return sum(
        node.body[0].end_lineno - node.body[0].lineno + 1  # type: ignore[operator]
        for module in house.modules.values()
        for node in module.nodes
        if isinstance(node, ast.Module | ast.ClassDef | Function) and ast.get_docstring(node, clean=False) is not None
    )


def dialect(house: House) -> Counter[str]:
    """Bindings of words that are not the field's: variables, arguments, attributes, functions, classes, modules."""
    bound: Counter[str] = Counter()
    for module in house.modules.values():
        bound[module.name.split(".")[-1]] += 1
        for node in module.nodes:
            if isinstance(node, ast.Name | ast.Attribute) and isinstance(node.ctx, ast.Store):
                bound[node.id if isinstance(node, ast.Name) else node.attr] += 1
            elif isinstance(node, Function | ast.ClassDef):
                bound[node.name] += 1
            elif isinstance(node, ast.arg):
                bound[node.arg] += 1
    return Counter({word: bound[word] for word in DIALECT if bound[word]})


def alike(house: House) -> int:
    """Pairs of places that share six or more lines of code."""
    starts: dict[tuple[str, ...], list[tuple[str, int]]] = defaultdict(list)
    codes = {name: _code(module) for name, module in house.modules.items()}
    for name, code in codes.items():
        for k in range(len(code) - ALIKE_LINES + 1):
            starts[tuple(code[k : k + ALIKE_LINES])].append((name, k))
    pairs = {(a, b) for places in starts.values() for i, a in enumerate(places) for b in places[i + 1 :]}
    return sum(((a, i - 1), (b, j - 1)) not in pairs for (a, i), (b, j) in pairs)  # a longer place counts once


def _code(module: Module) -> list[str]:
    """Lines of code without indentation; no docstrings, imports, comments, blank lines or lone brackets."""
    left_out: set[int] = set()
    for node in module.nodes:
        docstring = isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
        if docstring or isinstance(node, ast.Import | ast.ImportFrom):
            left_out |= set(range(node.lineno, (node.end_lineno or 0) + 1))
    kept = (line.strip() for k, line in enumerate(module.lines, 1) if k not in left_out)
    return [line for line in kept if line.strip("()[]{},") and not line.startswith("#")]


# Tables


LIMITS = {
    "upward imports": lambda house: dict.fromkeys(upward_imports(house), 1),
    "circles": lambda house: {" - ".join(group): len(group) for group in circles(house)},
    "lines of a function's body": long_functions,
    "lines over 120 columns": wide_lines,
    "private names imported": private_imports,
    "Any in public signatures": any_in_signatures,
}


def offenders(house: House) -> dict[str, Offenders]:
    """What the tests hold, by name: who offends, and by how much."""
    return {name: dict(sorted(measure(house).items())) for name, measure in LIMITS.items()}


def of_tests(root: Path) -> dict[str, Offenders]:
    """Of the tests: imports of one test file by another."""
    house = House(root, "tests")
    crossing = {
        f"{name} imports {target}": 1
        for name, targets in house.edges.items()
        for target in targets
        if target.split(".")[-1].startswith("test_")
    }
    return {"test files imported": crossing}


def totals(root: Path) -> dict[str, int]:
    """What the project is made of, in numbers that only fall: lines, files, options, diagnostics, named numbers."""
    house, tests = House(root), House(root, "tests")
    codes = [
        node
        for module in house.modules.values()
        for node in module.nodes
        if module.path.startswith("sipe_bayes/core/") and isinstance(node, ast.ClassDef) and node.name == "Code"
    ]
    return {
        "package lines": sum(len(module.lines) for module in house.modules.values()),
        "package files": len(house.modules),
        "test lines": sum(len(module.lines) for module in tests.modules.values()),
        "option fields": option_fields(house),
        "diagnostics": sum(isinstance(line, ast.Assign) for code in codes for line in code.body),
        "named numbers": named_numbers(house).total(),
    }


def option_fields(house: House) -> int:
    """Fields of dataclasses that derive from ``Options``."""
    return sum(
        isinstance(line, ast.AnnAssign) and "ClassVar" not in ast.unparse(line.annotation)
        for module in house.modules.values()
        for node in module.nodes
        if isinstance(node, ast.ClassDef) and any(ast.unparse(base) == "Options" for base in node.bases)
        for line in node.body
    )


def table(house: House) -> dict[str, str]:
    """Every measure in one line."""
    over, folders, words = offenders(house), modules_per_folder(house), dialect(house)
    lines = sum(len(module.lines) for module in house.modules.values())
    numbers = named_numbers(house)
    rooms = Counter(path.split("/")[1] for path in numbers.elements())
    laplace = [name for name in folders if name.endswith("/laplace")]
    return {
        "package lines": f"{lines:,}",
        "modules": f"{len(house.modules)} (in folders: {listed(folders.most_common(5))})",
        "top-level entries": str(len(top_entries(house))),
        "modules of laplace": str(folders[laplace[0]]) if laplace else "no folder of its own",
        "docstring share": f"{docstring_lines(house) / lines:.1%}",
        "named numbers": f"{numbers.total()} ({listed(rooms.most_common())})",
        "pairs of places alike": str(alike(house)),
        "dialect": f"{words.total()} ({listed(words.most_common())})",
        **{f"over: {name}": f"{len(one)} ({sum(one.values())})" for name, one in over.items()},
    }


def listed(counts: list[tuple[str, int]]) -> str:
    return ", ".join(f"{name} {count}" for name, count in counts)


def tighten() -> None:
    """Lower every allowance to what is left of it."""
    allowed = json.loads(ALLOWANCE.read_text(encoding="utf-8"))
    today = {**offenders(House(ROOT)), **of_tests(ROOT)}
    kept = {
        limit: {key: min(size, today[limit][key]) for key, size in sizes.items() if key in today[limit]}
        for limit, sizes in allowed.items()
    }
    ALLOWANCE.write_text(json.dumps(kept, indent=1) + "\n", encoding="utf-8")
    most = json.loads(TOTALS.read_text(encoding="utf-8"))
    lower = {name: min(number, most[name]) for name, number in totals(ROOT).items()}
    TOTALS.write_text(json.dumps(lower, indent=1) + "\n", encoding="utf-8")


def main(arguments: list[str]) -> None:
    if "--tighten" in arguments:
        tighten()
    elif "--offenders" in arguments:
        print(json.dumps({**offenders(House(ROOT)), **of_tests(ROOT)}, indent=1))
    else:
        for name, value in table(House(Path(arguments[0]) if arguments else ROOT)).items():
            print(f"{name:34} {value}")


if __name__ == "__main__":
    main(sys.argv[1:])
