"""Rivals of kept pieces: who did about as well in the round that chose, and nobody else."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from sipe_bayes.structure.fitted import FittedStructure
from sipe_bayes.structure.rivals import rivals
from sipe_bayes.structure.search import StructureSearch
from sipe_bayes.structure.state import DiscoverState, Judgement, Phase

EMPTY = np.zeros(0)


def structure(labels: str, evidence: float) -> FittedStructure:
    """One of single-letter pieces with a parameter each, beside one of the user's."""
    theta = np.array([0.5, *(ord(x) / 1000 for x in labels)])
    return FittedStructure(
        tuple(labels), theta, theta, np.eye(len(theta)), EMPTY, EMPTY, EMPTY, evidence, None, 1, settled=True
    )


def test_rivals_are_those_that_came_close_in_the_round_of_the_piece() -> None:
    fitted = [
        structure("", 0),
        structure("a", 100),
        structure("b", 95),  # close to a
        structure("c", 50),  # far behind it
        structure("ad", 200),
        structure("ae", 199),
        structure("af", 193),
        structure("ag", 192),  # close as well, but the third
        structure("d", 99),  # close, but kept itself
    ]
    tried = list(rivals(fitted, ("a", "d"), lambda one: one.evidence, share=0.1, most=2))
    assert [(rival.labels, rival.kept) for rival in tried] == [
        (("b", "d"), "a"),
        (("a", "e"), "d"),
        (("a", "f"), "d"),
    ]
    assert [rival.theta.tolist() for rival in tried] == [[ord(x) / 1000] for x in "bef"]
    assert not list(rivals(fitted, ("a", "d"), lambda one: one.evidence, share=0.1, most=0))


def test_a_piece_whose_round_is_not_known_has_no_rivals() -> None:
    """After a piece was left out, what was fitted beside it says nothing of the rest."""
    fitted = [structure("", 0), structure("ad", 200), structure("ae", 199), structure("d", 100), structure("e", 20)]
    assert [r.labels for r in rivals(fitted, ("d",), lambda one: one.evidence, 0.1, 2)] == []
    assert [r.labels for r in rivals(fitted, ("d",), lambda one: one.evidence, 0.9, 2)] == [("e",)]


@pytest.mark.parametrize(("log_score", "ends_with"), [(50.0, ("b", "d")), (-50.0, ("a", "d")), (None, ("b", "d"))])
def test_a_rival_takes_the_place_unless_held_out_logs_speak_against_it(
    log_score: float | None, ends_with: tuple[str, ...]
) -> None:
    """One that they speak against is refused, so that it does not count among the structures either.

    A fit to them that was cut short says nothing.
    """
    better = replace(structure("bd", 210), held_out=1.0)
    fitted = (structure("", 0), structure("a", 100), structure("b", 95), structure("ad", 200), better)
    judged = (Judgement(("a", "d"), 0.0, 1), Judgement(("b", "d"), log_score, 1))
    fitting: Any = SimpleNamespace(holdout="logs", corrected=lambda columns: fitting)
    search = StructureSearch(fitting, ())
    state = DiscoverState(Phase.SWAP, fitted, ("a", "d"), judged=judged)
    for _ in range(2):
        state = search._swap(state)
    assert state.present == ends_with
    assert state.is_refused(("b", "d")) == (log_score is not None and log_score < 0)
    assert state.phase is Phase.RESIDUAL
