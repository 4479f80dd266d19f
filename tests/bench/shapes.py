"""What `sipe calibrate` costs on the shapes of real data, beside the bare physics that it simulates.

Each example is calibrated in a process of its own, imports left out; afterwards that process steps the example's model
as often by bare `mujoco.rollout` on one thread, with the log's commands, which is the denominator. A rollout copies
parameters and starts, so that its own CPU time is given beside.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import mujoco
import mujoco.rollout
import numpy as np

from sipe_bayes.calibration.problem import prepare
from sipe_bayes.calibration.run import run
from sipe_bayes.simulation.simulator import Simulator

EXAMPLES = Path(__file__).parents[2] / "examples"
BARS = {
    "servo": 120,
    "drive": 30,
    "arm": 240,
    "double_pendulum": None,
    "cube": 180,
    "quadruped": None,
}  # s of wall time
RATIO, CHECKS = 1.5, 0.3
_SAMPLE = 20_000  # physics steps of which the bare cost is taken


def table(names: list[str] | None = None) -> None:
    """A line for each example."""
    print(
        "\n`sipe calibrate` on the shapes of real data (simulated stand-ins, seed 0), CPU s of the whole against bare"
    )
    print(f"physics; bars: {RATIO} times, checks {100 * CHECKS:.0f} % of the CPU time")
    heading = (
        "example",
        "wall s",
        "bar",
        "CPU s",
        "rollouts",
        "M steps",
        "bare s",
        "CPU/bare",
        "CPU/rollouts'",
        "checks",
    )
    print("".join(f"{word:>16}" if k else f"{word:<16}" for k, word in enumerate(heading)))
    for name in names or BARS:
        done = subprocess.run([sys.executable, __file__, name], capture_output=True, text=True, check=False)
        if done.returncode:
            print(f"{name:<16}{done.stderr.strip().splitlines()[-1]}")
            continue
        row = json.loads(done.stdout.splitlines()[-1])
        bar = "" if BARS[name] is None else str(BARS[name])
        numbers = (
            *(f"{row['wall']:.0f}", bar, f"{row['cpu']:.1f}", str(row["rollouts"]), f"{row['steps'] / 1e6:.1f}"),
            *(f"{row['bare']:.1f}", f"{row['cpu'] / row['bare']:.2f}", f"{row['cpu'] / row['own']:.2f}"),
            f"{100 * row['checks'] / row['cpu']:.0f} %",
        )
        print(f"{name:<16}" + "".join(f"{number:>16}" for number in numbers), flush=True)


def measured(name: str) -> dict[str, Any]:
    """One example: wall and CPU seconds, those of its rollouts, of the checks after the fit, and of bare physics."""
    config, spent, fitted = EXAMPLES / name / "calibrate.toml", {"steps": 0, "own": 0.0}, [0.0]
    rollout = Simulator.rollout

    def counted(self: Simulator, theta: Any, actions: Any, start: Any, dt: float, *rest: Any, **named: Any) -> Any:
        began = time.process_time()
        out = rollout(self, theta, actions, start, dt, *rest, **named)
        spent["own"] += time.process_time() - began
        substeps = max(round(float(np.max(dt)) / self.model.opt.timestep), 1)
        spent["steps"] += int(np.prod(out.observations.shape[:2])) * substeps
        return out

    def progress(what: str, *_: int) -> None:
        if what.startswith("check 1 of") and not fitted[0]:
            fitted[0] = time.process_time()

    Simulator.rollout = counted  # type: ignore[method-assign]
    with tempfile.TemporaryDirectory() as folder:
        wall, began = time.monotonic(), time.process_time()
        calibration = run(config, out=Path(folder) / "out", progress=progress)
        cpu, wall, ended = time.process_time() - began, time.monotonic() - wall, time.process_time()
    own = {"wall": wall, "cpu": cpu, "checks": ended - fitted[0], "rollouts": calibration.rollouts}
    return {**own, **spent, "bare": spent["steps"] * bare_step(config)}


def bare_step(config: Path) -> float:
    """CPU seconds of a physics step of an example's model under its first log's commands."""
    problem = prepare(config, 1)
    model, (log, *_) = problem.simulator.model, problem.train
    data, substeps = mujoco.MjData(model), max(round(log.dt / model.opt.timestep), 1)
    state = np.zeros(mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS))
    mujoco.mj_getState(model, data, state, mujoco.mjtState.mjSTATE_FULLPHYSICS)
    commands = np.repeat(np.asarray(log.actions), substeps, axis=0)
    commands = commands if commands.shape[1] == model.nu else np.zeros((len(commands), model.nu))
    rounds = max(_SAMPLE // len(commands), 1)
    began = time.process_time()
    for _ in range(rounds):
        mujoco.rollout.rollout(model, data, state, commands)
    return (time.process_time() - began) / (rounds * len(commands))


if __name__ == "__main__":
    print(json.dumps(measured(sys.argv[1])))
