"""Closed-loop controllers that solve the Fetch tasks by hand, for demonstrations.

A share of demonstrated transitions in each batch is what makes sparse rewards learnable for a plain DDPG: Vecerik et
al., "Leveraging Demonstrations for Deep Reinforcement Learning on Robotics Problems with Sparse Rewards", 2017,
https://arxiv.org/abs/1707.08817; Nair et al., "Overcoming Exploration in Reinforcement Learning with Demonstrations",
2018, https://arxiv.org/abs/1709.10089. Their demonstrations come from people, these from geometry: lengths in metres,
an action of 1 asks for 5 cm, of which a control step makes less.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.envs.task import Task

Demonstrator = Callable[[FloatArray, int, Sequence[np.random.Generator]], FloatArray]
"""Actions (B, A) of observations (B, O), the control step and B generators."""

_GAIN = 10.0  # action per metre that the gripper is off
_BRAKING = 2 * 0.1 * 9.81 * 0.04**2  # a puck goes v^2 / (2 friction gravity); v in metres a step of 0.04 s


def push(observations: FloatArray) -> FloatArray:
    """Over the block, down behind it as seen from the goal, then straight on: actions (B, 4) of observations (B, O)."""
    grip, block, goal = (observations[:, i : i + 3] for i in (0, 3, 28))
    ahead, left, heading = _towards(block, goal)
    behind, from_block = block - 0.06 * heading, grip - block
    along, aside = _split(from_block, heading)
    ready = (along < -0.03) & (_length(aside) < 0.02) & (np.abs(from_block[:, 2:]) < 0.02)
    over = _length((grip - behind)[:, :2]) > 0.02
    approach = _GAIN * (behind + np.where(over, (0, 0, 0.08), 0.0) - grip)
    onward = np.where(left < 0.02, 0.0, 6 * ahead - _GAIN * aside)
    return _action(np.where(ready, onward, approach))


def slide(observations: FloatArray) -> FloatArray:
    """Over the puck, down behind it, and one hit as hard as the goal is far: actions (B, 4) of observations (B, O).

    It stops as soon as the puck would slide there by itself. Hits that are not central miss: about two fifths reach the
    goal.
    """
    grip, puck, goal = (observations[:, i : i + 3] for i in (0, 3, 28))
    _, left, heading = _towards(puck, goal)
    speed = ((observations[:, 14:17] + observations[:, 20:23]) * heading).sum(1, keepdims=True)
    from_puck = grip - puck
    along, aside = _split(from_puck, heading)
    ready = (along < -0.02) & (_length(aside) < 0.02) & (np.abs(from_puck[:, 2:]) < 0.02)
    done = (np.maximum(speed, 0) ** 2 >= _BRAKING * left) | (left < 0.03)
    behind = puck - 0.07 * heading
    far = _length((grip - behind)[:, :2]) > 0.02
    blocked = far & (_length(from_puck[:, :2]) < 0.09) & (from_puck[:, 2:] < 0.04)
    rise = np.concatenate([grip[:, :2], puck[:, 2:] + 0.09], axis=1)
    approach = _GAIN * (np.where(blocked, rise, behind + np.where(far, (0, 0, 0.06), 0.0)) - grip)
    hit = np.minimum(np.sqrt(left / 0.64), 1.0) * heading - _GAIN * aside
    hit[:, 2:] = -_GAIN * from_puck[:, 2:]
    return _action(np.where(done, 0.0, np.where(ready, hit, approach)))


def _towards(place: FloatArray, goal: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """On the table from place to goal (B, 3): the way, its length (B, 1) and direction."""
    way = goal - place
    way[:, 2] = 0
    length = _length(way)
    return way, length, way / np.maximum(length, 1e-9)


def _split(offset: FloatArray, heading: FloatArray) -> tuple[FloatArray, FloatArray]:
    """How far (B, 1) along the heading an offset (B, 3) goes, and what is left of it on the table."""
    along = (offset * heading).sum(1, keepdims=True)
    aside = offset - along * heading
    aside[:, 2] = 0
    return along, aside


def _length(x: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.norm(x, axis=1, keepdims=True))


def _action(moves: FloatArray) -> FloatArray:
    """Moves (B, 3) with the fingers as they are."""
    return np.clip(np.pad(moves, ((0, 0), (0, 1))), -1, 1)


CONTROLLERS: dict[str, tuple[Callable[[FloatArray], FloatArray], float]] = {
    "FetchPush": (push, 0.2),
    "FetchSlide": (slide, 0.05),
}
"""Controllers and the sd of the noise on their actions."""
TASKS = (*CONTROLLERS, "FetchPickAndPlace")


def demonstrator(task: Task) -> Demonstrator:
    """How a task of ``TASKS`` is done, with noise.

    FetchPickAndPlace has its excitation, which grasps the block and brings it to the goal.
    """
    if task.name not in CONTROLLERS:
        return lambda observations, step, rngs: np.concatenate(
            [np.asarray(task.excitation(seen[None], rng)) for seen, rng in zip(observations, rngs, strict=True)]
        )
    controller, noise = CONTROLLERS[task.name]
    return lambda observations, step, rngs: (
        controller(observations) + noise * np.stack([rng.standard_normal(task.num_actions) for rng in rngs])
    )
