"""What user code sees of the public names: mypy --strict and pyright know each of them, and what calls return."""

import importlib.util
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

import sipe_bayes

ROOT = Path(__file__).parents[2]
PUBLIC = [name for name in sipe_bayes.__all__ if name not in ("__version__", "gym")]
LIBRARIES = r"tuple\[Any, \.\.\.\]|(dtype|floating|NDArray)\[Any\]|_[AaTt]ny\w*"  # array shapes and numpy's own names
USE = """
space = sipe.ParameterSpace([sipe.Parameter("mass", 0.5, 2.0, unit="kg", targets=("body:rod.mass",))])
simulator = sipe.Simulator(sipe.make_task("Pendulum"))
environment = sipe.make("Pendulum")
trajectories = sipe.demonstrations(environment)
estimator = sipe.get_estimator(simulator, "laplace", seed=1)
posterior = estimator.fit(trajectories)
"""
RESULTS = [
    *("space[0].low", "simulator.space", "trajectories.observations", "trajectories[0].dt", "posterior.mean"),
    *(
        "posterior.stddev",
        "posterior.quantile(0.5)",
        "posterior.values(10)",
        "estimator.warnings",
        "estimator.rollouts",
    ),
    *("sipe.load_posterior('posterior')", "sipe.calibrate(sipe.prepare(Path('config.toml'), 1)).posterior"),
    "sipe.discover(sipe.prepare(Path('config.toml'), 1)).posterior",
    *("sipe.gym.make('Pendulum')", "trajectories[:2]"),
]
STRICT = (  # what mypy --strict adds to pyproject.toml, for the user's file alone, so that the package's cache serves
    "# mypy: disallow-any-generics, disallow-subclassing-any, disallow-untyped-calls, disallow-incomplete-defs, "
    "check-untyped-defs, disallow-untyped-decorators, warn-return-any, strict-equality, extra-checks"
)
CHECKERS = {
    "mypy": ["-m", "mypy", f"--config-file={ROOT}/pyproject.toml"],
    "basedpyright": ["-m", "basedpyright", "--pythonpath", sys.executable],
}
MISTAKES = ["sipe.Simulater", "sipe.Parameter('mass', low='a')", "sipe.make_task(3)", "sipe.load_posterior('p').means"]


def check(checker: str, code: str, folder: Path) -> tuple[int, list[str]]:
    """Exit code and lines of a type checker over a user's file."""
    if importlib.util.find_spec(checker) is None:
        pytest.skip(f"{checker} is not installed: pip install {checker}")
    head = f"from pathlib import Path\n{STRICT}\nimport sipe_bayes as sipe\n"
    (folder / "user.py").write_text(head + code, encoding="utf-8")
    (folder / "pyrightconfig.json").write_text('{"include": ["user.py"], "typeCheckingMode": "standard"}')
    path = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH", "")]))
    environment = {**os.environ, "PYTHONPATH": path}
    given, at = ("user.py", folder) if checker == "basedpyright" else (str(folder / "user.py"), ROOT)
    command = [sys.executable, *CHECKERS[checker], given]
    done = subprocess.run(command, cwd=at, env=environment, capture_output=True, text=True, check=False)
    return done.returncode, (done.stdout + done.stderr).splitlines()


@pytest.mark.parametrize("checker", CHECKERS)
def test_no_public_name_is_any(checker: str, tmp_path: Path) -> None:
    names = [f"sipe.{name}" for name in PUBLIC]
    code = USE + "".join(f"reveal_type({one})\n" for one in [*names, *RESULTS])
    exit_code, lines = check(checker, code, tmp_path)
    revealed = [line for line in lines if "note: Revealed type" in line or "information: Type of" in line]
    print("\n".join(lines))
    assert exit_code == 0
    assert len(revealed) == len(names) + len(RESULTS)
    for line in revealed[: len(names)]:
        assert not re.search(r'is "(builtins\.)?(Any|Unknown|object)"$', line), line
    for line in revealed[len(names) :]:
        assert not re.search(r"\b(Any|Unknown)\b", re.sub(LIBRARIES, "", line)), line


@pytest.mark.parametrize("checker", CHECKERS)
def test_mistakes_are_errors(checker: str, tmp_path: Path) -> None:
    """Each of them, and nothing else."""
    exit_code, lines = check(checker, "".join(f"print({mistake})\n" for mistake in MISTAKES), tmp_path)
    assert exit_code == 1
    errors = [int(m[1]) for line in lines if (m := re.search(r"user\.py:(\d+).*\berror\b", line))]
    assert sorted(set(errors)) == [4 + k for k in range(len(MISTAKES))], lines
