"""The code of the SiPE paper's figure, as it runs here.

A target, an environment to randomise, an estimator, its estimate.

    python examples/paper_snippet.py

Simulated demonstrations carry no measurement noise, so that this estimator finds the parameters to the last digits.

Mehta, Handa, Fox, Ramos 2020, "A User's Guide to Calibrating Robotics Simulators" (https://arxiv.org/abs/2011.08985).
"""

import sipe_bayes as sipe

TASK = "Pendulum"
ESTIMATOR = "laplace"
ITERATIONS = 20


def main(path: str | None = "runs/paper_snippet.png") -> "sipe.Posterior":
    """Estimate the parameters of a pendulum that is not the published one."""
    target_env = sipe.make(TASK, variant="in_distribution")
    trajectories = sipe.demonstrations(target_env, type="expert")
    print(f"{len(trajectories)} demonstrations of {trajectories.length[0]} control steps")

    randomizable_env = sipe.make(TASK)
    estimator = sipe.get_estimator(randomizable_env, ESTIMATOR)
    for _ in range(ITERATIONS):
        estimator.update_parameter_estimate(target_env)

    final_estimates = estimator.get_parameter_estimate(target_env)
    sipe.show_results(final_estimates, truth=target_env.theta, path=path)
    return final_estimates


if __name__ == "__main__":
    main()
