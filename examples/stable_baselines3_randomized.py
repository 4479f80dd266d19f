"""Train under a posterior with your own code: Stable-Baselines3's DDPG in ``sipe.RandomizedEnv``.

    pip install stable-baselines3
    python examples/stable_baselines3_randomized.py          # a minute
    python examples/stable_baselines3_randomized.py 20000    # control steps: long enough to swing up

The posterior is of a pendulum whose parameters are hidden. Every episode of the training runs under a draw of it, with
up to one control step of delay on the torque and a little noise on what is seen; the agent is then tested where the log
came from. Other code that makes its own environments calls ``make_env(posterior)`` in place of ``gymnasium.make``.
"""

import sys

import numpy as np
import torch
from stable_baselines3 import DDPG
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor

import sipe_bayes as sipe

TASK = "Pendulum"


def make_env(posterior: sipe.Posterior) -> sipe.RandomizedEnv:
    under = sipe.Randomization(posterior.wider(1.5), observation_noise=0.02, action_delay=1)
    return sipe.RandomizedEnv(sipe.make(TASK), under)


def main(steps: int = 2_000) -> float:
    """Mean return in the target."""
    torch.set_num_threads(1)  # faster for networks this small
    target = sipe.make(TASK, variant="in_distribution")
    log = sipe.demonstrations(target, type="random", count=1, steps=100)
    posterior = sipe.get_estimator(TASK, "abc", budget=1_000, seed=0).fit(log)
    sipe.show_results(posterior, truth=target.theta)

    env = make_env(posterior)
    agent = DDPG("MlpPolicy", env, learning_starts=1_000, seed=0, device="cpu", policy_kwargs={"net_arch": [64, 64]})
    agent.learn(steps)
    seen = [env.reset()[1]["theta"] for _ in range(3)]
    print(f"three episodes' masses: {', '.join(f'{posterior.space[0].value(theta[0]):.3f} kg' for theta in seen)}")

    mean, sd = evaluate_policy(agent, Monitor(target), n_eval_episodes=5)
    print(
        f"return in the target after {steps} control steps: {mean:.0f} (sd {sd:.0f}); {env.redrawn} draws were made "
        "anew"
    )
    return float(np.mean(mean))


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
