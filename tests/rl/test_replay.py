"""The replay buffer: samples against a plain list of episodes, with hindsight, n-step returns and a full ring."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sipe_bayes.core.trajectory import Trajectories, Trajectory
from sipe_bayes.rl.replay import Batch, Replay, ReplayError
from sipe_bayes.simulation.episodes import Step

G, DISCOUNT = 1, 0.5


def goal_reward(achieved: np.ndarray, goals: np.ndarray) -> np.ndarray:
    return -np.abs(achieved[..., 0] - goals[..., 0])


class World:
    """Lanes that count: an observation is (lane, episode, time in it, goal), what is achieved its time.

    Episodes of lane i take 4 + i steps and terminate if i is odd, else run out of time; ``diverging``: (lane, episode,
    time) where one fails.
    """

    def __init__(self, lanes: int, diverging: tuple[int, int, int] = (-1, -1, -1)) -> None:
        self.lanes, self.diverging = lanes, diverging
        self.episode, self.time, self.over = np.zeros(lanes, int), np.zeros(lanes, int), np.zeros(lanes, bool)

    def step(self) -> Step:
        rewards, valid = np.zeros(self.lanes), np.ones(self.lanes, bool)
        ended = np.zeros(self.lanes, bool)
        for i in range(self.lanes):
            if self.over[i]:
                self.episode[i], self.time[i] = self.episode[i] + 1, 0
            elif (i, self.episode[i], self.time[i]) == self.diverging:
                valid[i], ended[i] = False, True
            else:
                rewards[i] = 100 * self.episode[i] + self.time[i]
                self.time[i] += 1
                ended[i] = self.time[i] == 4 + i
        self.over = ended
        odd = np.arange(self.lanes) % 2 == 1
        return self.seen(rewards, ended & (odd | ~valid), ended & ~odd & valid, valid)

    def seen(self, rewards: np.ndarray, terminated: np.ndarray, truncated: np.ndarray, valid: np.ndarray) -> Step:
        goals = 1000.0 + self.episode
        observations = np.stack([np.arange(self.lanes), self.episode, self.time, goals], 1).astype(float)
        achieved = self.time[:, None].astype(float)
        return Step(observations, rewards, terminated, truncated, valid, None, goals[:, None], achieved)

    def first(self) -> Step:
        none = np.zeros(self.lanes, bool)
        return self.seen(np.zeros(self.lanes), none, none, ~none)


def filled(lanes: int, steps: int, capacity: int = 1000, world: World | None = None, **settings: int) -> Replay:
    world = world or World(lanes)
    goals = {"goal_size": G, "goal_reward": goal_reward} if settings.get("hindsight") else {}
    replay = Replay(4, 1, capacity, lanes, DISCOUNT, **settings, **goals)  # type: ignore[arg-type]
    replay.begin(world.first())
    for _ in range(steps):
        replay.add(10.0 * world.time[:, None] + world.episode[:, None], world.step())
    return replay


def sample(replay: Replay, rng: np.random.Generator, count: int) -> Any:
    """A batch of NumPy's arrays."""
    batch = replay.sample(rng, count)
    return Batch(*(getattr(batch, name).numpy() for name in Batch.__annotations__))


def places(batch: Any) -> set[tuple[int, int, int]]:
    return {tuple(row) for row in batch.observations[:, :3].astype(int).tolist()}


def check(batch: Any, n_step: int, newest: dict[int, tuple[int, int]]) -> None:
    """Every row against the world's own rules; newest: (episode, time) that each lane has come to."""
    for k, (lane, episode, time, goal) in enumerate(batch.observations.tolist()):
        length = 4 + int(lane)
        end = newest[int(lane)][1] if newest[int(lane)][0] == episode else length
        taken = min(n_step, int(end - time))
        assert taken > 0
        terminated = lane % 2 == 1 and time + taken == length
        assert batch.actions[k, 0] == 10 * time + episode
        own = [100 * episode + time + j for j in range(taken)]
        hindsight = [-abs(time + j + 1 - goal) for j in range(taken)]
        rewards = own if goal >= 1000 else hindsight
        if goal < 1000:
            assert time < goal <= end
        assert batch.returns[k] == pytest.approx(sum(DISCOUNT**j * r for j, r in enumerate(rewards)))
        assert batch.discounts[k] == (0 if terminated else pytest.approx(DISCOUNT**taken))
        np.testing.assert_array_equal(batch.next_observations[k], [lane, episode, time + taken, goal])


@pytest.mark.parametrize("lanes", [1, 3])
@pytest.mark.parametrize("n_step", [1, 3])
def test_transitions_are_those_that_happened(lanes: int, n_step: int) -> None:
    world = World(lanes)
    batch = sample(filled(lanes, 21, world=world, n_step=n_step), np.random.default_rng(0), 2000)
    newest = {i: (int(world.episode[i]), int(world.time[i])) for i in range(lanes)}
    check(batch, n_step, newest)
    everything = {
        (i, e, t)
        for i in range(lanes)
        for e in range(newest[i][0] + 1)
        for t in range(newest[i][1] if e == newest[i][0] else 4 + i)
    }
    assert places(batch) == everything


def test_a_full_ring_forgets_the_oldest() -> None:
    world = World(2)
    replay = filled(2, 500, 60, world)
    batch = sample(replay, np.random.default_rng(0), 2000)
    check(batch, 1, {i: (int(world.episode[i]), int(world.time[i])) for i in range(2)})
    assert min(e for _, e, _ in places(batch)) > 70
    assert len(places(batch)) == len(replay) <= 60


def test_transitions_are_equally_likely() -> None:
    replay = filled(2, 40)
    batch = sample(replay, np.random.default_rng(0), 40_000)
    _, counts = np.unique(batch.observations, axis=0, return_counts=True)
    expected = 40_000 / len(replay)
    chi = float(((counts - expected) ** 2 / expected).sum())
    freedom = len(replay) - 1  # chi-squared: mean and half the variance; five sd are a false alarm in a million
    assert len(counts) == len(replay)
    assert abs(chi - freedom) < 5 * np.sqrt(2 * freedom)


def test_hindsight_takes_a_later_goal_of_the_same_episode() -> None:
    world = World(3)
    drawn = sample(filled(3, 30, world=world, hindsight=4, n_step=2), np.random.default_rng(0), 20_000)
    relabelled = drawn.observations[:, 3] < 1000
    assert abs(relabelled.mean() - 0.8) < 5 * np.sqrt(0.8 * 0.2 / 20_000)
    chosen: Any = Batch(*(getattr(drawn, name)[relabelled] for name in Batch.__annotations__))
    check(chosen, 2, {i: (int(world.episode[i]), int(world.time[i])) for i in range(3)})
    first = chosen.observations[(chosen.observations[:, 0] == 0) & (chosen.observations[:, 2] == 0)]
    finished = first[first[:, 1] < world.episode[0]]
    _, counts = np.unique(finished[:, 3], return_counts=True)
    assert len(counts) == 4  # the goals reached at times 1 to 4, equally often
    assert (np.abs(counts - len(finished) / 4) < 5 * np.sqrt(len(finished))).all()


def test_a_diverged_step_is_not_sampled() -> None:
    batch = sample(filled(2, 30, world=World(2, (1, 1, 2)), n_step=3), np.random.default_rng(0), 2000)
    found = places(batch)
    assert (1, 1, 1) in found
    assert (1, 1, 2) not in found
    rows = (batch.observations[:, 0] == 1) & (batch.observations[:, 1] == 1)
    assert batch.next_observations[rows, 2].max() == 2
    assert (batch.discounts[rows] > 0).all()  # it did not terminate, it broke off


def test_demonstrations_are_sampled_as_far_as_they_are_valid() -> None:
    rng = np.random.default_rng(0)
    items = [
        Trajectory(rng.standard_normal((n + 1, 2)), rng.standard_normal((n, 1)), 0.1, rewards=np.arange(n) + 1.0)
        for n in (3, 5)
    ]
    replay = Replay(2, 1, 100, 2, DISCOUNT)
    replay.add_trajectories(Trajectories.stack(items))
    batch = sample(replay, rng, 500)
    assert len(replay) == 8
    assert len(np.unique(batch.observations, axis=0)) == 8
    for k, observation in enumerate(batch.observations):
        lane = next(t for t in items if (np.float32(t.observations[:-1]) == observation).all(1).any())
        step = int((np.float32(lane.observations[:-1]) == observation).all(1).argmax())
        assert batch.returns[k] == step + 1
        np.testing.assert_array_equal(batch.next_observations[k], np.float32(lane.observations[step + 1]))


def test_file_round_trip_goes_on_where_it_was(tmp_path: Path) -> None:
    for steps, capacity in ((20, 1000), (500, 60)):
        path, world = tmp_path / f"{steps}.npz", World(2)
        replay = filled(2, steps, capacity, world)
        replay.save(path)
        other = Replay(4, 1, capacity, 2, DISCOUNT)
        other.load(path)
        for _ in range(7):
            actions, step = 10.0 * world.time[:, None] + world.episode[:, None], world.step()
            replay.add(actions, step)
            other.add(actions, step)
        a, b = (sample(r, np.random.default_rng(1), 200) for r in (replay, other))
        for name in Batch.__annotations__:
            np.testing.assert_array_equal(getattr(a, name), getattr(b, name))


def test_files_that_do_not_fit_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "replay.npz"
    filled(1, 20).save(path)
    with pytest.raises(ReplayError, match=r"observations: expected .*, got"):
        Replay(3, 1, 1000).load(path)
    with pytest.raises(ReplayError, match="rows"):
        Replay(4, 1, 500).load(path)
    path.write_bytes(path.read_bytes()[:-200])
    with pytest.raises(ReplayError, match=r"replay\.npz: cannot be read as a whole replay buffer"):
        Replay(4, 1, 1000).load(path)


def test_an_empty_buffer_and_wrong_settings_are_refused() -> None:
    with pytest.raises(ValueError, match="no transitions"):
        filled(1, 0).sample(np.random.default_rng(0), 4)
    with pytest.raises(ValueError, match="capacity: expected at least 2"):
        Replay(4, 1, 3, num_envs=2)
    with pytest.raises(ValueError, match="hindsight: expected 0"):
        Replay(4, 1, 100, hindsight=4)
