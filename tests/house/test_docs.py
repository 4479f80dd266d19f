"""README and docs are true: generated pages are up to date, code runs, commands, keys, links and anchors are there."""

from __future__ import annotations

import ast
import functools
import importlib.util
import json
import os
import re
import shlex
import subprocess
import sys
import tomllib
from pathlib import Path
from types import ModuleType
from typing import Any
from urllib.parse import unquote

import pytest
import typer.main

from sipe_bayes.calibration.config import Config
from sipe_bayes.cli.app import app
from sipe_bayes.cli.examples import EXAMPLES
from sipe_bayes.core.files import VARIABLES
from sipe_bayes.core.finding_advice import ADVICE
from sipe_bayes.core.finding_texts import Code
from sipe_bayes.envs.sensing import NEUTRAL
from sipe_bayes.envs.target_texts import TARGET_TEXTS
from sipe_bayes.envs.targets import ATTRIBUTES

ROOT = Path(__file__).parents[2]
README = ROOT / "README.md"
OWN = [README, *(ROOT / name for name in ("CHANGELOG.md", "SECURITY.md", "llms.txt"))]
PAGES = OWN + sorted(page for page in (ROOT / "docs").rglob("*.md") if "_build" not in page.parts)
BLOCK = re.compile(
    r"(?:<!-- (?P<mark>[^\n]*) -->\n)?```(?:\{code-cell\} )?(?P<kind>\w+)\n(?P<text>.*?)```", flags=re.DOTALL
)
CELLS = "ipython3"  # which `make docs` runs
KINDS = {"python", "toml", "bash", CELLS}
COMMAND: Any = typer.main.get_command(app)


def blocks(page: Path, kind: str) -> list[tuple[str, str]]:
    """(comment above, code) of the page's blocks of a kind; a comment ``not run: REASON`` takes a block out."""
    found = [
        (m["mark"] or "", m["text"]) for m in BLOCK.finditer(page.read_text(encoding="utf-8")) if m["kind"] == kind
    ]
    return [(mark, text) for mark, text in found if not re.match(r"not run: \w", mark)]


@functools.cache
def generator() -> ModuleType:
    spec = importlib.util.spec_from_file_location("generate", ROOT / "docs" / "generate.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


# What is written from its source


def test_generated_pages_are_up_to_date(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(sys, "argv", ["generate.py", "--check"])
    assert not generator().main(), f"{capsys.readouterr().out}; run python docs/generate.py"


def test_every_target_has_its_words() -> None:
    wanted = {kind: set(attributes) for kind, attributes in {**ATTRIBUTES, "sensor": NEUTRAL}.items()}
    assert {kind: set(texts) for kind, texts in TARGET_TEXTS.items()} == wanted, "sipe_bayes/envs/target_texts.py"


def test_every_key_is_described() -> None:
    rows = generator().keys(Config, "")
    assert len(rows) > 40
    assert not [key for key, text, _ in rows if not text], "write a docstring below the field"


def test_every_environment_variable_is_described() -> None:
    named = {
        name
        for path in (*(ROOT / "sipe_bayes").rglob("*.py"), *PAGES)
        for name in re.findall(r"\bSIPE_[A-Z_]+", path.read_text(encoding="utf-8"))
    }
    assert named == set(VARIABLES)


def test_every_finding_says_what_to_do() -> None:
    assert set(ADVICE) == set(Code), "sipe_bayes/core/finding_advice.py"


def test_every_finding_has_its_anchor() -> None:
    assert {str(code) for code in Code} <= anchors(ROOT / "docs" / "reference" / "findings.md")


# The README


def test_readme_is_short() -> None:
    lines = README.read_text(encoding="utf-8").splitlines()
    assert len(lines) <= 150
    assert not [line for line in lines if len(line) > 120]


STUDY = ROOT / "examples" / "studies" / "results" / "discover_real.json"


@pytest.mark.parametrize(("name", "found"), json.loads(STUDY.read_text(encoding="utf-8")).items())
def test_examples_print_what_the_study_found(name: str, found: dict[str, Any]) -> None:
    """What, by how much, and the error on each held-out log before and after; of nothing, what came first instead."""
    page = " ".join((ROOT / "examples" / name / "README.md").read_text(encoding="utf-8").split())
    errors = [f"{row['before']:.4f} to {row['after']:.4f}" for row in found["held-out errors"]]
    if not found["found"]:
        errors = [f"{row['after']:.4f}" for row in found["held-out errors"]]
        found = found["others"][0]
    expected = [*found["found"], f"{found['gain']:.0f} ± {found['error']:.0f} nats", *errors]
    assert [text for text in expected if text not in page] == []


def test_pictures_are_small() -> None:
    folder = ROOT / "examples" / "simple_pendulum"
    assert (folder / "figure.png").stat().st_size < 150_000
    assert (folder / "clip.webp").stat().st_size < 2_000_000


# Code


def test_blocks_are_of_kinds_that_are_tested() -> None:
    for page in PAGES:
        kinds = {m["kind"] for m in BLOCK.finditer(page.read_text(encoding="utf-8"))}
        assert kinds <= KINDS, page


def test_pages_with_cells_are_notebooks() -> None:
    """`make docs` runs those alone."""
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        assert text.startswith("---\nfile_format: mystnb\n") == bool(blocks(page, CELLS)), page


def test_gallery_has_every_figure() -> None:
    """Each public function of the figures' modules that returns one."""
    shown = "\n".join(text for _, text in blocks(ROOT / "docs" / "gallery.md", CELLS))
    wanted = []
    for path in sorted((ROOT / "sipe_bayes").rglob("*.py")):
        if re.search(r"(plots?|figures)\.py$", path.name):
            tree = ast.parse(path.read_text(encoding="utf-8"))
            wanted += [
                f"{path.stem.replace('sipe_plot', '')}.{f.name}".lstrip(".")
                for f in tree.body
                if isinstance(f, ast.FunctionDef)
                and not f.name.startswith("_")
                and f.returns is not None
                and ast.unparse(f.returns) in ("Figure", "list[Figure]")
                and f.name not in ("log_figure",)  # a part of others
            ]
    assert len(wanted) > 15
    assert not [name for name in wanted if f"{name}(" not in shown]


RUN = """\
import json, os, sys, time, gymnasium, scipy.stats, sipe_bayes  # once: they are most of what each would take
for name in sipe_bayes.__all__:
    getattr(sipe_bayes, name)
from sipe_bayes.inference.registry import ESTIMATORS, estimator_class
for name in ("laplace", "bayessim"):
    estimator_class(name)

for folder, name, text in json.load(sys.stdin):
    child = os.fork()
    if not child:
        print("##", name, flush=True)
        began = time.process_time()
        os.chdir(folder)
        exec(text, {"__name__": "__main__"})
        print(f"CPU {time.process_time() - began:.1f} s", flush=True)
        raise SystemExit
    assert not os.waitpid(child, 0)[1], name
"""


def test_python_runs(tmp_path: Path) -> None:
    """Each block in a process of its own, those of a page one after the other in a folder, which has its files."""
    work = []
    for k, page in enumerate(PAGES):
        folder = tmp_path / str(k)
        folder.mkdir()
        (folder / "examples").symlink_to(ROOT / "examples")
        for mark, text in blocks(page, "toml"):
            if mark.startswith("file: "):
                (folder / mark.removeprefix("file: ")).write_text(text, encoding="utf-8")
        work += [(str(folder), str(page.relative_to(ROOT)), text) for _, text in blocks(page, "python")]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1", "MPLBACKEND": "Agg"}
    command = [sys.executable, "-c", RUN]
    done = subprocess.run(
        command, input=json.dumps(work), capture_output=True, text=True, check=False, env=environment, cwd=tmp_path
    )
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-4000:]
    output = dict(re.findall(r"^## (\S+)\n(.*?)(?=^## |\Z)", done.stdout, flags=re.DOTALL | re.MULTILINE))
    values = re.findall(r"^([\w\[\]]+): ([-.\d]+) ±", output["README.md"], flags=re.MULTILINE)
    assert [name for name, _ in values] == ["weight_mass", "armature", "damping", "coulomb", "torque_offset[ddp]"]
    assert float(values[0][1]) == pytest.approx(0.70, abs=0.03)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_configurations_are_legal(page: Path) -> None:
    """Whole ones, and parts by their keys."""
    known = {key for key, *_ in generator().keys(Config, "")}
    for mark, text in blocks(page, "toml"):
        table = tomllib.loads(text)
        if mark != "part of a configuration":
            Config.model_validate(table)
        assert not set(keys_of(table)) - known, mark


def keys_of(table: dict[str, Any], prefix: str = "") -> list[str]:
    found = []
    for key, value in table.items():
        inner = value if isinstance(value, list) and value and isinstance(value[0], dict) else [value]
        for one in inner:
            names = isinstance(one, dict) and key != "added"  # whose keys are targets
            found += keys_of(one, f"{prefix}{key}.") if names else [f"{prefix}{key}"]
    return found


def test_the_least_configuration_is_one() -> None:
    ((_, text),) = blocks(README, "toml")
    table = tomllib.loads(text)
    assert [log.use for log in Config.model_validate(table).logs] == ["train", "holdout"]
    for left_out in ("model", "window", "measurements", "logs", "parameters"):
        with pytest.raises(ValueError, match=r"(?i)missing|required|at least"):
            Config.model_validate({k: v for k, v in table.items() if k != left_out})


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_commands_are_there(page: Path) -> None:
    """Every ``sipe ...`` in a block of code or between backticks, with its options."""
    text = page.read_text(encoding="utf-8")
    lines = [line for _, block in blocks(page, "bash") for line in block.splitlines()]
    lines += re.findall(r"^    (?:\.venv/bin/)?(sipe [^\n]*)", text, flags=re.MULTILINE)
    lines += re.findall(r"`(sipe [^`]+)`", text)
    for line in lines:
        words = shlex.split(line, comments=True)
        if words[:1] == ["sipe"]:
            check_command([word for word in words[1:] if word not in ("...", "[OPTIONS]")], line)


def check_command(words: list[str], line: str) -> None:
    command = COMMAND
    while words and hasattr(command, "commands") and not words[0].startswith("-"):
        assert words[0] in command.commands, line
        command, words = command.commands[words[0]], words[1:]
    options = {"--help"} | {o for p in command.params for o in (*p.opts, *p.secondary_opts)}
    assert not [w for w in words if w.startswith("--") and w.partition("=")[0] not in options], line


def test_every_command_has_an_example() -> None:
    """In its --help, in the order of EXAMPLES, and it is legal."""
    listed = []
    for path, command in every_command(COMMAND, ""):
        assert command.epilog == f"Example: {EXAMPLES[path]}", path
        assert EXAMPLES[path].startswith(f"sipe {path}")
        words = shlex.split(EXAMPLES[path])[1 + len(path.split()) :]
        assert command.make_context(path, words), "parsed, every argument among them"
        listed.append(path)
    assert sorted(listed) == sorted(EXAMPLES)


def every_command(command: Any, path: str) -> list[tuple[str, Any]]:
    below = getattr(command, "commands", None)
    if below is None:
        return [(path, command)]
    return [pair for name, one in below.items() for pair in every_command(one, f"{path} {name}".strip())]


# Links


def anchors(page: Path) -> set[str]:
    """Of the headings, as GitHub and the site make them."""
    headings = re.findall(r"^#+ (.+)$", BLOCK.sub("", page.read_text(encoding="utf-8")), flags=re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.strip().lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_links_lead_somewhere(page: Path) -> None:
    text = BLOCK.sub("", page.read_text(encoding="utf-8"))
    definitions = dict(re.findall(r"^\[([^\]]+)\]: (\S+)$", text, flags=re.MULTILINE))
    assert not [word for word in re.findall(r"\]\[([^\]]+)\]", text) if word not in definitions]
    for target in (*re.findall(r"\]\(([^)]+)\)", text), *definitions.values()):
        if re.match(r"https?://", target):
            continue
        file, _, anchor = unquote(target).partition("#")
        path = (page.parent / file).resolve() if file else page
        assert path.exists(), target
        assert path.is_relative_to(ROOT), target
        assert not anchor or anchor in anchors(path), target
