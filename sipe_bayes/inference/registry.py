"""The one list of estimators: name -> module and class. Tests, command and tables are generated from it."""

from __future__ import annotations

import difflib
import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sipe_bayes.inference.base import Estimator

ESTIMATORS = {
    "laplace": ("sipe_bayes.inference.laplace", "Laplace"),
    "mcmc": ("sipe_bayes.inference.mcmc", "MCMC"),
}


def estimator_class(name: str) -> type[Estimator]:
    """The class of an estimator's name; raises ValueError that suggests the nearest."""
    if name not in ESTIMATORS:
        close = difflib.get_close_matches(name, ESTIMATORS, 1)
        hint = f"did you mean {close[0]!r}?" if close else f"known: {', '.join(ESTIMATORS)}"
        raise ValueError(f"estimator: no {name!r}; {hint}")
    module, attribute = ESTIMATORS[name]
    found: type[Estimator] = getattr(importlib.import_module(module), attribute)
    return found


def get_estimator(simulator: Any, name: str, **settings: Any) -> Estimator:
    """The estimator called ``name`` on ``simulator``, or on the benchmark's task of that name; settings as the class's own
    (budget, seed, prior, ...)."""
    if isinstance(simulator, str):
        from sipe_bayes.envs.registry import make_task
        from sipe_bayes.simulator import Simulator

        simulator = Simulator(make_task(simulator))
    return estimator_class(name)(simulator, **settings)
