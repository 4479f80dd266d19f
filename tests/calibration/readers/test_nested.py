"""Lists in the cells of a CSV, folders that are one log and JSON: what their columns are called and hold."""

import json
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from scipy.io import savemat

from sipe_bayes.calibration.init.propose import propose
from sipe_bayes.calibration.readers.base import LogError
from sipe_bayes.calibration.readers.joined import JOINTS
from sipe_bayes.calibration.readers.tables import READERS, read_table
from tests.calibration.readers.files import joined_folder
from tests.problems.log_tables import regular

NAN = float("nan")
ROWS = [{"t": 0, "q": 1}, {"t": 1, "q": 2}]
LONG = {"t": [0, 1, 2], "q": [3, 4, 5]}


def columns(path: Path) -> dict[str, list[object]]:
    return {name: values.tolist() for name, values in read_table(path).items()}


@pytest.mark.parametrize(
    ("cells", "expected"),
    [
        (['"[1, 2]"', '"[3, nan]"'], {"q[0]": [1.0, 3.0], "q[1]": [2.0, NAN]}),
        (["[1 2]", '" (3, 4)"'], {"q[0]": [1.0, 3.0], "q[1]": [2.0, 4.0]}),
        (["", '"[3, 4]"'], {"q[0]": [NAN, 3.0], "q[1]": [NAN, 4.0]}),
        (['"[1, 2]"', '"[3]"'], {"q": ["[1, 2]", "[3]"]}),
        (['"[1, 2]"', '"[3, x]"'], {"q": ["[1, 2]", "[3, x]"]}),
    ],
)
def test_lists_in_cells(cells: list[str], expected: dict[str, list[object]], tmp_path: Path) -> None:
    (tmp_path / "x.csv").write_text("t,q\n" + "".join(f"{t},{cell}\n" for t, cell in enumerate(cells)))
    found = columns(tmp_path / "x.csv")
    assert found.pop("t") == [0, 1]
    assert str(found) == str(expected)


def test_lists_have_names_where_there_are_as_many(tmp_path: Path) -> None:
    root = joined_folder(tmp_path, regular(9)).path
    assert {"control.timestamp", "state.timestamp", "state.positions[Pan]", "event.event"} <= {*read_table(root)}
    (root / JOINTS).write_text("Pan\n\nLift\nGrip\n")
    assert {"state.positions[0]", "state.positions[1]"} <= {*read_table(root)}
    (root / JOINTS).write_text("Pan\nLift\nPan\n")
    with pytest.raises(LogError, match=r"joint_list.txt: 'Pan' stands in it twice; give each joint a name of its own"):
        read_table(root)
    (root / JOINTS).write_text("Pan\nLift\n")
    for file in root.glob("*.csv"):
        file.unlink()
    with pytest.raises(LogError, match=r"motion: no CSV file beside joint_list.txt; name"):
        read_table(root)


def test_a_folder_of_motions_is_matched_by_the_order_of_its_joints(tmp_path: Path) -> None:
    for motion in ("one", "two"):
        (tmp_path / "raw").mkdir(exist_ok=True)
        joined_folder(tmp_path, regular(200)).path.rename(tmp_path / "raw" / motion)
    body = "<body><joint name='{0}'/><geom size='.1' pos='.2 0 0'/>{1}</body>"
    motors = "".join(f"<position name='{name}' joint='{name}'/>" for name in ("shoulder", "elbow"))
    world = f"<worldbody>{body.format('shoulder', body.format('elbow', ''))}</worldbody>"
    (tmp_path / "m.xml").write_text(f"<mujoco>{world}<actuator>{motors}</actuator></mujoco>")
    draft = propose(tmp_path / "m.xml", [tmp_path / "raw"], tmp_path)
    assert {r.match.target: r.match.column for r in draft.readings} == {
        "joint:shoulder.position": "state.positions[Pan]",
        "joint:elbow.position": "state.positions[Lift]",
        "actuator:shoulder": "control.positions[Pan]",
        "actuator:elbow": "control.positions[Lift]",
    }
    assert [log.file for log in draft.logs] == ["raw/one", "raw/two"]


class Runs:
    """Makes a file when it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[object, tuple[object, ...]]:
        return Path.touch, (self.path,)


def test_no_pickle_is_loaded(tmp_path: Path) -> None:
    harm, data = Runs(tmp_path / "ran"), {"t": np.arange(3.0)}
    for kind in (".pt", ".pth", ".pkl", ".pickle"):
        (tmp_path / f"x{kind}").write_bytes(pickle.dumps(harm))
        with pytest.raises(LogError, match=rf"x{kind}: is a pickle, which .* where it was made: `numpy.savez"):
            read_table(tmp_path / f"x{kind}")
    for kind in (kind for kind in READERS if kind.startswith(".")):
        (tmp_path / f"x{kind}").write_bytes(pickle.dumps(harm))
        with pytest.raises(LogError):
            read_table(tmp_path / f"x{kind}")
    np.savez(tmp_path / "x.npz", **data, q=np.array([harm, harm, harm]))
    with pytest.raises(LogError, match="array 'q' holds Python objects"):
        read_table(tmp_path / "x.npz")
    frame = pd.DataFrame({**data, "q": [pickle.dumps(harm)] * 3})
    frame.to_parquet(tmp_path / "x.parquet")
    assert read_table(tmp_path / "x.parquet")["t"].tolist() == [0, 1, 2]
    assert not (tmp_path / "ran").exists()
    assert pickle.loads(pickle.dumps(harm)) is None  # noqa: S301, that it would have
    assert (tmp_path / "ran").exists()


@pytest.mark.parametrize(
    ("data", "expected"),
    [
        ({"dt": 0.1, "motor": "x", "entries": ROWS}, {"t": [0.0, 1.0], "q": [1.0, 2.0]}),
        ([{"t": 0, "q": None, "on": True}, {"t": 1, "q": 2}], {"t": [0.0, 1.0], "q": [NAN, 2.0], "on": [1.0, NAN]}),
        ([{"q": [1, None]}, {"q": None}], {"q[0]": [1.0, NAN], "q[1]": [NAN, NAN]}),
        ({"t": [0, 1], "q": [[1, 2], [3, 4]]}, {"t": [0.0, 1.0], "q[0]": [1.0, 3.0], "q[1]": [2.0, 4.0]}),
        ([{"a": {"q": 1, "b": {"c": 2}}}] * 2, {"a.q": [1.0, 1.0], "a.b.c": [2.0, 2.0]}),
        ({"arm": {"q": [1, 2]}, "t": [0, 1]}, {"arm.q": [1.0, 2.0], "t": [0.0, 1.0]}),
        ([LONG, None], {"episodes[0].t": [0.0, 1.0, 2.0], "episodes[0].q": [3.0, 4.0, 5.0]}),
        ({"runs": [ROWS]}, {"runs[0].t": [0.0, 1.0], "runs[0].q": [1.0, 2.0]}),
        ({"t": ["a", None], "q": [[1], [1, 2]], "w": [[0] * 600]}, {"t": ["a", NAN]}),
    ],
)
def test_json(data: Any, expected: dict[str, list[object]], tmp_path: Path) -> None:
    (tmp_path / "x.json").write_text(json.dumps(data))
    assert str(columns(tmp_path / "x.json")) == str(expected)


def test_pieces_of_json_are_episodes(tmp_path: Path) -> None:
    (tmp_path / "x.json").write_text(json.dumps([[{"t": k / 10, "q": k} for k in range(n)] for n in (30, 40)]))
    table = read_table(tmp_path / "x.json", ["episodes[*].q"])
    assert np.bincount(table["episodes[*]"]).tolist() == [30, 40]
    assert len(table["episodes[*].q"]) == 70


@pytest.mark.parametrize("text", ["", "[", "5", "[1, 2]", "[[[{}]]]", "[" * 100_000, '{"q": [1e999, ', "\ud800"])
def test_json_without_a_log(text: str, tmp_path: Path) -> None:
    (tmp_path / "x.json").write_text(text, errors="surrogatepass")
    with pytest.raises(LogError, match=r"x.json: (cannot be read as|holds no samples)"):
        read_table(tmp_path / "x.json")


def test_json_that_claims(tmp_path: Path) -> None:
    (tmp_path / "x.json").write_text(json.dumps([{str(k): 1} for k in range(20_000)]))
    with pytest.raises(LogError, match=r"claims 2.98 GiB of columns, the most is 1"):
        read_table(tmp_path / "x.json")


def test_rows_of_a_matlab_struct(tmp_path: Path) -> None:
    rows = np.array([(0.0, 1.0, "a"), (0.1, 2.0, "b")], dtype=[("t", "f8"), ("q", "f8"), ("word", object)])
    savemat(tmp_path / "x.mat", {"log": rows, "vir": np.arange(2.0)})
    assert columns(tmp_path / "x.mat") == {"log.t": [0.0, 0.1], "log.q": [1.0, 2.0], "vir": [0.0, 1.0]}


@pytest.mark.parametrize("text", ["0,1\n1,2\n", "# made by a logger\n0,1\n1,2\n", "0 1\n1 2\n"])
def test_names_of_a_table_without_a_header(text: str, tmp_path: Path) -> None:
    path, names = tmp_path / "x.csv", ("t", "q")
    path.write_text(text)
    assert str({k: v.tolist() for k, v in read_table(path, (), names).items()}) == "{'t': [0, 1], 'q': [1, 2]}"
    with pytest.raises(LogError, match=r"3 names are given for a table without a header, its first row is '0"):
        read_table(path, (), (*names, "u"))
    path.write_text("t,q\n0,1\n")
    with pytest.raises(LogError, match="2 names are given for a table without a header, its first row is 't,q'"):
        read_table(path, (), names)
    with pytest.raises(LogError, match=r"`columns.names` is for a CSV without a header"):
        read_table(path.rename(tmp_path / "x.json"), (), names)
