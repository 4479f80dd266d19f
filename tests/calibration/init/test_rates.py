"""`sipe init` on machines with a rate gyro, whose kinematics tell units and signs of positions; and without one."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pandas as pd

from sipe_bayes.calibration.init.decisions import missing_more
from sipe_bayes.calibration.init.draft import Draft, Reading, Scale
from sipe_bayes.calibration.init.propose import propose
from sipe_bayes.calibration.init.write import toml_of
from sipe_bayes.core.arrays import FloatArray

BOOM = """<mujoco><option timestep="0.002" integrator="implicitfast" gravity="0 0 {gravity}"/><worldbody>
  <body name="mast"><joint name="slew" axis="0 0 1" damping=".3"/>
  <geom type="box" size=".05 .05 .2" mass="1" contype="0" conaffinity="0"/>
  <body name="boom" pos="0 0 .2"><joint name="luff" axis="0 1 0" damping=".3"/>
  <geom type="capsule" fromto="0 0 0 .3 0 0" size=".02" mass=".5" contype="0" conaffinity="0"/>
  <site name="tip" pos=".3 0 0"/></body></body></worldbody>
  <actuator><velocity name="slew_drive" joint="slew" kv="3"/>
  <velocity name="luff_drive" joint="luff" kv="3"/></actuator>
  {sensor}</mujoco>"""
SENSOR = '<sensor><gyro name="gyro" site="tip"/></sensor>'
TURN, DT = 2 * np.pi, 0.01


def moved(gravity: float, steps: int = 500) -> dict[str, FloatArray]:
    """Time, commands in rad/s, positions in rad and rates in rad/s of a boom that goes to and fro."""
    model = mujoco.MjModel.from_xml_string(BOOM.format(gravity=gravity, sensor=SENSOR))
    data, rows = mujoco.MjData(model), []
    for k in range(steps):
        t = DT * k
        data.ctrl[:] = np.sin(1.3 * t) + 0.5 * np.sin(4.1 * t), 0.6 * np.cos(1.9 * t) + 0.4 * np.sin(5.3 * t)
        mujoco.mj_forward(model, data)
        rows.append([t, *data.ctrl, *data.qpos, *data.sensordata])
        mujoco.mj_step(model, data, 5)
    names = ["time_s", "slew_cmd_rad_s", "luff_cmd_rad_s", "slew", "luff", "gyro_x", "gyro_y", "gyro_z"]
    return dict(zip(names, np.array(rows).T, strict=True))


def proposed(folder: Path, columns: dict[str, FloatArray], gravity: float = 0.0, sensor: str = SENSOR) -> Draft:
    (folder / "model.xml").write_text(BOOM.format(gravity=gravity, sensor=sensor))
    pd.DataFrame(columns).to_csv(folder / "log.csv", index=False)
    return propose(folder / "model.xml", [folder / "log.csv"], folder)


def counted(columns: dict[str, FloatArray], slew: float, luff: float) -> dict[str, FloatArray]:
    """With encoders of so many counts a turn, negative ones turned round, in place of angles."""
    own = {f"{name}_enc": np.round(columns[name] * n / TURN) for name, n in (("slew", slew), ("luff", luff))}
    return {name: values for name, values in columns.items() if name not in ("slew", "luff")} | own


def felt(columns: dict[str, FloatArray], scale: float, turned: tuple[int, int, int] = (1, 1, 1)) -> None:
    """Noise, a constant error and a scale in the gyro's columns, or its axes turned round."""
    noise = 0.005 * np.random.default_rng(0).standard_normal((3, len(columns["time_s"])))
    for axis, sign, own in zip("xyz", turned, noise, strict=True):
        columns[f"gyro_{axis}"] = scale * sign * columns[f"gyro_{axis}"] + scale * own + 0.01


def by_column(draft: Draft) -> dict[str, Reading]:
    return {reading.match.column: reading for reading in draft.readings}


def test_a_gyro_tells_counts_and_signs(tmp_path: Path) -> None:
    """Of a machine without gravity, whose drives with the encoders turned round move alike."""
    columns = counted(moved(0.0), 20000, -20000)
    felt(columns, 1.02)
    draft = proposed(tmp_path, columns)
    for column, sign in (("slew_enc", 1), ("luff_enc", -1)):
        reading = by_column(draft)[column]
        assert (reading.unit, round(1 / reading.factor), reading.sign) == ("rev", 20000, sign), reading
        assert any("20000 counts a rev" in text for text in (*reading.notes, *reading.doubts)), reading
        assert any(f"sign {sign}: flipped" in note for note in reading.notes), reading
    assert by_column(draft)["luff_cmd_rad_s"].sign == 1
    assert not [d for d in draft.open_doubts if "enc" in d and ("sign" in d or "turned" in d)]


def test_a_gyro_in_degrees_that_no_name_tells(tmp_path: Path) -> None:
    """The counts tell it; those that are as near as a gyro may be off stay open."""
    columns = counted(moved(0.0), 4096, 4096)
    felt(columns, 180 / np.pi)
    draft = proposed(tmp_path, columns)
    readings = by_column(draft)
    assert readings["gyro_x"].unit == "deg/s", readings["gyro_x"]
    assert round(1 / readings["slew_enc"].factor) == 4096
    doubt = "'slew_enc': 4096 counts a rev or 4000? the model explains the log as well with either"
    assert doubt in draft.open_doubts, draft.open_doubts
    assert "# factor = 0.00025" in toml_of(draft, "sipe init")


def test_degrees_or_radians_of_both_are_left_to_simulations(tmp_path: Path) -> None:
    """Of angles and rates whose names say no unit: the gyro's follows that of the angles."""
    columns = moved(-9.81)
    felt(columns, 180 / np.pi)
    columns |= {name: np.degrees(columns[name]) for name in ("slew", "luff")}
    readings = by_column(proposed(tmp_path, columns, gravity=-9.81))
    assert (readings["luff"].unit, readings["slew"].unit, readings["gyro_x"].unit) == ("deg", "deg", "deg/s"), readings
    assert (readings["luff"].sign, readings["slew"].sign) == (1, 1)


def test_counts_that_nobody_uses_are_told(tmp_path: Path) -> None:
    """Behind a gear of 7."""
    columns = counted(moved(0.0), 28672, 28672)
    felt(columns, 1.0)
    draft = proposed(tmp_path, columns)
    assert any("look at" in doubt or "how is it mounted?" in doubt for doubt in draft.open_doubts), draft.open_doubts


def test_without_a_gyro_simulations_alone_tell(tmp_path: Path) -> None:
    draft = proposed(tmp_path, counted(moved(0.0), 20000, 20000), sensor="")
    assert not any("gyro" in text for r in draft.readings for text in (*r.notes, *r.doubts))
    assert any("flipped together" in doubt for doubt in draft.open_doubts), draft.open_doubts


def test_a_gyro_that_is_mounted_otherwise_does_not_decide_against_gravity(tmp_path: Path) -> None:
    columns = moved(-9.81)
    felt(columns, 1.0, (1, -1, -1))
    draft = proposed(tmp_path, columns, gravity=-9.81)
    reading = by_column(draft)["luff"]
    assert (reading.unit, reading.sign) == ("rad", 1), reading
    assert any("how is it mounted?" in doubt for doubt in draft.open_doubts), draft.open_doubts


def test_units_that_many_others_miss_more_than_are_one_line() -> None:
    one, answer = [(Scale("deg"), 12.34)], Scale("rev", 1 / 4096)
    many = [(Scale("rev", 1 / count), times) for count, times in ((1024, 2.41), (2048, 25.4), (360, 3.0), (400, 9.0))]
    assert missing_more(Scale("rad"), one) == "rad: read as deg, 12 times as much of the joints' forces is left"
    words = "4096 counts a rev: with 4 other usual counts a rev, 2.4 to 25 times as much of the joints' forces is left"
    assert missing_more(answer, many) == words


def test_what_is_being_done_is_told(tmp_path: Path) -> None:
    lines: list[str] = []
    (tmp_path / "model.xml").write_text(BOOM.format(gravity=0.0, sensor=SENSOR))
    pd.DataFrame(moved(0.0, 300)).to_csv(tmp_path / "log.csv", index=False)
    propose(tmp_path / "model.xml", [tmp_path / "log.csv"], tmp_path, tell=lines.append)
    headings = [line.partition(":")[0] for line in lines]
    assert list(dict.fromkeys(headings)) == [
        "reading the logs",
        "units and signs",
        "zeros of joints",
        "delay and parameters",
    ]
