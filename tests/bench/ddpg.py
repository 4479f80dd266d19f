"""DDPG's gradient updates against Stable-Baselines3's: table of `bench.py ddpg`."""

from __future__ import annotations

import cProfile
import pstats
import time
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
import torch
from stable_baselines3 import DDPG
from stable_baselines3.common.logger import Logger

import sipe_bayes as sipe
from sipe_bayes.rl.settings import Settings
from sipe_bayes.rl.trainer import Trainer

TASK, FILLED, UPDATES = "HalfCheetahLinks", 3000, 60
SideBySide = Callable[[Callable[[int], float], Callable[[int], float], int], tuple[float, float, float]]


def stable_baselines() -> Any:
    """Its agent with our networks, rates and batch, on the same environment, the buffer as full as ours."""
    environment: gymnasium.Env[Any, Any] = sipe.make(TASK)
    shared = {"learning_rate": 3e-4, "batch_size": 256, "gamma": 0.99, "tau": 0.005, "buffer_size": 100_000}
    policy = {"net_arch": [256, 256]}
    model = DDPG("MlpPolicy", environment, policy_kwargs=policy, learning_starts=FILLED, device="cpu", seed=0, **shared)
    model.learn(FILLED - 1)
    model.set_logger(Logger(folder=None, output_formats=[]))
    return model


def seconds(work: Callable[[], object]) -> float:
    begin = time.perf_counter()
    work()
    return time.perf_counter() - begin


def table(pairs: int, side_by_side: SideBySide) -> None:
    """Updates/s of both on one thread, what a control step costs beside them, and where an update's time goes."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        other = stable_baselines()
        trainer = Trainer(sipe.make_task(TASK), Settings(start_steps=10**9, capacity=100_000))
        stepping = seconds(lambda: [trainer.advance() for _ in range(FILLED)]) / FILLED

        def ours() -> None:
            for _ in range(UPDATES):
                trainer.agent.update(trainer._batch())

        mine, theirs, ratio = side_by_side(
            lambda _: seconds(ours), lambda _: seconds(lambda: other.train(UPDATES, 256)), pairs
        )
        print(f"\nDDPG on {TASK}, one thread, 256-256, batch 256; medians of {pairs} alternating pairs")
        print(
            f"updates/s {UPDATES / mine:.0f}, Stable-Baselines3 {UPDATES / theirs:.0f}: {1 / ratio:.2f} times (bar 1.3)"
        )
        print(f"a control step of one lane, random actions: {1e6 * stepping:.0f} us ({1 / stepping:.0f}/s)")
        observations = np.zeros((1, len(trainer.task.channels)))
        acting = seconds(lambda: [trainer.agent.act(observations) for _ in range(500)]) / 500
        picking = seconds(lambda: [trainer._batch() for _ in range(500)]) / 500
        print(f"the actor's answer: {1e6 * acting:.0f} us; drawing a batch: {1e6 * picking:.0f} us")
        _profile(ours)
    finally:
        torch.set_num_threads(threads)


def _profile(work: Callable[[], object]) -> None:
    profile = cProfile.Profile()
    profile.runcall(work)
    rows = pstats.Stats(profile).stats.items()  # type: ignore[attr-defined]
    total = sum(row[2] for _, row in rows)
    print("where an update's time goes")
    for (_, _, name), row in sorted(rows, key=lambda item: -item[1][2])[:8]:
        print(f"  {name:<60}{100 * row[2] / total:>5.0f} %")
