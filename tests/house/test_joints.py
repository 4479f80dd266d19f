"""The likelihood and laplace are joined to the rest by a few public names, and the contract loads no method."""

import subprocess
import sys
from pathlib import Path

import pytest

from tests.house.sources import House

ROOT = Path(__file__).parents[2]
INSIDE = ("sipe_bayes.likelihood", "sipe_bayes.inference.laplace")
MOST_NAMES, MOST_FILES = 25, 30


def reaching_inside(house: House) -> set[str]:
    """Imports of an internal of ``INSIDE`` by a file outside both rooms."""
    inside = tuple(f"{room}." for room in INSIDE)
    outside = [m for m in house.modules.values() if not f"{m.name}.".startswith(inside)]
    return {f"{m.name} imports {t}" for m in outside for t, _, _ in house.imports(m) if t.startswith(inside)}


def test_nobody_reaches_inside(tmp_path: Path) -> None:
    """Neither in a function, nor for types alone, nor by a text for importlib, as is seen in files made for it."""
    assert not reaching_inside(House(ROOT))
    text = (
        "from sipe_bayes.likelihood import bind\nfrom sipe_bayes.likelihood.noise import Noise\n"
        "if TYPE_CHECKING:\n    import sipe_bayes.likelihood.windows\n"
        "def f():\n    return 'sipe_bayes.inference.laplace.target:Target'\n"
    )
    for name in ("likelihood/noise", "inference/laplace/target", "structure/scores"):
        (tmp_path / "sipe_bayes" / name).parent.mkdir(parents=True)
        (tmp_path / "sipe_bayes" / f"{name}.py").write_text(text)
    seen = {"likelihood.noise", "likelihood.windows", "inference.laplace.target"}
    assert reaching_inside(House(tmp_path)) == {f"sipe_bayes.structure.scores imports sipe_bayes.{x}" for x in seen}


@pytest.mark.parametrize("room", INSIDE)
def test_a_joint_holds_what_others_take(room: str) -> None:
    house, public = House(ROOT), set(__import__(room, fromlist=["__all__"]).__all__)
    outside = [module for module in house.modules.values() if not module.name.startswith(room)]
    assert public == {n for module in outside for target, n, _ in house.imports(module) if target == room and n}
    assert len(public) <= MOST_NAMES


def test_the_contract_of_estimators_loads_no_method() -> None:
    code = "import sys, sipe_bayes.inference.base; print(*(m for m in sys.modules if m.split('.')[0] == 'sipe_bayes'))"
    made = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=True)
    assert len(made.stdout.split()) <= MOST_FILES
