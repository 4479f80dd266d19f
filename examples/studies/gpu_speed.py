"""Steps a second on a GPU, every rollout with a theta of its own, beside bare mujoco-warp and the processor.

    python examples/studies/gpu_speed.py                    # HumanoidJoints and HalfCheetahLinks on cuda
    python examples/studies/gpu_speed.py --million          # a million rollouts of 200 half-cheetah steps
    python examples/studies/gpu_speed.py --train            # DDPG on HalfCheetahLinks, 4,096 lanes
    python examples/studies/gpu_speed.py --device warp:cpu --worlds 64 --steps 4 --task Pendulum  # a try

`writing` is the processor's share: theta written into fields one after the other. `bare` is mujoco-warp's own step on
one model, captured as a graph, without commands and records. The processor has all its cores. The published figure of
mujoco-warp's README is one model, 8,192 humanoids: 2.7 to 4 million steps/s.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

import mujoco_warp
import numpy as np
import warp
from gpu_agreement import newton

import sipe_bayes as sipe
from sipe_bayes.core.files import write_text
from sipe_bayes.rl.settings import Settings
from sipe_bayes.rl.trainer import Trainer
from sipe_bayes.simulation.gpu.devices import warp_name

RESULT = Path(__file__).parent / "results" / "gpu_speed.json"
PROCESSOR = 512  # rollouts of its row


def drawn(task: Any, batch: int, steps: int) -> tuple[Any, Any, Any]:
    rng = np.random.default_rng(0)
    actions = rng.uniform(task.action_low, task.action_high, (batch, steps, task.num_actions))
    return rng.random((batch, len(task.space))), actions, task.initial_states(rng, batch)[0]


def seconds(simulator: sipe.Simulator, inputs: tuple[Any, Any, Any]) -> float:
    begin = time.perf_counter()
    simulator.rollout(*inputs)
    return time.perf_counter() - begin


def bare(simulator: Any, worlds: int, steps: int, device: str) -> float:
    """Seconds of as many physics steps of one model in all worlds."""
    capacity, skip = simulator.runs.capacity, simulator.environment.frame_skip
    with warp.ScopedDevice(device):
        model = mujoco_warp.put_model(simulator.runs.recipe.model)
        model.opt.warn_overflow = 0
        data = mujoco_warp.make_data(simulator.model, worlds, capacity.contacts, njmax=capacity.rows)
        mujoco_warp.step(model, data)
        graph = None
        if warp.get_device(device).is_cuda:
            with warp.ScopedCapture() as capture:
                for _ in range(skip):
                    mujoco_warp.step(model, data)
            graph = capture.graph
        warp.synchronize()
        begin = time.perf_counter()
        for _ in range(steps):
            if graph is not None:
                warp.capture_launch(graph)
                continue
            for _ in range(skip):
                mujoco_warp.step(model, data)
        warp.synchronize()
        return time.perf_counter() - begin


def measured(name: str, worlds: int, steps: int, device: str) -> dict[str, Any]:
    task = sipe.make_task(name)
    task = newton(task) if name.startswith("Humanoid") else task
    simulator, inputs = sipe.Simulator(task, device=device), drawn(task, worlds, steps)
    simulator.audit = None  # a bench of the device alone
    rng, size = np.random.default_rng(1), len(task.space)
    seconds(simulator, inputs)  # compiles
    before = memory(device)
    ours = min(seconds(simulator, (rng.random((worlds, size)), *inputs[1:])) for _ in range(3))
    grown = before - memory(device)
    begin = time.perf_counter()
    simulator.pool.take(rng.random((worlds, size)), np.full(worlds, simulator.model.opt.timestep), [None] * worlds)
    writing = time.perf_counter() - begin
    alone, physics = bare(simulator, worlds, steps, warp_name(device)), worlds * steps * task.frame_skip
    few = tuple(x[:PROCESSOR] for x in inputs)
    processor = sipe.Simulator(task)
    seconds(processor, few)  # copies models
    own = len(few[0]) * steps * task.frame_skip / seconds(processor, few)
    return {
        "device": str(warp.get_device(warp_name(device)).name),
        "control_steps": steps,
        "physics_steps_per_s": round(physics / ours),
        "of_which_writing": round(writing / ours, 3),
        "bare_steps_per_s": round(physics / alone),
        "share_of_bare": round(alone / ours, 3),
        "share_of_bare_without_writing": round(alone / max(ours - writing, 1e-9), 3),
        "processor_steps_per_s": round(own),
        "processor_threads": processor.num_threads,
        "gain": round(physics / ours / own, 2),
        "bytes_grown": grown,
    }


def memory(device: str) -> int:
    card = warp.get_device(warp_name(device))
    return int(card.free_memory) if card.is_cuda else 0


def million(device: str, rollouts: int, steps: int) -> dict[str, Any]:
    """As a user asks for them: in waves of 2^15, whose observations are looked at and forgotten."""
    task = sipe.make_task("HalfCheetahLinks")
    simulator, wave = sipe.Simulator(task, device=device), min(2**15, rollouts)
    inputs = drawn(task, wave, steps)
    seconds(simulator, inputs)
    begin, rng = time.perf_counter(), np.random.default_rng(1)
    for _ in range(-(-rollouts // wave)):
        simulator.rollout(rng.random((wave, len(task.space))), *inputs[1:])
    return {
        "rollouts": rollouts,
        "steps": steps,
        "seconds": round(time.perf_counter() - begin, 1),
        "audit": [f.text for f in simulator.audit.findings()] if simulator.audit else [],
    }


def trained(name: str, lanes: int, device: str, steps: int) -> dict[str, Any]:
    """Control steps a second of a training: worlds, replay buffer and networks on the device; four updates a step."""
    task = sipe.make_task(name)
    settings = Settings(
        lanes=lanes,
        capacity=2 * lanes * task.episode_steps,
        start_steps=0,
        batch=min(4096, lanes),
        updates_per_step=4 / lanes,
        normalise=True,
    )
    trainer = Trainer(task, settings, device=device)
    for _ in range(3):  # compiles
        trainer.advance()
    begin = time.perf_counter()
    for _ in range(steps):
        trainer.advance()
    return {
        "lanes": lanes,
        "batch": settings.batch,
        "updates": 4 * steps,
        "control_steps_per_s": round(lanes * steps / (time.perf_counter() - begin)),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--task", nargs="*", default=["HumanoidJoints", "HalfCheetahLinks"])
    parser.add_argument("--worlds", type=int, nargs="*", default=[4096, 16384, 65536])
    parser.add_argument("--steps", type=int, default=100, help="control steps")
    parser.add_argument("--million", type=int, nargs="?", const=1_000_000, default=0)
    parser.add_argument("--train", action="store_true")
    given = parser.parse_args()
    if given.device.startswith("cuda") and not warp.is_cuda_available():
        print(f"{given.device}: there is no such GPU here, nothing is measured")
        return
    kept = json.loads(RESULT.read_text()) if RESULT.exists() else {}
    rows = kept.setdefault(given.device, {})
    if given.million:
        rows[f"HalfCheetahLinks, {given.million:,} rollouts"] = made = million(given.device, given.million, 200)
        print(json.dumps(made), flush=True)
    if given.train:
        for lanes in given.worlds:
            rows[f"training, {lanes} lanes"] = made = trained("HalfCheetahLinks", lanes, given.device, given.steps)
            print(lanes, json.dumps(made), flush=True)
    for name in [] if given.million or given.train else given.task:
        for worlds in given.worlds:
            rows[f"{name}, {worlds} worlds"] = row = measured(name, worlds, given.steps, given.device)
            print(name, worlds, json.dumps(row), flush=True)
    if given.device != "warp:cpu":
        write_text(RESULT, json.dumps(kept, indent=1) + "\n")


if __name__ == "__main__":
    main()
