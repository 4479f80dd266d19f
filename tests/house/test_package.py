"""The package as a whole: light to import, no pickle, one copy of everything."""

import ast
import json
import os
import re
import subprocess
import sys
import tarfile
import time
import tomllib
import zipfile
from collections.abc import Iterator
from pathlib import Path

import pytest

import sipe_bayes
from sipe_bayes.inference import ESTIMATORS, estimator_class
from tests.house import distributions

ROOT = Path(__file__).parents[2]
PACKAGE = ROOT / "sipe_bayes"
SOURCES = sorted(PACKAGE.rglob("*.py"))
HEAVY = ("torch", "sbi", "botorch", "mujoco", "pyro", "emcee", "arviz", "matplotlib", "pandas", "scipy")


def run_python(code: str, folder: Path = ROOT) -> str:
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "2"}
    result = subprocess.run(
        [sys.executable, "-c", code], cwd=folder, env=environment, capture_output=True, text=True, check=False
    )
    assert result.returncode == 0, result.stderr
    return result.stdout


# What is imported


@pytest.mark.parametrize(
    "code",
    [
        "import sipe_bayes as sipe; dir(sipe)",
        "import sys; from sipe_bayes.cli.app import main; sys.argv = ['sipe', '--help']\n"
        "try: main()\nexcept SystemExit: pass",
        "import sys; from sipe_bayes.cli.app import main; sys.argv = ['sipe', 'calibrate', '--help']\n"
        "try: main()\nexcept SystemExit: pass",
    ],
    ids=["import", "help", "calibrate help"],
)
def test_answers_without_heavy_imports(code: str) -> None:
    began = time.monotonic()
    out = run_python(f"{code}\nimport json, sys\nprint(json.dumps(sorted(m.split('.')[0] for m in sys.modules)))")
    print(f"{time.monotonic() - began:.2f} s with the interpreter's start")
    assert set(HEAVY) & set(json.loads(out.splitlines()[-1])) == set()


@pytest.mark.parametrize("name", sipe_bayes.__all__)
def test_public_names_exist(name: str) -> None:
    assert getattr(sipe_bayes, name) is not None
    assert name in dir(sipe_bayes)


def test_unknown_public_name() -> None:
    with pytest.raises(AttributeError, match="'Simulater'"):
        sipe_bayes.Simulater  # noqa: B018


def imports() -> Iterator[tuple[Path, ast.stmt]]:
    for path in SOURCES:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import | ast.ImportFrom):
                yield path, node


def test_no_relative_imports_and_none_through_the_links() -> None:
    for path, node in imports():
        names = [a.name for a in node.names] if isinstance(node, ast.Import) else [node.module or ""]
        assert not (isinstance(node, ast.ImportFrom) and node.level), f"{path}:{node.lineno}"
        assert not {n.split(".")[0] for n in names} & {"models", "inference"}, f"{path}:{node.lineno}"


def test_nothing_is_pickled() -> None:
    for path, node in imports():
        names = [a.name for a in node.names] if isinstance(node, ast.Import) else [node.module or ""]
        banned = {"pickle", "cloudpickle", "dill", "joblib", "shelve", "marshal"}
        assert not {n.split(".")[0] for n in names} & banned, f"{path}:{node.lineno}"
    for path in SOURCES:
        text = path.read_text(encoding="utf-8")
        assert not re.search(
            r"allow_pickle\s*=\s*True|(?<!safetensors\.)torch\.(save|load)\(|read_pickle|to_pickle", text
        ), path
        for call in re.findall(r"np\.load\([^)]*\)", text):
            assert "allow_pickle=False" in call, path


@pytest.mark.parametrize("name", ["models", "inference"])
def test_root_links(name: str) -> None:
    link = ROOT / name
    assert link.is_symlink()
    assert os.readlink(link) == f"sipe_bayes/{name}"
    assert (link / "__init__.py").is_file()


def test_typed() -> None:
    assert (PACKAGE / "py.typed").is_file()


def test_registry_names_are_the_classes_own() -> None:
    for name in ESTIMATORS:
        assert estimator_class(name).name == name


def test_the_version_stands_in_one_place() -> None:
    text = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    project = tomllib.loads(text)
    assert "version" not in project["project"]
    assert project["tool"]["setuptools"]["dynamic"]["version"] == {"attr": "sipe_bayes.core.__version__"}
    for file in ("CITATION.cff", "CHANGELOG.md"):
        assert sipe_bayes.__version__ in (ROOT / file).read_text(encoding="utf-8"), file


ORDERS = (
    "import gymnasium, sipe_bayes",
    "import sipe_bayes, gymnasium; gymnasium.register_envs(sipe_bayes.gym)",
)


@pytest.mark.parametrize("imports", ORDERS)
def test_gymnasium_knows_the_environments(imports: str) -> None:
    check = "print('sipe/Pendulum-v0' in gymnasium.registry)"
    done = subprocess.run([sys.executable, "-c", f"{imports}; {check}"], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "True"


def test_a_wheel_and_an_sdist_that_are_wrong_are_refused(tmp_path: Path) -> None:
    wanted = {"sipe_bayes/a.py", "sipe_bayes/py.typed"}
    assert "sipe_bayes/py.typed" in distributions.package()
    assert not [name for name in distributions.package() if name.endswith(".npz")]

    def wheel(*names: str) -> list[str]:
        with zipfile.ZipFile(tmp_path / "x.whl", "w") as archive:
            for name in (*names, "x.dist-info/METADATA"):
                archive.writestr(name, "")
        return distributions.faults(tmp_path / "x.whl", wanted)

    assert wheel(*wanted) == []
    assert wheel("sipe_bayes/a.py") == ["sipe_bayes/py.typed: missing"]
    assert wheel(*wanted, "sipe_bayes/b.py") == ["sipe_bayes/b.py: not of this tree"]
    assert wheel(*wanted, "tests/a.py") == ["tests/a.py: does not belong there"]
    with tarfile.open(tmp_path / "x.tar.gz", "w:gz") as archive:
        for name in (*wanted, "README.md", "notes.txt"):
            archive.addfile(tarfile.TarInfo(f"x-1/{name}"))
        link = tarfile.TarInfo("x-1/LICENSE")
        link.type, link.linkname = tarfile.SYMTYPE, "/etc/passwd"
        archive.addfile(link)
    found = distributions.faults(tmp_path / "x.tar.gz", wanted)
    assert found == ["notes.txt: does not belong there", "LICENSE: a link"]
