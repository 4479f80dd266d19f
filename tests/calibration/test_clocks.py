"""Topics with clocks of their own on one grid, episodes of one file, many files by a pattern, and slow logs."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from sipe_bayes.calibration.config import Config, load_config
from sipe_bayes.calibration.config_fields import ConfigError
from sipe_bayes.calibration.logs import load_log, load_logs
from sipe_bayes.calibration.readers.base import LogError
from sipe_bayes.calibration.readers.many import clock_of, digest, matching
from sipe_bayes.core.findings import Code
from sipe_bayes.core.toml import to_toml
from sipe_bayes.core.trajectory import Trajectory
from sipe_bayes.diagnostics.records import LogReport
from tests.problems.log_files import (
    ROS_NAMES,
    START,
    WRITERS,
    Messages,
    Written,
    command,
    configured,
    joint_state,
    lerobot_folder,
    ros_bag,
    ros_messages,
)
from tests.problems.log_tables import load, regular, write


def codes(report: LogReport) -> set[Code]:
    return {item.code for item in report.findings}


def states(times: np.ndarray, values: np.ndarray, topic: str = "/joint_states", delay: int = 0) -> Messages:
    rows = [(START + round(1e9 * t), value) for t, value in zip(times, values, strict=True)]
    kind = "sensor_msgs/msg/JointState"
    return [(topic, kind, t, joint_state(t - delay, ["elbow"], np.array([v]))) for t, v in rows]


def efforts(times: np.ndarray, values: np.ndarray) -> Messages:
    kind = "std_msgs/msg/Float64MultiArray"
    rows = zip(times, values, strict=True)
    return [("/effort", kind, START + round(1e9 * t), command(np.array([0.0, value]))) for t, value in rows]


def recorded(folder: Path, messages: Messages, clock: str = "time", **words: str) -> tuple[Trajectory, LogReport]:
    bag = ros_bag(folder, sorted(messages, key=lambda message: message[2]))
    config = configured(Written(bag, {**ROS_NAMES, "t": clock}), folder, **words)
    return load_log(config, config.logs[0])


def test_topics_come_onto_the_grid_of_the_measurement(tmp_path: Path) -> None:
    """A ramp as position and as command, at 100 and 37 Hz: the position is untouched, the command held from before."""
    t, own = np.arange(200) * 0.01, 0.004 + np.arange(75) / 37
    trajectory, report = recorded(tmp_path, states(t, 3 * t) + efforts(own, own))
    start = 1  # the first command comes at 4 ms, so the grid begins at 10 ms
    np.testing.assert_array_equal(trajectory.observations[:, 0], 3 * t[start:])
    expected = [own[own <= now + 1e-9][-1] for now in t[start:-1]]
    np.testing.assert_array_equal(trajectory.actions[:, 0], expected)
    assert trajectory.dt == pytest.approx(0.01, rel=1e-9)
    assert {Code.LOG_CLOCKS, Code.LOG_CLOCK} <= codes(report)
    assert any(
        "1 of 2 columns have clocks of their own" in note and "begins 0.01 s after" in note for note in report.notes
    )


def test_a_measurement_of_another_clock_is_interpolated_and_never_invented(tmp_path: Path) -> None:
    t, other = np.arange(200) * 0.01, 0.0033 + np.arange(50) * 0.04
    messages = states(t, 3 * t) + states(other, 2 * other, "/camera") + efforts(t, t)
    second = '[[measurements]]\ncolumn = "/camera.position[elbow]"\ntarget = "joint:b.position"\nunit = "rad"\n'
    trajectory, report = recorded(tmp_path, messages, measurements=second)
    slow = trajectory.observations[:, 1]
    seen = np.isfinite(slow)
    assert 45 <= seen.sum() <= 50
    np.testing.assert_allclose(slow[seen], 2 * trajectory.time[seen], atol=1e-9)
    np.testing.assert_array_equal(trajectory.observations[:, 0], 3 * t)
    assert report.resampled


def test_stamps_take_the_latency_away(tmp_path: Path) -> None:
    """Positions are received 20 ms late: by the recorder's clock they lag the commands, by their stamps they do not."""
    t = np.arange(100) * 0.01
    messages = states(t + 0.02, t, delay=20_000_000) + efforts(t, t)
    late, _ = recorded(tmp_path, messages)
    bag = Written(tmp_path / "bag", {**ROS_NAMES, "t": "stamp"})
    config = configured(bag, tmp_path)
    stamped, _ = load_log(config, config.logs[0])
    np.testing.assert_allclose(late.actions[:90, 0] - late.observations[:90, 0], 0.02, atol=1e-9)
    np.testing.assert_allclose(stamped.actions[:90, 0] - stamped.observations[:90, 0], 0.0, atol=1e-9)


def test_messages_that_lack_a_joint_are_no_samples(tmp_path: Path) -> None:
    """Two publishers on one topic: the arm's joint at 50 Hz, the gripper's between."""
    t = np.arange(100) * 0.02
    kind = "sensor_msgs/msg/JointState"
    between = [("/joint_states", kind, START + round(1e9 * (s + 0.01)), joint_state(0, ["grip"], t[:1])) for s in t]
    trajectory, _ = recorded(tmp_path, states(t, 3 * t) + between + efforts(t, t))
    seen = np.isfinite(trajectory.observations[:, 0])
    np.testing.assert_allclose(trajectory.observations[seen, 0], 3 * t[: seen.sum()])
    assert seen.sum() == len(t)


def test_a_controller_that_stops_is_told(tmp_path: Path) -> None:
    t = np.arange(300) * 0.01
    _, report = recorded(tmp_path, states(t, t) + efforts(t[:100], t[:100]))
    assert any("no command in the last 2 s" in note for note in report.notes)


@pytest.mark.parametrize(("rate", "told"), [(20.0, True), (24.0, True), (26.0, False), (100.0, False)])
def test_a_slow_log_of_a_joint_is_told(rate: float, told: bool, tmp_path: Path) -> None:
    _, report = load(tmp_path, regular(60, 1 / rate))
    assert (Code.LOG_SLOW in codes(report)) == told
    assert any("friction and delays" in note for note in report.notes) == told


def test_a_slow_sensor_is_no_slow_joint(tmp_path: Path) -> None:
    columns = regular(300)
    columns["slow"] = np.where(np.arange(300) % 10 == 0, columns["q"], np.nan)
    second = '[[measurements]]\ncolumn = "slow"\ntarget = "TARGET"\nunit = "rad"\n'
    _, report = load(tmp_path, columns, measurements=second.replace("TARGET", "sensor:slow"))
    assert Code.LOG_SLOW not in codes(report)
    _, report = load(tmp_path, columns, measurements=second.replace("TARGET", "joint:b.position"))
    assert any(note.startswith("slow were recorded at 10 Hz") for note in report.notes)


T = np.arange(50) * 0.01
WRONG: list[tuple[Messages, Messages, str, str]] = [
    (states(T, T), efforts(T + 60, T), "time", r"the clock of '/effort.data\[1\]' goes from 60 to 60.49 s.* share"),
    (states(T + 60, T), efforts(T, T), "time", r"the clock of '/effort.data\[1\]' goes from 0 to 0.49 s.* share"),
    (states(T, T, delay=START), efforts(T, T), "stamp", r"goes from 0 to 0.49 s.*share"),
    (states(np.r_[T[:9], T[8:]], np.r_[T[:9], T[8:]]), efforts(T, T), "time", r"'/joint_states.time' must increase"),
    (states(T, T), efforts(T, T), "tick", r"no column 'tick' in bag; .*"),
    (states(T, T), efforts(T, T * np.nan), "time", r"command column '/effort.data\[1\]' holds no number"),
    (states(T, T * np.nan), efforts(T, T), "time", r"measured column .* holds no number"),
    (
        states(T, T),
        [],
        "time",
        r"no topic for '/effort.data\[1\]'.*it has /joint_states \(sensor_msgs/",
    ),
    (states(T[:1], T[:1]), efforts(T, T), "time", r"expected at least 2 samples, got 1"),
]


@pytest.mark.parametrize(("positions", "commands", "clock", "message"), WRONG, ids=[w[3][:30] for w in WRONG])
def test_wrong_clocks(positions: Messages, commands: Messages, clock: str, message: str, tmp_path: Path) -> None:
    with pytest.raises(LogError, match=message) as caught:
        recorded(tmp_path, positions + commands, clock)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("kind", sorted(set(WRITERS) - {".mcap", ".db3", "metadata.yaml"}))
@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ([0, 2, 1, 3], "must increase strictly, got .* in row 3 after .* in row 2; sort the rows"),
        ([0, 1, 1, 2], "must increase strictly, got .* in row 3 after .* in row 2; drop duplicate rows"),
        ([5, 6, 0, 1], "must increase strictly, got .* in row 3 after .* in row 2; sort the rows"),
    ],
)
def test_a_clock_that_jumps_back(kind: str, rows: list[int], message: str, tmp_path: Path) -> None:
    """In every format but a bag, whose messages its reader sorts."""
    table = {name: values[rows] for name, values in regular(9).items()}
    config = configured(WRITERS[kind](tmp_path, table), tmp_path)
    with pytest.raises(LogError, match=message) as caught:
        load_logs(config, config.logs)
    assert "\n" not in str(caught.value)


def test_a_clock_beyond_all_times(tmp_path: Path) -> None:
    for scale, words in ((1e300, "steps of 1e\\+298 s"), (1e-300, "steps of 1e-302 s")):
        with pytest.raises(LogError, match=f"'t' goes on for .* in {words}; correct the clock or its unit"):
            load(tmp_path, {**regular(), "t": regular()["t"] * scale})


def test_a_stamp_that_jumps_back(tmp_path: Path) -> None:
    bag = ros_bag(tmp_path, states(T[:25], T[:25]) + states(T[25:], T[25:], delay=10**9) + efforts(T + 0.5, T))
    config = configured(Written(bag, {**ROS_NAMES, "t": "stamp"}), tmp_path)
    with pytest.raises(
        LogError, match=r"'/joint_states.stamp' must increase strictly, got -0.75 in row 26.*; use the recorder's clock"
    ):
        load_log(config, config.logs[0])


def test_the_clock_of_a_column_is_the_nearest() -> None:
    table = {name: T for name in ("time", "/a.time", "/a/b.time", "data[0].time", "robot/time", "/a/b.c[x.y].time")}
    nearest = {
        "q": "time",
        "/a.q[1]": "/a.time",
        "/a/b.c[x.y]": "/a/b.time",
        "data[0].arm.q": "data[0].time",
        "data[1].arm.q": "time",
        "robot/arm/q[2]": "robot/time",
        "/c.q": "time",
    }
    assert {column: clock_of(table, column, "time") for column in nearest} == nearest


def many(folder: Path, table: dict[str, np.ndarray], logs: str = "", episode: str = "k") -> Config:
    """The configuration of a CSV whose column k numbers episodes; ``logs`` in place of its tables of logs."""
    write(folder / "log.csv", table)
    configured(Written(folder / "log.csv", episode=episode), folder)
    text = (folder / "run.toml").read_text()
    start, stop = text.index("[[logs]]"), text.index("[[parameters]]")
    if logs:
        text = text[:start] + text[stop:]
        text = f"{logs}\n{text}" if logs.startswith("logs") else f"{text}\n{logs}"
    (folder / "run.toml").write_text(text)
    return load_config(folder / "run.toml")


def episodes() -> dict[str, np.ndarray]:
    """Three of 50, 40 and 30 samples, called 7, 3 and 5; the clock begins anew in each."""
    pieces = [pd.DataFrame({**regular(n), "k": k}) for k, n in ((7, 50), (3, 40), (5, 30))]
    return {name: values.to_numpy() for name, values in pd.concat(pieces).items()}


def test_episodes_are_logs(tmp_path: Path) -> None:
    config = many(tmp_path, episodes())
    assert [log.name for log in config.logs] == ["log-7", "log-3", "log-5"]
    loaded = load_logs(config, config.logs)
    assert [len(trajectory) for trajectory, _ in loaded] == [49, 39, 29]
    np.testing.assert_array_equal(loaded[1][0].observations[:, 0], regular(40)["q"])
    assert len({report.sha256 for _, report in loaded}) == 3


def test_what_a_configuration_became_is_one_again(tmp_path: Path) -> None:
    config = many(tmp_path, episodes())
    data = config.model_dump(mode="json", by_alias=True, exclude_unset=True)
    (tmp_path / "again.toml").write_text(to_toml(data))
    assert load_config(tmp_path / "again.toml").logs == config.logs


def test_episodes_are_held_out_by_number(tmp_path: Path) -> None:
    part = '[[logs]]\nfile = "log.csv"\nepisodes = '
    tables = f'{part}[7, 5]\n{part}[3]\nuse = "holdout"\n'
    config = many(tmp_path, episodes(), tables)
    uses = [(log.name, log.use) for log in config.logs]
    assert uses == [("log-7", "train"), ("log-5", "train"), ("log-3", "holdout")]
    named = many(tmp_path, episodes(), tables.replace("[3]", '[3]\nname = "last"'))
    assert [log.name for log in named.logs] == ["log-7", "log-5", "last"]
    with pytest.raises(ConfigError, match=r"held out, but samples of it train as log"):
        many(tmp_path, episodes(), tables.replace("[3]", "[5]"))


def test_episodes_of_a_lerobot_dataset(tmp_path: Path) -> None:
    config = configured(lerobot_folder(tmp_path, regular(30), "v3.0", episodes=3), tmp_path)
    loaded = load_logs(config, config.logs)
    assert [trajectory.name for trajectory, _ in loaded] == ["log-0", "log-1", "log-2"]
    for trajectory, _ in loaded:
        np.testing.assert_array_equal(trajectory.observations[:, 0], regular(30)["q"])


WRONG_EPISODES = [
    ({"k": np.arange(120)}, "", r"column 'k' has 120 numbers in 120 rows, which are no episodes"),
    ({"k": np.arange(120) / 2}, "", r"column 'k' is to number the episodes; expected whole numbers"),
    ({"k": np.array(["a"] * 120)}, "", r"column 'k' is to number the episodes; expected whole numbers"),
    ({"k": np.r_[np.zeros(119), np.nan]}, "", r"expected whole numbers in every row"),
    ({"k": np.full(120, 1e300)}, "", r"expected whole numbers in every row"),
    ({}, '[[logs]]\nfile = "log.csv"\nepisodes = [9]\n', r"log 'log-9': no episode 9; they go from 3 to 7"),
    ({}, '[[logs]]\nfile = "log.csv"\nepisodes = [3, 3]\n', r"`logs\[0\].episodes`: names an episode twice"),
    ({}, '[[logs]]\nfile = "log.csv"\nepisodes = []\n', r"`logs\[0\].episodes`"),
    ({}, '[[logs]]\nfile = "log.csv"\nepisodes = [1.5]\n', r"`logs\[0\].episodes\[0\]`"),
    (
        {"k": np.r_[np.zeros(119), 1], "t": np.arange(120) / 100},
        "",
        r"'log-1': expected at least 2 samples, got 1",
    ),
    ({}, 'logs = ["log.csv", "./log.csv"]', r"`logs\[1\].name`: expected different values, got 'log'"),
]


@pytest.mark.parametrize(("changed", "logs", "message"), WRONG_EPISODES, ids=[w[2][-30:] for w in WRONG_EPISODES])
def test_wrong_episodes(changed: dict[str, np.ndarray], logs: str, message: str, tmp_path: Path) -> None:
    def read() -> None:
        config = many(tmp_path, {**episodes(), **changed}, logs)
        load_logs(config, config.logs)

    with pytest.raises(ValueError, match=message) as caught:
        read()
    assert "\n" not in str(caught.value)


def test_episodes_need_their_column(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"`logs\[0\].episodes`: needs `columns.episode`"):
        many(tmp_path, episodes(), '[[logs]]\nfile = "log.csv"\nepisodes = [3]\n', episode="")
    with pytest.raises(LogError, match=r"no column 'toss'; did you mean|no column 'toss'; use one of"):
        many(tmp_path, episodes(), episode="toss")


def test_a_pattern_is_every_file_in_the_order_of_its_numbers(tmp_path: Path) -> None:
    for k in (10, 2, 1):
        write(tmp_path / f"toss_{k}.csv", regular(40 + k))
    for logs in ('logs = "toss_*.csv"', 'logs = ["toss_?.csv", "toss_10.csv"]', '[[logs]]\nfile = "toss_*.csv"\n'):
        config = many(tmp_path, regular(), logs, episode="")
        assert [log.name for log in config.logs] == ["toss_1", "toss_2", "toss_10"]
    assert [len(trajectory) for trajectory, _ in load_logs(config, config.logs)] == [40, 41, 49]
    config = many(tmp_path, regular(), '[[logs]]\nfile = "toss_*.csv"\nname = "toss"\nuse = "train"\n', episode="")
    assert [log.name for log in config.logs] == ["toss-0", "toss-1", "toss-2"]
    with pytest.raises(ConfigError, match=r"`logs\[0\].file`: no file matches .*throw_\*.csv; correct the pattern"):
        many(tmp_path, regular(), 'logs = "throw_*.csv"', episode="")


def test_files_of_one_name_are_told_apart_by_their_folders(tmp_path: Path) -> None:
    for run in ("a", "b"):
        (tmp_path / "[run]" / run).mkdir(parents=True)
        write(tmp_path / "[run]" / run / "log.csv", regular())
    config = many(tmp_path / "[run]", regular(), 'logs = "*/log.csv"', episode="")
    assert [log.name for log in config.logs] == ["a-log", "b-log"]
    assert matching(tmp_path / "[run]" / "log.csv", tmp_path) == [tmp_path / "[run]" / "log.csv"]


def test_a_folder_has_the_digest_of_its_logs(tmp_path: Path) -> None:
    bag = ros_bag(tmp_path, ros_messages(regular(5)))
    before = digest(bag)
    (bag / "notes.md").write_text("nothing of the log")
    assert digest(bag) == before
    (bag / "metadata.yaml").write_text((bag / "metadata.yaml").read_text() + "\n")
    assert digest(bag) != before
