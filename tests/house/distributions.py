"""What a wheel and an sdist hold: the whole of the package but its trajectory sets, nothing else, and no link.

python tests/house/distributions.py FOLDER    looks at the wheel and the sdist in it; exit code 1 where one is wrong
"""

from __future__ import annotations

import stat
import sys
import tarfile
import zipfile
from pathlib import Path

ROOT = Path(__file__).parents[2]
LIMIT = 10e6  # bytes of either
BESIDE = "sipe_bayes/datasets/trajectories/"  # in an archive beside the release: sipe_bayes.datasets.archive
OF_SDIST = {"LICENSE", "PKG-INFO", "README.md", "pyproject.toml", "setup.cfg"}


def package(root: Path = ROOT) -> set[str]:
    """Files that both are to hold."""
    paths = (p for p in (root / "sipe_bayes").rglob("*") if p.is_file() and "__pycache__" not in p.parts)
    names = {path.relative_to(root).as_posix() for path in paths}
    return {name for name in names if not (name.startswith(BESIDE) and name.endswith(".npz"))}


def members(path: Path) -> dict[str, bool]:
    """Name of each file, without an sdist's first folder, and whether it is a link."""
    if path.suffix == ".whl":
        with zipfile.ZipFile(path) as wheel:
            return {m.filename: stat.S_ISLNK(m.external_attr >> 16) for m in wheel.infolist()}
    with tarfile.open(path) as sdist:
        return {m.name.partition("/")[2]: not m.isfile() for m in sdist.getmembers() if not m.isdir()}


def faults(path: Path, wanted: set[str]) -> list[str]:
    """What is wrong with a wheel or an sdist, one line each."""
    held = members(path)
    own = {name for name in held if name.startswith("sipe_bayes/")}
    others = {name for name in held if not name.split("/")[0].endswith((".dist-info", ".egg-info"))} - own
    size = path.stat().st_size
    return [
        *(f"{name}: missing" for name in sorted(wanted - own)),
        *(f"{name}: not of this tree" for name in sorted(own - wanted)),
        *(f"{name}: does not belong there" for name in sorted(others - (OF_SDIST if path.suffix != ".whl" else set()))),
        *(f"{name}: a link" for name, link in held.items() if link),
        *([f"{size / 1e6:.1f} MB, over {LIMIT / 1e6:.0f}"] if size > LIMIT else []),
    ]


if __name__ == "__main__":
    wrong = False
    for path in sorted(Path(sys.argv[1]).glob("sipe_bayes-*")):
        lines = faults(path, package())
        wrong = wrong or bool(lines)
        size = f"{len(members(path))} files, {path.stat().st_size / 1e6:.1f} MB"
        print("\n".join([f"{path.name}: {size}", *(f"  {line}" for line in lines)]))
    sys.exit(wrong)
