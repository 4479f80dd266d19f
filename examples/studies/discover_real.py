"""What is found in the two real pendulums, and what it is worth on logs that were held out.

    python examples/studies/discover_real.py                        # both; some quarter of an hour on two cores
    python examples/studies/discover_real.py --examples simple_pendulum

`sipe discover` searches by discover.toml, or by calibrate.toml where there is none. Then `sipe calibrate` fits that
configuration and the discovered one, both with the example's own noise model. Errors are root-mean-square over
open-loop windows from measured starts. Searches go on from runs/ where they were interrupted;
results/discover_real.json holds what is found, held-out errors, whether the residuals pass for noise, rollouts and
seconds.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np

import sipe_bayes as sipe
from sipe_bayes.calibration.discover import run_discovery
from sipe_bayes.calibration.discovered import DISCOVERED_TOML
from sipe_bayes.core.files import write_text
from sipe_bayes.diagnostics.records import Misfit
from sipe_bayes.diagnostics.result import Calibration

HERE = Path(__file__).parent
EXAMPLES = ("simple_pendulum", "furuta_pendulum")


def calibrated(config: Path) -> Calibration:
    """What a configuration gives as it stands."""
    return sipe.calibrate(sipe.prepare(config))


def errors(calibration: Calibration) -> dict[str, float]:
    """Held-out error by channel, over logs."""
    channels = dict.fromkeys(s.channel for s in calibration.holdout)
    squares = {c: [s.rmse**2 for s in calibration.holdout if s.channel == c] for c in channels}
    return {channel: float(np.sqrt(np.mean(values))) for channel, values in squares.items()}


def residuals(misfit: Misfit | None) -> dict[str, Any] | None:
    """Whether they pass for noise, and what they look like."""
    return None if misfit is None else {"p": misfit.p, "passes": not misfit.alarm, "looks like": misfit.cause}


def studied(name: str) -> dict[str, Any]:
    """One example."""
    folder, out = HERE.parent / name, HERE / "runs" / f"discover_{name}"
    config = next(file for file in (folder / "discover.toml", folder / "calibrate.toml") if file.is_file())
    found = run_discovery(config, out, progress=lambda *told: print(*told, flush=True))
    best, *others = found.rows
    before, after = calibrated(config), calibrated(out / DISCOVERED_TOML)
    return {
        "found": list(best.sentences),
        "weight": best.weight,
        "gain": best.gain,
        "error": best.error,
        "others": [
            {"sentences": r.sentences, "gain": r.gain, "error": r.error, "behind": r.behind, "tied": r.tied}
            for r in others[:5]
        ],
        "held-out error before": errors(before),
        "held-out error after": errors(after),
        "by log": [
            {
                "log": b.log,
                "channel": b.channel,
                "unit": b.unit,
                "given": b.rmse_default,
                "before": b.rmse,
                "after": a.rmse,
            }
            for b, a in zip(before.holdout, after.holdout, strict=True)
        ],
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
