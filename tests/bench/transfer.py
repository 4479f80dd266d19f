"""What domain randomisation costs a training: table of `bench.py transfer`."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import torch

import sipe_bayes as sipe
from sipe_bayes.benchmark.transfer.study import settings
from sipe_bayes.posterior import Dirac, GaussianMixture, Particles, Posterior, prior
from sipe_bayes.rl.randomization import Randomization
from sipe_bayes.rl.trainer import Trainer

STEPS = {
    "FetchPush": 16 * 51,
    "HalfCheetahLinks": 8 * 1_001,
}  # control steps of each side of a pair: an episode in each environment
BAR = 0.9
SideBySide = Callable[[Callable[[int], float], Callable[[int], float], int], tuple[float, float, float]]


def table(pairs: int, side_by_side: SideBySide) -> None:
    """Control steps/s under a posterior of each family and without one, on one thread.

    Of the acting alone, where every lane begins an episode, and of whole trainings.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    print(
        f"\nTraining under a randomisation against training without, one thread; medians of {pairs} alternating pairs "
        f"(bar {BAR})"
    )
    print(f"{'task':<20}{'':<18}{'drawn from':<18}{'steps/s':>10}{'without':>10}{'ratio':>8}")
    try:
        for task, steps in STEPS.items():
            for learning, what in ((False, "acting alone"), (True, "with its updates")):
                for name, given in randomizations(task).items():
                    sides = trainer(task, given, learning), trainer(task, None, learning)
                    row(task, what, name, sides, steps, pairs, side_by_side)
    finally:
        torch.set_num_threads(threads)


def row(
    task: str, what: str, name: str, sides: tuple[Trainer, Trainer], steps: int, pairs: int, side_by_side: SideBySide
) -> None:
    under, plain = sides
    mine, theirs, ratio = side_by_side(lambda _: seconds(under, steps), lambda _: seconds(plain, steps), pairs)
    print(f"{task:<20}{what:<18}{name:<18}{steps / mine:>10.0f}{steps / theirs:>10.0f}{1 / ratio:>8.2f}", flush=True)


def trainer(task: str, given: Randomization | None, learning: bool) -> Trainer:
    """One that acts by its actor and, if ``learning``, learns already.

    Without demonstrations, which cost both sides alike.
    """
    made = sipe.make_task(task)
    chosen = replace(settings(made, 4 * 300), demonstration_share=0.0)
    found = Trainer(made, chosen if learning else replace(chosen, updates_per_step=0.0), 0, given)
    while found.steps < chosen.start_steps + 64:
        found.advance()
    return found


def seconds(of: Trainer, steps: int) -> float:
    until, begin = of.steps + steps, time.perf_counter()
    while of.steps < until:
        of.advance()
    return time.perf_counter() - begin


def randomizations(task: str) -> dict[str, Randomization]:
    space = sipe.make_task(task).space
    draws, n = np.random.default_rng(0).random((2_000, len(space))), len(space)
    normal: Any = (torch.zeros(1), np.full((1, n), 0.5), 0.01 * np.eye(n)[None])
    found: dict[str, Posterior] = {
        "Dirac": Dirac(draws[0], space),
        "Particles": Particles(draws, space),
        "GaussianMixture": GaussianMixture(*normal, space),
        "prior": prior(space),
    }
    disturbed = Randomization(prior(space), observation_noise=0.01, action_delay=2)
    return {**{name: Randomization(p) for name, p in found.items()}, "noise and delay": disturbed}
