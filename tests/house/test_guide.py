"""The contributing guide is true: its map is the house's, its paths are there, its letters are those of docstrings."""

import re
from pathlib import Path

import pytest

from tests.house.sources import ROOMS

ROOT = Path(__file__).parents[2]
GUIDE = (ROOT / ".github" / "CONTRIBUTING.md").read_text(encoding="utf-8")
PATHS = sorted(p for p in set(re.findall(r"`((?:[\w.]+/)+(?:[\w.]+\.\w+)?)`", GUIDE)) if "NAME" not in p)
NAMES = {
    "sipe_bayes/inference/base.py": ("class Estimator", "def start(", "def step(", "def posterior("),
    "sipe_bayes/inference/registry.py": ("ESTIMATORS = {",),
    "sipe_bayes/inference/laplace/levenberg_marquardt.py": ("class DampingRule", "def after("),
    "sipe_bayes/calibration/readers/tables.py": ("READERS:",),
    "sipe_bayes/calibration/readers/base.py": ("class LogReader",),
    "sipe_bayes/envs/task.py": ("class Task(",),
    "sipe_bayes/core/finding_texts.py": ("class Code", "TEXTS"),
    "tests/envs/test_targets.py": ("CASES",),
    "tests/inference/laplace/test_levenberg_marquardt.py": ("def test_the_damping_rule(",),
}


def test_the_map_is_the_house() -> None:
    """Every room in the order of imports, and no other."""
    listed = re.findall(r"^\| `(\w+)` \|", GUIDE, flags=re.MULTILINE)
    assert listed == [room for room in ROOMS if (ROOT / "sipe_bayes" / room).is_dir()]


@pytest.mark.parametrize("path", PATHS)
def test_what_it_points_at_is_there(path: str) -> None:
    """From the root, or from the package where the sentence is about a room."""
    folders = [ROOT, ROOT / "sipe_bayes", *(ROOT / "sipe_bayes" / room for room in ROOMS)]
    assert any((folder / path).exists() for folder in folders)


@pytest.mark.parametrize("path", NAMES)
def test_what_recipes_name_is_there(path: str) -> None:
    text = (ROOT / path).read_text(encoding="utf-8")
    assert [name for name in NAMES[path] if name not in text] == []
    assert Path(path).name in GUIDE
