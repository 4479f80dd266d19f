"""Where a command is started: streams that are closed or full, a folder that is gone, packages that do not import."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from sipe_bayes.cli.app import main
from sipe_bayes.cli.surroundings import broken_import

ROOT = Path(__file__).parents[2]
SIPE = f"{sys.executable} -m sipe_bayes.cli.app"


def shell(line: str, folder: Path, **variables: str) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "PYTHONPATH": str(ROOT), **variables}
    return subprocess.run(["sh", "-c", line], cwd=folder, env=environment, capture_output=True, text=True, check=False)


@pytest.mark.parametrize(
    ("line", "code", "error"),
    [
        (f"{SIPE} explain misfit >&- 2>&- <&-", 0, ""),
        (f"{SIPE} calibrate nothing.toml 2>&-", 2, ""),
        (f"{SIPE} --help > /dev/full", 2, "sipe: standard output: no space left on device; free some space there"),
        (f"mkdir x; cd x; rmdir ../x; {SIPE} explain misfit", 2, "sipe: the folder that this is started in is gone"),
    ],
)
def test_what_a_shell_does(line: str, code: int, error: str, tmp_path: Path) -> None:
    done = shell(line, tmp_path)
    assert (done.returncode, done.stderr.count("\n")) == (code, bool(error))
    assert done.stderr.startswith(error)


def test_a_variable_with_which_mujoco_cannot_be_imported(tmp_path: Path) -> None:
    done = shell(f"{SIPE} envs", tmp_path, MUJOCO_GL="nonsense")
    assert done.returncode == 2
    assert done.stderr.startswith("sipe: mujoco cannot be imported (")
    assert done.stderr.count("\n") == 1


def test_arviz_is_imported_where_no_cache_can_be_written(tmp_path: Path) -> None:
    (tmp_path / "cache").write_text("a file")
    line = f"{sys.executable} -c 'from sipe_bayes.posterior.storage import ready_arviz; ready_arviz()'"
    done = shell(line, tmp_path, XDG_CACHE_HOME=str(tmp_path / "cache"), MPLCONFIGDIR=str(tmp_path))
    assert (done.returncode, done.stderr) == (0, "")


def test_a_mistake_of_ours_is_no_broken_package() -> None:
    with pytest.raises(AttributeError) as caught:
        broken_import(None)  # type: ignore[arg-type]
    assert broken_import(caught.value) == ""


def test_a_mistake_of_ours_stays_a_traceback(monkeypatch: pytest.MonkeyPatch) -> None:
    def wrong(*_: object) -> None:
        raise KeyError("ours")

    monkeypatch.setattr("sipe_bayes.cli.app.settle", wrong)
    monkeypatch.setattr(sys, "argv", ["sipe", "explain", "misfit"])
    with pytest.raises(KeyError):
        main()
