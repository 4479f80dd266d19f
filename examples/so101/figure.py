"""Draw the held-out motions of the SO-101: measured, nominal model, calibrated model.

    python examples/so101/figure.py RUN [--out figure.png]

RUN is the folder of a finished ``sipe calibrate``; each motion is one simulation from its first sample.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping
from pathlib import Path

import matplotlib
import plain_fit
from matplotlib import pyplot as plt
from matplotlib.figure import Figure
from PIL import Image

MEASURED, NOMINAL, CALIBRATED = "#8c8c8c", "#d55e00", "#0072b2"
LENGTH = 12.0  # s that are drawn


def read_mode(run: Path) -> dict[str, float]:
    """The posterior mode by parameter name."""
    result = json.loads((run / "result.json").read_text(encoding="utf-8"))
    return {row["name"]: row["mode"] for row in result["parameters"]}


def draw(values: Mapping[str, float]) -> Figure:
    """Rows are motions, columns the five arm joints."""
    model, nominal = plain_fit.load_model(), plain_fit.nominal_values()
    joints = plain_fit.JOINTS[: plain_fit.ARM]
    rows = len(plain_fit.HELD_OUT)
    figure, axes = plt.subplots(rows, len(joints), figsize=(11, 1.5 * rows), sharex=True, layout="constrained")
    for row, motion in zip(axes, plain_fit.HELD_OUT, strict=True):
        log = plain_fit.load_log(motion, model)
        runs = {colour: plain_fit.free_run(model, v, log) for colour, v in ((NOMINAL, nominal), (CALIBRATED, values))}
        shown = slice(1, int((log.time < LENGTH).sum()))
        for k, ax in enumerate(row):
            ax.plot(log.time[shown], log.position[shown, k], color=MEASURED, lw=2.5)
            for colour, error in runs.items():
                simulated = log.position[1 : 1 + len(error), k] + error[:, k]
                ax.plot(log.time[shown], simulated[: shown.stop - 1], color=colour, lw=0.8)
            ax.tick_params(labelsize=7)
        row[0].set_ylabel(motion.replace("_", "\n"), fontsize=8)
    for ax, joint in zip(axes[0], joints, strict=True):
        ax.set_title(f"{joint} (rad)", fontsize=9)
    for ax in axes[-1]:
        ax.set_xlabel("s", fontsize=8)
    labels = {"measured": MEASURED, "nominal model": NOMINAL, "calibrated model": CALIBRATED}
    handles = [plt.Line2D([], [], color=colour, label=label) for label, colour in labels.items()]
    figure.legend(handles=handles, loc="outside lower center", ncols=3, frameon=False, fontsize=9)
    return figure


def save_figure(run: Path, path: Path) -> None:
    """Write the figure of a finished run as a PNG of 64 colours."""
    matplotlib.use("Agg")
    figure = draw(read_mode(run))
    figure.savefig(path, dpi=110)
    plt.close(figure)
    with Image.open(path) as picture:
        smaller = picture.convert("RGB").quantize(64)
    smaller.save(path, optimize=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path, help="folder of a finished `sipe calibrate`")
    parser.add_argument("--out", type=Path, default=Path("figure.png"))
    given = parser.parse_args()
    save_figure(given.run, given.out)
    print(f"{given.out}: {given.out.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main()
