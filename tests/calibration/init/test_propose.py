"""`sipe init` on made-up logs: units, signs and delays come out, or it says that they do not."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from typer.testing import CliRunner

from sipe_bayes.calibration.config import load_config
from sipe_bayes.calibration.init.draft import Draft
from sipe_bayes.calibration.init.propose import propose
from sipe_bayes.calibration.init.tables import ask_of_columns, richest
from sipe_bayes.calibration.init.write import summary, toml_of
from sipe_bayes.calibration.logs import load_log
from sipe_bayes.cli.app import app
from tests.problems.log_tables import EXAMPLES
from tests.problems.made_up_logs import KINDS, PENDULUM, Truth, make_log

LOGS = [(kind, variant) for k, kind in enumerate(KINDS) for variant in ((0, 2), (1, 3), (2, 4), (1, 3))[k]]


def wrong(draft: Draft, truth: Truth) -> list[str]:
    """What came out other than it is. Signs that are all turned are the same machine in a mirror: they must be told."""
    out, signs = [], []
    readings = {reading.match.target: reading for reading in draft.readings}
    for (column, target), (unit, sign) in truth.columns.items():
        reading = readings.get(target)
        if reading is None or reading.match.column != column:
            out.append(f"{target} is {column}, not {reading and reading.match.column}")
            continue
        if reading.unit != unit:
            out.append(f"{column} is in {unit}, not {reading.unit}")
        signs.append(reading.sign * sign)
    if len(set(signs)) > 1:
        out.append(f"signs {signs} of {list(truth.columns)}")
    elif signs[0] < 0 and not any("flipped together" in doubt for doubt in draft.open_doubts):
        out.append("a mirror image, and nothing is told")
    if (draft.clock.column, draft.clock.unit) != truth.clock:
        out.append(f"clock {draft.clock}")
    if abs(draft.delay - truth.delay) > 1.1:
        out.append(f"delay of {draft.delay}, not {truth.delay} samples")
    return out


def test_units_signs_and_delays_of_eight_logs(tmp_path: Path) -> None:
    """Each kind of machine in two of the variants, and each variant once or twice: all come out."""
    mistakes = {}
    for seed, (kind, variant) in enumerate(LOGS):
        folder = tmp_path / f"{kind}{variant}"
        folder.mkdir()
        truth = make_log(folder, KINDS[kind], variant, seed, steps=450)
        draft = propose(folder / "model.xml", [folder / "log.csv"], folder)
        (folder / "calibrate.toml").write_text(toml_of(draft, "sipe init"))
        config = load_config(folder / "calibrate.toml")
        assert len(config.logs) == 2
        assert len(summary(draft, "calibrate.toml")) <= 20
        if mistake := wrong(draft, truth):
            mistakes[kind, variant] = mistake
    assert not mistakes


@pytest.mark.parametrize(("kind", "variant", "spring"), [("servo", 3, 2.0), ("servo", 3, 0.0), ("arm", 1, 4.0)])
def test_a_spring_that_the_model_lacks_hides_no_delay(kind: str, variant: int, spring: float, tmp_path: Path) -> None:
    truth = make_log(tmp_path, KINDS[kind], variant, 100 + variant, spring)
    draft = propose(tmp_path / "model.xml", [tmp_path / "log.csv"], tmp_path)
    assert abs(draft.delay - truth.delay) < 1.1
    joint = f"joint:{KINDS[kind].joints[0]}"
    told = spring > 0 and kind != "servo"  # whose gain does the same
    assert [joint in doubt for doubt in draft.doubts if "a spring" in doubt] == [True] * told
    asked = [target for unknown in draft.free for target in unknown.targets if "spring" in unknown.name]
    assert asked == [f"{joint}.stiffness", f"{joint}.springref"] * told


def test_samples_that_are_missing_hide_nothing(tmp_path: Path) -> None:
    """A sensor at a fifth of the other's rate, dropped frames, cells of text, and a gap; in a file with remarks."""
    truth = make_log(tmp_path, KINDS["arm"], 1, 3)
    table = pd.read_csv(tmp_path / "log.csv").astype(object)
    rows = np.arange(len(table))
    table.loc[rows % 5 > 0, "joint_2_pos"] = np.nan
    table.loc[(rows > 300) & (rows < 330), ["joint_1_pos", "joint_2_pos"]] = np.nan
    table.loc[[7, 90, 91], "joint_1_pos"] = "ERR"
    table["temp"], table["state"] = np.where(rows % 2, "ERR", "20.5"), np.where(rows % 9, "run", "stop")
    table = table[(np.random.default_rng(0).uniform(size=len(table)) > 0.05) | (rows < 100)]
    text = "# arm of bench 2\n# started by hand\n" + table.to_csv(index=False, sep="\t")
    (tmp_path / "log.txt").write_text(text)
    draft = propose(tmp_path / "model.xml", [tmp_path / "log.txt"], tmp_path)
    assert not wrong(draft, truth)
    assert {"upper_arm_mass", "forearm_mass", "shoulder_damping"} <= {unknown.name for unknown in draft.free}
    missing, unused = sorted(doubt for doubt in draft.open_doubts if "no numbers" in doubt)
    assert missing.startswith("'joint_1_pos': cells that are no numbers (3) are read as missing; correct the log")
    assert unused.startswith("'temp'")


def test_angles_against_the_world_are_told_from_those_of_joints(tmp_path: Path) -> None:
    """As a camera sees a chain of links, both columns turned round; a joint's own angle is none, nor a difference."""
    truth = make_log(tmp_path, KINDS["arm"], 0, 20, steps=500)
    assert {truth.columns[q, f"joint:{joint}.position"][1] for q, joint in (("q1", "shoulder"), ("q2", "elbow"))} == {
        -1
    }
    table = pd.read_csv(tmp_path / "log.csv").drop(columns=["dq1", "dq2"])
    said = []
    for seen in (table["q2"], table["q1"] + table["q2"], table["q1"] - table["q2"]):
        table.assign(q2=seen).to_csv(tmp_path / "log.csv", index=False)
        draft = propose(tmp_path / "model.xml", [tmp_path / "log.csv"], tmp_path)
        said.append(any("'q2' looks like the angle of a link against the world" in d for d in draft.open_doubts))
    assert said == [False, True, False]


def test_where_nothing_shows_all_is_asked_for(tmp_path: Path) -> None:
    (tmp_path / "model.xml").write_text(PENDULUM)
    time = np.arange(200) * 0.01
    still = 1e-3 * np.random.default_rng(0).standard_normal(len(time))
    pd.DataFrame({"time": time, "angle": still, "torque": 0.0 * time}).to_csv(tmp_path / "log.csv", index=False)
    draft = propose(tmp_path / "model.xml", [tmp_path / "log.csv"], tmp_path)
    assert draft.free
    assert any("all are free" in doubt for doubt in draft.open_doubts)


@pytest.fixture(scope="module")
def arm(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """A folder with an arm's model and log, and the configuration that is written for them."""
    folder = tmp_path_factory.mktemp("arm")
    make_log(folder, KINDS["arm"], 1, 6, steps=600)
    result = CliRunner().invoke(app, init_of(folder))
    assert result.exit_code == 0, result.output
    assert result.output.count("\n") <= 20
    return folder, (folder / "calibrate.toml").read_text()


def init_of(folder: Path, *more: str) -> list[str]:
    return ["init", str(folder / "model.xml"), str(folder / "log.csv"), "--out", str(folder / "calibrate.toml"), *more]


def test_a_configuration_is_not_overwritten_unless_forced(arm: tuple[Path, str]) -> None:
    folder, text = arm
    refused = CliRunner().invoke(app, init_of(folder))
    assert refused.exit_code == 2
    assert "--force" in refused.output
    assert CliRunner().invoke(app, init_of(folder, "--force")).exit_code == 0
    assert (folder / "calibrate.toml").read_text().splitlines()[2:] == text.splitlines()[2:]  # below the command
    assert {path.name for path in folder.iterdir()} == {"model.xml", "log.csv", "calibrate.toml"}


@pytest.mark.parametrize(
    ("before", "after", "words"),
    [
        ("", "", []),
        ('unit = "deg"', 'unit = "rad"', ["joint_1_pos", "'deg' fits"]),
        ('column = "torque_1"\nunit = "N m"\nsign = -1', 'column = "torque_1"\nunit = "N m"', ["torque_1", "sign 1"]),
        ('column = "torque_1"', 'column = "torque_3"', ["torque_1", "torque_2", "swapped"]),
        ('column = "joint_1_vel"\nunit = "rad/s"', 'column = "joint_1_vel"\nunit = "deg/s"', ["joint_1_vel", "slope"]),
        ('name = "delay"', 'name = "slow"', ["late", "beyond the bounds"]),
    ],
)
def test_what_is_odd_is_named(arm: tuple[Path, str], before: str, after: str, words: list[str]) -> None:
    folder, text = arm
    assert before in text
    odd = text.replace(before, after)
    if "torque_3" in after:
        odd = odd.replace("torque_2", "torque_1").replace("torque_3", "torque_2")
    if "slow" in after:
        odd = odd.replace("bounds = [0.0, 0.02]", "bounds = [0.0, 0.001]")
    (folder / "odd.toml").write_text(odd)
    result = CliRunner().invoke(app, ["validate", str(folder / "odd.toml")])
    assert result.exit_code == (1 if words else 0), result.output
    assert all(word in result.output for word in words), result.output


def test_what_a_calibration_refuses_is_refused(arm: tuple[Path, str]) -> None:
    """A delay that leaves out the model's own, none: nothing was odd, and then the file did not load."""
    folder, text = arm
    assert "bounds = [0.0, 0.02]" in text
    (folder / "odd.toml").write_text(text.replace("bounds = [0.0, 0.02]", "bounds = [0.01, 0.02]"))
    result = CliRunner().invoke(app, ["validate", str(folder / "odd.toml")])
    assert result.exit_code == 2, result.output
    assert "the default 0 s lies outside the bounds" in result.output


@pytest.mark.parametrize(
    ("columns", "words"),
    [
        ({"a": [3.0, 1.0, 2.0], "theta": [1.0, 2.0, 1.0]}, ["clock", "'a'", "theta"]),
        ({"time": [0.0, 0.1, 0.2], "abc": [1.0, 2.0, 1.0]}, ["no column", "hinge", "abc"]),
        ({"time": [0.0, 0.1, 0.2], "hinge_cos": [1.0, 0.9, 0.8], "hinge_sin": [0.0, 0.4, 0.6]}, ["hinge_sin", "atan2"]),
    ],
)
def test_what_can_not_be_matched_is_refused(tmp_path: Path, columns: dict[str, list[float]], words: list[str]) -> None:
    (tmp_path / "model.xml").write_text(PENDULUM)
    pd.DataFrame(columns).to_csv(tmp_path / "log.csv", index=False)
    result = CliRunner().invoke(app, init_of(tmp_path))
    assert result.exit_code == 2
    assert result.output.count("\n") == 1
    assert all(word in result.output for word in words), result.output
    assert not (tmp_path / "calibrate.toml").exists()


def test_angles_that_come_round_are_written_on(tmp_path: Path) -> None:
    time = np.arange(400) * 0.01
    angle = 9.0 * np.sin(0.9 * time)
    (tmp_path / "model.xml").write_text(PENDULUM)
    table = {"time": time, "angle": (np.degrees(angle) + 180) % 360 - 180, "tau": np.sin(time)}
    pd.DataFrame(table).to_csv(tmp_path / "log.csv", index=False)
    draft = propose(tmp_path / "model.xml", [tmp_path / "log.csv"], tmp_path)
    (reading,) = draft.measurements
    assert (reading.unit, reading.wraps) == ("deg", True)
    config = draft.config(tmp_path)
    read, _ = load_log(config, config.logs[0])
    assert read.observations[:, 0] == pytest.approx(angle[: len(read.observations)], abs=1e-9)


def test_small_motions_of_a_real_machine_are_not_taken_for_degrees(tmp_path: Path) -> None:
    folder = EXAMPLES / "furuta_pendulum"  # arrays without names; near to rest, every unit makes a linear machine
    draft = propose(folder / "furuta.xml", sorted(folder.glob("qq_chrip*pos*.npz"))[:2], tmp_path)
    units = {reading.match.target: reading.unit for reading in draft.readings}
    expected = {"joint:arm.position": "rad", "joint:pole.position": "rad", "actuator:motor": "V"}
    assert units == expected | {"joint:arm.velocity": "rad/s", "joint:pole.velocity": "rad/s"}


TIED = """<mujoco><option timestep="0.005"/><worldbody>
  <body><joint name="hinge" axis="0 1 0" damping=".05"/><geom type="capsule" fromto="0 0 0 0 0 -.4" size=".02"/></body>
  <body pos="1 0 0"><joint name="crank" axis="0 1 0"/><geom type="capsule" fromto="0 0 0 0 0 -.2" size=".02"/></body>
  <body pos="2 0 0"><joint name="rocker" axis="0 1 0"/><geom type="capsule" fromto="0 0 0 0 0 -.2" size=".02"/></body>
  </worldbody><equality><joint joint1="crank" joint2="rocker"/></equality></mujoco>"""


@pytest.mark.parametrize(("measured", "blind"), [("position", False), ("velocity", True)])
def test_what_a_chain_ties_to_a_velocity_alone_starts_as_the_model(tmp_path: Path, measured: str, blind: bool) -> None:
    (tmp_path / "model.xml").write_text(TIED)
    time = 0.01 * np.arange(150)
    columns = {"time": time, "hinge_position": 0.3 * np.cos(4 * time), f"crank_{measured}": 0.2 * np.sin(4 * time)}
    pd.DataFrame(columns).to_csv(tmp_path / "log.csv", index=False)
    draft = propose(tmp_path / "model.xml", [tmp_path / "log.csv"], tmp_path)
    assert [doubt for doubt in draft.open_doubts if "rocker" in doubt] == [
        "no column measures rocker: windows start it where the model does"
    ] * blind


def test_columns_are_looked_for_in_the_log_in_which_most_of_them_change(tmp_path: Path) -> None:
    """A hip that stands still in squats moves in a trot; what only another log has is not what the first one has."""
    time = 0.01 * np.arange(50)
    still, moved = np.zeros(50), np.sin(time)
    pd.DataFrame({"t": time, "hip": still, "knee": moved}).to_csv(tmp_path / "squat.csv", index=False)
    pd.DataFrame({"t": time, "hip": moved, "knee": moved}).to_csv(tmp_path / "trot.csv", index=False)
    pd.DataFrame({"t": time, "hip": moved, "knee": moved, "tail": moved}).to_csv(tmp_path / "run.csv", index=False)
    opened, others = richest([tmp_path / f"{name}.csv" for name in ("squat", "trot", "run")])
    assert [*opened.columns] == ["hip", "knee"]
    assert [[*one.columns] for one in others] == [["knee"], ["hip", "knee", "tail"]]


def test_a_weight_that_logs_state_is_asked_for(tmp_path: Path) -> None:
    """It stands still within each log, so that it is no column of motion; none is none."""
    time = 0.01 * np.arange(50)
    for name, weight in (("empty", 0.0), ("loaded", 60.0)):
        columns = {"t": time, "boom": np.sin(time), "payload_kg": weight, "hook_kg": 0.0, "oil": weight}
        pd.DataFrame(columns).to_csv(tmp_path / f"{name}.csv", index=False)
    opened, others = richest([tmp_path / "empty.csv", tmp_path / "loaded.csv"])
    (doubt,) = ask_of_columns([opened, *others])
    assert doubt.startswith("'payload_kg' is 0 to 60 kg by log")
    assert "added" in doubt
    assert ask_of_columns([opened]) == []
