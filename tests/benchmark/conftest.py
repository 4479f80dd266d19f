"""A small run of the benchmark that nothing disturbed."""

from pathlib import Path

import pytest

from tests.problems.benchmarks import PENDULUM, measured


@pytest.fixture(scope="session")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("benchmark") / "out"
    found = measured(folder, *PENDULUM)
    assert found.exit_code == 0, found.output
    return folder
