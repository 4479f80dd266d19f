"""What is found in the two real pendulums, and what it is worth on logs that were held out.

    python examples/studies/discover_real.py                        # both; some quarter of an hour on two cores
    python examples/studies/discover_real.py --examples simple_pendulum

`sipe discover` searches by discover.toml, or by calibrate.toml where there is none. Errors are root-mean-square over
the open-loop windows of each held-out log, of the model as given, calibrated, and with what was found: from the initial
states that were measured, and from those that fit best. Searches go on from runs/ where they were interrupted;
results/discover_real.json holds these, what is found, its predictive density over the calibrated model's, whether the
residuals pass for noise, rollouts and seconds.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

from sipe_bayes.calibration.discover import run_discovery
from sipe_bayes.core.files import write_text
from sipe_bayes.diagnostics.records import Misfit

HERE = Path(__file__).parent
EXAMPLES = ("simple_pendulum", "furuta_pendulum")


def residuals(misfit: Misfit | None) -> dict[str, Any] | None:
    """Whether they pass for noise, and what they look like."""
    return None if misfit is None else {"p": misfit.p, "passes": not misfit.alarm, "looks like": misfit.cause}


def studied(name: str) -> dict[str, Any]:
    """One example."""
    folder, out = HERE.parent / name, HERE / "runs" / f"discover_{name}"
    config = next(file for file in (folder / "discover.toml", folder / "calibrate.toml") if file.is_file())
    found = run_discovery(config, out, progress=lambda *told: print(*told, flush=True))
    rows = [
        {"found": list(r.sentences), "gain": r.gain, "error": r.error, "tied": r.tied, "weight": r.weight}
        for r in found.rows
    ]
    return {
        **rows[0],
        "others": rows[1:6],
        "comparison": None if found.comparison is None else asdict(found.comparison),
        "held-out errors": [asdict(row) for row in found.errors if row.use == "holdout"],
        "residuals before": residuals(found.before.misfit),
        "residuals after": residuals(found.after.misfit),
        "rollouts": found.rollouts,
        "seconds": found.seconds,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--examples", nargs="+", choices=EXAMPLES, default=EXAMPLES)
    path = HERE / "results" / "discover_real.json"
    table = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}
    for name in parser.parse_args().examples:
        table[name] = studied(name)
        write_text(path, json.dumps(table, indent=1) + "\n")
        print(json.dumps(table[name], indent=1))


if __name__ == "__main__":
    main()
