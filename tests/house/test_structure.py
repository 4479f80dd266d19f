"""The house stays in order: what is over a limit today is listed in allowance.json, which only ever shrinks."""

import json
from pathlib import Path

import pytest

from tests.house.measures import ALLOWANCE, LIMITS, ROOT, TOTALS, of_tests, offenders, table, totals
from tests.house.sources import ROOMS, House, top_entries

ALLOWED = json.loads(ALLOWANCE.read_text(encoding="utf-8"))
MOST = json.loads(TOTALS.read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def today() -> dict[str, dict[str, int]]:
    return {**offenders(House(ROOT)), **of_tests(ROOT)}


def test_every_limit_is_held(today: dict[str, dict[str, int]]) -> None:
    assert set(ALLOWED) == set(today)


@pytest.mark.parametrize("limit", sorted(ALLOWED))
def test_nothing_new_is_over_a_limit(limit: str, today: dict[str, dict[str, int]]) -> None:
    worse = {key: size for key, size in today[limit].items() if size > ALLOWED[limit].get(key, 0)}
    assert not worse, f"{limit}: over the limit, or further over it than before"


@pytest.mark.parametrize("limit", sorted(ALLOWED))
def test_the_allowance_is_what_is_needed(limit: str, today: dict[str, dict[str, int]]) -> None:
    loose = {key: size for key, size in ALLOWED[limit].items() if size > today[limit].get(key, 0)}
    assert not loose, f"{limit}: less is needed now; python tests/house/measures.py --tighten"


@pytest.mark.parametrize("name", sorted(MOST))
def test_no_total_grows(name: str) -> None:
    """A change that needs more takes as much away elsewhere; nothing raises totals.json."""
    assert totals(ROOT)[name] <= MOST[name]


def test_totals_count(tmp_path: Path) -> None:
    """Each total of files made for it."""
    options = "class A(Options):\n    x: int = 1\n    y: ClassVar[int] = 2\n"
    codes = "class Code(StrEnum):\n    ONE = 'one'\n    TWO = 'two'\n"
    made = house(tmp_path, {"core/a.py": options + "LIMIT = 3\n", "core/findings.py": codes})
    (tmp_path / "tests").mkdir()
    (tmp_path / "tests" / "test_a.py").write_text("x = 1\n" * 5)
    counted = totals(tmp_path)
    assert counted == {
        "package lines": 7,
        "package files": len(made.modules),
        "test lines": 5,
        "option fields": 1,
        "diagnostics": 2,
        "named numbers": 1,
    }
    assert set(counted) == set(MOST)


def test_the_top_level_is_rooms_only() -> None:
    entries = set(top_entries(House(ROOT)))
    assert {"__init__.py", "py.typed"} <= entries
    assert entries - {"__init__.py", "py.typed"} <= set(ROOMS)
    assert len(ROOMS) <= 15


# Each limit is seen to be broken


SOUND = '"""Nothing is wrong here."""\n\n\ndef public(x: int) -> int:\n    return x\n'
BROKEN = {
    "upward imports": {"core/a.py": "def f():\n    from sipe_bayes.cli import b\n", "cli/b.py": ""},
    "circles": {
        "core/a.py": "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    import sipe_bayes.core.b\n",
        "core/b.py": "def f():\n    from sipe_bayes.core.a import g\n",
    },
    "lines of a function's body": {
        "core/a.py": "class A:\n    def f(self):\n        '''.'''\n" + "        x = 1\n" * 61
    },
    "lines over 120 columns": {"core/a.py": f"'''{'x' * 120}'''\n"},
    "private names imported": {
        "core/a.py": "from sipe_bayes.core import b\n\n\ndef f():\n    return b._hidden\n",
        "core/b.py": "_hidden = 1\n",
    },
    "Any in public signatures": {
        "core/a.py": "from sipe_bayes.core.b import Table\n\n\ndef f(x: 'list[Table]') -> None: ...\n",
        "core/b.py": "from typing import Any\nTable = dict[str, Any]\n",
    },
}


def house(folder: Path, files: dict[str, str]) -> House:
    for name, text in {"__init__.py": "", "core/__init__.py": "", "cli/__init__.py": "", **files}.items():
        path = folder / "sipe_bayes" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
    return House(folder)


def test_a_module_named_in_a_text_is_imported(tmp_path: Path) -> None:
    """By a list of names for importlib, or with what is taken from it; a format's name or a sentence is none."""
    texts = '"sipe_bayes.core.b", "sipe_bayes.core.c:f", "sipe_bayes.posterior/1", "see sipe_bayes.core.d"'
    files = {f"core/{name}.py": "" for name in "bcd"} | {"core/a.py": f"NAMES = ({texts})\n"}
    found = house(tmp_path / "forth", files)
    assert found.edges["sipe_bayes.core.a"] == {"sipe_bayes.core.b", "sipe_bayes.core.c"}
    back = house(tmp_path / "back", {**files, "core/c.py": "import sipe_bayes.core.a\n"})
    assert offenders(back)["circles"] == {"sipe_bayes.core.a - sipe_bayes.core.c": 2}


@pytest.mark.parametrize("limit", LIMITS)
def test_what_breaks_a_limit_is_seen(limit: str, tmp_path: Path) -> None:
    """Alone: what breaks one limit breaks no other."""
    sound = house(tmp_path / "sound", {"core/a.py": SOUND})
    assert not any(offenders(sound).values())
    broken = {name: list(keys) for name, keys in offenders(house(tmp_path / "broken", BROKEN[limit])).items() if keys}
    print(broken)
    assert list(broken) == [limit]


def test_the_table_counts(tmp_path: Path) -> None:
    """Each figure of a file made for it."""
    text = (
        'A, _B = 1, (2.0, 3)\nC = {"x": 1}\n\n\ndef f(found: int) -> int:\n    """One.\n\n    Two."""\n'
        + "    found += 1\n" * 2
    )
    figures = table(house(tmp_path, {"core/a.py": text, "inference/laplace/b.py": ""}))
    assert figures["package lines"] == "10"
    assert figures["docstring share"] == "30.0%"
    assert figures["named numbers"] == "2 (core 2)"
    assert figures["dialect"] == "3 (found 3)"
    assert figures["modules of laplace"] == "1"
    copied = "".join(f"x{k} = f({k})\n" for k in range(7))
    assert table(house(tmp_path, {"core/b.py": copied, "cli/b.py": copied}))["pairs of places alike"] == "1"


def test_a_test_that_imports_another_is_seen(tmp_path: Path) -> None:
    (tmp_path / "tests" / "core").mkdir(parents=True)
    (tmp_path / "tests" / "core" / "test_a.py").write_text("from tests.core.test_b import helper\n")
    (tmp_path / "tests" / "core" / "test_b.py").write_text("helper = 1\n")
    assert of_tests(tmp_path) == {"test files imported": {"tests.core.test_a imports tests.core.test_b": 1}}
