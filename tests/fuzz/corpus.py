"""Files that once broke a reader, by the reader's folder in ``tests/corpus``."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

FOLDER = Path(__file__).parents[1] / "corpus"
CORPUS = sorted(path for path in FOLDER.glob("*/*") if not path.name.endswith(".safetensors"))


def read(file: Path, folder: Path) -> object:
    """Read a file of the corpus, from a copy in a folder."""
    for one in file.parent.glob(f"{file.stem}.*"):
        shutil.copy(one, folder)
    return reader(file)(folder / file.name)


def reader(file: Path) -> Callable[[Path], object]:
    """What reads files of a name in a folder of the corpus."""
    from sipe_bayes.benchmark.records import PLAN, Record, planned
    from sipe_bayes.benchmark.run_log import RUNS, read_runs
    from sipe_bayes.calibration.config import load_config
    from sipe_bayes.calibration.readers.tables import read_table
    from sipe_bayes.core.trajectory import Trajectories
    from sipe_bayes.datasets.archive import install
    from sipe_bayes.datasets.minari_data import from_minari
    from sipe_bayes.envs.foreign.load import compile_spec, load_spec
    from sipe_bayes.models.policy import load_policy
    from sipe_bayes.posterior import load_posterior
    from sipe_bayes.rl.randomization import load_randomization

    def minari(path: Path) -> object:
        """What a data set says of itself, as a file of its folder."""
        data = path.parent / path.stem / "data"
        data.mkdir(parents=True)
        shutil.copy(path, data / "metadata.json")
        return from_minari(data.parent, dt=0.1)

    readers: dict[str, Callable[[Path], object]] = {
        "archives": install,
        "minari": minari,
        "configurations": load_config,
        "logs": read_table,
        "models": lambda path: compile_spec(load_spec(str(path)), str(path)),
        "policies": load_policy,
        "posteriors": load_posterior,
        "randomizations": load_randomization,
        "records": Record.read,
        "trajectories": Trajectories.load,
    }
    if file.name in (PLAN, RUNS):
        return lambda path: planned(path.parent) if path.name == PLAN else read_runs(path.parent)
    return readers[file.parent.name]
