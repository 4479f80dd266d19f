"""The archive of trajectory sets: what is packed can be installed, and nothing else."""

from __future__ import annotations

import shutil
import zipfile
from pathlib import Path

import pytest

import sipe_bayes as sipe
from sipe_bayes.core.files import to_json, write_text
from sipe_bayes.datasets import archive, trajectory_sets
from sipe_bayes.datasets.trajectory_sets import IN_PACKAGE, MANIFEST, TrajectorySetError

FILE = "FetchPush/default-test-random.npz"


@pytest.fixture
def wheel(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A package as a wheel has it, whose manifest knows one set, and an empty cache; gives the source tree's folder."""
    import json

    known = json.loads((IN_PACKAGE / MANIFEST).read_text(encoding="utf-8"))
    known["sets"] = {FILE: known["sets"][FILE]}
    tree, package = tmp_path / "tree", tmp_path / "package"
    (tree / FILE).parent.mkdir(parents=True)
    shutil.copy(IN_PACKAGE / FILE, tree / FILE)
    for folder in (tree, package):
        write_text(folder / MANIFEST, to_json(known))
    for module in (trajectory_sets, archive):
        monkeypatch.setattr(module, "IN_PACKAGE", package)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.delenv("SIPE_BAYES_DATA", raising=False)
    return tree


def asked() -> int:
    return len(sipe.demonstrations("FetchPush", "random", "test", "default"))


@pytest.mark.parametrize("data", [None, "data"])
def test_what_is_packed_is_installed(
    wheel: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, data: str | None
) -> None:
    if data:
        monkeypatch.setenv("SIPE_BAYES_DATA", str(tmp_path / data))
    else:
        with pytest.raises(TrajectorySetError, match=r"cannot be read.*`sipe data install ARCHIVE`"):
            asked()
    digests = {archive.pack(tmp_path / f"{k}.zip", wheel) for k in range(2)}
    assert len(digests) == 1
    folder = archive.install(tmp_path / "0.zip")
    assert folder == (tmp_path / data if data else tmp_path / "cache" / "sipe_bayes") / "trajectories"
    assert asked() == 5
    assert trajectory_sets.verify(trajectory_sets.shipped()) == []


def test_a_source_tree_has_its_own(wheel: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(trajectory_sets, "IN_PACKAGE", wheel)
    assert trajectory_sets.shipped() == wheel
    assert asked() == 5


def test_an_altered_archive_is_refused_as_a_whole(wheel: Path, tmp_path: Path) -> None:
    for name, content in (("altered", {FILE: b"x"}), ("short", {"other.npz": b"x"})):
        with zipfile.ZipFile(tmp_path / f"{name}.zip", "w") as opened:
            for file, inside in content.items():
                opened.writestr(file, inside)
    (tmp_path / "text.zip").write_text("no archive")
    for name, words in (("altered", "SHA-256 of FetchPush"), ("short", "cannot be read"), ("text", "cannot be read")):
        with pytest.raises(TrajectorySetError, match=words):
            archive.install(tmp_path / f"{name}.zip")
    with pytest.raises(TrajectorySetError, match="cannot be read"):
        archive.install(tmp_path / "none.zip")
    assert not (tmp_path / "cache").exists()
