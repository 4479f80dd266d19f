"""The randomisation that a calibration writes is of the intervals that its report says to use."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

import sipe_bayes as sipe
from sipe_bayes.calibration.run import run
from sipe_bayes.cli.app import app
from sipe_bayes.diagnostics.result import Calibration
from sipe_bayes.posterior import prior
from tests.problems.lacking import write_lacking

TRUTH = {"rod_mass": 0.6, "damping": 0.05}


@pytest.fixture(scope="module")
def case(tmp_path_factory: pytest.TempPathFactory) -> tuple[Calibration, Path, dict[str, dict[str, Any]]]:
    """A calibration of a model without the friction that the log shows, its folder, and the written rows by name."""
    config = write_lacking(tmp_path_factory.mktemp("lacking"))
    config.write_text(config.read_text().replace("bounds = [0.0, 0.2]", "bounds = [0.0, 0.1]"))  # narrower than is told
    out = config.parent / "out"
    calibration = run(config, out=out, num_threads=1)
    written = json.loads((out / "domain_randomization.json").read_text())
    return calibration, out, {row["name"]: row for row in written["parameters"]}


def test_it_is_as_wide_as_the_interval_with_what_the_model_lacks(
    case: tuple[Calibration, Path, dict[str, dict[str, Any]]],
) -> None:
    calibration, _, rows = case
    rod_mass = next(p for p in calibration.parameters if p.name == "rod_mass")
    assert rod_mass.further is not None
    ends = rows["rod_mass"]["q05"], rows["rod_mass"]["q95"]
    np.testing.assert_allclose(ends, rod_mass.further, atol=0.03 * (rod_mass.further[1] - rod_mass.further[0]))
    assert rows["rod_mass"]["usable"] == "wider"


def test_a_value_that_is_not_to_be_used_is_flagged_and_drawn_from_its_prior(
    case: tuple[Calibration, Path, dict[str, dict[str, Any]]],
) -> None:
    _, out, rows = case
    value = rows["damping"]
    assert (value["usable"], value["reason"]) == ("none", "not determined")
    np.testing.assert_allclose((value["q05"], value["q95"]), (0.005, 0.095), atol=0.003)  # of 0 to 0.1
    for path in (out / "randomization").iterdir():
        assert "WARNING, not calibrated, drawn from the prior: damping: not determined." in path.read_text(), path
    assert "# damping is NOT calibrated" in (out / "randomization" / "isaac_lab_events.py").read_text()


def test_what_is_read_back_is_what_was_written(case: tuple[Calibration, Path, dict[str, dict[str, Any]]]) -> None:
    """The saved posterior stays what was fitted."""
    calibration, out, rows = case
    read = sipe.load_randomization(out / "domain_randomization.json")
    assert dict(read.uncalibrated) == {"damping": "not determined"}
    values = read.posterior.values(4000)
    for j, name in enumerate(read.posterior.space.names):
        ends = np.quantile(values[:, j], [0.05, 0.95])
        width = rows[name]["q95"] - rows[name]["q05"]
        np.testing.assert_allclose(ends, (rows[name]["q05"], rows[name]["q95"]), atol=0.05 * width)
    fitted = sipe.load_posterior(out / "posterior")
    np.testing.assert_allclose(fitted.stddev, calibration.posterior.stddev, rtol=1e-12)


def test_train_says_what_is_not_calibrated(tmp_path: Path) -> None:
    space = sipe.make_task("Pendulum").space
    prior(space).save(tmp_path / "drawn")
    rows = [{"name": name, "usable": "wider", "reason": "within the first interval"} for name in space.names]
    rows[0] |= {"usable": "none", "reason": "at a bound"}
    file = tmp_path / "domain_randomization.json"
    file.write_text(json.dumps({"parameters": rows, "posterior": "drawn"}))
    sizes = {"steps": 40, "hidden": 8, "batch": 8, "start-steps": 20, "episodes": 1, "evaluation-episodes": 1}
    small = [word for name, size in sizes.items() for word in (f"--{name}", str(size))]
    given = ["train", "Pendulum", *small, "--randomization", str(file), "--out", str(tmp_path / "out")]
    made = CliRunner().invoke(app, given)
    assert made.exit_code == 0, made.output
    lines = [line for line in made.stdout.splitlines() if line.startswith("warning")]
    assert lines == [f"warning: {space.names[0]} is not calibrated, and drawn from its prior: at a bound"]
    file.write_text(json.dumps({"parameters": [rows[0] | {"usable": "perhaps"}], "posterior": "drawn"}))
    with pytest.raises(ValueError, match=r"cannot be read as a domain randomisation \('perhaps' is not a valid Usable"):
        sipe.load_randomization(file)
