"""Estimators: each infers a posterior over theta from trajectories."""

from typing import Any

from sipe_bayes.inference.registry import ESTIMATORS, estimator_class, get_estimator

__all__ = ["ESTIMATORS", "estimator_class", "get_estimator"]  # and every class that ESTIMATORS names


def __getattr__(name: str) -> Any:
    for key, (_, attribute) in ESTIMATORS.items():
        if attribute == name:
            return estimator_class(key)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
