"""sipe_bayes: calibrate robot simulators with honest uncertainty.

``import sipe_bayes as sipe``. Public names are imported when first used, so the import itself is instant.
"""

import importlib
import sys
from typing import Any

__version__ = "0.1.0"

_PUBLIC = {
    "Parameter": "sipe_bayes.core.parameters",
    "ParameterSpace": "sipe_bayes.core.parameters",
    "Trajectory": "sipe_bayes.core.trajectory",
    "Trajectories": "sipe_bayes.core.trajectory",
    "Channel": "sipe_bayes.envs.mjcf",
    "MjcfEnvironment": "sipe_bayes.envs.mjcf",
    "make": "sipe_bayes.simulation.gym",
    "make_vec": "sipe_bayes.simulation.gym",
    "make_task": "sipe_bayes.envs.registry",
    "Simulator": "sipe_bayes.simulation.simulator",
    "CallableSimulator": "sipe_bayes.simulation.callable_simulator",
    "Segments": "sipe_bayes.likelihood.settings",
    "StateSpace": "sipe_bayes.likelihood.settings",
    "Posterior": "sipe_bayes.posterior",
    "Dirac": "sipe_bayes.posterior",
    "Particles": "sipe_bayes.posterior",
    "GaussianMixture": "sipe_bayes.posterior",
    "load_posterior": "sipe_bayes.posterior",
    "demonstrations": "sipe_bayes.datasets.demonstrations",
    "from_minari": "sipe_bayes.datasets.minari_data",
    "get_estimator": "sipe_bayes.inference",
    "Recalibrated": "sipe_bayes.inference.recalibrated",
    "show_results": "sipe_bayes.report.show",
    "load_config": "sipe_bayes.calibration.config",
    "train_in_the_loop": "sipe_bayes.rl.policy_in_the_loop",
    "RandomizedEnv": "sipe_bayes.rl.randomized_env",
    "Randomization": "sipe_bayes.rl.randomization",
    "load_randomization": "sipe_bayes.rl.randomization",
    "prepare": "sipe_bayes.calibration.problem",
    "calibrate": "sipe_bayes.calibration.run",
}

__all__ = ["__version__", *_PUBLIC]


def __getattr__(name: str) -> Any:
    if name == "gym":
        return importlib.import_module("sipe_bayes.simulation.gym")
    if name in _PUBLIC:
        return getattr(importlib.import_module(_PUBLIC[name]), name)
    raise AttributeError(f"module 'sipe_bayes' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)


if "gymnasium" in sys.modules:  # its ids are wanted; importing it here would double the time of the import
    importlib.import_module("sipe_bayes.simulation.gym")
