"""Wrong input of `sipe calibrate` and what the parser refuses: one line, exit code 2, nothing written."""

import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from sipe_bayes.cli.app import main
from tests.problems.swings import call, contents, gone, sipe_command, swing, table, text, write_case


@pytest.fixture(scope="module")
def log() -> pd.DataFrame:
    return swing()


def turned_back(log: pd.DataFrame) -> pd.DataFrame:
    log.loc[7, "time"] = 0.02
    return log


def occupied(file: str, content: str) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        (folder / "out").mkdir()
        (folder / "out" / file).write_text(content)

    return change


def nothing(folder: Path) -> None:
    pass


# what is wrong: (change, more arguments, words of the one line: argument, value, remedy)
WRONG: dict[str, tuple[Callable[[Path], None], list[str], list[str]]] = {
    "missing config": (gone("config.toml"), [], ["config.toml", "no such file", "correct the path"]),
    "unknown device": (nothing, ["--device", "tpu"], ["device", "'cpu', 'cuda'", "got 'tpu'"]),
    "missing log": (gone("log.csv"), [], ["log 'log'", "log.csv: no such file", "correct the path"]),
    "misspelt log": (text('"log.csv"', '"lag.csv"'), [], ["lag.csv: no such file", "did you mean 'log.csv'?"]),
    "missing model": (text("pendulum.xml", "pendulm.xml"), [], ["key `model`", "did you mean 'pendulum.xml'?"]),
    "missing column": (
        table(lambda log: log.rename(columns={"position": "positn"})),
        [],
        ["log 'log'", "`measurements[0].column`: no column 'position'", "did you mean 'positn'?"],
    ),
    "missing clock": (
        text("[noise]", '[columns]\ntime = { column = "tome" }\n\n[noise]'),
        [],
        ["log 'log'", "`columns.time.column`: no column 'tome'", "did you mean 'time'?"],
    ),
    "unknown joint": (text("joint:hinge.pos", "joint:hing.pos"), [], ["'angle'", "no joint 'hing'", "'hinge'?"]),
    "unknown actuator": (text('"motor"', '"moter"'), [], ["no actuator 'moter'", "did you mean 'motor'?"]),
    "unknown body": (text("body:rod.mass", "body:rood.mass"), [], ["'mass'", "no body 'rood'", "'rod'?"]),
    "unknown attribute": (
        text("body:rod.mass", "body:rod.weight"),
        [],
        ["'mass'", "no attribute 'weight'", "known: com_x"],
    ),
    "target without attribute": (text("body:rod.mass", "rod"), [], ["'mass'", "'rod'", "KIND:NAME.ATTRIBUTE"]),
    "unknown quantity": (
        text("hinge.position", "hinge.angle"),
        [],
        ["measurements[0].target", "'joint:hinge.angle'", "'joint:NAME.position'"],
    ),
    "time turns back": (table(turned_back), [], ["log 'log'", "'time' must increase", "0.02", "sort the rows"]),
    "time stands still": (
        table(lambda log: log.assign(time=log["time"].where(log["time"] != 0.03, 0.02))),
        [],
        ["'time' must increase", "0.02 in row 4", "drop duplicate rows"],
    ),
    "channel all NaN": (
        table(lambda log: log.assign(position=np.nan)),
        [],
        ["log 'log'", "'position' holds no number", "drop the measurement"],
    ),
    "command all NaN": (
        table(lambda log: log.assign(torque=np.nan)),
        [],
        ["log 'log'", "'torque' holds no number", "choose another column"],
    ),
    "words in a column": (
        table(lambda log: log.assign(position="up")),
        [],
        ["'position' holds 'up' in row 1", "correct it"],
    ),
    "bounds reversed": (text("[0.3, 0.8]", "[0.8, 0.3]"), [], ["parameters[0].bounds", "[0.8, 0.3]", "swap to"]),
    "bounds equal": (text("[0.3, 0.8]", "[0.3, 0.3]"), [], ["parameters[0].bounds", "[0.3, 0.3]", "widen"]),
    "default outside bounds": (
        text("[0.3, 0.8]", "[0.6, 0.8]"),
        [],
        ["'mass'", "0.5", "[0.6, 0.8]", "widen"],
    ),
    "log scale from zero": (
        text("[0.01, 0.2]", "[0.0, 0.2]"),
        [],
        ["parameters[1].bounds", "[0, 0.2]", "raise the lower one"],
    ),
    "log shorter than a window": (
        text("window = 0.5", "window = 2.5"),
        [],
        ["log 'log'", "lasts 2 s", "window of 2.5 s", "lower `window`"],
    ),
    "wrong unit word": (text('"rad"', '"radian"'), [], ["measurements[0].unit", "'radian'", "did you mean 'rad'?"]),
    "wrong kind of unit": (
        text('"rad"', '"m"'),
        [],
        ["measurements[0].unit", "'m' (length)", "use one of 'rad'"],
    ),
    "not MJCF": (
        text("</mujoco>", "", "pendulum.xml"),
        [],
        ["model", "pendulum.xml", "not valid MJCF", "Line", "correct it"],
    ),
    "does not compile": (
        text('joint="hinge"', 'joint="knee"', "pendulum.xml"),
        [],
        ["model", "pendulum.xml", "knee", "line 9", "correct it"],
    ),
    "not TOML": (
        text('model = "pendulum.xml"', "model = "),
        [],
        ["config.toml", "not valid TOML", "line 1", "correct"],
    ),
    "unknown key": (text("window =", "windows ="), [], ["key `windows`", "did you mean 'window'?"]),
    "target twice": (
        text("joint:hinge.damping", "body:rod.mass"),
        [],
        ["parameters[1].targets", "'body:rod.mass'", "drop it from one"],
    ),
    "held-out samples train": (
        text("[2.01, 3.0]", "[1.0, 3.0]"),
        [],
        ["logs[1].use", "'log'", "give spans or episodes apart"],
    ),
    "unknown estimator": (nothing, ["--estimator", "laplase"], ["estimator", "'laplase'", "did you mean 'laplace'?"]),
    "negative seed": (nothing, ["--seed", "-1"], ["--seed -1", "at least 0", "raise it"]),
    "no budget": (nothing, ["--budget", "0"], ["--budget 0", "at least 1", "raise it"]),
    "output holds another run": (
        occupied("run.json", '{"seed": 3}'),
        [],
        ["--out", "out", "another run", "seed", "choose another folder"],
    ),
    "output holds something else": (
        occupied("thesis.tex", "precious"),
        [],
        ["--out", "out", "something else", "choose an empty or a new folder"],
    ),
    "output is a file": (lambda folder: (folder / "out").touch(), [], ["--out", "is a file", "another name"]),
}


@pytest.mark.parametrize("wrong", WRONG)
def test_wrong_input_is_one_line(
    wrong: str, tmp_path: Path, log: pd.DataFrame, monkeypatch: pytest.MonkeyPatch
) -> None:
    change, arguments, words = WRONG[wrong]
    config = write_case(tmp_path, log)
    change(tmp_path)
    monkeypatch.chdir(tmp_path)
    before = contents(tmp_path)
    result = call(config, "--out", tmp_path / "out", *arguments)
    assert result.exit_code == 2, result.output
    assert result.stdout == ""
    assert result.stderr.count("\n") == 1, result.stderr
    assert result.stderr.startswith("sipe: ")
    assert [w for w in words if w not in result.stderr] == [], result.stderr
    assert contents(tmp_path) == before


def test_wrong_input_of_the_installed_command(tmp_path: Path, log: pd.DataFrame) -> None:
    config = write_case(tmp_path, log)
    text('joint="hinge"', 'joint="knee"', "pendulum.xml")(tmp_path)
    before = contents(tmp_path)
    result = sipe_command(tmp_path, config, "--json")
    assert (result.returncode, result.stdout) == (2, "")
    assert result.stderr.count("\n") == 1
    assert "knee" in result.stderr
    assert contents(tmp_path) == before


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (["benchmark", "run", "--suite", "quick", "--budget", "many"], 2, "invalid value for '--budget'"),
        (["benchmark", "run", "quick"], 2, "(quick); see --help"),
        (["--foo"], 2, "no such option: --foo"),
        (["calibrate"], 2, "missing argument 'config'"),
        (["calibrate", "nowhere.toml"], 2, "nowhere.toml"),
        (["benchmark", "cells"], 0, ""),
    ],
)
def test_what_the_parser_refuses_is_one_line(
    arguments: list[str], code: int, words: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["sipe", *arguments])
    with pytest.raises(SystemExit) as ended:
        main()
    said = capsys.readouterr().err
    assert ended.value.code == code
    assert said.count("\n") == (code == 2)
    assert words in said
    assert code == 0 or said.startswith("sipe: ")


def test_a_group_alone_shows_its_help(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(sys, "argv", ["sipe", "benchmark"])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 2
    printed = capsys.readouterr()
    assert "[OPTIONS] COMMAND" in printed.out + printed.err
