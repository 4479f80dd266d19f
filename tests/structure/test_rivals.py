"""Rivals of kept pieces: what promises about as much in their place, and nothing else."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any
from unittest import mock

import numpy as np
import pytest

from sipe_bayes.structure.fitted import FittedStructure
from sipe_bayes.structure.rivals import rivals
from sipe_bayes.structure.search import StructureSearch
from sipe_bayes.structure.state import DiscoverState, Judgement, Offer, Phase

EMPTY = np.zeros(0)


def structure(labels: str, evidence: float) -> FittedStructure:
    """One of single-letter pieces with a parameter each, beside one of the user's."""
    theta = np.array([0.5, *(ord(x) / 1000 for x in labels)])
    return FittedStructure(
        tuple(labels), theta, theta, np.eye(len(theta)), EMPTY, EMPTY, EMPTY, evidence, None, 1, settled=True
    )


def offer(at: str, label: str, gain: float) -> Offer:
    return Offer(tuple(at), label, gain, np.array([ord(label) / 1000]), np.array([0.5, *(ord(x) / 1000 for x in at)]))


def test_rivals_are_those_that_promise_about_as_much_in_the_whole_structure() -> None:
    """Whatever they promised in the round that chose, while the other piece was missing."""
    early = [offer("", "d", 100), offer("", "b", 30), offer("", "c", 99)]
    late = [offer("a", label, gain) for label, gain in (("d", 200), ("b", 199), ("c", 40), ("e", 190), ("f", 185))]
    offers = [*early, *late]
    assert [o.label for o in rivals(offers, ("a",), ("a", "d"), share=0.1, most=5)] == ["b", "e", "f"]
    assert [o.label for o in rivals(offers, ("a",), ("d", "a"), share=0.1, most=1)] == ["b"]
    assert [o.label for o in rivals(offers, (), ("d",), share=0.1, most=5)] == ["c"]
    assert not rivals([offer("a", "g", -1.0)], ("a",), ("a", "d"), share=0.1, most=5)


def test_what_was_not_fitted_in_its_round_is_fitted_in_the_place_of_a_kept_piece() -> None:
    """Beside a, b promises as much as d; it fits better, and is kept. Nothing is fitted or ranked twice."""
    fitted: list[FittedStructure] = [structure("", 0), structure("a", 100), structure("d", 90), structure("ad", 200)]
    asked: list[tuple[str, ...]] = []
    fitting: Any = SimpleNamespace(holdout=None, corrected=lambda columns: fitting)
    search = StructureSearch(fitting, ())

    def ranked(state: DiscoverState, here: FittedStructure, last_resort: bool) -> tuple[DiscoverState, list[Any]]:
        asked.append(here.labels)
        gains = {"b": 99.0, "d": 100.0, "c": 60.0} if here.labels == ("a",) else {"a": 100.0, "c": 10.0}
        new = tuple(offer("".join(here.labels), label, gain) for label, gain in gains.items())
        return replace(state, offers=state.offers + new, ranked=(*state.ranked, here.labels)), []

    def fit(state: DiscoverState, labels: tuple[str, ...], initial: np.ndarray) -> DiscoverState:
        assert initial.tolist() == [0.5, ord("a") / 1000, ord("b") / 1000]
        return replace(state, fitted=(*state.fitted, structure("".join(labels), 210)))

    with mock.patch.object(search, "_ranked", ranked), mock.patch.object(search, "_fitted", fit):
        state = DiscoverState(Phase.SWAP, tuple(fitted), ("a", "d"))
        for _ in range(6):
            state = search._swap(state) if state.phase is Phase.SWAP else state
    assert sorted(asked) == [("a",), ("d",)]
    assert state.present == ("a", "b")
    assert state.phase is Phase.PRUNE  # what is kept beside it may have made up for its lack


def test_a_rival_that_held_out_pieces_speak_against_hides_none_that_they_do_not() -> None:
    scores = {"": (0.0, 0.0), "a": (100.0, 10.0), "d": (90.0, 10.0), "ad": (200.0, 20.0)}
    scores |= {"ab": (220.0, 15.0), "ac": (210.0, 25.0)}
    fitted = tuple(replace(structure(x, evidence), held_out=held) for x, (evidence, held) in scores.items())
    fitting: Any = SimpleNamespace(holdout=None, corrected=lambda columns: fitting)
    state = DiscoverState(Phase.SWAP, fitted, ("a", "d"), ranked=(("a",), ("d",)))
    assert StructureSearch(fitting, ())._swap(state).present == ("a", "c")


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
    asked = (("a",), (), ("b",), ("d",))
    state = DiscoverState(Phase.SWAP, fitted, ("a", "d"), judged=judged, ranked=asked)
    for _ in range(2):
        state = search._swap(replace(state, phase=Phase.SWAP))
    assert state.present == ends_with
    assert state.is_refused(("b", "d")) == (log_score is not None and log_score < 0)
    assert state.phase is Phase.RESIDUAL


@pytest.mark.parametrize(("held", "refused"), [(15.0, True), (19.0, False), (None, False)])
def test_a_rival_that_held_out_pieces_speak_against_does_not_count(held: float | None, refused: bool) -> None:
    """Whatever its evidence; what is behind by less than two nats, or not scored, does."""
    fitted = [replace(structure(x, e), held_out=20.0) for x, e in (("", 0), ("a", 100), ("d", 90), ("ad", 200))]
    rival = replace(structure("ab", 220), held_out=held)
    fitting: Any = SimpleNamespace(holdout=None, corrected=lambda columns: fitting)
    state = DiscoverState(Phase.SWAP, (*fitted, rival), ("a", "d"), ranked=(("a",), ("d",)))
    after = StructureSearch(fitting, ())._swap(state)
    assert after.is_refused(("a", "b")) is refused


@pytest.mark.parametrize(("theta", "wide"), [(0.7, True), (0.42, False), (0.0, False)])
def test_an_interval_reaches_as_far_as_the_optimum(theta: float, wide: bool) -> None:
    """Not where the mean lies behind a bound at which the optimum is, nor where it is within a sd."""
    mean, covariance = np.array([theta - 0.4 if wide or not theta else 0.4]), np.array([[0.05**2]])
    one = replace(structure("", 0.0), theta=np.array([theta]), mean=mean, covariance=covariance)
    expected = np.hypot(0.05, 0.4) if wide else 0.05
    assert np.sqrt(one.spanned[0, 0]) == pytest.approx(expected)


@pytest.mark.parametrize(
    ("evidence", "settled", "kept"), [(50.0, False, False), (150.0, False, True), (50.0, True, True)]
)
def test_a_fit_that_was_cut_short_below_its_own_part_says_nothing(evidence: float, settled: bool, kept: bool) -> None:
    """It may have more evidence than it had on the way, not less than with a piece fewer; it is not tried again."""
    one = replace(structure("ab", evidence), settled=settled, rollouts=70)
    fitting: Any = SimpleNamespace(enough=lambda placed: 90, fit=lambda *given: one)
    search = StructureSearch(fitting, (), budget=10_000)
    begun = DiscoverState(Phase.FIT, (structure("", 0), structure("a", 100)), ("a",))
    with mock.patch.object(search, "structure", return_value=[]):
        after = search._fitted(begun, ("a", "b"), np.zeros(3))
    assert (after.of("ab") is one) is kept
    assert (after.failed == (("a", "b"),)) is not kept
    assert after.is_tried("ba")
    assert after.rollouts == begun.rollouts + 70
    assert after.cut is None
