"""What the examples' make.py have in common: the truth of a seed, drawn within bounds, and the command line.

python examples/drive/make.py --seed 1 --out FOLDER
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

INSIDE = 0.15, 0.85  # share of the bounds within which truths lie


def make(
    script: str,
    bounds: Mapping[str, tuple[float, float]],
    write: Callable[[dict[str, float], np.random.Generator, Path], None],
    committed: Mapping[str, float] | None = None,
) -> None:
    """Draw the truth, let ``write`` simulate the logs, and keep the truth in ``truth.json``.

    Args:
        script: the make.py that is run.
        bounds: of each parameter.
        write: makes the logs of a truth in a folder, with what else the generator draws.
        committed: the truth of seed 0, where it is not drawn.
    """
    parser = argparse.ArgumentParser(description="Simulate the logs of this example and their hidden truth.")
    parser.add_argument("--seed", type=int, default=0, help="0 gives the logs that are in the repository")
    parser.add_argument("--out", type=Path, default=Path(script).parent)
    given = parser.parse_args()
    rng = np.random.default_rng(given.seed)
    if committed and given.seed == 0:
        truth = dict(committed)
    else:
        truth = {name: float(low + (high - low) * rng.uniform(*INSIDE)) for name, (low, high) in bounds.items()}
    given.out.mkdir(parents=True, exist_ok=True)
    write(truth, rng, given.out)
    (given.out / "truth.json").write_text(json.dumps(truth, indent=2) + "\n")
