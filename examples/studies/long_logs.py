"""What a calibrate of a long log takes: seconds, CPU seconds, how much of them is bare physics, and memory.

    python examples/studies/long_logs.py                       # half an hour, results/long_logs.json
    python examples/studies/long_logs.py --sizes 10000 --out /tmp/long.json --profile

One simulated pendulum, driven by five sines at 100 Hz for 100, 1,000 and 10,000 s, read from CSV, calibrated with
all that `sipe calibrate` does after the fit: checks, figures, report, identified model. Each size in a process of
its own. Physics is the time of MuJoCo's own ``rollout`` for as many physics steps as the fit and all checks simulated,
measured in the same process; memory is the process's peak, and what it had before it read anything.
"""

from __future__ import annotations

import argparse
import cProfile
import json
import pstats
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import mujoco
import mujoco.rollout
import numpy as np

from sipe_bayes.calibration.run import run
from sipe_bayes.core.files import to_json, write_text
from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.simulation.simulator import Simulator

RESULT = Path(__file__).parent / "results" / "long_logs.json"
SIZES = (10_000, 100_000, 1_000_000)
HELD_OUT = 0.2  # share of the log
DT, SKIP, NOISE = 0.01, 2, 0.002
MODEL = """\
<mujoco>
  <option timestep="0.005" integrator="implicitfast"/>
  <worldbody>
    <body name="rod">
      <joint name="hinge" axis="0 1 0" damping="{damping}"/>
      <geom name="rod" type="capsule" fromto="0 0 0 0 0 -0.5" size="0.02" mass="{mass}"/>
    </body>
  </worldbody>
  <actuator><motor name="motor" joint="hinge"/></actuator>
</mujoco>
"""
CONFIG = """\
model = "pendulum.xml"
window = 0.5
commands = [{{ actuator = "motor", column = "torque", unit = "N m" }}]
measurements = [{{ column = "angle", target = "joint:hinge.position", unit = "rad" }}]
parameters = [
  {{ name = "mass", target = "body:rod.mass", bounds = [0.3, 0.8] }},
  {{ name = "damping", target = "joint:hinge.damping", bounds = [0.01, 0.2], scale = "log" }},
]
logs = [
  {{ file = "log.csv", span = [0.0, {train}] }},
  {{ file = "log.csv", name = "rest", use = "holdout", span = [{held}, {end}] }},
]
"""


class Counted(Simulator):
    """Adds up the physics steps of all rollouts, and the CPU seconds within them."""

    steps, seconds = 0, 0.0


def count(rollout: Any) -> Any:
    """``Simulator.rollout``, counted."""

    def counted(self: Simulator, *arguments: Any, **settings: Any) -> Trajectories:
        began = time.process_time()
        made: Trajectories = rollout(self, *arguments, **settings)
        Counted.seconds += time.process_time() - began
        Counted.steps += int(np.prod(made.actions.shape[:2])) * SKIP
        return made

    return counted


def write_case(folder: Path, samples: int) -> Path:
    """The model, the log and the configuration; returns the last."""
    (folder / "pendulum.xml").write_text(MODEL.format(mass=0.5, damping=0.02))
    model = mujoco.MjModel.from_xml_string(MODEL.format(mass=0.6, damping=0.05))
    t = DT * np.arange(samples)
    torque = sum(
        a * np.sin(2 * np.pi * f * t) for a, f in ((0.8, 0.31), (0.7, 0.53), (0.6, 0.97), (0.4, 1.7), (0.3, 2.9))
    )
    state = np.zeros((1, mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS)))
    angles = np.empty(samples)
    for start in range(0, samples, 10_000):  # states of 1e6 samples at once take more memory than what is measured
        stop = min(samples, start + 10_000)
        control = np.repeat(torque[start:stop], SKIP)[None, :, None]
        states, _ = mujoco.rollout.rollout(model, mujoco.MjData(model), state, control)
        angles[start] = state[0, 1]
        angles[start + 1 : stop] = states[0, SKIP - 1 : -1 : SKIP, 1]
        state = states[:, -1]
    angles += np.random.default_rng(0).normal(0, NOISE, samples)
    np.savetxt(
        folder / "log.csv", np.column_stack([t, torque, angles]), "%.9g", ",", header="time,torque,angle", comments=""
    )
    held = round((1 - HELD_OUT) * samples) * DT
    text = CONFIG.format(train=held - DT, held=held, end=(samples - 1) * DT)
    (folder / "config.toml").write_text(text)
    return folder / "config.toml"


def bare(steps: int = 400_000) -> float:
    """CPU seconds of MuJoCo's own rollout for a physics step, in windows as the fit has them."""
    model = mujoco.MjModel.from_xml_string(MODEL.format(mass=0.6, damping=0.05))
    length = 100
    states = np.zeros((steps // length, mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS)))
    states[:, 1] = np.random.default_rng(0).uniform(-2, 2, len(states))
    controls = np.random.default_rng(1).normal(size=(len(states), length, 1))
    began = time.process_time()
    mujoco.rollout.rollout(model, mujoco.MjData(model), states, controls)
    return (time.process_time() - began) / states.shape[0] / length


def peak() -> float:
    """MiB of this process at most."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def measured(samples: int, threads: int, profile: bool) -> dict[str, Any]:
    """One size, in this process."""
    with tempfile.TemporaryDirectory() as folder:
        path = write_case(Path(folder), samples)
        before = peak()
        Simulator.rollout = count(Simulator.rollout)  # type: ignore[method-assign]
        profiler = cProfile.Profile()
        began, cpu = time.perf_counter(), time.process_time()
        if profile:
            profiler.enable()
        calibration = run(path, out=Path(folder) / "out", num_threads=threads)
        profiler.disable()
        seconds, cpu = time.perf_counter() - began, time.process_time() - cpu
        most = peak()
        if profile:
            pstats.Stats(profiler, stream=sys.stderr).sort_stats("tottime").print_stats(40)
            pstats.Stats(profiler, stream=sys.stderr).sort_stats("cumtime").print_stats(70)
    physics = bare() * Counted.steps
    return {
        "samples": samples,
        "seconds": round(seconds, 1),
        "cpu_seconds": round(cpu, 1),
        "physics_steps": Counted.steps,
        "physics_cpu_seconds": round(physics, 1),
        "share_of_physics": round(physics / cpu, 3),
        "share_of_rollouts": round(Counted.seconds / cpu, 3),
        "peak_mib": round(most),
        "before_mib": round(before),
        "fit_rollouts": calibration.rollouts,
        "findings": [str(finding.code) for finding in calibration.findings],
        "parameters": {p.name: [p.q05, p.mean, p.q95] for p in calibration.parameters},
    }


def main() -> None:
    """Measure the sizes and write the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", type=int, nargs="+", default=list(SIZES))
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--profile", action="store_true", help="where the time goes, on standard error")
    parser.add_argument("--one", action="store_true", help="in this process, as JSON on standard output")
    parser.add_argument("--out", type=Path, default=RESULT)
    given = parser.parse_args()
    if given.one:
        print(to_json(measured(given.sizes[0], given.threads, given.profile)))
        return
    rows = []
    for samples in given.sizes:
        words = ["--one", "--sizes", str(samples), "--threads", str(given.threads), *["--profile"] * given.profile]
        done = subprocess.run([sys.executable, __file__, *words], stdout=subprocess.PIPE, check=True, text=True)
        rows.append(json.loads(done.stdout.splitlines()[-1]))
        print({key: value for key, value in rows[-1].items() if key not in ("findings", "parameters")}, flush=True)
        write_text(given.out, to_json({"command": "python examples/studies/long_logs.py", "rows": rows}, indent=1))


if __name__ == "__main__":
    main()
