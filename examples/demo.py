"""``make demo``: calibrate the simple pendulum from one real log, compare it on two others, and ask what it lacks.

``make demo ROBOT=so101`` calibrates an SO-101 arm instead and draws its held-out motions.

The comparison is the error over 0.5 s open-loop windows of logs that were not used for the fit, from the same starts:
the posterior's mode, the identification published with the logs, and the model as weighed, without friction. Then the
model as weighed is asked what it lacks (``sipe discover``), which ends with an answer.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from sipe_bayes.calibration.discover import run_discovery
from sipe_bayes.calibration.problem import prepare
from sipe_bayes.calibration.run import run
from sipe_bayes.cli.app import print_calibration
from sipe_bayes.cli.discover import print_discovery
from sipe_bayes.core.files import OutputError
from sipe_bayes.diagnostics.discovery import Discovery
from sipe_bayes.diagnostics.evaluate import errors
from sipe_bayes.diagnostics.result import Calibration
from sipe_bayes.inference.progress_bar import ProgressBar
from sipe_bayes.likelihood import BoundLikelihood

FOLDER = Path(__file__).parent / "simple_pendulum"
CONFIG, LACKING = FOLDER / "calibrate.toml", FOLDER / "discover.toml"
SO101 = Path(__file__).parent / "so101"
OUT = Path("runs")
Run = TypeVar("Run")

INERTIA, MASS_LENGTH = 0.06259, 0.1022  # kg m^2, kg m: published with the logs
VISCOUS, COULOMB, OFFSET = 0.04707, 0.1839, -0.07586  # N m s/rad, N m, N m
GRAVITY = 9.81  # m/s^2
STEP = 5e-4  # s


def published_acceleration(
    angle: NDArray[np.float64], rate: NDArray[np.float64], torque: NDArray[np.float64]
) -> NDArray[np.float64]:
    """The published equation of motion: measured torque = J a + m g c sin(q) + viscous + Coulomb atan(100 v) + offset.

    The offset is thus taken off the measured torque, the sign with which a linear regression of that torque yields it;
    the arctangent counts as stated, so that Coulomb friction reaches pi / 2 times its coefficient.
    """
    friction = VISCOUS * rate + COULOMB * np.arctan(100 * rate)
    return (torque - OFFSET - friction - MASS_LENGTH * GRAVITY * np.sin(angle)) / INERTIA


def simulate_published(windows: BoundLikelihood) -> NDArray[np.float64]:
    """Angles (W, L) of the published model over the windows: MuJoCo has no arctangent friction, so by Runge-Kutta."""
    starts = windows.reference
    angle, rate = starts[:, 1].copy(), starts[:, 2].copy()
    path = [angle.copy()]
    for k in range(windows.actions.shape[1]):
        torque, parts = windows.actions[:, k, 0], int(np.ceil(windows.dt.max() / STEP))
        h = windows.dt / parts
        for _ in range(parts):
            v1, a1 = rate, published_acceleration(angle, rate, torque)
            v2 = rate + h / 2 * a1
            a2 = published_acceleration(angle + h / 2 * v1, v2, torque)
            v3 = rate + h / 2 * a2
            a3 = published_acceleration(angle + h / 2 * v2, v3, torque)
            v4 = rate + h * a3
            a4 = published_acceleration(angle + h * v3, v4, torque)
            angle = angle + h / 6 * (v1 + 2 * v2 + 2 * v3 + v4)
            rate = rate + h / 6 * (a1 + 2 * a2 + 2 * a3 + a4)
        path.append(angle)
    return np.stack(path, axis=1)


def published_errors(windows: BoundLikelihood) -> NDArray[np.float64]:
    """RMSE (logs,) of the published model, counted as ``errors`` counts."""
    difference = windows.measured[:, :, 0] - simulate_published(windows)
    square = np.where(windows.observed[:, :, 0], difference, 0.0) ** 2
    mine = [windows.log == k for k in range(len(windows.trajectories))]
    return np.array([np.sqrt(square[m].sum() / windows.observed[m].sum()) for m in mine])


def fresh(run_into: Callable[[Path], Run], name: str) -> Run:
    """What a run into runs/NAME gives, or into a fresh folder when that one holds another configuration's run."""
    for folder in [OUT / name, *(OUT / f"{name}-{n}" for n in range(2, 100))]:
        try:
            return run_into(folder)
        except OutputError:
            continue
    raise OutputError(f"{OUT}: holds a hundred demos; delete them")


def calibrate(folder: Path, config: Path = CONFIG) -> Calibration:
    with ProgressBar() as progress:
        return run(config, out=folder, progress=progress)


def discover(folder: Path) -> Discovery:
    with ProgressBar() as progress:
        return run_discovery(LACKING, out=folder, progress=progress)


def save_picture(found: Discovery) -> Path:
    """The README's figure, from the report's figures: before and after, of the training log and of a held-out one."""
    figures = Path(found.out) / "figures"
    parts = [
        Image.open(figures / f"{name}.png") for name in ("residuals_before_after", "before_after_1_direct_collocation")
    ]
    whole = Image.new("RGB", (max(p.width for p in parts), sum(p.height for p in parts)), "white")
    for part, top in zip(parts, (0, parts[0].height), strict=True):
        whole.paste(part, (0, top))
    path = Path(found.out) / "figure.png"
    whole.quantize(64).save(path, optimize=True)
    return path


def show_so101() -> None:
    """Calibrate the SO-101, print its held-out errors, and draw them beside the report."""
    sys.path.insert(0, str(SO101))
    import figure
    import plain_fit

    found = fresh(lambda folder: calibrate(folder, SO101 / "calibrate.toml"), "demo-so101")
    print_calibration(found)
    folder = Path(found.out).resolve()
    values = plain_fit.nominal_values(), figure.read_mode(folder)
    before, after = (plain_fit.held_out_errors(v) for v in values)
    print("\nHeld-out error of one simulation over 30 s (RMSE of the five arm joints, rad)")
    print(f"{'motion':28}{'nominal':>10}{'calibrated':>12}")
    for motion in after:
        print(f"{motion:28}{before[motion]:10.4f}{after[motion]:12.4f}")
    picture = folder / "held_out.png"
    figure.save_figure(folder, picture)
    print(f"\nreport: {folder / 'report.html'}\npicture: {picture}")


def show_pendulum() -> None:
    """Calibrate the pendulum, compare it on held-out logs, and ask what its model lacks."""
    found = fresh(calibrate, "demo")
    print_calibration(found)
    problem = prepare(CONFIG)
    if problem.holdout is None:
        raise ValueError(f"{CONFIG}: no log is held out; mark one with use = 'holdout'")
    windows = BoundLikelihood(problem.likelihood, problem.simulator, problem.holdout)
    space = problem.environment.space
    ours, weighed = errors(windows, np.stack([found.posterior.mode.numpy(), space.default_theta]))[:, :, 0]
    print("\nHeld-out error over 0.5 s windows (RMSE, rad), from the same starts")
    print(f"{'log':28}{'posterior mode':>16}{'published':>12}{'weighed, no friction':>23}")
    rows = zip(problem.holdout.names, ours, published_errors(windows), weighed, strict=True)
    for name, *values in rows:
        print(f"{name:28}{values[0]:16.3f}{values[1]:12.3f}{values[2]:23.3f}")
    print(f"\nreport: {Path(found.out).resolve() / 'report.html'}\n")
    lacking = fresh(discover, "demo-discover")
    save_picture(lacking)
    print_discovery(lacking)


def main() -> int:
    parser = argparse.ArgumentParser(description="Calibrate a real robot from its logs.")
    robots = {"pendulum": show_pendulum, "so101": show_so101}
    parser.add_argument("robot", nargs="?", default="pendulum", choices=list(robots))
    robots[parser.parse_args().robot]()
    return 0


if __name__ == "__main__":
    sys.exit(main())
