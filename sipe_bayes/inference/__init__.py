"""Estimators: each infers a posterior over theta from trajectories."""

from __future__ import annotations

from typing import TYPE_CHECKING

from sipe_bayes.inference.registry import ESTIMATORS, estimator_class, get_estimator

if TYPE_CHECKING:
    from sipe_bayes.inference.base import Estimator

__all__ = ["ESTIMATORS", "estimator_class", "get_estimator"]  # and every class that ESTIMATORS names


def __getattr__(name: str) -> type[Estimator]:
    for key, (_, attribute) in ESTIMATORS.items():
        if attribute == name:
            return estimator_class(key)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
