"""How steps are damped, and that every search goes downhill in this one way."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest

from sipe_bayes.inference.laplace.levenberg_marquardt import DampingRule, QuadraticModel, descend
from sipe_bayes.inference.laplace.options import LaplaceTuning


@dataclass
class Bowl:
    """1/2 |theta - middle|^2 with whatever is simulated in its place; counts simulations."""

    theta: np.ndarray
    middle: np.ndarray
    simulate: Callable[[np.ndarray], float]
    singular_below: float = 0.0
    simulations: int = 0

    @property
    def energy(self) -> float:
        return 0.5 * float(((self.theta - self.middle) ** 2).sum())

    def model(self, damping: float) -> QuadraticModel:
        if damping < self.singular_below:
            raise np.linalg.LinAlgError
        return QuadraticModel(np.eye(len(self.theta)), self.middle - self.theta, 0.0, lambda move: np.zeros(0))

    def simulated(self, theta: np.ndarray, change: np.ndarray) -> tuple[np.ndarray, float]:
        self.simulations += 1
        return theta, self.simulate(theta)


def bowl(simulate: Callable[[np.ndarray], float] | None = None, **more: float) -> Bowl:
    middle = np.array([0.6, 0.3])
    return Bowl(np.array([0.1, 0.9]), middle, simulate or (lambda t: 0.5 * float(((t - middle) ** 2).sum())), **more)  # type: ignore[arg-type]


def test_the_damping_rule() -> None:
    """After a step that lowered the energy a fifth, after one that did not eight times as much: within its bounds."""
    rule = LaplaceTuning().damping
    assert rule == DampingRule()
    assert rule.first == 1e-4
    assert rule.after(1e-2, lowered=True) == pytest.approx(2e-3)
    assert rule.after(1e-2, lowered=False) == pytest.approx(8e-2)
    assert rule.after(2e-9, lowered=True) == 1e-9
    assert DampingRule(least_refused=1e-4).after(1e-9, lowered=False) == pytest.approx(8e-4)


def test_a_search_damps_its_steps_by_the_rule() -> None:
    """A simulation refuses every step longer than .08: of the damping that is first short enough."""
    start = bowl().theta

    def narrow(theta: np.ndarray) -> float:
        return 0.1 if np.linalg.norm(theta - start) < 0.08 else np.inf

    rule, tried = DampingRule(), [1e-4]  # the step is the way over one and the damping
    for _ in range(12):
        tried.append(rule.after(tried[-1], lowered=False))
    way = float(np.linalg.norm(bowl().middle - start))
    first = next(k for k, damping in enumerate(tried) if way / (1 + damping) < 0.08)
    problem = bowl(narrow)
    fit = descend(problem, 1e-4, 1e-6, DampingRule())
    assert problem.simulations == first + 1
    assert fit.damping == pytest.approx(rule.after(tried[first], lowered=True))
    assert fit.point is not None
    assert np.linalg.norm(fit.point - start) == pytest.approx(way / (1 + tried[first]))
    assert fit.gained == pytest.approx(problem.energy - 0.1)


def test_a_full_step_is_tried_first_and_ends_at_the_bottom() -> None:
    problem = bowl()
    fit = descend(problem, 1e-9, 1e-6, DampingRule())
    assert problem.simulations == 1
    np.testing.assert_allclose(fit.point, problem.middle, atol=1e-8)
    assert fit.expected == pytest.approx(fit.gained)
    assert not fit.converged


def _first_regular(damping: float, least: float) -> float:
    """Damping after a step at the first damping, in the rule's order, that is at least ``least``."""
    rule = DampingRule()
    while damping < least:
        damping = rule.after(damping, lowered=False)
    return rule.after(damping, lowered=True)


@pytest.mark.parametrize(
    ("problem", "tolerance", "stale", "expected"),
    [
        (bowl(), 1.0, False, {"converged": True, "gained": 0.0, "refused": 0.0, "damping": 1e-4}),
        (bowl(lambda t: np.inf), 1e-9, False, {"converged": True, "gained": 0.0, "damping": 1e-4}),
        (bowl(lambda t: np.inf), 1e-9, True, {"converged": False, "expected": np.inf, "damping": 1e-4}),
        (bowl(singular_below=1e-2), 1e-9, False, {"damping": _first_regular(1e-4, 1e-2)}),
    ],
    ids=["too little to gain", "every step diverges", "a stale linearisation is left", "singular until damped"],
)
def test_where_no_step_is_taken(problem: Bowl, tolerance: float, stale: bool, expected: dict[str, float]) -> None:
    fit = descend(problem, 1e-4, tolerance, DampingRule(), stale)
    for name, value in expected.items():
        assert getattr(fit, name) == pytest.approx(value), name
    assert (fit.point is None) == (fit.gained == 0)


@pytest.mark.parametrize("tolerance", [1e-9, 1e-2], ids=["until a step is none", "until it is to gain little"])
def test_a_refused_search_says_what_it_was_to_gain(tolerance: float) -> None:
    problem = bowl(lambda t: np.inf)
    fit = descend(problem, 1e-4, tolerance, DampingRule())
    assert fit.exhausted == (tolerance < 1e-6)
    assert fit.refused == pytest.approx(problem.energy, rel=1e-3)
    assert fit.converged


@pytest.mark.parametrize("kinked", [False, True])
def test_damping_of_earlier_steps_hides_no_kink(kinked: bool) -> None:
    """Where damping promises nothing, one nearly undamped step is tried: it leads on, or a kink is said."""
    problem = bowl((lambda t: np.inf) if kinked else None)
    fit = descend(problem, 1e5, 1e-3, DampingRule())
    assert problem.simulations == 1
    if kinked:
        assert fit.converged
        assert fit.point is None
        assert fit.refused == pytest.approx(problem.energy, rel=1e-3)
    else:
        np.testing.assert_allclose(fit.point, problem.middle, atol=1e-3)
        assert fit.damping < 1e-4
