"""sipe_bayes: calibrate robot simulators with honest uncertainty.

``import sipe_bayes as sipe``. Public names are imported when first used, so the import itself is instant.
"""

import importlib
import sys
from typing import Any

__version__ = "0.1.0"

_PUBLIC = {
    "Parameter": "sipe_bayes.parameters",
    "ParameterSpace": "sipe_bayes.parameters",
    "Trajectory": "sipe_bayes.trajectory",
    "Trajectories": "sipe_bayes.trajectory",
    "Channel": "sipe_bayes.envs.mjcf",
    "MjcfEnvironment": "sipe_bayes.envs.mjcf",
    "make": "sipe_bayes.gym",
    "make_vec": "sipe_bayes.gym",
    "make_task": "sipe_bayes.envs.registry",
    "Simulator": "sipe_bayes.simulator",
    "CallableSimulator": "sipe_bayes.callable_simulator",
    "Segments": "sipe_bayes.likelihood",
    "StateSpace": "sipe_bayes.state_space",
    "Posterior": "sipe_bayes.posterior",
    "Dirac": "sipe_bayes.posterior",
    "Particles": "sipe_bayes.posterior",
    "GaussianMixture": "sipe_bayes.posterior",
    "load_posterior": "sipe_bayes.posterior",
    "demonstrations": "sipe_bayes.demonstration",
    "from_minari": "sipe_bayes.minari_data",
    "get_estimator": "sipe_bayes.inference",
    "Recalibrated": "sipe_bayes.inference.recalibrated",
    "show_results": "sipe_bayes.show",
    "load_config": "sipe_bayes.config",
    "train_in_the_loop": "sipe_bayes.rl.policy_in_the_loop",
    "RandomizedEnv": "sipe_bayes.randomized_env",
    "Randomization": "sipe_bayes.rl.randomization",
    "load_randomization": "sipe_bayes.rl.randomization",
    "prepare": "sipe_bayes.problem",
    "calibrate": "sipe_bayes.calibration",
}

__all__ = ["__version__", *_PUBLIC]


def __getattr__(name: str) -> Any:
    if name == "gym":
        return importlib.import_module("sipe_bayes.gym")
    if name in _PUBLIC:
        return getattr(importlib.import_module(_PUBLIC[name]), name)
    raise AttributeError(f"module 'sipe_bayes' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)


if "gymnasium" in sys.modules:  # its ids are wanted; importing it here would double the time of the import
    importlib.import_module("sipe_bayes.gym")
