"""The configuration file: what it gives, and one line of error for everything that is wrong with it."""

import contextlib
import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sipe_bayes.calibration.config import Config, check_dimensions, load_config
from sipe_bayes.calibration.config_fields import ConfigError, MeasurementTarget, parse_measurement_target
from sipe_bayes.core.units import UNITS, convert, find_unit, to_si

EXAMPLES = Path(__file__).parents[2] / "examples"

BASE = """\
model = "pendulum.xml"
window = 0.5

[columns]
time = { column = "t", unit = "ms" }

[[commands]]
actuator = "motor"
column = "torque"
unit = "N m"

[[measurements]]
column = "position"
target = "joint:hinge.position"
unit = "deg"
sign = -1

[[logs]]
file = "a.csv"

[[logs]]
file = "b.csv"
use = "holdout"

[[parameters]]
name = "mass"
target = "body:rod.mass"
bounds = [0.1, 1.0]
prior = { mean = 0.5, sd = 0.1 }

[[parameters]]
name = "friction"
targets = ["joint:hinge.damping", "joint:hinge.frictionloss"]
factor = [0.5, 2.0]
scale = "log"
"""


def read(folder: Path, text: str) -> Config:
    (folder / "pendulum.xml").write_text("<mujoco/>")
    path = folder / "run.toml"
    path.write_text(text)
    return load_config(path)


def test_reads_everything(tmp_path: Path) -> None:
    config = read(tmp_path, BASE)
    assert config.model == tmp_path / "pendulum.xml"
    assert (config.estimator, config.window, config.seed, config.budget) == ("laplace", 0.5, 0, None)
    assert config.columns.time.column == "t"
    assert config.channels == ("position",)
    assert config.measurements[0].sign == -1
    assert [log.name for log in config.logs] == ["a", "b"]
    assert [log.name for log in config.logs_for("train")] == ["a"]
    assert config.logs[0].file == tmp_path / "a.csv"
    assert config.parameters[0].targets == ("body:rod.mass",)
    assert config.parameters[1].targets == ("joint:hinge.damping", "joint:hinge.frictionloss")
    assert config.noise.model == "ar1"
    assert config.path == tmp_path / "run.toml"


def test_whole_log_as_one_window_and_earlier_posterior(tmp_path: Path) -> None:
    text = BASE.replace("window = 0.5", 'window = "log"') + '[prior]\nfrom = "runs/one/posterior"\n'
    config = read(tmp_path, text)
    assert config.window == "log"
    assert config.prior is not None
    assert config.prior.source == tmp_path / "runs/one/posterior"


STATE_SPACE = BASE.replace("window = 0.5", 'likelihood = "state_space"')


def test_state_space_has_no_windows_but_may_score_held_out_logs_by_them(tmp_path: Path) -> None:
    config = read(tmp_path, STATE_SPACE.replace('"b.csv"', '"b.csv"\nwindow = 0.3') + '[noise]\nmodel = "white"\n')
    assert (config.likelihood, config.window) == ("state_space", None)
    assert [config.window_of(log) for log in config.logs] == [None, 0.3]
    with pytest.raises(ConfigError, match=r"key `logs\[0\].window`: given with likelihood = 'state_space'"):
        read(tmp_path, STATE_SPACE.replace('"a.csv"', '"a.csv"\nwindow = 0.3'))
    for model in ("ar1", "sandwich"):
        with pytest.raises(ConfigError, match=f"key `noise.model`: expected 'white' .* got '{model}'; drop it"):
            read(tmp_path, STATE_SPACE + f'[noise]\nmodel = "{model}"\n')


def test_a_file_may_train_and_be_held_out_in_different_spans(tmp_path: Path) -> None:
    text = BASE.replace('"a.csv"', '"a.csv"\nspan = [0, 2]').replace('"b.csv"', '"a.csv"\nname = "rest"\nspan = [2, 3]')
    assert [log.span for log in read(tmp_path, text).logs] == [(0.0, 2.0), (2.0, 3.0)]


@pytest.mark.parametrize("name", ["simple_pendulum", "furuta_pendulum"])
def test_shipped_examples(name: str) -> None:
    config = load_config(EXAMPLES / name / "calibrate.toml")
    assert all(log.file.is_file() for log in config.logs)
    assert config.logs_for("train")
    assert config.logs_for("holdout")
    assert (EXAMPLES / name / "LICENSE.txt").is_file()


# (old text, new text, words in the message)
WRONG: list[tuple[str, str, str]] = [
    ('model = "pendulum.xml"\n', "", "`model`: missing; add it"),
    ('"pendulum.xml"', '"pendulun.xml"', "`model`: no such file, got .*did you mean 'pendulum.xml'"),
    ('"pendulum.xml"', "3", "`model`: .*got 3"),
    ("window = 0.5\n", "", "`window`: missing; add it"),
    (
        "window = 0.5",
        'window = 0.5\nlikelihood = "kalman"',
        "`likelihood`: .*'segments' or 'state_space', got 'kalman'",
    ),
    ("window = 0.5", 'window = 0.5\nlikelihood = "state_space"', "`window`: .*no windows; drop it or use"),
    ("window = 0.5", "window = 0", "`window`: .*above zero.*got 0; try"),
    ("window = 0.5", 'window = "half"', "`window`: .*got 'half'"),
    ("window = 0.5", "window = 0.5\nestimator = 'laplac'", "`estimator`: .*'laplac'; did you mean 'laplace'"),
    ("window = 0.5", "window = 0.5\nseed = -1", "`seed`: .*got -1"),
    ("window = 0.5", "window = 0.5\nbudget = 0", "`budget`: .*greater than 0, got 0"),
    ("window = 0.5", "window = 0.5\ngeometry_tolerance = 2", "`geometry_tolerance`: .*got 2; give one such as 0.05"),
    ('"a.csv"', '"a.csv"\ngeometry_tolerance = 0.1', r"`logs\[0\].geometry_tolerance`: .*above the first line with \["),
    ("window = 0.5", "windw = 0.5", "`windw`: unknown key; did you mean 'window'"),
    ("window = 0.5", "window = 0.5 s", "not valid TOML"),
    ('"ms"', '"msec"', "`columns.time.unit`: .*got 'msec'; did you mean 'ms'"),
    ('"ms"', '"deg"', r"`columns.time.unit`: expected a unit of time, got 'deg' \(angle\)"),
    ('"N m"', '"newton"', r"`commands\[0\].unit`: expected a unit word, got 'newton'; use one of .*'N m'"),
    ("sign = -1", "sign = 2", r"`measurements\[0\].sign`: expected 1 or -1, got 2"),
    ("sign = -1", "fit = false", "`measurements`: expected at least one with fit = true"),
    ("sign = -1", "noise_sd = 0", r"`measurements\[0\].noise_sd`: .*got 0"),
    ('"joint:hinge.position"', '"hinge"', r"`measurements\[0\].target`: .*got 'hinge'; write 'joint:NAME"),
    ('"deg"', '"degrees"', r"`measurements\[0\].unit`: .*'degrees'"),
    ('"a.csv"', '"a.csv"\nfle = 1', r"`logs\[0\].fle`: unknown key; did you mean 'file'"),
    ('"a.csv"', "3", r"`logs\[0\].file`: .*got 3"),
    ('"a.csv"', '""', r"`logs\[0\].file`: expected a path"),
    ('"a.csv"', '"a.csv"\nuse = "test"', r"`logs\[0\].use`: .*got 'test'; .*'train'"),
    ('"a.csv"', '"a.csv"\nuse = "holdout"', "`logs`: expected at least one with use = 'train', got none"),
    ('"a.csv"', '"a.csv"\nspan = [3, 1]', r"`logs\[0\].span`: reversed, got \[3, 1\]; swap to \[1, 3\]"),
    ('"a.csv"', '"a.csv"\nspan = [1, 1]', r"`logs\[0\].span`: .*low < high"),
    ('"a.csv"', '"a.csv"\nspan = [-1, 1]', r"`logs\[0\].span`: starts before the log"),
    ('"b.csv"', '"c/a.csv"', r"`logs\[1\].name`: .*got 'a' also at logs\[0\]"),
    ('"b.csv"', '"a.csv"\nname = "b"', r"`logs\[1\].use`: held out, but samples of it train as log 'a'"),
    ("[0.1, 1.0]", "[1.0, 0.1]", r"`parameters\[0\].bounds`: reversed, got \[1, 0.1\]; swap to \[0.1, 1\]"),
    ("[0.1, 1.0]", '["0.1", 1.0]', r"`parameters\[0\].bounds\[0\]`: .*got '0.1'"),
    ("[0.1, 1.0]", "[0.1]", r"`parameters\[0\].bounds\[1\]`: missing"),
    ("[0.1, 1.0]", "[0.1, inf]", r"`parameters\[0\].bounds\[1\]`: .*finite.*got inf"),
    (
        "[0.1, 1.0]",
        '[0.0, 1.0]\nscale = "log"',
        r"`parameters\[0\].bounds`: a log scale needs .* use scale =",
    ),
    ("factor = [0.5, 2.0]", "", r"`parameters\[1\].bounds`: .*got neither"),
    ("factor = [0.5, 2.0]", "factor = [1, 2]\nbounds = [1, 2]", r"`parameters\[1\].bounds`: .*got both"),
    (
        "mean = 0.5",
        "mean = 5",
        r"`parameters\[0\].prior.mean`: expected a mean within the bounds \[0.1, 1\], got 5",
    ),
    ("sd = 0.1", "sd = -1", r"`parameters\[0\].prior.sd`: .*got -1"),
    ('target = "body:rod.mass"', "", r"`parameters\[0\].target`: .*got neither"),
    ('target = "body:rod.mass"', "target = 1", r"`parameters\[0\].target`: expected one string, got 1"),
    (
        '"body:rod.mass"',
        '"joint:hinge.damping"',
        r"`parameters\[1\].targets`: .*already driven by parameter 'mass'",
    ),
    (
        '"joint:hinge.frictionloss"',
        '"joint:hinge.damping"',
        r"`parameters\[1\].targets`: names a target twice",
    ),
    ('name = "friction"', 'name = "mass"', r"`parameters\[1\].name`: .*got 'mass' also at parameters\[0\]"),
    ('name = "friction"', 'name = "f"\nper_log = 1', r"`parameters\[1\].per_log`: .*got 1"),
    ("[columns]", "[resample]\nrate = 0\n[columns]", "`resample.rate`: .*got 0"),
    (
        "[columns]",
        '[noise]\nmodel = "pink"\n[columns]',
        "`noise.model`: .*got 'pink'; use one of 'ar1', 'white'",
    ),
    ("[columns]", '[prior]\nfile = "x"\n[columns]', "`prior.file`: unknown key; use one of 'from'"),
    (BASE, "", "`model`: missing"),
]


@pytest.mark.parametrize(("old", "new", "words"), WRONG, ids=[w[2][:45] for w in WRONG])
def test_wrong_input(tmp_path: Path, old: str, new: str, words: str) -> None:
    assert old in BASE
    with pytest.raises(ConfigError) as caught:
        read(tmp_path, BASE.replace(old, new, 1))
    message = str(caught.value)
    assert re.search(words, message), message
    assert "\n" not in message
    assert message.startswith(str(tmp_path / "run.toml"))


def test_two_commands_for_one_actuator(tmp_path: Path) -> None:
    again = '[[commands]]\nactuator = "motor"\ncolumn = "other"\nunit = "N m"\n'
    with pytest.raises(ConfigError, match=r"`commands\[1\].actuator`: .*'motor' also at commands\[0\]"):
        read(tmp_path, BASE + again)


def test_missing_configuration_names_the_nearest(tmp_path: Path) -> None:
    read(tmp_path, BASE)
    with pytest.raises(ConfigError, match=r"run.tml: no such file; did you mean 'run.toml'"):
        load_config(tmp_path / "run.tml")
    with pytest.raises(ConfigError, match=r"folder .* does not exist"):
        load_config(tmp_path / "nowhere" / "run.toml")


def test_wrong_kind_of_unit(tmp_path: Path) -> None:
    config = read(tmp_path, BASE.replace('"deg"', '"m"'))
    with pytest.raises(ConfigError, match=r"`measurements\[0\].unit`: .*expected a unit of angle, got 'm' \(length\)"):
        check_dimensions(config, {"joint:hinge.position": "angle"})
    check_dimensions(config, {"joint:other.position": "angle"})
    with pytest.raises(ConfigError, match=r"`commands\[0\].unit`: actuator:motor .*unit of voltage, got 'N m'"):
        check_dimensions(config, {"actuator:motor": "voltage"})


@pytest.mark.parametrize(
    ("text", "parsed"),
    [
        ("joint:hinge.position", MeasurementTarget("joint", "hinge", "position")),
        ("joint:left/knee.1.velocity", MeasurementTarget("joint", "left/knee.1", "velocity")),
        ("sensor:imu", MeasurementTarget("sensor", "imu", "reading")),
        ("sensor:imu[2]", MeasurementTarget("sensor", "imu", "reading", 2)),
    ],
)
def test_measurement_targets(text: str, parsed: MeasurementTarget) -> None:
    assert parse_measurement_target(text) == parsed


@given(st.text(max_size=30))
def test_measurement_target_parser_is_total(text: str) -> None:
    with contextlib.suppress(ValueError):
        assert parse_measurement_target(text).name in text
    for written in (f"joint:{text}.velocity", f"sensor:{text}[3]"):
        if text and not set(text) & set("[]\n"):
            assert parse_measurement_target(written).name == text


def test_units() -> None:
    assert to_si("deg") == (math.pi / 180, "rad")
    assert to_si(" N  m ") == (1.0, "N m")
    np.testing.assert_allclose(convert([60.0], "rpm", "angular velocity"), [2 * math.pi])
    np.testing.assert_allclose(convert([1.0, math.nan], "g0"), [9.80665, math.nan])
    for word, unit in UNITS.items():
        assert find_unit(unit.si).factor == 1.0
        assert find_unit(unit.si).dimension == unit.dimension, word


UNIT_ERRORS: list[tuple[Any, str]] = [
    (lambda: to_si("Rad"), "'Rad'; did you mean 'rad'"),
    (lambda: convert([1.0], "m", "angle"), r"expected a unit of angle, got 'm' \(length\); use one of 'rad'"),
    (lambda: convert([1.0], "m", "angel"), "unknown dimension 'angel'"),
    (lambda: to_si(""), "got ''; use one of"),
]


@pytest.mark.parametrize(("call", "words"), UNIT_ERRORS)
def test_unit_errors(call: Any, words: str) -> None:
    with pytest.raises(ValueError, match=words) as caught:
        call()
    assert "\n" not in str(caught.value)
