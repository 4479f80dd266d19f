"""`sipe calibrate`: JSON is JSON, the folder is complete, what was found is told, a killed run resumes."""

import hashlib
import json
import signal
import subprocess
import time
import tomllib
from pathlib import Path
from typing import Any

import arviz
import mujoco
import numpy as np
import pandas as pd
import pytest
import torch
from safetensors import safe_open
from typer.testing import CliRunner

import sipe_bayes as sipe
from sipe_bayes.cli.app import app
from sipe_bayes.cli.errors import NOTHING_USABLE
from sipe_bayes.core.files import LOCK
from sipe_bayes.diagnostics.prior_predictive import OutsidePrior
from sipe_bayes.posterior import load_posterior
from sipe_bayes.rl.randomization import Randomization, load_randomization
from tests.problems.swings import (
    CONFIG,
    MODEL,
    TRUTH,
    call,
    command,
    contents,
    environment,
    sipe_command,
    strict_json,
    swing,
    text,
    write_case,
)


@pytest.fixture(scope="module")
def log() -> pd.DataFrame:
    return swing()


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory, log: pd.DataFrame) -> tuple[Path, Path, Any]:
    """(config, output folder, the subprocess's result) of a run with --json."""
    folder = tmp_path_factory.mktemp("finished")
    config = write_case(folder, log)
    text("window = 0.5\n", "window = 0.5\nstep_tolerance = 0.0  # a log in the model's own steps\n")(folder)
    result = sipe_command(folder, config, "--json", "--out", folder / "out")
    assert result.returncode == 0, result.stderr
    return config, folder / "out", result


def test_json_is_one_object(finished: tuple[Path, Path, Any]) -> None:
    _, out, result = finished
    assert result.stdout.count("\n") == 1
    assert result.stderr == ""
    found = strict_json(result.stdout)
    assert {"parameters", "holdout", "train", "warnings", "rollouts", "seconds", "out"} <= set(found)
    assert found["comparison"]["verdict"] == "better"
    assert found["misfit"]["p"] > 0.05  # a right model: fails for one seed in twenty, and this is not one
    assert set(found["misfit"]["share"]) == {"angle"}
    assert [o["log"] for o in found["outside_prior"]] == ["log"]
    assert found["outside_prior"][0]["p"] > 0.05
    assert found["warnings"] == []
    wanted = {"name", "unit", "targets", "mean", "sd", "q05", "q50", "q95", "contraction", "flags"}
    assert [wanted - set(p) for p in found["parameters"]] == [set(), set()]
    for p in found["parameters"]:  # nothing is missing: a fifth wider on average
        low, high = p["further"]
        assert low <= p["q05"] < p["q95"] <= high
        assert high - low < 1.6 * (p["q95"] - p["q05"])
    for use, name in (("holdout", "rest"), ("train", "log")):
        assert [set(s) for s in found[use]] == [{"log", "channel", "unit", "rmse", "rmse_default"}]
        assert (found[use][0]["log"], found[use][0]["channel"], found[use][0]["unit"]) == (name, "angle", "rad")
        assert found[use][0]["rmse"] < found[use][0]["rmse_default"]
    assert found["rollouts"] > 0
    assert Path(found["out"]) == out
    for p in found["parameters"]:  # 5 sd: one in a million
        assert abs(p["mean"] - TRUTH[p["name"]]) < 5 * p["sd"]
        assert p["q05"] < p["q50"] < p["q95"]


def test_numbers_that_are_not_finite_are_null() -> None:
    from sipe_bayes.core.files import to_json

    assert strict_json(to_json({"a": float("nan"), "b": [1.0, float("inf")]})) == {"a": None, "b": [1.0, None]}


def test_output_folder(finished: tuple[Path, Path, Any]) -> None:
    config, out, result = finished
    names = {p.name for p in out.iterdir()}
    assert names == {
        *("checkpoint.safetensors", "checks", "posterior.safetensors", "posterior.json", "posterior.nc", "run.json"),
        *("identified.xml", "domain_randomization.json", "randomization", "result.json", "report.html", "figures"),
        *(f"domain_randomization_posterior.{kind}" for kind in ("safetensors", "json")),
        LOCK,
    }
    assert list((out / "figures").iterdir())
    assert strict_json((out / "result.json").read_text()) == strict_json(result.stdout)
    run = strict_json((out / "run.json").read_text())
    assert (run["status"], run["estimator"], run["seed"]) == ("complete", "laplace", 0)
    assert run["versions"]["mujoco"] == mujoco.__version__
    assert run["config_sha256"] == hashlib.sha256(config.read_bytes()).hexdigest()
    assert run["model_sha256"] == sipe.prepare(config).simulator.checksum()
    assert run["logs_sha256"]["log"] == hashlib.sha256((config.parent / "log.csv").read_bytes()).hexdigest()
    assert run["configuration"]["window"] == tomllib.loads(CONFIG)["window"]


def test_posterior_is_read_back(finished: tuple[Path, Path, Any]) -> None:
    _, out, result = finished
    posterior = sipe.load_posterior(out / "posterior")
    found = {p["name"]: p for p in strict_json(result.stdout)["parameters"]}
    assert posterior.space.names == tuple(found)
    mode = posterior.space.values(posterior.mode.numpy())
    np.testing.assert_allclose(mode, [p["mode"] for p in found.values()], rtol=1e-12)
    data = arviz.from_netcdf(out / "posterior.nc")
    for name, p in found.items():
        draws = data.posterior[name].values
        assert abs(draws.mean() - p["mean"]) < 6 * p["sd"] / np.sqrt(draws.size)
    again = posterior.netcdf(torch.Generator().manual_seed(0))
    assert again == (out / "posterior.nc").read_bytes(), "the same draws each time"


def test_identified_model_carries_the_mode(finished: tuple[Path, Path, Any]) -> None:
    _, out, result = finished
    mode = {p["name"]: p["mode"] for p in strict_json(result.stdout)["parameters"]}
    before = mujoco.MjModel.from_xml_string(MODEL)
    after = mujoco.MjModel.from_xml_path(str(out / "identified.xml"))
    assert after.body("rod").mass[0] == pytest.approx(mode["mass"], rel=1e-5)
    assert after.joint("hinge").damping[0] == pytest.approx(mode["damping"], rel=1e-5)
    scaled = before.body("rod").inertia * mode["mass"] / before.body("rod").mass[0]
    np.testing.assert_allclose(after.body("rod").inertia, scaled, rtol=1e-5)
    np.testing.assert_allclose(after.opt.timestep, before.opt.timestep)


def test_domain_randomization(finished: tuple[Path, Path, Any]) -> None:
    _, out, result = finished
    found = strict_json((out / "domain_randomization.json").read_text())
    parameters = strict_json(result.stdout)["parameters"]
    assert found["names"] == ["mass", "damping"]
    assert [row["targets"] for row in found["parameters"]] == [{"body:rod.mass": 1.0}, {"joint:hinge.damping": 1.0}]
    assert [(row["low"], row["high"]) for row in found["parameters"]] == [(0.3, 0.8), (0.01, 0.2)]
    for row, p in zip(found["parameters"], parameters, strict=True):
        assert (row["name"], row["unit"], row["usable"]) == (p["name"], p["unit"], "wider")
        # what a model that passes may lack all the same: ends of 4000 draws, of a sd to a few percent
        np.testing.assert_allclose((row["q05"], row["q95"]), p["further"], atol=0.2 * p["sd"])
    covariance = np.array(found["covariance"])
    np.testing.assert_array_equal(covariance, covariance.T)
    np.testing.assert_allclose(np.sqrt(np.diag(covariance)), [row["sd"] for row in found["parameters"]], rtol=1e-3)
    read = load_randomization(out / "domain_randomization.json")
    assert read.fingerprint == Randomization(load_posterior(out / found["posterior"])).fingerprint
    assert not read.uncalibrated


def test_same_run_comes_back_and_another_seed_is_refused(finished: tuple[Path, Path, Any]) -> None:
    config, out, result = finished
    posterior = (out / "posterior.safetensors").read_bytes()
    again = call(config, "--json", "--out", out)
    assert again.exit_code == 0, again.stderr
    first, second = strict_json(result.stdout), strict_json(again.stdout)
    assert first.pop("seconds") > 0
    assert second.pop("seconds") > 0
    assert first == second
    assert (out / "posterior.safetensors").read_bytes() == posterior
    before = contents(out)
    other = call(config, "--seed", 1, "--out", out)
    assert other.exit_code == 2
    assert "differs in seed" in other.stderr
    assert other.stderr.count("\n") == 1
    assert contents(out) == before


def test_table_for_people(tmp_path: Path, log: pd.DataFrame, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    config = write_case(tmp_path / "swing", log)
    text("bounds = [0.01, 0.2]", "bounds = [0.01, 0.2]\nper_log = true")(config.parent)
    result = call(config)
    assert result.exit_code == 0, result.stderr
    first, *slow = result.stderr.splitlines()
    assert first.startswith("sipe: First estimate")
    assert all(line.split(": ")[0].endswith(" s") for line in slow)  # how far it is, if slow
    assert (tmp_path / "runs" / "config-laplace").is_dir() or (tmp_path / "runs" / "swing-laplace").is_dir()
    shown = "mass", "damping[log]", "with what it may lack", "held out rest, angle: RMSE", "rollouts", "report: runs/"
    for words in shown:
        assert words in result.stdout
    table = result.stdout.index("with what it may lack")
    assert result.stdout.index("may be trusted within its interval") < table
    assert result.stdout.index("is better than the model you had") < table


def test_state_space_leaves_out_what_does_not_apply_and_says_so(tmp_path: Path, log: pd.DataFrame) -> None:
    config = write_case(tmp_path, log)
    text("window = 0.5", 'likelihood = "state_space"\n[search]\nrestarts = 1\ncandidates = 0')(tmp_path)
    result = call(config, "--json", "--out", tmp_path / "out")
    assert result.exit_code == 0, result.stderr
    found = strict_json(result.stdout)
    assert found["misfit"] is None
    texts = {item["code"]: item["text"] for item in found["findings"]}
    assert "state is unknown at every sample" in texts["residuals_left_out"]
    assert "Process noise is largest in the position of hinge" in texts["process_noise"]
    assert (found["comparison"]["verdict"], len(found["outside_prior"])) == ("better", 1)
    assert found["noise"]["angle"]["tau"] == 0
    for p in found["parameters"]:  # 5 sd: one in a million
        assert abs(p["mean"] - TRUTH[p["name"]]) < 5 * p["sd"]
    assert "state is unknown at every sample" in (tmp_path / "out" / "report.html").read_text()
    refused = call(config, "--estimator", "cem", "--out", tmp_path / "other")
    assert refused.exit_code == 2
    assert refused.stderr.count("\n") == 1


@pytest.mark.usefixtures("unreported")
def test_the_spread_of_a_search_is_not_trusted(tmp_path: Path, log: pd.DataFrame) -> None:
    config = write_case(tmp_path, log)
    result = call(config, "--estimator", "cem", "--budget", 200, "--out", tmp_path / "out")
    assert result.exit_code == NOTHING_USABLE, result.stderr
    assert "domain_randomization.json holds the prior of every parameter" in " ".join(result.stdout.split())
    assert "interval yet: " in result.stdout
    assert "warning: the spread of cem" in " ".join(result.stdout.split())
    found = strict_json((tmp_path / "out" / "result.json").read_text())
    assert any("spread of cem is that of its search" in said for said in found["doubts"])
    assert set(found["doubts"]) <= set(found["warnings"])


@pytest.mark.usefixtures("unreported")
def test_a_log_outside_the_prior_is_a_doubt(tmp_path: Path, log: pd.DataFrame, monkeypatch: pytest.MonkeyPatch) -> None:
    outside = OutsidePrior(0.01, "log", "angle", 1.0)
    monkeypatch.setattr("sipe_bayes.calibration.checks.predictions.outside_prior", lambda *_, **__: [outside])
    result = call(write_case(tmp_path, log), "--out", tmp_path / "out")
    assert "interval yet: " in result.stdout
    assert "warning: log log is unlike simulations of the prior" in " ".join(result.stdout.split())
    assert strict_json((tmp_path / "out" / "result.json").read_text())["doubts"] == [outside.finding.text]


@pytest.mark.usefixtures("unreported")
def test_a_log_that_the_model_follows_is_no_doubt(
    tmp_path: Path, log: pd.DataFrame, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One of twenty right logs is unlike the prior's simulations by chance."""

    def outside(*_: object, followed: bool, **__: object) -> list[OutsidePrior]:
        return [OutsidePrior(0.01, "log", "angle", 1.0, followed)]

    monkeypatch.setattr("sipe_bayes.calibration.checks.predictions.outside_prior", outside)
    found = strict_json(call(write_case(tmp_path, log), "--json", "--out", tmp_path / "out").stdout)
    assert found["doubts"] == []
    assert ("outside_prior", "caution") in [(item["code"], item["severity"]) for item in found["findings"]]


def test_what_the_model_lacks_is_a_warning(tmp_path: Path, log: pd.DataFrame) -> None:
    """A torque that is 0.2 N m stronger than logged."""
    config = write_case(tmp_path, log.assign(torque=log["torque"] - 0.2))
    found = strict_json(call(config, "--json", "--out", tmp_path / "out").stdout)
    assert "an offset of motor" in found["misfit"]["cause"]
    assert found["misfit"]["matters"]
    assert "the residuals are not noise" in found["warnings"][0]
    flagged = {p["name"] for p in found["parameters"] if "misfit" in p["flags"]}
    assert flagged
    assert "model lacks something" in (tmp_path / "out" / "report.html").read_text()


def test_logs_that_differ_have_an_interval_for_a_further_one(tmp_path: Path, log: pd.DataFrame) -> None:
    """The second log's torque is logged 1.2 times too small, so that its mass is, too."""
    config = write_case(tmp_path, log)
    log.assign(torque=log["torque"] / 1.2).to_csv(tmp_path / "other.csv", index=False)
    text('file = "log.csv"\nname = "rest"\nuse = "holdout"', 'file = "other.csv"\nname = "other"')(tmp_path)
    result = call(config, "--out", tmp_path / "out")
    assert result.exit_code == 0, result.stderr
    assert "with what it lacks" in result.stdout
    assert "with what the model lacks" in (tmp_path / "out" / "report.html").read_text()
    found = strict_json((tmp_path / "out" / "result.json").read_text())
    assert any("logs disagree" in said for said in found["doubts"])
    (mass,) = (p for p in found["parameters"] if p["name"] == "mass")
    low, high = mass["further"]
    assert low < TRUTH["mass"] / 1.2 < TRUTH["mass"] < high
    assert high - low > 3 * (mass["q95"] - mass["q05"])


@pytest.mark.usefixtures("unreported")
@pytest.mark.parametrize("part", ["lacking.AugmentedModel", "predictions.outside_prior"])
def test_a_check_that_fails_is_one_warning(
    part: str, tmp_path: Path, log: pd.DataFrame, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: Any, **__: Any) -> Any:
        raise ValueError("the simulation diverges")

    monkeypatch.setattr(f"sipe_bayes.calibration.checks.{part}", fail)
    found = strict_json(call(write_case(tmp_path, log), "--json", "--out", tmp_path / "out").stdout)
    assert ["skipped, because the simulation diverges" in w for w in found["warnings"]] == [True]


# A killed run


@pytest.mark.usefixtures("unreported")
def test_killed_run_resumes_to_the_same_posterior(tmp_path: Path, log: pd.DataFrame) -> None:
    """A kill -9 in the middle of the chain; the same command again gives bit for bit what nobody disturbed gives.

    The number of native threads differs on purpose. The budget ends the chain once it has run for some seconds.
    """
    config = write_case(tmp_path, log)
    text('model = "white"', 'model = "ar1"')(tmp_path)
    given = [config, "--estimator", "mcmc", "--budget", 2500]
    whole, broken = [*given, "--out", tmp_path / "whole", "--threads", 1], [*given, "--out", tmp_path / "broken"]
    quiet: dict[str, Any] = {"env": environment(), "stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE}
    process = subprocess.Popen(command(*broken, "--threads", 1), **quiet)
    try:
        size = wait_for_growth(tmp_path / "broken" / "checkpoint.safetensors", process)
        process.send_signal(signal.SIGKILL)
        assert process.wait() == -signal.SIGKILL
        with safe_open(tmp_path / "broken" / "checkpoint.safetensors", framework="numpy") as file:
            assert not json.loads(file.metadata()["plain"])["state"]["done"]
        assert not (tmp_path / "broken" / "posterior.safetensors").exists()
    finally:
        process.kill()
    resumed = call(*broken)  # with two threads
    assert resumed.exit_code == NOTHING_USABLE, resumed.output  # the budget ended it
    undisturbed = CliRunner().invoke(app, ["calibrate", *map(str, whole)])
    assert undisturbed.exit_code == NOTHING_USABLE, undisturbed.output
    assert (tmp_path / "broken" / "checkpoint.safetensors").stat().st_size > size
    for name in ("posterior.safetensors", "posterior.json", "identified.xml", "domain_randomization.json"):
        assert (tmp_path / "broken" / name).read_bytes() == (tmp_path / "whole" / name).read_bytes(), name
    results = [strict_json((tmp_path / k / "result.json").read_text()) for k in ("broken", "whole")]
    assert results[0]["rollouts"] == results[1]["rollouts"]
    assert results[0]["mixing"]["rhat"]
    assert results[0]["mixing"] == results[1]["mixing"]


def wait_for_growth(checkpoint: Path, process: subprocess.Popen[bytes]) -> int:
    """The size of the checkpoint once it has appeared and grown."""
    sizes: set[int] = set()
    deadline = time.monotonic() + 300
    while len(sizes) < 2:
        assert process.poll() is None, "it ended before it could be killed: make the problem longer"
        assert time.monotonic() < deadline, "no checkpoint in five minutes"
        if checkpoint.exists():
            sizes.add(checkpoint.stat().st_size)
        time.sleep(0.02)
    return max(sizes)
