"""Files that are cut, broken or made to break a reader: one line each, nothing run, nothing allocated for a claim."""

import io
import random
import shutil
import sqlite3
import struct
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
from scipy.io import savemat

from sipe_bayes.calibration.logs import load_logs
from sipe_bayes.calibration.readers.base import LogError
from sipe_bayes.calibration.readers.ros_messages import Message
from sipe_bayes.calibration.readers.tables import read_table
from tests.calibration.readers.files import OTHERS
from tests.problems.log_files import WRITERS, Table, Written, configured, lerobot_folder, matlab_7_3_file
from tests.problems.log_tables import load, regular

ALL: dict[str, Callable[[Path, Table], Written]] = {
    **WRITERS,
    **OTHERS,
    "MATLAB 7.3": matlab_7_3_file,
    "LeRobot 3": lambda folder, table: lerobot_folder(folder, table, "v3.0"),
}
CASES = 40  # of each format; a longer run has more


def broken(data: bytes, chance: random.Random) -> bytes:
    """Cut, with bytes set to what is often a claim, or with a piece twice."""
    some = bytearray(data)
    at, size = chance.randrange(len(some)), chance.choice([1, 2, 4, 8])
    how = chance.choice(["cut", "cut", "set", "repeat"])
    if how == "cut":
        return bytes(some[:at])
    if how == "repeat":
        return bytes(some[:at] + some[at // 2 : at] + some[at:])
    some[at : at + size] = chance.choice([b"\xff" * size, bytes(size), chance.randbytes(size)])
    return bytes(some)


def said(read: Callable[[], object]) -> str:
    """What a LogError said, nothing where there was none."""
    try:
        read()
    except LogError as error:
        return str(error)
    return ""


@pytest.mark.parametrize("kind", ALL)
def test_a_broken_file_gives_a_table_or_one_line(kind: str, tmp_path: Path) -> None:
    written = ALL[kind](tmp_path, regular(30))
    config = configured(written, tmp_path)
    files = [written.path] if written.path.is_file() else [f for f in sorted(written.path.rglob("*")) if f.is_file()]
    chance, refused = random.Random(0), 0
    for _ in range(CASES):
        file = chance.choice(files)
        whole = file.read_bytes()
        file.write_bytes(broken(whole, chance))
        words = [said(lambda: read_table(written.path)), said(lambda: load_logs(config, config.logs))]
        assert not any("\n" in word or len(word) > 700 for word in words), words
        refused += any(words)
        file.write_bytes(whole)
    assert refused > CASES / 5, "hardly any of them was broken"


@pytest.mark.parametrize("kind", sorted({Path(kind).suffix for kind in WRITERS} - {".json", ".yaml"}))
def test_a_file_of_another_format(kind: str, tmp_path: Path) -> None:
    for other in {".csv", ".npz", ".mat", ".mcap", ".ulg"} - {kind}:
        (tmp_path / other).mkdir()
        shutil.copy(WRITERS[other](tmp_path / other, regular(9)).path, tmp_path / f"x{kind}")
        with pytest.raises(LogError) as caught:
            read_table(tmp_path / f"x{kind}")
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize("kind", [".csv", ".parquet", ".npz", ".h5", ".mat", "MATLAB 7.3"])
def test_words_where_numbers_were_expected(kind: str, tmp_path: Path) -> None:
    table = {**regular(), "q": np.array(["left", "right"] * 25)}
    if kind == ".npz":
        np.savez(tmp_path / "log.npz", **table)
        written = Written(tmp_path / "log.npz")
    elif kind == ".h5":
        with h5py.File(tmp_path / "log.h5", "w") as file:
            for name, values in table.items():
                file[name] = values.astype("S") if name == "q" else values
        written = Written(tmp_path / "log.h5")
    else:
        written = ALL[kind](tmp_path, {**table, "q": table["q"].astype("S" if kind == "MATLAB 7.3" else object)})
    config = configured(written, tmp_path)
    with pytest.raises(LogError, match=r"expected numbers; correct it|no column '.*q'") as caught:
        load_logs(config, config.logs)
    assert "\n" not in str(caught.value)


# npz


def header(shape: tuple[int, ...], kind: str = "<f8") -> bytes:
    file = io.BytesIO()
    np.lib.format.write_array_header_1_0(file, {"descr": kind, "fortran_order": False, "shape": shape})
    return file.getvalue()


def archive(path: Path, member: bytes, name: str = "q.npy") -> None:
    with zipfile.ZipFile(path, "w") as file:
        file.writestr(name, member)


def flagged(path: Path, at: int, value: int) -> None:
    """Set a number of two bytes in both headers of the one member."""
    data = bytearray(path.read_bytes())
    for start, offset in ((0, at), (data.index(b"PK\x01\x02"), at + 2)):
        data[start + offset : start + offset + 2] = struct.pack("<H", value)
    path.write_bytes(bytes(data))


# (content of the member, words in the message)
MEMBERS = [
    (b"", "cannot be read as .npz"),
    (b"no array", "cannot be read as .npz"),
    (header((2,))[:-9], "cannot be read as .npz"),
    (header((10**12,)), r"array 'q' claims the shape \(1000000000000,\), more than its 128 bytes"),
    (header((2**31, 2**31, 2**31)), "array 'q' claims the shape"),
    (header((10**9, 0)), "holds no samples"),
    (header((0,)), "holds no samples"),
    (header(()) + bytes(8), "holds no samples"),
    (header((-3,)) + bytes(80), "array 'q' claims the shape"),
    (header((2,), "O"), "array 'q' holds Python objects"),
    (header((4,)).replace(b"'<f8'", b"'<q8'") + bytes(32), "cannot be read as .npz"),
    (header((4,)).replace(b"(4,)", b"(((("), "cannot be read as .npz"),
]


@pytest.mark.parametrize(("member", "message"), MEMBERS)
def test_members_of_an_npz(member: bytes, message: str, tmp_path: Path) -> None:
    archive(tmp_path / "x.npz", member)
    with pytest.raises(LogError, match=message) as caught:
        read_table(tmp_path / "x.npz")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(("at", "value", "message"), [(6, 1, "is encrypted"), (8, 77, "is compressed in a way")])
def test_members_that_zip_has_ways_for(at: int, value: int, message: str, tmp_path: Path) -> None:
    archive(tmp_path / "x.npz", header((2,)) + bytes(16))
    flagged(tmp_path / "x.npz", at, value)
    with pytest.raises(LogError, match=f"array 'q' {message}"):
        read_table(tmp_path / "x.npz")


def test_an_npz_that_grows_when_it_is_unpacked(tmp_path: Path) -> None:
    """Two members of 0.6 GiB of zeros in a small file: refused by what they claim, before they are read."""
    zeros = zlib.compress(bytes(1000))
    archive(tmp_path / "x.npz", zeros)
    data = bytearray((tmp_path / "x.npz").read_bytes())
    at = data.index(b"PK\x01\x02") + 24
    data[at : at + 4] = struct.pack("<I", 2**30 + 1)
    (tmp_path / "x.npz").write_bytes(bytes(data))
    with pytest.raises(LogError, match=r"claims 1 GiB of arrays, the most is 1 \(SIPE_LOG_GIB\)"):
        read_table(tmp_path / "x.npz")


def test_a_single_number_beside_the_columns_is_none(tmp_path: Path) -> None:
    np.savez(tmp_path / "x.npz", rate=100.0, q=np.arange(3.0), image=np.zeros((3, 2, 2)), wide=np.zeros((3, 600)))
    assert list(read_table(tmp_path / "x.npz")) == ["q"]


# CSV


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('"' + "t" * 200_000 + '",q\n0,1\n', "the first line is longer than 131072 characters"),
        ("t" * 140_000, "the first line is longer"),
        ("t,q,u\n0,1,2\n" + '"' * 5, "cannot be read as .csv"),
    ],
)
def test_csv(text: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "x.csv").write_text(text)
    with pytest.raises(LogError, match=message) as caught:
        read_table(tmp_path / "x.csv")
    assert len(str(caught.value)) < 500


@pytest.mark.parametrize("cell", ["9" * 400, "x" * 200_000, "1e-5 N m", "0x1p3", "True but"])
def test_cells_that_are_no_numbers(cell: str, tmp_path: Path) -> None:
    (tmp_path / "log.csv").write_text(f"t,q,u\n0,1,2\n0.1,{cell},2\n0.2,1,2\n")
    with pytest.raises(LogError, match=r"column 'q' holds .* in row 2, expected numbers") as caught:
        load(tmp_path, file="log.csv")
    assert len(str(caught.value)) < 200


def test_complex_numbers_are_none(tmp_path: Path) -> None:
    with pytest.raises(LogError, match=r"column 'q' holds .*j.* in row 1, expected numbers"):
        load(tmp_path, {**regular(), "q": regular()["q"] * 1j})


# HDF5, MATLAB


def test_hdf5_that_claims_or_points_elsewhere(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "secret.h5", "w") as file:
        file["q"] = np.arange(3.0)
    (tmp_path / "secret.bin").write_bytes(bytes(24))
    with h5py.File(tmp_path / "x.h5", "w") as file:
        file["link"] = h5py.ExternalLink("secret.h5", "/q")
        file.create_dataset("bytes", (3,), "f8", external=[(str(tmp_path / "secret.bin"), 0, 24)])
        layout = h5py.VirtualLayout((3,), "f8")
        layout[:] = h5py.VirtualSource(str(tmp_path / "secret.h5"), "q", (3,))
        file.create_virtual_dataset("virtual", layout)
        file["own"], file["group/loop"] = np.arange(2.0), h5py.SoftLink("/group")
        file["table"] = np.array([(0.0, b"a", 1)], dtype=[("q", "f8"), ("word", "S1"), ("n", "i4")])
    assert set(read_table(tmp_path / "x.h5")) == {"own", "table.q", "table.n"}
    with h5py.File(tmp_path / "x.h5", "a") as file:
        file.create_dataset("claimed", (10**12,), "f8", chunks=(1024,))
    with pytest.raises(LogError, match=r"claims 7.45e\+03 GiB of columns, the most is 1; cut it"):
        read_table(tmp_path / "x.h5")


def matrix(kind: int, lengths: tuple[int, ...], inside: bytes, name: bytes = b"q") -> bytes:
    """An element of MATLAB 5."""

    def element(what: int, data: bytes) -> bytes:
        return struct.pack("<II", what, len(data)) + data + bytes(-len(data) % 8)

    parts = element(6, struct.pack("<II", kind, 0)) + element(5, struct.pack(f"<{len(lengths)}i", *lengths))
    return element(14, parts + element(1, name) + inside)


def matlab(*elements: bytes) -> bytes:
    return b"MATLAB 5.0 MAT-file".ljust(124) + b"\x00\x01IM" + b"".join(elements)


DOUBLE, CELL = 6, 1
NUMBERS = struct.pack("<II", 9, 16) + bytes(16)
NESTED = NUMBERS
for _ in range(60):
    NESTED = matrix(CELL, (1, 1), NESTED)
# (elements, words in the message)
CLAIMS = [
    (matrix(DOUBLE, (10**6, 10**6), NUMBERS), r"claims the size \[1000000, 1000000\], more than it holds"),
    (matrix(CELL, (10**9, 1), b""), r"claims the size \[1000000000, 1\]"),
    (matrix(CELL, (1, 1), matrix(CELL, (10**9, 1), b"")), r"claims the size \[1000000000, 1\]"),
    (matrix(DOUBLE, (-1, 2), NUMBERS), r"claims the size \[-1, 2\]"),
    (matrix(DOUBLE, (1, 2), struct.pack("<II", 9, 10**6)), "a variable is cut short"),
    (struct.pack("<II", 14, 10**6), "ends within a variable"),
    (NESTED, "nested more than 32 deep"),
    (struct.pack("<II", 15, 8) + b"no zlib!", "cannot be read as .mat"),
]


@pytest.mark.parametrize(("element", "message"), CLAIMS, ids=[c[1][:30] for c in CLAIMS])
@pytest.mark.parametrize("packed", [False, True])
def test_matlab_that_claims(element: bytes, message: str, packed: bool, tmp_path: Path) -> None:
    if packed:
        data = zlib.compress(element)
        element = struct.pack("<II", 15, len(data)) + data
        message = f"{message}|cannot be read as .mat|holds no samples"
    (tmp_path / "x.mat").write_bytes(matlab(element))
    with pytest.raises(LogError, match=message) as caught:
        read_table(tmp_path / "x.mat")
    assert "\n" not in str(caught.value)


def test_matlab_by_hand_is_read(tmp_path: Path) -> None:
    """What the claims above are changed from."""
    (tmp_path / "x.mat").write_bytes(matlab(matrix(DOUBLE, (1, 2), NUMBERS)))
    assert read_table(tmp_path / "x.mat")["q"].tolist() == [0.0, 0.0]


def test_objects_of_matlab_are_named(tmp_path: Path) -> None:
    """As `save` writes a timeseries: class 17, with the names of variable, system and class, and numbers of its own."""
    savemat(tmp_path / "x.mat", {"t": np.arange(3.0)})
    word = struct.pack("<II", 1, 4)
    parts = struct.pack("<IIII", 6, 8, 17, 0) + word + b"knee\0\0\0\0" + word + b"MCOS\0\0\0\0" + word + b"time\0\0\0\0"
    parts += matrix(13, (2, 1), struct.pack("<II", 6, 8) + struct.pack("<II", 0xDD000000, 2), b"x")
    data = (tmp_path / "x.mat").read_bytes() + struct.pack("<II", 14, len(parts)) + parts
    (tmp_path / "x.mat").write_bytes(data)
    assert list(read_table(tmp_path / "x.mat")) == ["t"]
    with pytest.raises(LogError, match=r"no column 'knee.Data', and MATLAB's objects \(.*\) are not read; save their"):
        read_table(tmp_path / "x.mat", ["t", "knee.Data"])


# ROS 2, LeRobot

TYPES = {
    "p/msg/A": [("a", (4, ((1, ("float64", 0)), 0)))],
    "p/msg/Own": [("own", (2, "p/msg/Own"))],
    "p/msg/Many": [("b", (3, ((2, "p/msg/None"), 10**9)))],
    "p/msg/Deep": [("c", (3, ((2, "p/msg/Wide"), 200)))],
    "p/msg/Wide": [("c", (3, ((2, "p/msg/None"), 200)))],
    "p/msg/None": [],
    "p/msg/Text": [("s", (1, ("string", 0)))],
}


@pytest.mark.parametrize(
    ("kind", "data", "message"),
    [
        ("p/msg/A", b"\0\1\0\0" + struct.pack("<I", 2**32 - 1), "claims 4294967295 bytes or entries and has 0"),
        ("p/msg/A", b"\0\1\0\0" + struct.pack("<IId", 2, 0, 1.0), "claims 16 bytes or entries and has 8"),
        ("p/msg/A", b"\0\7\0\0", "not encoded as plain CDR"),
        ("p/msg/A", b"", "not encoded as plain CDR"),
        ("p/msg/Many", b"\0\1\0\0" + bytes(99), "claims 1000000000 bytes or entries and has 99"),
        ("p/msg/Deep", b"\0\1\0\0" + bytes(999), "more than 20000 fields"),
        ("p/msg/Text", b"\0\1\0\0" + struct.pack("<I", 77), "claims 77 bytes or entries and has 0"),
    ],
)
def test_messages_that_claim(kind: str, data: bytes, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Message(TYPES, kind, data)
    with pytest.raises(RecursionError):
        Message(TYPES, "p/msg/Own", b"\0\1\0\0")


@pytest.mark.parametrize("order", ["<", ">"])
def test_messages_of_either_order(order: str) -> None:
    data = bytes([0, order == "<", 0, 0]) + struct.pack(f"{order}I4xdd", 2, 0.5, -3.0)
    assert Message(TYPES, "p/msg/A", data).numbers == {"a[0]": 0.5, "a[1]": -3.0}


def test_a_bag_whose_tables_compute_is_refused(tmp_path: Path) -> None:
    written = WRITERS[".db3"](tmp_path, regular(9))
    with sqlite3.connect(written.path) as database:
        database.execute("ALTER TABLE messages RENAME TO kept")
        endless = "WITH RECURSIVE r(id) AS (SELECT 1 UNION ALL SELECT id FROM r) SELECT id, 1 topic_id FROM r"
        database.execute(f"CREATE VIEW messages AS {endless}")
    with pytest.raises(LogError, match="'messages' is no plain table"):
        read_table(written.path)


@pytest.mark.parametrize(
    ("formats", "message"),
    [
        ("wide:uint64_t timestamp;float[65000] x;|joint:wide[65000] y;", "'joint' claims 4225065000 fields, the most"),
        ("joint:uint64_t timestamp;joint x;", "'joint' is defined by itself"),
        (
            "|".join(f"m{k}:m{k + 1}[2] a;m{k + 1}[2] b;" for k in range(60)),
            r"'m\d+' claims \d+ fields, the most is 65535",
        ),
        ("joint:uint64_t timestamp;float[1000000000] x;", "no message 'joint' was logged"),
    ],
)
def test_ulog_that_claims(formats: str, message: str, tmp_path: Path) -> None:
    parts = [b"ULog\x01\x12\x35\x01" + bytes(8)]
    parts += [struct.pack("<HB", len(text), ord("F")) + text.encode() for text in formats.split("|")]
    parts += [struct.pack("<HBBH", 8, ord("A"), 0, 0) + b"joint"]
    (tmp_path / "x.ulg").write_bytes(b"".join(parts))
    with pytest.raises(LogError, match=message):
        read_table(tmp_path / "x.ulg", ["joint.x[0]"])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda text: text.replace("v2.1", "v1.6"), "expected a dataset of version v2 or v3, got 'v1.6'"),
        (lambda text: text.replace('"total_frames": 30', '"total_frames": 31'), "counts 31 frames, .* hold 30"),
        (lambda text: "[1, 2]", "meta/info.json: cannot be read as the description of a dataset .*expected an object"),
        (lambda text: "[" * 100_000, "cannot be read as the description of a dataset .nested too deep"),
        (lambda text: text[:50], "cannot be read as the description of a dataset"),
        (lambda text: text.replace('{"motors"', '{"x": 1, "motors"'), ""),
    ],
)
def test_lerobot(change: Callable[[str], str], message: str, tmp_path: Path) -> None:
    root = lerobot_folder(tmp_path, regular(30)).path
    about = root / "meta" / "info.json"
    about.write_text(change(about.read_text()))
    if not message:
        assert "observation.state[0]" in read_table(root)
        return
    with pytest.raises(LogError, match=message):
        read_table(root)


def test_lerobot_without_its_data_or_with_a_broken_file(tmp_path: Path) -> None:
    root = lerobot_folder(tmp_path, regular(30), episodes=2).path
    file = root / "data/chunk-000/episode_000001.parquet"
    file.write_bytes(file.read_bytes()[:-9])
    with pytest.raises(LogError, match=r"cannot be read as meta/info.json \(episode_000001.parquet: "):
        read_table(root)
    shutil.rmtree(root / "data")
    with pytest.raises(LogError, match="no Parquet file below dataset/data; fetch the data"):
        read_table(root)
