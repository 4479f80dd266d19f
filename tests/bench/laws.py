"""What a law costs: table of `bench.py laws`.

The same simulations with a law at every joint or actuator and without, and load friction in a plain loop over
MuJoCo's Python bindings, one simulation after the other.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np

from sipe_bayes.core.parameters import Parameter
from sipe_bayes.envs.laws.base import Law
from sipe_bayes.envs.laws.registry import LAWS
from sipe_bayes.simulation.simulator import Simulator
from tests.problems.machines import MACHINES, Drive, environment

SIMULATIONS, STEPS, MOST = 64, 200, 0.2
SideBySide = Callable[[Callable[[int], float], Callable[[int], float], int], tuple[float, float, float]]


def table(pairs: int, side_by_side: SideBySide) -> None:
    """Microseconds of a physics step."""
    print(f"\nLaws: {SIMULATIONS} simulations x {STEPS} physics steps, us for a step of one simulation")
    print("plain loop: load friction by mj_forward, mj_rne and mj_step, one simulation after the other")
    print(f"{'machine':<10}{'law':<20}{'with':>8}{'without':>9}{'ratio':>7}{'plain loop':>12}{'ratio':>7}")
    for name, drive in MACHINES.items():
        plain = Simulator(environment(drive))
        for law in LAWS.values():
            lawful = Simulator(with_law(drive, law))
            ours, without, ratio = side_by_side(work(lawful), work(plain), pairs)
            row = f"{name:<10}{law.name:<20}{_us(ours):>8.2f}{_us(without):>9.2f}{ratio:>7.1f}"
            if law.name == "load_friction":
                ours, loop, ratio = side_by_side(work(lawful), lambda _, d=drive, s=lawful: looped(d, s), pairs)
                row += f"{_us(loop):>12.2f}{ratio:>7.2f}"
            print(row, flush=True)


def _us(seconds: float) -> float:
    return 1e6 * seconds / (SIMULATIONS * STEPS)


def with_law(drive: Drive, law: Law) -> Any:
    """A machine with a law wherever it may be, its numbers unknown."""
    owners = drive.joints if law.kind == "joint" else drive.actuators
    numbers = [(f"{law.kind}:{owner}.{number.attribute}", number.shape) for owner in owners for number in law.numbers]
    return environment(drive, [Parameter(at, MOST / 2 * shape, MOST, targets=(at,)) for at, shape in numbers])


def inputs(simulator: Simulator) -> tuple[Any, Any, Any]:
    """Theta (B, N), actions (B, T, A) and starts (B, S)."""
    rng, start = np.random.default_rng(0), simulator.default_state()
    actions = rng.standard_normal((SIMULATIONS, STEPS, simulator.environment.num_actions))
    return rng.random((SIMULATIONS, len(simulator.space))), actions, np.tile(start, (SIMULATIONS, 1))


def work(simulator: Simulator) -> Callable[[int], float]:
    """Seconds of a batch."""
    given = inputs(simulator)

    def run(_: int) -> float:
        begin = time.perf_counter()
        simulator.rollout(*given)
        return time.perf_counter() - begin

    return run


def looped(drive: Drive, simulator: Simulator) -> float:
    """Seconds of load friction by a plain loop."""
    theta, actions, starts = inputs(simulator)
    models = [simulator.written(row) for row in theta]
    data, torque = mujoco.MjData(models[0]), np.empty(models[0].nv)
    dofs = [int(models[0].joint(joint).dofadr[0]) for joint in drive.joints]
    begin = time.perf_counter()
    for model, row, start in zip(models, actions, starts, strict=True):
        dry, shares = model.dof_frictionloss.copy(), model.numeric_data
        mujoco.mj_setState(model, data, start, mujoco.mjtState.mjSTATE_FULLPHYSICS)
        for action in row:
            data.ctrl[:], model.dof_frictionloss[:] = action, dry
            mujoco.mj_forward(model, data)
            mujoco.mj_rne(model, data, 1, torque)
            model.dof_frictionloss[dofs] = dry[dofs] + shares[: len(dofs)] * np.abs(torque[dofs])
            mujoco.mj_step(model, data)
    return time.perf_counter() - begin
