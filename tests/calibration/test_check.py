"""``sipe check`` passes an honest estimator, sees planted widths, and goes on where it was interrupted."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from sipe_bayes.calibration import check as checks
from sipe_bayes.calibration.study import study_of_task
from sipe_bayes.cli.app import app
from sipe_bayes.inference.laplace import Laplace
from sipe_bayes.likelihood import StateSpace


def call(*arguments: object) -> Any:
    return CliRunner().invoke(app, ["check", *map(str, arguments)])


@pytest.mark.parametrize(
    ("estimator", "verdict"), [("laplace", "calibrated"), ("half", "too narrow"), ("twice", "too wide")]
)
def test_planted_widths_are_seen_and_honest_ones_pass(
    config: Path, estimator: str, verdict: str, tmp_path: Path
) -> None:
    """A check alarms falsely in 2 % in all; halved and doubled posteriors are seen in 40 logs all but surely.

    The halved ones sooner, and the rest is spared.
    """
    result = call(config, estimator, "--truths", 40, "--out", tmp_path / "out", "--threads", 1, "--json")
    summary = json.loads(result.stdout)
    print(summary["verdict"], summary["sharpness"])
    assert verdict in {p["verdict"] for p in summary["parameters"]}
    assert (summary["spared"] > 0) == (verdict == "too narrow")
    assert result.exit_code == (0 if verdict == "calibrated" else 1)
    assert summary["truths"] == 40 - summary["spared"]
    share = {"calibrated": (0.78, 0.98), "too narrow": (0.4, 0.75), "too wide": (0.96, 1.0)}[verdict]
    assert share[0] <= summary["coverage_90"] <= share[1]
    assert {"calibrated": "no cause for alarm"}.get(verdict, verdict) in summary["verdict"]
    for name in ("ranks.png", "coverage.png"):
        assert (tmp_path / "out" / name).read_bytes()[:4] == b"\x89PNG"


def test_an_interrupted_check_goes_on(config: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What is there is not fitted again; a damaged file is."""
    arguments = (config, "laplace", "--truths", 20, "--threads", 1, "--json", "--out")
    done: list[int] = []
    fit = checks._Worker.fit

    def dying(self: Any, number: int) -> Any:
        if number == 12:
            raise KeyboardInterrupt
        return fit(self, number)

    monkeypatch.setattr(checks._Worker, "fit", dying)
    assert call(*arguments, tmp_path / "out").exit_code != 0
    assert len(list((tmp_path / "out" / "fits").iterdir())) == 12
    (tmp_path / "out" / "fits" / "00003.npz").write_bytes(b"half a file")
    before = (tmp_path / "out" / "fits" / "00007.npz").read_bytes()
    monkeypatch.setattr(checks._Worker, "fit", lambda self, number: (done.append(number), fit(self, number))[1])
    assert json.loads(call(*arguments, tmp_path / "out").stdout)["truths"] == 20
    assert done == [3, *range(12, 20)]
    assert (tmp_path / "out" / "fits" / "00007.npz").read_bytes() == before
    other = call(*arguments, tmp_path / "out", "--seed", 1)
    assert other.exit_code == 2
    assert "holds another check (it differs in seed, settings)" in other.stderr


def test_an_amortised_estimator_is_trained_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A task, its method trained once and conditioned on every log."""
    trained: list[int] = []
    from sipe_bayes.inference.amortised.abc import ABC

    train = ABC.train
    monkeypatch.setattr(ABC, "train", lambda self, *given: (trained.append(1), train(self, *given))[1])
    arguments = ("Pendulum", "abc", "--truths", 20, "--budget", 200, "--steps", 20, "--threads", 1, "--json", "--out")
    result = call(*arguments, tmp_path / "plain")
    summary = json.loads(result.stdout)
    assert summary["truths"] == 20, result.output
    assert len(trained) == 1
    assert summary["rollouts"] == 200  # counted once
    again = json.loads(call("Pendulum", "abc", "--truths", 22, *arguments[4:], tmp_path / "plain").stdout)  # two more
    assert (again["truths"], again["rollouts"]) == (22, 200)


@pytest.mark.parametrize(
    ("method", "refits", "said"),
    [
        ("abc", 0, "one training of 200 rollouts, then 20 fits, kept in"),
        ("abc", 20, "one training of 200 rollouts, then 20 fits of at most 20 rollouts each, kept in"),
        ("laplace", 0, "20 fits of at most 200 rollouts each, kept in"),
        ("laplace", 20, "20 fits of at most 4220 rollouts each, kept in"),
    ],
)
def test_the_cost_is_said_first(
    method: str, refits: int, said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With refits: a fit of the log, and for each replica the replica and a fit."""

    def stopped(*given: Any) -> None:
        raise ValueError("that is all")

    monkeypatch.setattr(checks, "run", stopped)
    result = call("Pendulum", method, "--truths", 20, "--budget", 200, "--refits", refits, "--out", tmp_path / "out")
    assert result.stdout.startswith(said), result.stdout


def test_every_fit_has_a_seed_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seeds: list[int] = []
    fit = Laplace.fit
    monkeypatch.setattr(Laplace, "fit", lambda self, given: (seeds.append(self.seed), fit(self, given))[1])
    call("Pendulum", "laplace", "--truths", 20, "--steps", 10, "--noise", 0, "--threads", 1, "--out", tmp_path / "out")
    assert len(seeds) == len(set(seeds)) == 20


def test_fetch_is_checked_from_its_recorded_start() -> None:
    """Its controller has a memory, which StateSpace does not look for in measurements."""
    given = {"steps": 4, "noise": 0.01, "budget": 1500, "refits": 0, "seed": 0, "threads": 1}
    for task, starts in (("FetchPush", "recorded"), ("Pendulum", "estimated")):
        study = study_of_task(task, "laplace", **given)  # type: ignore[arg-type]
        assert isinstance(study.estimator.likelihood, StateSpace)
        assert study.estimator.likelihood.starts == starts
    study = study_of_task("FetchPush", "laplace", **given)  # type: ignore[arg-type]
    fitted = checks._Worker(study, Path(), lambda *what: None).fit(0)
    assert fitted.error == ""
    assert len(fitted.draws)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("config.toml", "laplace", "--truths", 10), "truths: expected at least 20, got 10"),
        (("config.toml", "laplase"), "did you mean 'laplace'?"),
        (("missing.toml", "laplace"), "missing.toml"),
        (("Pendulumm", "laplace"), "Pendulumm"),
        (("Pendulum", "abc", "--noise", -1), "--noise: expected at least 0"),
        (("config.toml", "laplace", "--out", "."), "holds files of something else"),
    ],
)
def test_wrong_input_is_one_line(config: Path, arguments: tuple[object, ...], words: str) -> None:
    result = call(*arguments, "--json")
    assert result.exit_code == 2, result.output
    assert words in result.stderr
    assert result.stderr.count("\n") == 1
