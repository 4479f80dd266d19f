"""Reading logs: formats, the control grid, masking, and what is said of them."""

import dataclasses
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

import sipe_bayes as sipe
from sipe_bayes.calibration.checks.clipping import count_clipped
from sipe_bayes.calibration.checks.fitted import with_wild
from sipe_bayes.calibration.config import load_config
from sipe_bayes.calibration.config_fields import ConfigError
from sipe_bayes.calibration.logs import load_log
from sipe_bayes.calibration.problem import Problem
from sipe_bayes.calibration.readers.base import LogError
from sipe_bayes.calibration.readers.tables import read_table
from sipe_bayes.core.findings import Code
from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.inference.laplace import Laplace
from tests.problems.lacking import write_lacking
from tests.problems.log_tables import EXAMPLES, FAST, QUIET, TOML, configure, load, regular, write

finite = st.floats(-1e6, 1e6, allow_subnormal=False)


@QUIET
@given(
    values=hnp.arrays(float, st.tuples(st.integers(2, 30), st.just(2)), elements=finite),
    rate=st.floats(1, 5000),
)
def test_regular_log_passes_bit_for_bit(tmp_path: Path, values: np.ndarray, rate: float) -> None:
    t = np.arange(len(values)) / rate + 1234.5
    trajectory, report = load(tmp_path, {"t": t, "q": values[:, 0], "u": values[:, 1]}, window='"log"')
    np.testing.assert_array_equal(trajectory.observations[:, 0], values[:, 0])
    np.testing.assert_array_equal(trajectory.actions[:, 0], values[:-1, 1])
    assert trajectory.dt == pytest.approx(1 / rate, rel=1e-6)
    assert not report.resampled
    assert report.jitter_s == 0.0
    assert report.missing == {"q": 0}


@QUIET
@given(seed=st.integers(0, 2**32 - 1), size=st.floats(0.15, 0.45))
def test_jittered_clock_of_a_line_is_exact(tmp_path: Path, seed: int, size: float) -> None:
    generator = np.random.default_rng(seed)
    t = (np.arange(200) + generator.uniform(-size, size, 200)) * 0.01
    t -= t[0]
    trajectory, report = load(tmp_path, {"t": t, "u": t, "q": 3 * t - 1}, resample="rate = 100.0")
    q = trajectory.observations[:, 0]
    seen = np.isfinite(q)
    assert report.resampled
    assert 0.5 * len(t) < seen.sum() <= len(t)
    np.testing.assert_allclose(q[seen], 3 * trajectory.time[seen] - 1, atol=1e-9)
    assert report.missing["q"] == (~seen).sum()


@QUIET
@given(seed=st.integers(0, 2**32 - 1), rate=st.floats(20, 400))
def test_held_commands_equal_the_plain_loop(tmp_path: Path, seed: int, rate: float) -> None:
    generator = np.random.default_rng(seed)
    t = np.cumsum(generator.uniform(0.002, 0.03, 80))
    u = np.where(generator.random(80) < 0.3, np.nan, generator.standard_normal(80))
    u[0] = 0.5
    trajectory, report = load(tmp_path, {"t": t, "u": u, "q": t}, resample=f"rate = {rate!r}")
    assert report.resampled
    for time, action in zip(trajectory.time, trajectory.actions[:, 0], strict=False):
        before = [a for s, a in zip(t - t[0], u, strict=True) if s <= time + 1e-6 * trajectory.dt and a == a]
        assert action == before[-1]
    assert any("blank commands" in note for note in report.notes)
    assert np.isfinite(trajectory.observations).sum() <= len(t)


def test_small_jitter_is_not_smoothed(tmp_path: Path) -> None:
    columns = regular(400)
    generator = np.random.default_rng(0)
    columns["t"] = columns["t"] + generator.uniform(-4e-4, 4e-4, 400)
    columns["q"] = generator.standard_normal(400)
    trajectory, report = load(tmp_path, columns)
    np.testing.assert_array_equal(trajectory.observations[:, 0], columns["q"])
    assert not report.resampled
    assert 1e-4 < report.jitter_s < 8e-4


def test_clock_that_is_a_little_fast_passes_at_its_mean_period(tmp_path: Path) -> None:
    columns = regular(3000)
    columns["t"] = columns["t"] * 1.0003
    columns["t"][1500:] += 4e-4
    trajectory, report = load(tmp_path, columns)
    assert not report.resampled
    assert trajectory.dt == pytest.approx(columns["t"][-1] / 2999, rel=1e-12)
    assert len(trajectory) == 2999


def test_dropped_rows_are_masked_and_told(tmp_path: Path) -> None:
    full = regular(200)
    kept = np.r_[0:50, 80:200]
    trajectory, report = load(tmp_path, {k: v[kept] for k, v in full.items()})
    assert not report.resampled
    assert trajectory.observations.shape == (200, 1)
    np.testing.assert_array_equal(trajectory.observations[kept, 0], full["q"][kept])
    assert np.isnan(trajectory.observations[50:80]).all()
    assert (trajectory.actions[50:80, 0] == full["u"][49]).all()
    assert report.missing == {"q": 30}
    np.testing.assert_allclose(report.gaps, [[0.49, 0.80]])
    assert any("no measurement from 0.490 to 0.800 s" in note for note in report.notes)


def test_gap_in_a_jittered_log_is_masked(tmp_path: Path) -> None:
    generator = np.random.default_rng(1)
    t = (np.arange(300) + generator.uniform(-0.3, 0.3, 300)) * 0.01
    keep = (t < 1.0) | (t > 1.5)
    _, report = load(tmp_path, {"t": t[keep], "u": t[keep], "q": t[keep]})
    trajectory, _ = load(tmp_path)
    start, stop = report.gaps[0]
    assert report.resampled
    assert len(report.gaps) == 1
    assert start == pytest.approx(1.0, abs=0.03)
    assert stop == pytest.approx(1.5, abs=0.03)
    inside = (trajectory.time > start + 1e-9) & (trajectory.time < stop - 1e-9)
    assert np.isnan(trajectory.observations[inside]).all()


def test_max_gap_decides_what_is_interpolated(tmp_path: Path) -> None:
    t = np.array([0.0, 0.013, 0.02, 0.03, 0.074, 0.08, 0.09, 0.1])
    columns = {"t": t, "u": t, "q": t}
    narrow, _ = load(tmp_path, columns, resample="rate = 100.0\nmax_gap = 0.02")
    wide, _ = load(tmp_path, columns, resample="rate = 100.0\nmax_gap = 0.05")
    missing = np.flatnonzero(np.isnan(narrow.observations[:, 0]))
    np.testing.assert_array_equal(missing, [4, 5, 6, 7])
    np.testing.assert_array_equal(np.flatnonzero(np.isnan(wide.observations[:, 0])), [4, 5, 6])
    assert wide.observations[7, 0] == pytest.approx(0.07)


@pytest.mark.parametrize("jitter", [0.0, 0.3])
@pytest.mark.parametrize("every", [3, 10])
def test_slow_column_keeps_only_its_own_samples(tmp_path: Path, jitter: float, every: int) -> None:
    columns = regular(301)
    t = columns["t"] = columns["t"] + jitter * 0.01 * np.random.default_rng(2).uniform(-1, 1, 301)
    columns["slow"] = np.where(np.arange(301) % every == 0, 2 * (t - t[0]), np.nan)
    trajectory, report = load(tmp_path, columns, file="log.csv", measurements=FAST)
    slow = trajectory.observations[:, 1]
    seen = np.isfinite(slow)
    assert trajectory.channels == ("q", "slow")
    assert report.resampled == (jitter > 0)
    assert 0.85 * (301 / every) <= seen.sum() <= 301 / every + 1
    np.testing.assert_allclose(slow[seen], 2 * trajectory.time[seen], atol=1e-9 if jitter else 1e-12)
    assert report.gaps == ()


def test_grid_faster_than_the_log_invents_nothing(tmp_path: Path) -> None:
    columns = regular(50)
    trajectory, report = load(tmp_path, columns, resample="rate = 200.0")
    q = trajectory.observations[:, 0]
    assert len(q) == 99
    np.testing.assert_array_equal(q[::2], columns["q"])
    assert np.isnan(q[1::2]).all()
    assert report.rate_hz == pytest.approx(200)


def test_grid_slower_than_the_log_takes_samples_out(tmp_path: Path) -> None:
    columns = regular(51)
    trajectory, report = load(tmp_path, columns, resample="rate = 50.0")
    assert report.resampled
    np.testing.assert_array_equal(trajectory.observations[:, 0], columns["q"][::2])
    np.testing.assert_array_equal(trajectory.actions[:, 0], columns["u"][:-1:2])


@QUIET
@given(values=hnp.arrays(float, (6, 2), elements=st.one_of(finite, st.just(np.nan), st.just(np.inf))))
def test_csv_parquet_and_npz_agree(tmp_path: Path, values: np.ndarray) -> None:
    values[:1], values[3, 0] = 1 / 3, 0.1
    columns = {"t": np.arange(6) * 0.1 + 1 / 7, "q": values[:, 0], "u": values[:, 1]}
    loaded = [load(tmp_path, columns, file=f"log.{suffix}") for suffix in ("csv", "parquet", "npz")]
    for trajectory, report in loaded[1:]:
        np.testing.assert_array_equal(trajectory.observations, loaded[0][0].observations)
        np.testing.assert_array_equal(trajectory.actions, loaded[0][0].actions)
        assert trajectory.dt == loaded[0][0].dt
        assert report.missing == loaded[0][1].missing


@pytest.mark.parametrize(
    "text",
    [
        "t,q,u\n0.1,1.5,2\n0.2,,3\n",
        "t;q;u\n0,1;1,5;2\n0,2;;3\n",
        "t\tq\tu\n0.1\t1.5\t2\n0.2\t\t3\n",
        "# t q u\n0.1 1.5 2\n0.2 nan 3\n",
        '\ufeff"t", "q", "u"\r\n0.1, 1.5, 2\r\n0.2, , 3\r\n',
    ],
)
def test_separators(tmp_path: Path, text: str) -> None:
    path = tmp_path / "log.csv"
    path.write_bytes(text.encode())
    table = read_table(path)
    assert list(table) == ["t", "q", "u"]
    for name, values in {"t": [0.1, 0.2], "q": [1.5, np.nan], "u": [2, 3]}.items():
        np.testing.assert_array_equal(table[name].astype(float), values)


def test_npz_matrices_and_actions_one_shorter(tmp_path: Path) -> None:
    columns = {
        "t": np.arange(9) * 0.1,
        "states": np.arange(18.0).reshape(9, 2),
        "acts": np.arange(8.0)[:, None],
    }
    write(tmp_path / "log.npz", columns)
    (tmp_path / "m.xml").write_text("<mujoco/>")
    text = TOML.format(window=0.1, resample="", measurements="", log="", file="log.npz")
    (tmp_path / "run.toml").write_text(text.replace('"u"', '"acts[0]"').replace('"q"', '"states[1]"'))
    config = load_config(tmp_path / "run.toml")
    trajectory, report = load_log(config, config.logs[0])
    np.testing.assert_array_equal(trajectory.observations[:, 0], columns["states"][:, 1])
    np.testing.assert_array_equal(trajectory.actions, columns["acts"])
    assert not any("blank" in note for note in report.notes)


def test_parquet_dates_are_seconds(tmp_path: Path) -> None:
    columns = regular(20)
    columns["t"] = pd.Timestamp("2021-04-14 18:52:33") + pd.to_timedelta(columns["t"], unit="s")
    trajectory, _ = load(tmp_path, columns, file="log.parquet")
    assert trajectory.dt == pytest.approx(0.01)


def test_a_clock_of_seconds_that_are_milliseconds_is_refused(tmp_path: Path) -> None:
    columns = regular(100)
    columns["t"] = 1e3 * columns["t"]
    write(tmp_path / "log.csv", columns)
    configure(tmp_path, "log.csv")
    said = (tmp_path / "run.toml").read_text()
    (tmp_path / "run.toml").write_text(said.replace('column = "t", unit = "s"', 'column = "t"'))
    config = load_config(tmp_path / "run.toml")
    with pytest.raises(LogError, match=r"read in seconds, 't' is 10 s from row to row; name its unit"):
        load_log(config, config.logs[0])
    (tmp_path / "run.toml").write_text(said)  # named, it is taken at its word
    config = load_config(tmp_path / "run.toml")
    assert load_log(config, config.logs[0])[0].dt == pytest.approx(10)


def test_units_signs_and_span(tmp_path: Path) -> None:
    columns = regular(100)
    columns["t"] = 1e3 * columns["t"] + 5e6
    write(tmp_path / "log.csv", columns)
    config = configure(tmp_path, "log.csv", log="span = [0.2, 0.5]")
    text = (tmp_path / "run.toml").read_text().replace('"s"', '"ms"').replace('"rad"', '"deg"\nsign = -1')
    (tmp_path / "run.toml").write_text(text.replace('"N m"', '"mN m"'))
    config = load_config(tmp_path / "run.toml")
    trajectory, report = load_log(config, config.logs[0], {"joint:hinge.position": "angle", "actuator:motor": "torque"})
    assert report.samples == 31
    assert report.duration_s == pytest.approx(0.3)
    np.testing.assert_allclose(trajectory.observations[:, 0], -np.deg2rad(columns["q"][20:51]))
    np.testing.assert_allclose(trajectory.actions[:, 0], 1e-3 * columns["u"][20:50])
    with pytest.raises(ConfigError, match="expected a unit of length, got 'deg'"):
        load_log(config, config.logs[0], {"joint:hinge.position": "length"})


@pytest.mark.parametrize("quantum", [0.0, 0.0015])
def test_clipping_is_counted_and_rest_is_not(tmp_path: Path, quantum: float) -> None:
    t = np.arange(2000) * 0.002
    clean = -np.cos(5 * t)
    clean = np.round(clean / quantum) * quantum if quantum else clean
    clipped = np.clip(clean, -2, 0.8)
    assert count_clipped(clean) == 0
    if quantum:
        assert count_clipped(np.concatenate([np.full(100, clean.min()), clean])) == 0
    assert count_clipped(clipped) == pytest.approx((clean >= 0.8).sum(), rel=0.05)
    assert count_clipped(np.sign(clean)) == count_clipped(np.zeros(50)) == 0
    _, report = load(tmp_path, {"t": t, "u": clean, "q": clipped})
    assert report.clipped["q"] > 100
    idle = np.maximum(clean - 0.5, 0.0)
    assert count_clipped(idle) > 100
    assert count_clipped(idle, command=True) == 0, "a rotor that idles at 0 is not clipped"
    assert report.clipped["actuator:motor"] == 0
    assert any(note.startswith("q: ") and "saturated" in note for note in report.notes)


@pytest.mark.parametrize("name", ["simple_pendulum", "furuta_pendulum"])
def test_shipped_logs_pass_through(name: str) -> None:
    config = load_config(EXAMPLES / name / "calibrate.toml")
    for log in config.logs:
        trajectory, report = load_log(config, log)
        table = read_table(log.file)
        np.testing.assert_array_equal(trajectory.observations[:, 0], np.float64(table[config.measurements[0].column]))
        assert not report.resampled
        assert len(report.notes) == 1, report.notes


def test_a_sensor_that_is_slower_than_the_log_misses_nothing(tmp_path: Path) -> None:
    t = np.arange(200) / 200
    q = np.where(np.arange(200) % 4 == 1, np.sin(9 * t), np.nan)
    _, report = load(tmp_path, {"t": t, "q": q, "u": t})
    print(report.notes)
    assert any("q comes at 50 Hz, in one of 4 samples" in note for note in report.notes)
    assert not report.suspect
    _, report = load(tmp_path, {"t": t, "q": np.where(t < 0.5, q, np.nan), "u": t})
    assert report.missing["q"] == 25, "a sensor that falls silent half-way"
    assert report.suspect
    q[np.random.default_rng(0).random(200) < 0.3] = np.nan
    _, report = load(tmp_path, {"t": t, "q": q, "u": t})
    assert report.missing["q"] == np.isnan(q).sum()
    assert report.suspect


def test_samples_left_out_as_wild_are_counted(tmp_path: Path) -> None:
    columns = {"t": np.arange(400) * 0.01, "u": np.zeros(400), "q": np.sin(np.arange(400) * 0.02)}
    assert load(tmp_path, columns)[1].wild == {}
    columns["q"][[100, 250]] += 20.0
    report = load(tmp_path, columns)[1]
    assert report.wild == {"q": 2}
    assert any("no smooth motion" in note for note in report.notes)


def test_samples_that_the_fit_left_out_are_counted_with_them(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    trajectory, report = load(tmp_path, regular())
    problem = SimpleNamespace(
        reports=(dataclasses.replace(report, wild={"q": 2}),),
        train=Trajectories.stack([trajectory]),
        environment=SimpleNamespace(channels=("q",)),
    )
    left_out = SimpleNamespace(outliers=np.array([[0, 5, 0], [0, 6, 0], [0, 7, 0]]))
    monkeypatch.setattr(Laplace, "result", left_out)
    (counted,) = with_wild(cast(Problem, problem), Laplace.__new__(Laplace))
    assert counted.wild == {"q": 5}


@pytest.mark.parametrize(("late", "warned"), [(2, False), (None, True), (40, True)], ids=["follows", "alone", "later"])
def test_a_joint_that_follows_a_jump_of_its_command_has_not_jumped(
    late: int | None, warned: bool, tmp_path: Path
) -> None:
    config = write_lacking(tmp_path)
    table = pd.read_csv(tmp_path / "log.csv")
    table["torque"], table["angle"] = 0.1, 0.1 * np.sin(6 * table["time"])
    table.loc[200:, "angle"] += 0.5
    if late is not None:
        table.loc[200 - late :, "torque"] = 0.6
    table.to_csv(tmp_path / "log.csv", index=False)
    codes = {one.code for report in sipe.prepare(config, 1).reports for one in report.findings}
    assert (Code.LOG_JUMPS in codes) == warned
