"""sipe_bayes: calibrate robot simulators with honest uncertainty.

``import sipe_bayes as sipe``. The imports below are the one list of public names: type checkers and completion read
them as they stand; at run time each name is imported when it is first used, so that the import itself is instant.
"""

import importlib
import sys
from typing import TYPE_CHECKING

from sipe_bayes.core import VIEWS
from sipe_bayes.core import __version__ as __version__
from sipe_bayes.core.lazy import exports

VIEWS.update(posterior="sipe_bayes.report.posterior_plots", calibration="sipe_bayes.report.page")

if TYPE_CHECKING:
    from sipe_bayes.calibration.config import load_config as load_config
    from sipe_bayes.calibration.discover import discover as discover
    from sipe_bayes.calibration.problem import prepare as prepare
    from sipe_bayes.calibration.run import calibrate as calibrate
    from sipe_bayes.core.parameters import Parameter as Parameter
    from sipe_bayes.core.parameters import ParameterSpace as ParameterSpace
    from sipe_bayes.core.trajectory import Trajectories as Trajectories
    from sipe_bayes.core.trajectory import Trajectory as Trajectory
    from sipe_bayes.datasets.demonstrations import demonstrations as demonstrations
    from sipe_bayes.datasets.minari_data import from_minari as from_minari
    from sipe_bayes.envs.channels import Channel as Channel
    from sipe_bayes.envs.mjcf import MjcfEnvironment as MjcfEnvironment
    from sipe_bayes.envs.registry import make_task as make_task
    from sipe_bayes.inference import get_estimator as get_estimator
    from sipe_bayes.inference.progress_bar import ProgressBar as ProgressBar
    from sipe_bayes.inference.recalibrated import Recalibrated as Recalibrated
    from sipe_bayes.likelihood import Segments as Segments
    from sipe_bayes.likelihood import StateSpace as StateSpace
    from sipe_bayes.posterior import Dirac as Dirac
    from sipe_bayes.posterior import GaussianMixture as GaussianMixture
    from sipe_bayes.posterior import Particles as Particles
    from sipe_bayes.posterior import Posterior as Posterior
    from sipe_bayes.posterior import load_posterior as load_posterior
    from sipe_bayes.report.show import show_results as show_results
    from sipe_bayes.rl.policy_in_the_loop import train_in_the_loop as train_in_the_loop
    from sipe_bayes.rl.randomization import Randomization as Randomization
    from sipe_bayes.rl.randomization import load_randomization as load_randomization
    from sipe_bayes.rl.randomized_env import RandomizedEnv as RandomizedEnv
    from sipe_bayes.simulation import gym as gym
    from sipe_bayes.simulation.callable_simulator import CallableSimulator as CallableSimulator
    from sipe_bayes.simulation.gym import make as make
    from sipe_bayes.simulation.gym import make_vec as make_vec
    from sipe_bayes.simulation.simulator import Simulator as Simulator
else:
    __getattr__, __dir__ = exports(__name__)


if "gymnasium" in sys.modules:  # its ids are wanted; importing it here would double the time of the import
    importlib.import_module("sipe_bayes.simulation.gym")
