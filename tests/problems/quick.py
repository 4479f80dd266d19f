"""Settings with which estimators fit quickly, by name: the one list of them for the tests."""

from __future__ import annotations

from typing import Any

from sipe_bayes.models.training import Training

Settings = dict[str, dict[str, Any]]

SEARCH = {"budget": 40, "batch": 8, "pool": 64, "growth": 3.0, "effective_draws": 50, "most_steps": 100}  # of bayesopt

FORM: Settings = {
    "bayesopt": SEARCH,
    "bayessim": {"components": 2, "training": Training(epochs=40), "calibration": 0.0},
    "maml": {"iterations": 20, "tasks": 3},
    "mcmc": {"budget": 300},
    "npe": {"max_epochs": 10, "transforms": 1, "hidden": 16, "calibration": 0.0},
    "regression": {"iterations": 2000},
}
"""Where only form counts."""

SMALL: Settings = {
    "bayesopt": SEARCH,
    "bayessim": {"calibration": 0.0},
    "maml": {"iterations": 100},
    "npe": {
        "calibration": 0.0,
        "embedding": "none",
        "transforms": 2,
        "hidden": 24,
        "batch_size": 200,
        "learning_rate": 1e-2,
        "max_epochs": 40,
    },
}
"""Networks that still find the exact posterior of a function with few outputs from 1,500 simulations."""
