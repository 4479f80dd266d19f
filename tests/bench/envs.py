"""The benchmark's environments: tables of `bench.py envs` and `bench.py memory`.

Bare: mujoco.rollout on the published model, parameters written beforehand, controls repeated beforehand, states alone
read. Everything on 2 threads and 64 simulations.
"""

from __future__ import annotations

import contextlib
import copy
import functools
import importlib.util
import io
import multiprocessing
import resource
import sys
import tempfile
import time
import warnings
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import mujoco
import mujoco.rollout
import numpy as np

from sipe_bayes.envs.foreign.quiet import quiet
from sipe_bayes.envs.registry import make_task
from sipe_bayes.envs.task import Task
from sipe_bayes.simulation.simulator import Simulator

NUM_ENVS, STEPS, THREADS = 64, 200, 2
SideBySide = Callable[[Callable[[int], float], Callable[[int], float], int], tuple[float, float, float]]
PUBLISHED = {  # task: model file, id of the published environment, bar against its AsyncVectorEnv
    "HalfCheetahJoints": ("gymnasium/envs/mujoco/assets/half_cheetah.xml", "HalfCheetah-v5", 8.0),
    "HumanoidJoints": ("gymnasium/envs/mujoco/assets/humanoid.xml", "Humanoid-v4", 2.0),
    "Relocate": (
        "gymnasium_robotics/envs/assets/adroit_hand/adroit_relocate.xml",
        "AdroitHandRelocate-v1",
        2.5,
    ),
    "FetchPush": ("gymnasium_robotics/envs/assets/fetch/push.xml", None, None),
}


def seconds(work: Callable[[], Any]) -> float:
    begin = time.perf_counter()
    work()
    return time.perf_counter() - begin


def _found(file: str) -> str:
    """Path of a package's file, without importing the package."""
    package, _, rest = file.partition("/")
    spec = importlib.util.find_spec(package)
    assert spec is not None
    assert spec.origin is not None
    return str(Path(spec.origin).parent / rest)


def _load(file: str) -> Any:
    with quiet, warnings.catch_warnings():  # settotalmass is deprecated
        warnings.simplefilter("ignore")
        return mujoco.MjModel.from_xml_path(file)


class Case:
    """One task, ours and bare."""

    def __init__(self, name: str) -> None:
        self.simulator = Simulator(make_task(name), num_threads=THREADS)
        assert isinstance(self.simulator.environment, Task)
        self.task = self.simulator.environment
        self.steps = min(STEPS, self.task.episode_steps)
        rng = np.random.default_rng(0)
        self.theta = rng.random((NUM_ENVS, len(self.task.space)))
        shape = (NUM_ENVS, self.steps, self.task.num_actions)
        self.actions = rng.uniform(self.task.action_low, self.task.action_high, shape)
        self.start, self.goals = self.task.initial_states(rng, NUM_ENVS)
        file, self.id, self.bar = PUBLISHED[name]
        self.file = _found(file)
        self.datas, self.models = self._bare_models()
        self.controls = self._controls()

    def _bare_models(self) -> tuple[list[Any], list[Any]]:
        if self.task.stepwise:  # the published file lacks the weld that its environment adds after loading
            return [mujoco.MjData(self.simulator.model) for _ in range(THREADS)], list(
                map(self.simulator.written, self.theta)
            )
        plain, models = _load(self.file), []
        scratch = mujoco.MjData(plain)
        for row in self.theta:
            model = copy.copy(plain)
            model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_WARMSTART
            self.task.write(model, self.task.space.values(row))
            mujoco.mj_setConst(model, scratch)
            models.append(model)
        return [mujoco.MjData(plain) for _ in range(THREADS)], models

    def _controls(self) -> np.ndarray:
        """What the bare rollout is given: of a stepwise task, what our control was."""
        task, model = self.task, self.simulator.model
        if not task.stepwise:
            return np.repeat(task.control(model, self.start, self.actions), task.frame_skip, axis=1)
        states = self.ours().states
        rows = [task.control(model, states[:, t], self.actions[:, t]) for t in range(self.steps)]
        return np.repeat(np.stack(rows, axis=1), task.frame_skip, axis=1)

    def bare(self) -> Any:
        size = mujoco.mj_stateSize(self.models[0], mujoco.mjtState.mjSTATE_FULLPHYSICS)
        return mujoco.rollout.rollout(
            self.models,
            self.datas,
            initial_state=self.start[:, :size],
            control=self.controls,
            control_spec=self.task.control_spec,
            persistent_pool=True,
        )[0]

    def ours(self) -> Any:
        return self.simulator.rollout(self.theta, self.actions, self.start, goals=self.goals)

    def stepping(self) -> float:
        """Seconds of the episode in closed loop, without the reset."""
        self.simulator.reset(self.theta)
        begin = time.perf_counter()
        for t in range(self.steps - 1):
            self.simulator.step(self.actions[:, t])
        return (time.perf_counter() - begin) * self.steps / (self.steps - 1)


def table(pairs: int, side_by_side: SideBySide) -> None:
    print(
        f"\nEnvironments: {NUM_ENVS} simulations x {STEPS} control steps (Fetch: its 50), {THREADS} threads; k steps/s"
    )
    print("'rollout', 'stepping' (observations and rewards included): share of the bare speed; bars .90 and .75")
    print("'theta': share of a rollout that writing new parameters into every simulation takes; bar 5 %")
    print(
        "'async': times the published environment's AsyncVectorEnv of 64 processes, stepping alone, of what bare "
        "rollouts would be (bar)"
    )
    heading = ("bare", "rollout", "share", "stepping", "share", "theta")
    print(f"{'task':<20}" + "".join(f"{h:>10}" for h in heading) + f"{'async':>18}")
    for name in PUBLISHED:
        case = Case(name)
        total = NUM_ENVS * case.steps
        a, bare, ratio = side_by_side(lambda _, w=case: seconds(w.ours), lambda _, w=case: seconds(w.bare), pairs)
        b, _, stepped = side_by_side(lambda _, w=case: w.stepping(), lambda _, w=case: seconds(w.bare), pairs)
        share = np.median([_writing(case) for _ in range(pairs)]) / a
        row = (
            f"{total / bare / 1e3:.1f}",
            f"{total / a / 1e3:.1f}",
            f"{1 / ratio:.2f}",
            f"{total / b / 1e3:.1f}",
            f"{1 / stepped:.2f}",
            f"{100 * share:.1f} %",
        )
        times = None if case.id is None else _against_async(case, pairs, side_by_side)
        against = "" if case.id is None else "not measured"
        if times is not None:
            against = f"{times:.1f} of {times * stepped:.1f} ({case.bar:g})"
        print(f"{name:<20}" + "".join(f"{r:>10}" for r in row) + f"{against:>18}", flush=True)


def _writing(case: Case) -> float:
    """Seconds to write new theta into 64 models, pooled ones or those of a closed loop, whichever takes longer."""
    rng = np.random.default_rng()
    simulator, theta = case.simulator, rng.random(case.theta.shape)
    timesteps = np.full(NUM_ENVS, simulator.model.opt.timestep)
    pooled = seconds(lambda: simulator.pool.take(theta, timesteps, [None] * NUM_ENVS))
    simulator.reset(case.theta)
    assert simulator.episodes is not None
    set_theta = simulator.episodes.set_theta
    return max(pooled, seconds(lambda: set_theta(np.arange(NUM_ENVS), theta)))


def _against_async(case: Case, pairs: int, side_by_side: SideBySide) -> float | None:
    """How many times faster 64 simulations step than 64 processes of the published environment.

    The same actions from the same kind of start, neither ending its episodes early, resets not counted.
    """
    steps = min(NUM_ENVS, case.steps - 1)
    actions = case.actions.astype(np.float32)

    def ours(_: int) -> float:
        case.simulator.reset(case.theta)
        return seconds(lambda: [case.simulator.step(case.actions[:, t]) for t in range(steps)])

    def measured(other: Any) -> float:
        def theirs(_: int) -> float:
            other.reset(seed=0)
            return seconds(lambda: [other.step(actions[:, t]) for t in range(steps)])

        return 1 / side_by_side(ours, theirs, pairs)[2]

    return in_processes(functools.partial(_published, str(case.id)), measured)


def in_processes(make: Callable[[], Any], measured: Callable[[Any], float]) -> float | None:
    """What ``measured`` returns of an AsyncVectorEnv of 64; None, and why, where two tries at one have failed.

    A busy machine may end a process or keep it waiting; sub-processes that were left over are ended.
    """
    why = ""
    for _ in range(2):
        other: Any = None
        try:
            other = gymnasium.vector.AsyncVectorEnv([make] * NUM_ENVS, shared_memory=True)
            found = measured(other)
        except (OSError, EOFError, MemoryError, multiprocessing.ProcessError, gymnasium.error.Error) as error:
            why = f"{type(error).__name__}: {error}"
            continue
        finally:
            if other is not None:
                with contextlib.suppress(Exception):  # whatever is broken, it must not outlive the table
                    other.close(terminate=True)
        return found
    print(f"not measured: {NUM_ENVS} sub-processes failed twice ({why})", flush=True)
    return None


def _published(name: str) -> Any:
    """One of the 64, made in its own process."""
    settings = {"terminate_when_unhealthy": False} if name.startswith("Humanoid") else {}
    with quiet, warnings.catch_warnings(), contextlib.redirect_stderr(io.StringIO()):
        warnings.simplefilter("ignore")
        if name.startswith("Adroit"):
            import gymnasium_robotics

            gymnasium.register_envs(gymnasium_robotics)
        return gymnasium.make(name, **settings)


class Reparsed(gymnasium.Env[np.ndarray, np.ndarray]):
    """The usual design: a half-cheetah whose XML is parsed anew with every theta; ``factor`` times its damping."""

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (17,), np.float64)
    action_space = gymnasium.spaces.Box(-1, 1, (6,), np.float32)
    factor = 1.0

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[np.ndarray, dict[str, Any]]:
        tree = ElementTree.parse(_found(PUBLISHED["HalfCheetahJoints"][0]))
        for joint in tree.iter("joint"):
            if joint.get("damping"):
                joint.set("damping", str(float(joint.get("damping", 0)) * self.factor))
        with tempfile.NamedTemporaryFile("wb", suffix=".xml") as file:
            tree.write(file)
            file.flush()
            with quiet, warnings.catch_warnings():
                warnings.simplefilter("ignore")
                self.env = gymnasium.make("HalfCheetah-v5", xml_file=file.name)
        return self.env.reset(seed=seed)

    def step(self, action: np.ndarray) -> Any:
        return self.env.step(action)


def against_parsing(pairs: int, side_by_side: SideBySide) -> None:
    case = Case("HalfCheetahJoints")
    rng = np.random.default_rng(0)
    actions = case.actions.astype(np.float32)

    def ours(_: int) -> float:
        case.theta = rng.random(case.theta.shape)
        return seconds(case.ours)

    def measured(other: Any) -> float:
        def theirs(_: int) -> float:
            begin = time.perf_counter()
            other.set_attr("factor", list(rng.uniform(0.5, 1.5, NUM_ENVS)))
            other.reset()
            for t in range(STEPS):
                other.step(actions[:, t])
            return time.perf_counter() - begin

        return 1 / side_by_side(ours, theirs, pairs)[2]

    print(f"\nHalf-cheetah, {NUM_ENVS} rollouts of {STEPS} steps with a new theta each, against XML parsed anew for")
    print(f"each theta and stepped in {NUM_ENVS} sub-processes (bar 10)")
    times = in_processes(Reparsed, measured)
    if times is not None:
        print(f"{times:.1f} times as fast")


def memory() -> None:
    """Resident memory over 10,000 rollouts, then 100,000 rollouts of 50 steps in pieces of 1,000."""
    simulator = Simulator(make_task("HalfCheetahJoints"), num_threads=THREADS)
    task = simulator.environment
    assert isinstance(task, Task)
    rng = np.random.default_rng(0)

    def piece(count: int, steps: int) -> None:
        start, _ = task.initial_states(rng, count)
        simulator.rollout(rng.random((count, len(task.space))), rng.uniform(-1, 1, (count, steps, 6)), start)

    print("\nMemory, half-cheetah (resident MiB)")
    readings = []
    for k in range(101):
        piece(100, 5)
        if k % 20 == 0:
            readings.append(_resident())
    print(f"10,000 rollouts: {', '.join(f'{r:.0f}' for r in readings)} after 100, 2,100, 4,100, 6,100, 8,100, 10,100")
    begin = time.perf_counter()
    for _ in range(100):
        piece(1000, 50)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (1024 if sys.platform != "darwin" else 2**20)
    print(f"100,000 rollouts of 50 steps in {time.perf_counter() - begin:.0f} s, peak {peak:.0f} MiB (bar 2,048)")


def _resident() -> float:
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize() / 2**20
