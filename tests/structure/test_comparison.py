"""Structures compared: exact differences, ties that are called ties, the set that is reported, and its search."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any
from unittest import mock

import numpy as np
import pytest

from sipe_bayes.likelihood import Noise
from sipe_bayes.structure.comparison import choose_ties, difference, stack
from sipe_bayes.structure.fitted import FittedStructure
from sipe_bayes.structure.scores import Pieces
from sipe_bayes.structure.search import StructureSearch
from sipe_bayes.structure.state import DiscoverState, Offer, Phase

EMPTY, SAMPLES = np.zeros(0), 50


def structure(labels: str, *density: float, evidence: float = 0.0, logs: int = 1) -> FittedStructure:
    """One of single-letter extensions with a parameter each, beside one of the user's, and its pieces' densities."""
    theta, count = np.array([0.5, *(ord(x) / 1000 for x in labels)]), len(density)
    log = np.repeat(np.arange(logs), -(-count // logs))[:count]
    held = Pieces(np.array(density, float), log, np.ones(count))
    return FittedStructure(
        tuple(labels), theta, theta, np.eye(len(theta)), Noise(EMPTY, EMPTY), EMPTY, evidence, held, 1, settled=True
    )


def test_two_right_models_of_white_noise_differ_by_their_standard_error() -> None:
    """2,000 pairs of which one has an offset of its own in every piece: z has a standard deviation of one to 4 %.

    The difference is that of two normal densities; a limit of 6 % is passed by chance once in 5,000.
    """
    rng, z = np.random.default_rng(0), []
    for _ in range(2000):
        noise = rng.standard_normal((20, SAMPLES))
        shift = 0.4 * np.ones(SAMPLES)
        right, wrong = (-0.5 * (x**2).sum(1) for x in (noise, noise + shift))
        found = difference(structure("a", *right), structure("", *wrong))
        z.append((found.nats - 0.5 * 20 * SAMPLES * 0.4**2) / found.error)
    assert np.std(z) == pytest.approx(0.93, abs=0.06)  # the error counts pieces that oppose the sum, and neighbours
    assert abs(np.mean(z)) < 0.15


def test_useless_extensions_are_never_clear_of_what_they_contain() -> None:
    """5,000 null effects, each fitted: none of 40 candidates in a search may be kept by more than one chance in 20."""
    gains = 0.5 * np.random.default_rng(1).chisquare(1, 5000)
    parts = np.random.default_rng(2).normal(size=(5000, 20))
    parts -= parts.mean(1, keepdims=True)
    each = gains[:, None] / 20 + np.sqrt(2 * gains / 20)[:, None] * parts
    plain = structure("", *np.zeros(20))
    assert np.mean([difference(structure("a", *d), plain).clear for d in each]) < 0.05 / 40


@pytest.mark.parametrize(
    ("pieces", "clear"),
    [
        ([5.0] * 8, True),
        ([40.0, 30.0, 6.0, 5.0, -2.0, 1.0, 0.5, -0.2], True),  # motions tell differently much
        ([300.0, -250.0, 200.0, -280.0, 100.0, 20.0], False),
        ([0.1, -0.2, 0.3, 0.0, 0.1, 0.2], False),
    ],
)
def test_a_gain_is_clear_where_pieces_agree(pieces: list[float], clear: bool) -> None:
    found = difference(structure("a", *pieces), structure("", *np.zeros(len(pieces))))
    assert found.clear is clear
    back = difference(structure("", *np.zeros(len(pieces))), structure("a", *pieces))
    assert back.nats == -found.nats
    assert not back.clear


def test_a_structure_that_diverges_on_held_out_logs_loses() -> None:
    lost, plain = structure("a", 90.0, -np.inf), structure("", 1.0, 1.0)
    assert difference(plain, lost).clear
    assert not difference(lost, lost).clear
    assert stack([lost, lost]) == pytest.approx([0.5, 0.5])
    assert difference(structure("b", 99.0, -np.inf), lost).nats == 9.0
    assert choose_ties([plain, lost]) == [plain]


def test_equivalent_structures_are_ties_and_what_is_not_needed_is_left_out() -> None:
    plain, one, twin = structure("", *np.zeros(8)), structure("a", *np.full(8, 5.0)), structure("b", *np.full(8, 5.0))
    more = structure("ac", *np.full(8, 5.1))
    found = choose_ties([plain, one, twin, more])
    assert [x.labels for x in found] == [("a",), ("b",)]
    assert stack(found) == pytest.approx([0.5, 0.5])
    assert choose_ties([plain, structure("c", *np.full(8, 0.1))]) == [plain]
    best, larger = structure("d", *np.full(8, 9.0)), structure("ae", *[-30.0, 60.0, -30.0, 60.0, -30.0, 0.0, 0.0, 0.0])
    assert not difference(best, larger).clear  # which predicts worse than its part, itself no tie
    assert choose_ties([plain, best, one, larger]) == [best]


def test_stacking_weights_maximise_the_mixture() -> None:
    """Two structures that are right in half of the pieces each, and one that is nowhere better."""
    halves = np.repeat([3.0, 0.0], 10)
    weights = stack([structure("a", *halves), structure("b", *halves[::-1]), structure("c", *np.zeros(20))])
    assert weights == pytest.approx([0.5, 0.5, 0.01], abs=0.01)  # a hundredth at least


def search_of(*fitted: FittedStructure, **needs: float) -> tuple[StructureSearch, list[FittedStructure]]:
    """A search whose fits are those of structures that are given, by their labels; and those that were asked for.

    needs: nats that each extension is worth to first order, where not one.
    """
    fitting: Any = SimpleNamespace(
        ends=np.inf,
        trajectories=[0],
        holdout=None,
        simulator=lambda pieces: None,
        needs=lambda pieces, one: ({x: needs.get(x, 1.0) for x in one.labels}, 3),
    )
    search, asked = StructureSearch(fitting, ()), list[FittedStructure]()
    named = SimpleNamespace(extension=SimpleNamespace(native=True, slow=1), parameters=(None,))
    search.placed = dict.fromkeys("abcd", named)  # type: ignore[arg-type]

    def fit(state: DiscoverState, labels: tuple[str, ...], initial: np.ndarray, begin: object) -> DiscoverState:
        assert initial.tolist() == [0.5, *(ord(x) / 1000 for x in labels)]
        one = next(x for x in fitted if set(x.labels) == set(labels))
        asked.append(one)
        theta = structure("".join(labels)).theta
        return replace(state, fitted=(*state.fitted, replace(one, labels=labels, theta=theta)))

    mock.patch.object(search, "_fitted", fit).start()
    return search, asked


def offer(at: str, label: str, gain: float) -> Offer:
    return Offer(tuple(at), label, gain, np.array([ord(label) / 1000]), np.array([0.5, *(ord(x) / 1000 for x in at)]))


def test_a_beam_finds_what_the_first_choice_hides() -> None:
    """Alone, c predicts best; with a and b it is not needed. Each smaller structure of the best one is fitted."""
    gains = {"": 0.0, "a": 8.5, "b": 1.0, "c": 9.0, "ac": 11.0, "bc": 9.5, "ab": 15.0, "d": 0.0}
    search, asked = search_of(*(structure(x, *np.full(10, gain)) for x, gain in gains.items()))
    offers = [offer("", x, 10 * gains[x]) for x in "abcd"]
    offers += [offer("a", "b", 70.0), offer("a", "c", 30.0), offer("c", "a", 20.0), offer("c", "b", 5.5)]
    state = DiscoverState(Phase.RANK, (structure("", *np.zeros(10)),), offers=tuple(offers), ranked=((),))
    while state.phase in (Phase.RANK, Phase.FIT, Phase.PRUNE):
        state = replace(state, ranked=(*state.ranked, *state.beam))
        state = {Phase.RANK: search._rank, Phase.FIT: search._fit, Phase.PRUNE: search._prune}[state.phase](state)
    assert {one.labels for one in asked} >= {("a",), ("c",), ("a", "b"), ("b",)}
    assert [one.labels for one in search.supported(state)] == [("a", "b")]


@pytest.mark.parametrize(("b", "asked"), [(12.0, ["ab", "ac"]), (0.05, ["ab", "ac", "bc"])])
def test_pruning_ends_where_the_least_needed_extension_is_needed(b: float, asked: list[str]) -> None:
    """C is not; then b is asked for, and a where b is not needed either."""
    gains = {"abc": 25.1, "ab": 25.0, "ac": 25.0 - b, "bc": 0.0}
    search, fitted = search_of(*(structure(x, *np.full(10, gain)) for x, gain in gains.items()), a=9.0, b=5.0)
    state = DiscoverState(Phase.PRUNE, (structure("", *np.zeros(10)), structure("abc", *np.full(10, 25.1))))
    while state.phase is Phase.PRUNE:
        state = search._prune(state)
    assert ["".join(one.labels) for one in fitted] == asked


@pytest.mark.parametrize(("held_out", "kept"), [(1.0, "a"), (-1.0, "")])
def test_what_predicts_held_out_logs_worse_is_not_in_the_set(held_out: float, kept: str) -> None:
    """However much better it predicts pieces of the training log."""
    pieces = [20.0] * 10 + [held_out] * 10
    (search, _), log = search_of(), np.repeat([0, 1], 10)
    fitted = [structure("", *np.zeros(20)), structure("a", *pieces)]
    fitted = [replace(one, held=replace(one.held, log=log)) for one in fitted]
    assert [one.labels for one in search.supported(DiscoverState(Phase.DONE, tuple(fitted)))] == [tuple(kept)]


@pytest.mark.parametrize(("theta", "wide"), [(0.7, True), (0.42, False), (0.0, False)])
def test_an_interval_reaches_as_far_as_the_optimum(theta: float, wide: bool) -> None:
    """Not where the mean lies behind a bound at which the optimum is, nor where it is within a sd."""
    mean, covariance = np.array([theta - 0.4 if wide or not theta else 0.4]), np.array([[0.05**2]])
    one = replace(structure(""), theta=np.array([theta]), mean=mean, covariance=covariance)
    expected = np.hypot(0.05, 0.4) if wide else 0.05
    assert np.sqrt(one.spanned[0, 0]) == pytest.approx(expected)


@pytest.mark.parametrize(
    ("evidence", "settled", "kept"), [(50.0, False, False), (150.0, False, True), (50.0, True, True)]
)
def test_a_fit_that_was_cut_short_below_its_own_part_says_nothing(evidence: float, settled: bool, kept: bool) -> None:
    """It may have more evidence than it had on the way, not less than with one fewer; it is not tried again."""
    one = replace(structure("ab", evidence=evidence), settled=settled, rollouts=70)
    fitting: Any = SimpleNamespace(is_late=False, ends=np.inf, enough=lambda placed: 90, fit=lambda *given: one)
    search = StructureSearch(fitting, (), budget=10_000)
    begun = DiscoverState(Phase.FIT, (structure(""), structure("a", evidence=100.0)))
    with mock.patch.object(search, "structure", return_value=[]):
        after = search._fitted(begun, ("a", "b"), np.zeros(3), None)
    assert (after.of("ab") is one) is kept
    assert (after.failed == (("a", "b"),)) is not kept
    assert after.is_tried("ba")
    assert after.rollouts == begun.rollouts + 70
    assert after.cut is None
