"""Columns with the quantity of the model that they are taken for."""

from __future__ import annotations

from dataclasses import dataclass

from sipe_bayes.calibration.init.columns.names import Label

SURE = 1.0
"""A score from which names alone decide."""


@dataclass(frozen=True)
class Match:
    """Columns that are taken for a quantity of the model; score: how well the names agree; named: whether any does."""

    columns: tuple[str, ...]
    target: str
    label: Label
    score: float
    quaternion: str = ""
    named: bool = False

    @property
    def column(self) -> str:
        """The one column, or the first."""
        return self.columns[0]

    @property
    def sure(self) -> bool:
        """Whether names alone tell it."""
        return self.score >= SURE


@dataclass(frozen=True)
class Matches:
    """Every quantity of the model that has a column; rivals: commands that would do as well; doubts: of all columns.

    forces: what actuators with another command apply at their joints.
    """

    positions: tuple[Match, ...]
    velocities: tuple[Match, ...]
    commands: tuple[Match, ...]
    vectors: tuple[Match, ...]
    rivals: tuple[Match, ...]
    left: tuple[str, ...]
    doubts: tuple[str, ...] = ()
    forces: tuple[Match, ...] = ()
