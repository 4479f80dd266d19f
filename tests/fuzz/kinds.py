"""What stands in a file's place and is none: a folder, a pipe that nobody writes to, a device, links that go round."""

from __future__ import annotations

import os
import random
import shutil
import socket
from collections.abc import Callable
from pathlib import Path

from tests.fuzz import corpus
from tests.fuzz.mutations import Change, Read, Target

LONG = "n" * 300


def _folder(path: Path) -> None:
    path.mkdir()
    (path / "inside").write_text("text")


def _socket(path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as end:
        back = os.getcwd()
        os.chdir(path.parent)  # the longest name of a socket is short
        end.bind(path.name)
        os.chdir(back)


def _holes(path: Path) -> None:
    """A terabyte, none of it on the disk."""
    with path.open("wb") as file:
        file.truncate(2**40)


def _zeros(path: Path) -> None:
    path.write_bytes(bytes(100_000))


STAND_INS: dict[str, Callable[[Path], object]] = {
    "a folder": _folder,
    "a pipe": os.mkfifo,
    "a socket": _socket,
    "a link to itself": lambda path: path.symlink_to(path.name),
    "a link to nothing": lambda path: path.symlink_to("nothing"),
    "a link to its folder": lambda path: path.symlink_to("."),
    "zeros without end": lambda path: path.symlink_to("/dev/zero"),
    "a terminal": lambda path: path.symlink_to("/dev/tty"),
    "no bytes": lambda path: path.symlink_to("/dev/null"),
    "memory of this process": lambda path: path.symlink_to("/proc/self/mem"),
    "a terabyte of holes": _holes,
    "a file of no bytes": lambda path: path.write_bytes(b""),
    "zeros": _zeros,
    "a mark of the order of bytes": lambda path: path.write_bytes(b"\xff\xfe\x00\x00"),
    "blank lines": lambda path: path.write_text("\n" * 100),
}


NAMES = (
    *("archives/sets.zip", "configurations/config.toml", "models/robot.xml", "policies/agent.safetensors"),
    *("posteriors/posterior.json", "posteriors/posterior.safetensors", "randomizations/drawn.json"),
    *("records/record.json", "records/plan.json", "records/runs.json", "trajectories/shown.npz"),
    *(f"logs/log{suffix}" for suffix in (".csv", ".parquet", ".npz", ".h5", ".mat", ".mcap", ".db3", ".ulg")),
)
"""A file of each kind that is read, by the folder of the corpus."""


def stand_ins(folder: Path) -> Change:
    """Readers, each given what is no such file by a name that such files have."""

    def change(chance: random.Random) -> Read:
        case = folder / "case"
        shutil.rmtree(case, ignore_errors=True)
        case.mkdir()
        name = Path(chance.choice(NAMES))
        if chance.random() < 0.05:
            return lambda: corpus.reader(name)(case / f"{LONG}{name.suffix}")
        STAND_INS[chance.choice(sorted(STAND_INS))](case / name.name)
        for other in (".json", ".safetensors"):  # the other half of a posterior
            if name.parent.name == "posteriors" and name.suffix != other:
                STAND_INS[chance.choice(sorted(STAND_INS))]((case / name.name).with_suffix(other))
        return lambda: corpus.reader(name)(case / name.name)

    return change


KINDS: dict[str, tuple[Target, int]] = {"kind of file": (stand_ins, 12)}
