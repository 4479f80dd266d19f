"""Logs of poses: quaternions in either order and of any sign, vectors, wrong input."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sipe_bayes.calibration.config import load_config
from sipe_bayes.calibration.config_fields import ConfigError
from sipe_bayes.calibration.logs import load_log
from sipe_bayes.calibration.problem import prepare
from sipe_bayes.calibration.readers.base import LogError
from sipe_bayes.core.findings import Code
from sipe_bayes.core.rotations import between, quaternions
from tests.problems.bodies import CUBE

CONFIG = """
model = "cube.xml"
window = "log"
logs = "tosses/*.csv"

[[measurements]]
target = "body:cube.position"
columns = ["x", "y", "z"]
unit = "mm"

[[measurements]]
target = "body:cube.orientation"
columns = ["a", "b", "c", "d"]
quaternion = "wxyz"
name = "turn"
noise_sd = 0.02

[[parameters]]
name = "friction"
targets = ["geom:cube.friction", "geom:floor.friction"]
bounds = [0.05, 0.6]
"""
TIME = np.arange(40) / 148
VECTORS = np.stack([9 * TIME, np.sin(20 * TIME), 12 * TIME], axis=1)


def write(folder: Path, text: str = CONFIG, order: str = "wxyz", samples: int = 40, **columns: Any) -> Path:
    """A folder with the cube, two tosses and a configuration."""
    rng = np.random.default_rng(0)
    (folder / "cube.xml").write_text(CUBE)
    (folder / "tosses").mkdir(exist_ok=True)
    for k in range(2):
        turns = quaternions(VECTORS) * rng.choice([-1.0, 1.0], (40, 1))
        turns = turns if order == "wxyz" else turns[:, [1, 2, 3, 0]]
        rows = np.column_stack([TIME, 100 * TIME, 0 * TIME, 500 + k + 0 * TIME, turns])
        for name, values in columns.items():
            rows[:, ["time", "x", "y", "z", *"abcd"].index(name)] = values
        lines = [",".join(f"{x:.7f}" if np.isfinite(x) else "" for x in row) for row in rows[:samples]]
        (folder / "tosses" / f"{k}.csv").write_text("\n".join(["time,x,y,z,a,b,c,d", *lines]) + "\n")
    path = folder / "calibrate.toml"
    path.write_text(text)
    return path


@pytest.mark.parametrize("order", ["wxyz", "xyzw"])
def test_poses_are_read_in_either_order_with_any_signs(tmp_path: Path, order: str) -> None:
    problem = prepare(write(tmp_path, CONFIG.replace("wxyz", order), order))
    assert problem.environment.channels[3:] == ("turn_x", "turn_y", "turn_z")
    assert problem.environment.channels[0] == "cube.position_x"
    assert problem.environment.channel_units == ("m",) * 3 + ("rad",) * 3
    assert problem.likelihood.noise_sd == (None, None, None, 0.02, 0.02, 0.02)
    assert problem.train.names == ("0", "1")
    for k, log in enumerate(problem.train):
        np.testing.assert_allclose(log.observations[:, 0], 0.1 * TIME, atol=1e-9)
        np.testing.assert_allclose(log.observations[:, 2], 0.5 + 0.001 * k, atol=1e-9)
        np.testing.assert_allclose(between(log.observations[:, 3:], VECTORS), 0, atol=1e-6)
        assert np.abs(np.diff(log.observations[:, 3:], axis=0)).max() < 0.5, "written without jumps"


def test_an_uneven_clock_interpolates_the_rotation(tmp_path: Path) -> None:
    """Between samples whose quaternions have opposite signs, and over a missing one."""
    late = TIME.copy()
    late[1::2] += 0.4 / 148
    missing = np.where(np.arange(40) == 20, np.nan, 500.0)
    path = write(tmp_path, CONFIG + "\n[resample]\nrate = 148\n", time=late, a=np.nan * TIME)
    with pytest.raises(LogError, match=r"'a' holds no number|no quaternion"):
        load_log(load_config(path), load_config(path).logs[0])
    path = write(tmp_path, CONFIG + "\n[resample]\nrate = 148\n", time=late, z=missing)
    trajectory, report = load_log(load_config(path), load_config(path).logs[0])
    assert report.resampled
    seen = np.isfinite(trajectory.observations[:, 3])
    expected = np.stack([np.interp(TIME[: len(seen)], late, v) for v in VECTORS.T], axis=1)
    np.testing.assert_allclose(between(trajectory.observations[seen, 3:], expected[seen]), 0, atol=0.02)


def test_a_log_of_one_sample_is_refused_in_one_line(tmp_path: Path) -> None:
    path = write(tmp_path, samples=1)
    with pytest.raises(LogError, match=r"log '0': expected at least 2 samples, got 1; record a longer log") as error:
        prepare(path)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('quaternion = "wxyz"', "", "an orientation is four columns of a quaternion; name their order"),
        ('quaternion = "wxyz"', 'quaternion = "wzyx"', "expected 'wxyz' or 'xyzw', got 'wzyx'"),
        ('"a", "b", "c", "d"', '"a", "b", "c"', r"body:cube.orientation is 4 columns, got \['a', 'b', 'c'\]"),
        ('"x", "y", "z"', '"x", "y"', r"body:cube.position is 3 columns, got \['x', 'y'\]"),
        ('columns = ["x", "y", "z"]', 'column = "x"', r"is 3 columns, got \['x'\]; give `columns` in order"),
        (
            'columns = ["x", "y", "z"]',
            'column = "x"\ncolumns = ["y"]',
            "expected either `column` or `columns`, got both",
        ),
        ('unit = "mm"', 'unit = "mm"\nquaternion = "wxyz"', "body:cube.position is no orientation; drop it"),
        ('name = "turn"', "sign = -1", "a quaternion has none; turn the frame in the MJCF instead"),
        ('name = "turn"', 'unit = "deg"', "body:cube.orientation is no such quantity"),
        ("body:cube.position", "body:cub.position", "no body 'cub'; did you mean 'cube'"),
        ("body:cube.orientation", "sensor:tag", "gives no quaternion"),
    ],
)
def test_wrong_poses_are_one_line(tmp_path: Path, old: str, new: str, words: str) -> None:
    assert old in CONFIG
    with pytest.raises(ValueError, match=words) as error:
        prepare(write(tmp_path, CONFIG.replace(old, new, 1)))
    assert "\n" not in str(error.value)


def test_a_quaternion_sensor_needs_its_four_columns(tmp_path: Path) -> None:
    text = CONFIG.replace('"body:cube.orientation"', '"sensor:tag_turn"')
    assert prepare(write(tmp_path, text)).environment.rotations == ((3, 4, 5),)
    one = text.replace('columns = ["a", "b", "c", "d"]\nquaternion = "wxyz"', 'column = "a"\nunit = "1"')
    with pytest.raises(ConfigError, match="sensor:tag_turn is an orientation; give its quaternion's four `columns`"):
        prepare(write(tmp_path, one))


def test_columns_that_are_no_quaternion_are_refused(tmp_path: Path) -> None:
    with pytest.raises(LogError, match=r"columns \['x', 'b', 'c', 'd'\] are no quaternion: its length is"):
        prepare(write(tmp_path, CONFIG.replace('"a", "b"', '"x", "b"')))


@pytest.mark.parametrize(("rate", "slow"), [(20.0, True), (60.0, False)])
def test_a_body_that_is_filmed_slowly_is_named(tmp_path: Path, rate: float, slow: bool) -> None:
    problem = prepare(write(tmp_path, time=np.arange(40) / rate))
    texts = {item.text for report in problem.reports for item in report.findings if item.code is Code.LOG_SLOW}
    assert bool(texts) == slow
    assert all("cube.position, turn were recorded at 20 Hz" in text for text in texts)


def test_a_body_at_rest_has_no_saturated_quaternion(tmp_path: Path) -> None:
    """Its w is one, sample after sample; a position that is cut off is told still."""
    turns = quaternions(np.stack([0 * TIME, 0 * TIME, np.maximum(TIME - 0.15, 0)], axis=1))
    columns = dict(zip("abcd", turns.T, strict=True)) | {"x": np.minimum(100 * TIME, 15)}
    config = load_config(write(tmp_path, **columns))
    _, report = load_log(config, config.logs[0])
    said = [finding.text.split(":")[0] for finding in report.findings if finding.code == Code.LOG_CLIPPED]
    assert said == ["cube.position (x)"], report.clipped
