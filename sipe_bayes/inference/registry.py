"""The one list of estimators: name -> module and class. Tests, command and tables are generated from it."""

from __future__ import annotations

import difflib
import importlib
import inspect
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sipe_bayes.inference.base import Estimator

ESTIMATORS = {
    "regression": ("sipe_bayes.inference.amortised.regression", "Regression"),
    "maml": ("sipe_bayes.inference.amortised.maml", "MAML"),
    "bayessim": ("sipe_bayes.inference.amortised.bayessim", "BayesSim"),
    "laplace": ("sipe_bayes.inference.laplace.estimator", "Laplace"),
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
        close = difflib.get_close_matches(name, ESTIMATORS, 1)
        hint = f"did you mean {close[0]!r}?" if close else f"known: {', '.join(ESTIMATORS)}"
        raise ValueError(f"estimator: no {name!r}; {hint}")
    module, attribute = ESTIMATORS[name]
    found: type[Estimator] = getattr(importlib.import_module(module), attribute)
    return found


def get_estimator(simulator: Any, name: str, **settings: Any) -> Estimator:
    """The estimator called ``name`` on ``simulator``, or on the simulator of a benchmark's task: its name, the Task, or the
    Gymnasium environment of ``sipe.make``; settings as the class's own (budget, seed, prior, ...)."""
    from sipe_bayes.datasets.demonstrations import is_environment, simulator_of

    engine = simulator_of(simulator)[0] if is_environment(simulator) else simulator
    found = estimator_class(name)
    known = sorted({p for c in found.__mro__[:-1] for p in inspect.signature(c).parameters} - {"simulator", "settings"})
    for unknown in sorted(set(settings) - set(known)):
        close = difflib.get_close_matches(unknown, known, 1)
        hint = f"did you mean {close[0]!r}?" if close else f"it has {', '.join(known)}"
        raise ValueError(f"{name}: no setting {unknown!r}; {hint}")
    return found(engine, **settings)
