"""The Gymnasium wrapper: every episode under a draw of the posterior, for anyone's own training code."""

from __future__ import annotations

import copy
import runpy
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import sipe_bayes as sipe
from sipe_bayes.posterior import Dirac, Particles, prior

TASK = sipe.make_task("Pendulum")
SPACE = TASK.space
EXAMPLE = Path(__file__).parents[2] / "examples" / "stable_baselines3_randomized.py"


def randomized(posterior: Any = None, env: Any = None, **settings: Any) -> sipe.RandomizedEnv:
    return sipe.RandomizedEnv(env or sipe.make("Pendulum"), posterior or prior(SPACE), **settings)


def thetas(env: sipe.RandomizedEnv, seed: int, count: int = 5) -> np.ndarray:
    found = [env.reset(seed=seed)[1]["theta"]]
    for _ in range(count - 1):
        found.append(env.reset()[1]["theta"])
    return np.array(found)


@pytest.mark.filterwarnings("ignore::UserWarning")  # Gymnasium's remarks on unbounded observations
@pytest.mark.parametrize("disturbed", [False, True])
def test_gymnasium_accepts_it(disturbed: bool) -> None:
    more = {"observation_noise": 0.1, "action_delay": 2} if disturbed else {}
    check_env(randomized(sipe.Randomization(prior(SPACE), **more)), skip_render_check=True)


def test_every_episode_runs_under_a_draw_of_its_own() -> None:
    """What the simulator has, the plain environment with that theta does to the last bit; a seed draws the same."""
    env = randomized()
    drawn = thetas(env, 3)
    assert len(np.unique(drawn, axis=0)) == 5
    np.testing.assert_array_equal(drawn, thetas(randomized(), 3))
    assert (drawn != thetas(env, 4)).all()
    plain = sipe.make("Pendulum")
    seen, info = env.reset(seed=7)
    np.testing.assert_array_equal(plain.reset(seed=7, options={"theta": info["theta"]})[0], seen)
    for _ in range(20):
        got, *_, told = env.step(np.array([1.5]))
        np.testing.assert_array_equal(got, plain.step(np.array([1.5]))[0])
        np.testing.assert_array_equal(told["theta"], info["theta"])


def test_draws_are_of_the_posterior() -> None:
    points = np.array([[0.1, 0.2, 0.3], [0.4, 0.5, 0.6]])
    drawn = thetas(randomized(Particles(points, SPACE)), 0, 40)
    assert {tuple(row) for row in drawn} == {tuple(row) for row in points}


def test_an_episode_may_be_given_its_theta() -> None:
    theta = np.array([0.1, 0.2, 0.3])
    assert (randomized().reset(seed=0, options={"theta": theta})[1]["theta"] == theta).all()


def test_actions_arrive_late_and_observations_are_noisy() -> None:
    """Against the plain environment fed with actions that are late by the episode's delay."""
    under = sipe.Randomization(Dirac([0.3, 0.4, 0.5], SPACE), np.array([0.0, 0.0, 0.5]), action_delay=3)
    env, plain, delays = randomized(under), sipe.make("Pendulum"), set()
    sent = np.random.default_rng(0).uniform(-2, 2, (40, 1))
    for seed in range(8):
        env.reset(seed=seed)
        seen = np.array([env.step(action)[0] for action in sent])
        matching = []
        for delay in range(4):
            plain.reset(seed=seed, options={"theta": np.array([0.3, 0.4, 0.5])})
            late = np.concatenate([np.zeros((delay, 1)), sent])[: len(sent)]
            true = np.array([plain.step(action)[0] for action in late])
            if (seen[:, :2] == true[:, :2]).all():
                matching.append(delay)
                assert (seen[:, 2] != true[:, 2]).all()
        assert len(matching) == 1
        delays.update(matching)
    assert len(delays) > 1


def test_another_environments_parameters_are_refused_by_name() -> None:
    with pytest.raises(
        ValueError, match=r"^posterior: is over other parameters than Pendulum: it lacks mass, length, damping and"
    ):
        randomized(prior(sipe.make_task("CartPole").space))


def test_own_environment_gets_values_by_name() -> None:
    env, got = gymnasium.make("Pendulum-v1"), []
    with pytest.raises(ValueError, match=r"env: PendulumEnv is not of sipe\.make; pass write\(env, values\)"):
        randomized(env=env)

    with pytest.raises(ValueError, match="write: expected a function of the environment and a dict of values"):
        randomized(env=env, write=3)

    def write(inner: Any, values: dict[str, float]) -> None:
        got.append(values)
        inner.unwrapped.m, inner.unwrapped.l = values["mass"], values["length"]

    wrapped = randomized(env=env, write=write)
    for _ in range(3):
        _, info = wrapped.reset(seed=None)
        np.testing.assert_allclose(list(got[-1].values()), SPACE.values(info["theta"]), rtol=1e-12)
        assert wrapped.unwrapped.m == got[-1]["mass"]  # type: ignore[attr-defined]
    assert len({values["mass"] for values in got}) == 3


def test_a_delay_needs_bounded_actions() -> None:
    env = gymnasium.wrappers.TransformAction(
        sipe.make("Pendulum"), lambda a: a, gymnasium.spaces.Box(-np.inf, np.inf, (1,))
    )
    with pytest.raises(ValueError, match="a delay needs bounds"):
        randomized(sipe.Randomization(prior(SPACE), action_delay=1), env)


def swing(noise: float = 0.0, delay: int = 0, name: str = "Pendulum-v1") -> sipe.RandomizedEnv:
    """Of Gymnasium's own environments."""
    under = sipe.Randomization(prior(SPACE), noise, delay)
    return sipe.RandomizedEnv(gymnasium.make(name), under, write=_set_mass)


def _set_mass(env: Any, values: dict[str, float]) -> None:
    env.unwrapped.m = values["mass"]


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_own_environments_keep_to_their_spaces() -> None:
    """Observations of 32 bits within bounds, which noise does away with."""
    for noise, delay in ((0.0, 0), (0.5, 0), (0.0, 2), (0.5, 2)):
        env = swing(noise, delay)
        check_env(env, skip_render_check=True)
        seen = [env.reset(seed=0)[0], *(env.step(env.action_space.sample())[0] for _ in range(50))]
        assert all(one in env.observation_space for one in seen)
        assert np.isfinite(env.observation_space.high).all() == (noise == 0)  # type: ignore[attr-defined]


def test_noise_asks_nothing_of_the_actions_nor_a_delay_of_the_observations() -> None:
    env = swing(0.1, name="CartPole-v1")
    env.reset(seed=0)
    assert env.step(1)[0] in env.observation_space  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"a delay needs a flat Box as its action_space, got Discrete\(2\)"):
        swing(0.0, 1, "CartPole-v1")
    with pytest.raises(ValueError, match="noise needs a flat Box as its observation_space"):
        sipe.RandomizedEnv(_Counted(), sipe.Randomization(prior(SPACE), 0.1), write=_set_mass)
    late = sipe.RandomizedEnv(_Counted(), sipe.Randomization(prior(SPACE), 0.0, 1), write=_set_mass)
    assert late.reset(seed=0)[0] == 0


class _Counted(gymnasium.ObservationWrapper):  # type: ignore[type-arg]
    """An observation that is no Box."""

    def __init__(self) -> None:
        super().__init__(gymnasium.make("Pendulum-v1"))
        self.observation_space = gymnasium.spaces.Discrete(1)

    def observation(self, observation: Any) -> int:
        return 0


def test_a_given_theta_is_checked_for_own_environments() -> None:
    env = swing()
    with pytest.raises(ValueError, match=r"theta: expected numbers in \[0, 1\], got \[2\.0, 0\.5, 0\.5\]"):
        env.reset(options={"theta": [2.0, 0.5, 0.5]})
    with pytest.raises(ValueError, match="expected 3 parameters on the last axis"):
        env.reset(options={"theta": [0.5]})
    env.reset(options={"theta": [2.0, 0.5, 0.5], "allow_outside": True})
    mass = SPACE[0]
    assert env.unwrapped.m == pytest.approx(mass.low + 2 * (mass.high - mass.low))  # type: ignore[attr-defined]


def test_vector_environments_take_it_as_cleanrl_does() -> None:
    """Lanes of one seed each, episode statistics, and a copy draw the same."""

    def make(seed: int) -> Any:
        env = gymnasium.wrappers.RecordEpisodeStatistics(randomized())
        env.action_space.seed(seed)
        return env

    lanes = gymnasium.vector.SyncVectorEnv([lambda k=k: make(k) for k in range(3)])
    _, info = lanes.reset(seed=5)
    assert len(np.unique(info["theta"], axis=0)) == 3
    for k in range(3):
        np.testing.assert_array_equal(info["theta"][k], randomized().reset(seed=5 + k)[1]["theta"])
    for _ in range(200):
        *_, truncated, info = lanes.step(lanes.action_space.sample())
        if truncated.any():
            break
    assert (info["episode"]["l"] == 200).all()
    copied = copy.deepcopy(swing(0.1, 1))  # by the protocol of pickle, which processes of vector environments use
    seen, told = copied.reset(seed=3)
    same, info = swing(0.1, 1).reset(seed=3)
    np.testing.assert_array_equal(seen, same)
    np.testing.assert_array_equal(told["theta"], info["theta"])


def test_diverging_simulations_are_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    env = randomized()
    env.reset(seed=0)
    engine = env.unwrapped.simulator.engine  # type: ignore[attr-defined]
    advance = engine.advance

    def diverging(*args: Any, **settings: Any) -> Any:
        states, derived, sound = advance(*args, **settings)
        return states, derived, sound & False

    monkeypatch.setattr(engine, "advance", diverging)
    *_, terminated, _, info = env.step(np.zeros(1))
    assert (terminated, info["valid"], env.diverged) == (True, False, 1)


def test_stable_baselines3_trains_under_a_posterior() -> None:
    """The example as it is, shorter."""
    pytest.importorskip("stable_baselines3")
    found = runpy.run_path(str(EXAMPLE))["main"](1_100)
    assert np.isfinite(found)
