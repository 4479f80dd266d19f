"""The one list of estimators: name -> module and class. Tests, command and tables are generated from it."""

from __future__ import annotations

import importlib
import inspect
from collections.abc import Callable
from typing import TYPE_CHECKING

from sipe_bayes.core.validation import nearest_name

if TYPE_CHECKING:
    from sipe_bayes.envs.task import Task
    from sipe_bayes.inference.base import Estimator
    from sipe_bayes.inference.recorded import GymnasiumEnvironment
    from sipe_bayes.simulation.callable_simulator import CallableSimulator
    from sipe_bayes.simulation.simulator import Simulator

ESTIMATORS = {
    "regression": ("sipe_bayes.inference.amortised.regression", "Regression"),
    "maml": ("sipe_bayes.inference.amortised.maml", "MAML"),
    "bayessim": ("sipe_bayes.inference.amortised.bayessim", "BayesSim"),
    "laplace": ("sipe_bayes.inference.laplace", "Laplace"),
    "mcmc": ("sipe_bayes.inference.mcmc", "MCMC"),
    "bayesopt": ("sipe_bayes.inference.search.bayesopt", "BayesOpt"),
    "npe": ("sipe_bayes.inference.amortised.npe", "NPE"),
    "abc": ("sipe_bayes.inference.amortised.abc", "ABC"),
    "simopt": ("sipe_bayes.inference.search.simopt", "SimOpt"),
    "adr": ("sipe_bayes.inference.search.adr", "ADR"),
    "cem": ("sipe_bayes.inference.search.cem", "CEM"),
}


def estimator_class(name: str) -> type[Estimator]:
    """The class of an estimator's name; raises ValueError that suggests the nearest."""
    if name not in ESTIMATORS:
        hint = nearest_name(name, ESTIMATORS) or f"; known: {', '.join(ESTIMATORS)}"
        raise ValueError(f"estimator: no {name!r}{hint}")
    module, attribute = ESTIMATORS[name]
    method: type[Estimator] = getattr(importlib.import_module(module), attribute)
    return method


def get_estimator(
    simulator: Simulator | CallableSimulator | Task | GymnasiumEnvironment | str, name: str, **settings: object
) -> Estimator:
    """The estimator called ``name`` on a simulator.

    Args:
        simulator: what is calibrated, or what stands for the simulator of a benchmark's task: its name, the Task, or
            the Gymnasium environment of ``sipe.make``.
        name: one of ``ESTIMATORS``.
        **settings: as the class's own (budget, seed, prior, ...).

    Returns:
        The estimator; nothing has been simulated yet.

    Raises:
        ValueError: for a name or a setting that there is not, or a value beyond its limits.
    """
    from sipe_bayes.datasets.demonstrations import is_environment, simulator_of

    engine = simulator_of(simulator)[0] if is_environment(simulator) else simulator
    method: Callable[..., Estimator] = estimator_class(name)
    known = arguments(name)
    for unknown in sorted(settings.keys() - known):
        hint = nearest_name(unknown, known) or f"; it has {', '.join(known)}"
        raise ValueError(f"{name}: no setting {unknown!r}{hint}")
    return method(engine, **settings)


def arguments(name: str) -> dict[str, inspect.Parameter]:
    """What the estimator called ``name`` takes besides the simulator, in alphabetical order."""
    taken = inspect.signature(estimator_class(name)).parameters
    return {key: taken[key] for key in sorted(taken.keys() - {"simulator", "options"})}
