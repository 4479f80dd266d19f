"""The net under a restructuring.

One small fit of every kind with a fixed seed, before and after, which must not differ.

    python examples/studies/net.py --against examples/studies/results/net.json
        # fit, and compare with what is kept; some minutes on one core
    python examples/studies/net.py --against examples/studies/results/net.json --only npe arm-white
    python examples/studies/net.py --out examples/studies/results/net.json       # keep what there is now

Nothing but the package's public names is used, so that the same file runs before and after. Budgets are small: the
posteriors are as good as they need be to notice a change, not good. Fits are kept one by one, so an interrupted run
goes on; those of another state of the package's code are made anew. One thread each, and each problem apart: any choice
of them gives the same bits. Another processor, or other versions of NumPy, MuJoCo and PyTorch, rounds otherwise, and
chains and networks magnify that: make both files on one machine where a line says that they differ in these.

A line for each problem: the largest difference of a mean, in units of the earlier sd (of the range, for a point), the
largest relative one of an sd, rollouts before and after, and whether all is the same to the last bit: both, rollouts,
1,000 draws, the number of warnings and the log itself. The exit status is 1 where a mean or an sd moved by more than
1e-6, or a problem failed.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import logging
import os
import platform
import re
import sys
import time
import warnings
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

import sipe_bayes as sipe

FloatArray = NDArray[np.float64]
Case = tuple[Any, Any]  # an estimator, and what it is fitted to

HERE = Path(__file__).parent
EXAMPLES = HERE.parent
RUN = HERE / "runs" / "net.json"
ONE_THREAD = {name: "1" for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")}
SEED, DRAWS, MOVED = 0, 1000, 1e-6
ARM = """
<mujoco>
  <option timestep="0.002"/>
  <worldbody>
    <body name="upper">
      <joint name="shoulder" axis="0 1 0" damping="0.1"/>
      <geom name="upper" type="capsule" fromto="0 0 0 0 0 -0.3" size="0.03" mass="1.5" contype="0" conaffinity="0"/>
      <body name="lower" pos="0 0 -0.3">
        <joint name="elbow" axis="0 1 0" damping="0.1"/>
        <geom name="lower" type="capsule" fromto="0 0 0 0 0 -0.25" size="0.025" mass="0.8" contype="0" conaffinity="0"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor name="shoulder" joint="shoulder"/><motor name="elbow" joint="elbow"/></actuator>
</mujoco>
"""
ARM_TRUTH = np.array([0.3, 0.7, 0.6, 0.4])
UNSEEN = ("velocity", "turning", "from_grip", "goal")  # parts of FetchPush's channels' names


def real(example: str, method: str, **settings: Any) -> Case:
    """A method on the logs of an example that is shipped."""
    problem = sipe.prepare(EXAMPLES / example / "calibrate.toml", num_threads=1)
    given = {"prior": problem.prior, "likelihood": problem.likelihood, "seed": SEED, **settings}
    return sipe.get_estimator(problem.simulator, method, **given), problem.train


def arm(rho: float, likelihood: Any) -> Case:
    """Two links that sines move for 2 s from rest; angles with noise of 0.02 rad, white or autoregressive."""
    parameters = [
        *(sipe.Parameter(f"{j}_damping", 0.02, 0.4, targets=(f"joint:{j}.damping",)) for j in ("shoulder", "elbow")),
        *(sipe.Parameter(f"{b}_mass", 0.5, 2.0, targets=(f"body:{b}.mass",)) for b in ("upper", "lower")),
    ]
    channels = [sipe.Channel(f"joint:{j}.position", f"{j}_angle") for j in ("shoulder", "elbow")]
    environment = sipe.MjcfEnvironment.build(ARM, parameters, ["shoulder", "elbow"], channels)
    simulator, dt = sipe.Simulator(environment, num_threads=1), 0.01
    clock = np.arange(200)[:, None] * dt
    torques = np.array([3.0, 1.0]) * np.sin(2 * np.pi * np.array([0.7, 1.1]) * clock + np.array([0.0, 1.0]))
    motion = simulator.rollout(ARM_TRUTH, torques, simulator.default_state(), dt=dt)
    noise = np.random.default_rng([SEED, round(100 * rho)]).standard_normal(motion.observations[0].shape)
    for k in range(1, len(noise)):
        noise[k] = rho * noise[k - 1] + np.sqrt(1 - rho**2) * noise[k]
    log = sipe.Trajectory(motion.observations[0] + 0.02 * noise, torques, dt, states=motion.states[0])
    return sipe.get_estimator(simulator, "laplace", likelihood=likelihood, seed=SEED), log


def chain(task: str, method: str, steps: int, **settings: Any) -> Case:
    """A method on StateSpace: one log with 1 % noise, without states."""
    simulator = sipe.Simulator(sipe.make_task(task), num_threads=1)
    log = sipe.demonstrations(simulator, "random", variant="in_distribution", count=1, steps=steps, noise=0.01)
    return sipe.get_estimator(simulator, method, likelihood=sipe.StateSpace(), seed=SEED, **settings), log


def door(steps: int) -> Case:
    """`laplace` on an expert's motion of the hand at the door, all states known, by windows of one control step."""
    simulator = sipe.Simulator(sipe.make_task("Door"), num_threads=1)
    log = sipe.demonstrations(simulator, variant="in_distribution", count=1, steps=steps)
    likelihood = sipe.Segments(simulator.dt, noise="white", starts="recorded")
    return sipe.get_estimator(simulator, "laplace", likelihood=likelihood, seed=SEED), log


def push(known: bool, steps: int, **settings: Any) -> Case:
    """`laplace` on an expert's push.

    known: all states, for windows of one control step; else the first, for StateSpace with 1 % noise.
    """
    simulator = sipe.Simulator(sipe.make_task("FetchPush"), num_threads=1)
    log = sipe.demonstrations(simulator, variant="in_distribution", count=1, steps=steps)[0]
    likelihood: Any = sipe.Segments(simulator.dt, noise="white", starts="recorded")
    if not known:
        names = simulator.environment.channels
        used = np.array([not any(part in name for part in UNSEEN) for name in names])
        spread = log.observations.std(axis=0)
        noise = np.random.default_rng(SEED).standard_normal(log.observations.shape)
        noisy = log.observations + 0.01 * np.maximum(spread, 0.1 * spread[used].max()) * noise
        log = sipe.Trajectory(noisy, log.actions, log.dt, states=log.states)
        likelihood = sipe.StateSpace(tuple(np.array(names)[used].tolist()), starts="recorded")
    return sipe.get_estimator(simulator, "laplace", likelihood=likelihood, seed=SEED, **settings), log


def task(name: str, method: str, budget: int, noise: float = 0.0, **settings: Any) -> Case:
    """A method on 50 control steps of a benchmark's task."""
    simulator = sipe.Simulator(sipe.make_task(name), num_threads=1)
    log = sipe.demonstrations(simulator, "random", variant="in_distribution", count=1, steps=50, noise=noise)
    return sipe.get_estimator(simulator, method, budget=budget, seed=SEED, **settings), log


def recalibrated() -> Case:
    inner, log = task("Pendulum", "cem", 60, noise=0.01)
    return sipe.Recalibrated(inner, refits=40, seed=SEED), log


def line(values: FloatArray) -> FloatArray:
    """``x`` (B, 3) of slope and square (B, 2)."""
    return np.stack([values[:, 0], values[:, 0] * values[:, 1], values[:, 1] ** 2], axis=1)


def function(method: str, **settings: Any) -> Case:
    """A method on a function in MuJoCo's place."""
    space = sipe.ParameterSpace([sipe.Parameter("slope", 0.0, 2.0), sipe.Parameter("square", 0.0, 1.0)])
    simulator = sipe.CallableSimulator(line, space, likelihood=0.05, name="net_line")
    return sipe.get_estimator(simulator, method, seed=SEED, **settings), np.array([1.1, 0.5, 0.2])


PROBLEMS: dict[str, Callable[[], Case]] = {
    "pendulum-laplace": lambda: real("simple_pendulum", "laplace"),
    "pendulum-mcmc": lambda: real("simple_pendulum", "mcmc", budget=1000, effective=50),
    "furuta-laplace": lambda: real("furuta_pendulum", "laplace"),
    "arm-white": lambda: arm(0.0, sipe.Segments(None, noise="white", starts="recorded")),
    "arm-ar1": lambda: arm(0.95, sipe.Segments(0.5)),
    "cheetah-chain": lambda: chain("HalfCheetahJoints", "laplace", 100),
    "hopper-chain-mcmc": lambda: chain("Hopper", "mcmc", 50, budget=2000, effective=50),
    "push-steps": lambda: push(True, 50),
    "push-chain": lambda: push(False, 30, restarts=1),
    "door-steps": lambda: door(40),
    "function-mcmc": lambda: function("mcmc", effective=100),
    "npe": lambda: task("Pendulum", "npe", 300, max_epochs=50),
    "bayessim": lambda: task("Pendulum", "bayessim", 300),
    "simopt": lambda: task("HalfCheetahLinks", "simopt", 200),
    "adr": lambda: task("HalfCheetahLinks", "adr", 200),
    "adr-learned": lambda: task("HalfCheetahLinks", "adr", 100, reward="learned"),
    "bayesopt": lambda: task("Pendulum", "bayesopt", 30),
    "maml": lambda: task("Pendulum", "maml", 300, iterations=200),
    "abc": lambda: task("HalfCheetahLinks", "abc", 300),
    "regression": lambda: task("HalfCheetahLinks", "regression", 300),
    "cem": lambda: task("HalfCheetahLinks", "cem", 300),
    "recalibrated": recalibrated,
}


def sha(*arrays: Any) -> str:
    found = hashlib.sha256()
    for array in arrays:
        found.update(np.ascontiguousarray(array, dtype=float).tobytes())
    return found.hexdigest()[:16]


def source() -> str:
    """Hash of the package's code."""
    found, home = hashlib.sha256(), Path(sipe.__file__).parent
    for file in sorted(home.glob("**/*.py")):
        found.update(f"{file.relative_to(home).as_posix()}\n".encode() + file.read_bytes())
    return found.hexdigest()[:16]


def recorded(log: Any) -> str:
    """Hash of a log."""
    if isinstance(log, np.ndarray):
        return sha(log)
    return sha(*(part for one in sipe.Trajectories.stack(log) for part in (one.observations, one.actions, one.dt)))


def fit(name: str) -> dict[str, Any]:
    """A problem's record; "error" and the seconds alone where it fails."""
    began = time.perf_counter()
    try:
        torch.manual_seed(SEED)
        estimator, log = PROBLEMS[name]()
        posterior = estimator.fit(log)
        draws = posterior.sample((DRAWS,), generator=torch.Generator().manual_seed(SEED))
        found = {
            "parameters": list(posterior.space.names),
            "mean": posterior.mean.tolist(),
            "stddev": posterior.stddev.tolist(),
            "rollouts": int(estimator.rollouts),
            "draws": sha(draws.numpy()),
            "warnings": len(estimator.warnings),
            "log": recorded(log),
        }
    except Exception as error:  # a problem that fails must not hide the others
        found = {"error": f"{type(error).__name__}: {error}"}
    return {**found, "seconds": round(time.perf_counter() - began, 1)}


def rounding() -> dict[str, Any]:
    """What the last bits depend on besides the package."""
    cpu = Path("/proc/cpuinfo")
    model = re.search(r"model name\s*:\s*(.*)", cpu.read_text(encoding="utf-8")) if cpu.is_file() else None
    used = ("mujoco", "numpy", "scipy", "torch", "sbi", "botorch")
    return {"versions": {p: version(p) for p in used}, "processor": model[1] if model else platform.machine()}


def write(path: Path, problems: dict[str, dict[str, Any]]) -> None:
    """All records; the file appears whole or not at all."""
    ordered = {name: problems[name] for name in PROBLEMS if name in problems}
    found = {"command": f"python examples/studies/net.py --out {path}", **rounding(), "problems": ordered}
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    temporary.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    os.replace(temporary, path)


def read(path: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    return found


def compared(before: dict[str, Any] | None, after: dict[str, Any]) -> tuple[str, bool]:
    """The columns of a problem's line, and whether it moved."""
    if before is None or "error" in before:
        return "  not in the earlier file" if before is None else "  failed in the earlier file", True
    if "error" in after:
        return f"  {after['error'][:90]}", True
    if before["parameters"] != after["parameters"]:
        return "  other parameters", True
    (m0, s0), (m1, s1) = ([np.array(row[key]) for key in ("mean", "stddev")] for row in (before, after))
    unit = np.where(s0 > 0, s0, 1.0)
    mean, sd = float((np.abs(m1 - m0) / unit).max()), float((np.abs(s1 - s0) / unit).max())
    unlike = [key for key in after if key not in ("seconds", "source") and before.get(key) != after[key]]
    rollouts = f"{before['rollouts']} / {after['rollouts']}"
    return f"{mean:9.1e} {sd:9.1e} {rollouts:>15}  {'identical' if not unlike else 'not ' + ', '.join(unlike)}", not (
        max(mean, sd) <= MOVED
    )


def shown(row: dict[str, Any]) -> str:
    return row.get("error", "")[:90] or f"{row['rollouts']:7} rollouts {row['warnings']:2} warnings  {row['draws']}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", metavar="NAME", default=list(PROBLEMS), choices=list(PROBLEMS))
    parser.add_argument("--out", type=Path, default=RUN, help="default: %(default)s")
    parser.add_argument("--against", type=Path, metavar="FILE", help="an earlier one to compare with")
    parser.add_argument("--fresh", action="store_true", help="fit anew what --out holds")
    given = parser.parse_args()
    if given.against is not None and given.against.resolve() == given.out.resolve():
        parser.error("--against: a file other than --out")
    if any(os.environ.get(name) != one for name, one in ONE_THREAD.items()):  # read as NumPy is loaded
        os.execve(sys.executable, sys.orig_argv, {**os.environ, **ONE_THREAD})
    torch.set_num_threads(1)
    warnings.simplefilter("ignore")
    logging.disable(logging.WARNING)
    made_by, moved = source(), 0
    kept = read(given.out)["problems"] if given.out.exists() else {}
    before = read(given.against) if given.against is not None else None
    if before is not None:
        if {name: before[name] for name in rounding()} != rounding():
            print("other versions or another processor made the earlier file: the last bits may differ")
        print(f"{'problem':18} {'mean/sd':>9} {'sd':>9} {'rollouts':>15}  of {Path(sipe.__file__).parent}")
    for name in [name for name in PROBLEMS if name in given.only]:
        row = kept.get(name)
        if row is None or given.fresh or "error" in row or row["source"] != made_by:
            row = kept[name] = {**fit(name), "source": made_by}
            write(given.out, kept)
        text, bad = (shown(row), "error" in row) if before is None else compared(before["problems"].get(name), row)
        moved += bad
        print(f"{name:18} {text}  {row['seconds']:.0f} s", flush=True)
    if before is not None:
        print(f"{moved} moved by more than {MOVED:g}, or failed" if moved else "none moved")
    sys.exit(moved > 0)


if __name__ == "__main__":
    main()
