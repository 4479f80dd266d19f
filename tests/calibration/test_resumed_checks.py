"""An interrupted calibration goes on with its first unfinished check, to the same bits; how far it is, it says."""

from __future__ import annotations

import json
import re
import signal
import subprocess
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from sipe_bayes.calibration.checks.plan import Check, plan_of
from sipe_bayes.calibration.problem import Problem, method_of, prepare
from sipe_bayes.calibration.run import calibrate
from sipe_bayes.cli.app import app
from sipe_bayes.diagnostics.result import Calibration
from sipe_bayes.likelihood.windows import Windows
from sipe_bayes.simulation.simulator import Simulator
from sipe_bayes.structure import probes
from tests.problems.swings import call, command, environment, strict_json, swing, text, write_case


def reported(calibration: Calibration) -> dict[str, object]:
    """All that a calibration says, but how long it took and in which folder its logs are."""
    drawn = {f"{s.log} {s.channel} {k}": v for s in calibration.signals for k, v in vars(s).items()}
    left = {f"{r.log} {r.channel} left {k}": v for r in calibration.residuals for k, v in vars(r).items()}
    arrays = {k: v.tobytes() for k, v in (drawn | left).items() if isinstance(v, np.ndarray)}
    further = None if calibration.further is None else calibration.further.theta.numpy().tobytes()
    plain = calibration.to_dict()
    logs = [{key: value for key, value in log.items() if key != "file"} for log in plain["logs"]]
    return {**plain, **arrays, "logs": logs, "further": further, "seconds": 0}


class Stopped:
    """A progress that notes what is said of checks, and interrupts where it begins so; never where that is empty."""

    def __init__(self, at: str = "") -> None:
        self.at, self.heard = at, list[str]()

    def __call__(self, what: str, done: int, total: int) -> None:
        if what.startswith("check "):
            self.heard.append(what)
        if self.at and what.startswith(self.at):
            raise KeyboardInterrupt


def counted(monkeypatch: pytest.MonkeyPatch, place: Any, name: str) -> Callable[[], int]:
    """How often a function has been called since the last look."""
    calls, own = [0], getattr(place, name)

    def counting(*arguments: Any, **named: Any) -> Any:
        calls[0] += 1
        return own(*arguments, **named)

    def look() -> int:
        seen, calls[0] = calls[0], 0
        return seen

    monkeypatch.setattr(place, name, counting)
    return look


@pytest.fixture
def problem(tmp_path: Path) -> Problem:
    return prepare(write_case(tmp_path, swing()), 1)


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> Calibration:
    """Of ``problem``, which nobody stopped."""
    return calibrate(prepare(write_case(tmp_path_factory.mktemp("undisturbed"), swing()), 1))


@pytest.fixture
def apart(tmp_path: Path) -> Problem:
    """Two logs that disagree: the torque of the second is logged 1.2 times too small."""
    config = write_case(tmp_path, swing())
    swing().assign(torque=swing()["torque"] / 1.2).to_csv(tmp_path / "other.csv", index=False)
    text('file = "log.csv"\nname = "rest"\nuse = "holdout"', 'file = "other.csv"\nname = "other"')(tmp_path)
    return prepare(config, 1)


def test_a_run_that_is_stopped_in_every_check(problem: Problem, undisturbed: Calibration, tmp_path: Path) -> None:
    """Each time it goes on with that one, and in the end says what one says that nobody stopped."""
    checkpoint, count = tmp_path / "out" / "checkpoint.safetensors", len(Check)
    for number in range(1, count + 1):
        at = f"check {number} of {count}, "
        progress = Stopped(at)
        with pytest.raises(KeyboardInterrupt):
            calibrate(problem, checkpoint=checkpoint, progress=progress)
        begun = list(dict.fromkeys(what.partition(",")[0] for what in progress.heard))
        assert begun == [f"check {k} of {count}" for k in range(max(number - 1, 1), number + 1)]
    assert reported(calibrate(problem, checkpoint=checkpoint)) == reported(undisturbed)


def test_nothing_is_simulated_again(problem: Problem, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    checkpoint = tmp_path / "out" / "checkpoint.safetensors"
    first = calibrate(problem, checkpoint=checkpoint)
    rollouts, predictions = counted(monkeypatch, Simulator, "rollout"), counted(monkeypatch, Windows, "predict")
    assert reported(calibrate(problem, checkpoint=checkpoint)) == reported(first)
    assert (rollouts(), predictions()) == (0, 0)


def test_parts_of_a_check_are_kept(problem: Problem, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Groups of extensions; gone when the check is whole."""
    checkpoint, checking = tmp_path / "out" / "checkpoint.safetensors", f"check 3 of {len(Check)}, what the model lacks"
    groups = counted(monkeypatch, probes, "_of_group")
    whole = calibrate(problem)
    of_groups = groups()
    for words, made in (("simulating what extensions would do, 3 of", 2), ("comparing with noise", of_groups - 2)):
        with pytest.raises(KeyboardInterrupt):
            calibrate(problem, checkpoint=checkpoint, progress=Stopped(f"{checking}: {words}"))
        assert groups() == made
    kept = {file.name for file in (tmp_path / "out" / "checks").iterdir()}
    assert {"starts.safetensors", "logs.safetensors", "lacking.extensions-0.safetensors"} <= kept
    assert reported(calibrate(problem, checkpoint=checkpoint)) == reported(whole)
    assert groups() == 0
    kept = {file.name for file in (tmp_path / "out" / "checks").iterdir()}
    assert kept == {f"{check.name.lower()}.safetensors" for check in Check}


def test_checks_of_another_fit_are_made_again(problem: Problem, undisturbed: Calibration, tmp_path: Path) -> None:
    """In the same folder: of a fit that a larger budget let go on, and of files that are damaged."""
    folder = tmp_path / "out"
    calibrate(problem, budget=undisturbed.rollouts - 3, checkpoint=folder / "checkpoint.safetensors")
    assert reported(calibrate(problem, checkpoint=folder / "checkpoint.safetensors")) == reported(undisturbed)
    for file in (folder / "checks").iterdir():
        file.write_bytes(file.read_bytes()[:-3])
    assert reported(calibrate(problem, checkpoint=folder / "checkpoint.safetensors")) == reported(undisturbed)


@pytest.mark.parametrize("case", ["problem", "apart"])
def test_the_forecast_holds_the_checks(
    case: str, request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What is done never falls and never exceeds it all; no more is simulated after the fit than its plan has."""
    given, spent, done_before = request.getfixturevalue(case), [0], [0]
    forecast = sum(plan_of(given, method_of(given, None, None, None)).values())
    spend = Windows.spend

    def counting(self: Windows, batch: int) -> None:
        spent[0] += batch * len(self.trajectories)
        spend(self, batch)

    def progress(what: str, done: int, total: int) -> None:
        if what.endswith("(then checks)"):
            spent[0] = 0
            assert total - forecast >= done
        else:
            assert done_before[0] <= done <= total, what
            done_before[0] = done

    monkeypatch.setattr(Windows, "spend", counting)
    calibrate(given, progress=progress)
    print(spent, forecast)
    if case == "problem":  # where logs disagree, each is fitted by itself
        assert 0 < spent[0] <= forecast < 3 * spent[0]


def test_killed_in_its_checks(tmp_path: Path) -> None:
    """A kill -9; the same command again gives what nobody disturbed gives, the report too but for the seconds."""
    config, broken = write_case(tmp_path, swing()), tmp_path / "broken"
    quiet: dict[str, Any] = {
        "env": {**environment(), "MUJOCO_GL": "disabled"},
        "stdout": subprocess.DEVNULL,
        "stderr": subprocess.PIPE,
    }
    process = subprocess.Popen(command(config, "--out", broken, "--threads", 1), **quiet)
    try:
        deadline = time.monotonic() + 300
        while not (broken / "checks" / "lacking.extensions-1.safetensors").exists():
            assert process.poll() is None, "it ended before it could be killed"
            assert time.monotonic() < deadline, "no check in five minutes"
            time.sleep(0.005)
        process.send_signal(signal.SIGKILL)
        assert process.wait() == -signal.SIGKILL
    finally:
        process.kill()
    assert strict_json((broken / "result.json").read_text())["checked"] is False
    ended = call(config, "--out", broken)  # with two threads
    assert ended.exit_code == 0, ended.output
    undisturbed = CliRunner().invoke(
        app, ["calibrate", str(config), "--out", str(tmp_path / "whole"), "--threads", "1"]
    )
    assert undisturbed.exit_code == 0, undisturbed.output
    results = [strict_json((tmp_path / k / "result.json").read_text()) for k in ("broken", "whole")]
    for result in results:
        del result["seconds"], result["out"]
    assert json.dumps(results[0]) == json.dumps(results[1])
    pages = [(tmp_path / k / "report.html").read_text() for k in ("broken", "whole")]
    broken_page, whole_page = (re.sub(r"\d[\d.]* s</p>|broken|whole", "", page) for page in pages)
    assert broken_page == whole_page
