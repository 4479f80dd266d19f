"""Written models on ``mujoco.batch`` and on ``mujoco.rollout``: table of `bench.py batch`.

Both take the same models, starts and controls and give the same bits. Open loop: the whole horizon in one call. Closed
loop: a call for every control step, each from where the last one ended; models are handed over once, as is fair to a
batch that keeps them.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import envs
import mujoco
import mujoco.batch
import mujoco.rollout
import numpy as np

from sipe_bayes.core.parameters import Parameter
from sipe_bayes.envs.foreign.quiet import quiet
from sipe_bayes.envs.mjcf import MjcfEnvironment
from sipe_bayes.simulation.simulator import Simulator

STATE = int(mujoco.mjtState.mjSTATE_FULLPHYSICS)
CONTROL = int(mujoco.mjtState.mjSTATE_CTRL)
CLOSED_STEPS = 40


class Sides:
    """64 written models with controls (B, P, U), of ``skip`` physics steps a control step, on both sides."""

    def __init__(self, models: list[Any], start: Any, controls: Any, spec: int, skip: int) -> None:
        count, model = len(models), models[0]
        self.models, self.spec, self.skip = models, spec, skip
        self.size = mujoco.mj_stateSize(model, STATE)
        self.start, self.controls = np.ascontiguousarray(start[:, : self.size]), np.ascontiguousarray(controls)
        self.steps = [
            np.ascontiguousarray(controls[:, k : k + skip])
            for k in range(0, min(controls.shape[1], CLOSED_STEPS * skip), skip)
        ]
        self.datas = [mujoco.MjData(model) for _ in range(envs.THREADS)]
        self.pool = mujoco.rollout.Rollout(nthread=envs.THREADS)
        self.batch = mujoco.batch.Batch(model, count, envs.THREADS)
        self.batch.set_models(models)

    def on_rollout(self, start: Any, controls: Any) -> Any:
        out = np.empty((len(start), controls.shape[1], self.size))
        few = {"chunk_size": -(-len(start) // (4 * envs.THREADS))} if controls.shape[1] <= 32 else {}  # as our engine
        self.pool.rollout(
            self.models,
            self.datas,
            start,
            controls,
            control_spec=self.spec,
            skip_checks=True,
            nstep=controls.shape[1],
            state=out,
            **few,
        )
        return out

    def on_batch(self, start: Any, controls: Any) -> Any:
        self.batch.state[:, : self.size] = start
        return self.batch.rollout(controls.shape[1], controls, self.spec, record=(STATE,))[STATE]

    def closed(self, run: Callable[[Any, Any], Any]) -> Any:
        state = self.start
        for controls in self.steps:
            state = np.ascontiguousarray(run(state, controls)[:, -1])
        return state


def table(pairs: int, side_by_side: envs.SideBySide, models: dict[str, tuple[str, str]]) -> None:
    """models: name -> MJCF and its joints, to which the benchmark's tasks are added."""
    print(f"\nmujoco.batch against mujoco.rollout, {envs.NUM_ENVS} written models, {envs.THREADS} threads; ms; times")
    print("time of mujoco.rollout (above 1: mujoco.batch is slower)")
    heading = ("rollout", "batch", "times")
    print(f"{'':<20}{'open loop':>30}{'closed loop, a control step':>34}")
    print(f"{'model':<20}" + "".join(f"{h:>10}" for h in heading) + "    " + "".join(f"{h:>10}" for h in heading))
    cases: dict[str, Callable[[], Sides]] = {n: lambda v=v: _small(*v) for n, v in models.items()}
    cases |= {name: lambda name=name: _task(name) for name in envs.PUBLISHED}
    for name, make in cases.items():
        sides = make()
        with quiet:
            np.testing.assert_array_equal(
                sides.on_batch(sides.start, sides.controls), sides.on_rollout(sides.start, sides.controls)
            )
            np.testing.assert_array_equal(sides.closed(sides.on_batch), sides.closed(sides.on_rollout))
            whole = side_by_side(
                lambda _, s=sides: _seconds(lambda: s.on_batch(s.start, s.controls)),
                lambda _, s=sides: _seconds(lambda: s.on_rollout(s.start, s.controls)),
                pairs,
            )
            steps = side_by_side(
                lambda _, s=sides: _seconds(lambda: s.closed(s.on_batch)),
                lambda _, s=sides: _seconds(lambda: s.closed(s.on_rollout)),
                pairs,
            )
        row = "".join(
            f"{1e3 * b / per:>10.2f}{1e3 * a / per:>10.2f}{ratio:>10.2f}" + "    "
            for (a, b, ratio), per in ((whole, 1), (steps, len(sides.steps)))
        )
        print(f"{name:<20}{row}".rstrip(), flush=True)


def _seconds(work: Callable[[], Any]) -> float:
    begin = time.perf_counter()
    work()
    return time.perf_counter() - begin


def _small(xml: str, joints: str) -> Sides:
    parameters = [Parameter(f"damping_{j}", 0.01, 1.0, targets=(f"joint:{j}.damping",)) for j in joints]
    environment = MjcfEnvironment.build(xml, parameters, list(joints), [f"joint:{j}.position" for j in joints])
    simulator, rng = Simulator(environment, num_threads=envs.THREADS), np.random.default_rng(0)
    models = [simulator.written(theta) for theta in rng.random((envs.NUM_ENVS, len(joints)))]
    controls = rng.standard_normal((envs.NUM_ENVS, envs.STEPS, len(joints)))
    return Sides(models, np.tile(simulator.default_state(), (envs.NUM_ENVS, 1)), controls, CONTROL, 1)


def _task(name: str) -> Sides:
    case = envs.Case(name)
    models = [case.simulator.written(theta) for theta in case.theta]
    return Sides(models, case.start, case.controls, case.task.control_spec, case.task.frame_skip)
