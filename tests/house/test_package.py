"""The package as a whole: light to import, no pickle, one copy of everything, a README that is true."""

import ast
import json
import os
import re
import subprocess
import sys
import time
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

import sipe_bayes
from sipe_bayes.calibration.config import Config
from sipe_bayes.calibration.config_fields import Table
from sipe_bayes.calibration.config_tables import (
    Columns,
    Command,
    LogEntry,
    Measurement,
    Noise,
    NormalPrior,
    ParameterEntry,
    PriorSource,
    Resample,
    Search,
    Structure,
    TimeColumn,
)
from sipe_bayes.calibration.readers.tables import READERS
from sipe_bayes.core.units import UNITS
from sipe_bayes.diagnostics.catalogue import tasks
from sipe_bayes.envs.sensing import NEUTRAL
from sipe_bayes.envs.targets import ATTRIBUTES
from sipe_bayes.inference import ESTIMATORS, estimator_class
from sipe_bayes.structure.registry import EXTENSIONS, get_extension

ROOT = Path(__file__).parents[2]
PACKAGE = ROOT / "sipe_bayes"
README = (ROOT / "README.md").read_text(encoding="utf-8")
SOURCES = sorted(PACKAGE.rglob("*.py"))
HEAVY = ("torch", "sbi", "botorch", "mujoco", "pyro", "emcee", "arviz", "matplotlib", "pandas", "scipy")


def run_python(code: str, folder: Path = ROOT) -> str:
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "2"}
    result = subprocess.run(
        [sys.executable, "-c", code], cwd=folder, env=environment, capture_output=True, text=True, check=False
    )
    assert result.returncode == 0, result.stderr
    return result.stdout


EACH_ALONE = """\
import os, mujoco, scipy.stats, torch  # once: they are most of what each would import

def alone(blocks):
    for block in blocks:
        child = os.fork()
        if not child:
            exec(block, {"__name__": "__main__"})
            raise SystemExit
        assert not os.waitpid(child, 0)[1], block

"""


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


def test_version_is_the_project_s() -> None:
    import tomllib

    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert project["version"] == sipe_bayes.__version__


ORDERS = (
    "import gymnasium, sipe_bayes",
    "import sipe_bayes, gymnasium; gymnasium.register_envs(sipe_bayes.gym)",
)


@pytest.mark.parametrize("imports", ORDERS)
def test_gymnasium_knows_the_environments(imports: str) -> None:
    check = "print('sipe/Pendulum-v0' in gymnasium.registry)"
    done = subprocess.run([sys.executable, "-c", f"{imports}; {check}"], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "True"


# The README


def rows(heading: str) -> dict[str, str]:
    """First cell (without backticks) -> whole row of the table under a heading."""
    section = README.split(f"## {heading}\n", 1)[1].split("\n## ", 1)[0]
    found = {}
    for line in section.splitlines():
        if match := re.match(r"\|\s*`([^`]+)`(?: to `([^`]+)`)?\s*\|", line):
            found.update(dict.fromkeys(numbered(match[1], match[2]), line))
    return found


def numbered(first: str, last: str | None) -> list[str]:
    """All from one word to another that differs in the number at its end."""
    if last is None:
        return [first]
    stem = first.rstrip("0123456789")
    assert last.rstrip("0123456789") == stem
    return [f"{stem}{k}" for k in range(int(first[len(stem) :]), int(last[len(stem) :]) + 1)]


def target_words() -> list[str]:
    return [
        f"{kind}.{attribute}" if kind == "option" else f"{kind}:NAME.{attribute}"
        for kind, attributes in ATTRIBUTES.items()
        for attribute in attributes
    ]


def test_readme_lists_every_target() -> None:
    differing = set(rows("Targets")) ^ {*target_words(), *(f"sensor:NAME.{attribute}" for attribute in NEUTRAL)}
    assert not differing, "README, Targets: a row for each, and for no other"


def test_readme_lists_every_estimator() -> None:
    listed = {(name, re.findall(r"`(\w+)`", line)[1]) for name, line in rows("Estimators").items()}
    differing = listed ^ {(name, cls) for name, (_, cls) in ESTIMATORS.items()}
    assert not differing, "README, Estimators: a row for each with its class, and for no other"


def test_readme_lists_every_extension() -> None:
    wanted = {}
    for name in EXTENSIONS:
        one = get_extension(name)
        wanted[name] = (
            f"| `{name}` | {one.kind} | {one.sentence('NAME')} | {'yes' if one.native else one.nearest or 'no'} |"
        )
    assert rows("What a model lacks") == wanted, "README, What a model lacks: a row for each, and for no other"


def test_readme_lists_every_environment() -> None:
    differing = set(rows("Environments")) ^ {row["name"] for row in tasks()}
    assert not differing, "README, Environments: a row for each, and for no other"
    for row in tasks():
        cells = [row[k] for k in ("parameters", "observations", "actions", "reproduces")]
        assert rows("Environments")[row["name"]] == f"| `{row['name']}` | {' | '.join(map(str, cells))} |"


TABLES: dict[str, type[Table]] = {
    "": Config,
    "columns.": Columns,
    "columns.time.": TimeColumn,
    "search.": Search,
    "resample.": Resample,
    "commands.": Command,
    "measurements.": Measurement,
    "logs.": LogEntry,
    "parameters.": ParameterEntry,
    "parameters.prior.": NormalPrior,
    "noise.": Noise,
    "prior.": PriorSource,
    "structure.": Structure,
}


def test_readme_explains_every_key() -> None:
    keys = {
        f"{prefix}{field.alias or name}"
        for prefix, table in TABLES.items()
        for name, field in table.model_fields.items()
    }
    keys |= {f"{prefix}{key}" for prefix, table in TABLES.items() for key in table.also}
    inner = {prefix.rstrip(".") for prefix in TABLES if prefix}
    assert sorted(rows("Configuration")) == sorted(keys - inner)


def test_readme_lists_every_format_of_logs() -> None:
    listed = {kind: line.split("|")[-2].strip(" `[]") for kind, line in rows("Logs").items()}
    assert listed == {kind: format.extra for kind, format in READERS.items()}
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert set(listed.values()) - {""} <= set(project["optional-dependencies"])


def test_readme_lists_every_unit() -> None:
    section = README.split("Unit words", 1)[1].split("\n\n", 1)[0]
    assert set(re.findall(r"`([^`]+)`", section)) == set(UNITS)


def test_readme_least_configuration_is_one() -> None:
    (block,) = re.findall(r"```toml\n(.*?)```", README, flags=re.DOTALL)
    found = Config.model_validate(tomllib.loads(block))
    assert [log.use for log in found.logs] == ["train", "holdout"]
    for left_out in ("model", "window", "measurements", "logs", "parameters"):
        with pytest.raises(ValueError, match=r"(?i)missing|required|at least"):
            Config.model_validate({k: v for k, v in tomllib.loads(block).items() if k != left_out})


def test_readme_python_runs(tmp_path: Path) -> None:
    blocks = re.findall(r"```python\n(.*?)```", README, flags=re.DOTALL)
    assert blocks
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    out = run_python(EACH_ALONE + f"alone({blocks!r})", tmp_path)
    found = {name: float(value) for name, value in re.findall(r"^([\w\[\]]+): ([-.\d]+) ±", out, flags=re.MULTILINE)}
    assert list(found) == ["weight_mass", "armature", "damping", "coulomb", "torque_offset[ddp]"]
    assert found["weight_mass"] == pytest.approx(0.70, abs=0.03)


def test_readme_files_exist() -> None:
    for target in re.findall(r"\]\(([^)#:]+)\)", README):
        assert (ROOT / target).exists(), target
    picture = ROOT / "examples" / "simple_pendulum" / "figure.png"
    assert picture.stat().st_size < 150_000
