"""Cells: what the benchmark measures, one estimate each, and the suites made of them.

The benchmark of B. Mehta, A. Handa, D. Fox, F. Ramos 2020, "A User's Guide to Calibrating Robotics Simulators"
(https://arxiv.org/abs/2011.08985): an estimator gets trajectories of an environment whose theta is hidden. Its
settings:

- direct: one recorded trajectory; the estimator compares states;
- learned_reward: as direct, but a discriminator's reward takes the place of the difference of states;
- policy, policy_learned_reward: the trajectories come from an agent that is trained meanwhile
  (``rl.policy_in_the_loop``);
- gradient_steps: MAML with 0 to 10 of them at test time;
- sweep: the grid of the paper's search over hyper-parameters, tuned by mean accuracy on validation trajectories of
  FetchPush and Relocate;
- rollouts: direct with other budgets, for accuracy against rollouts.

Tasks and estimators come from their registries, and which settings an estimator has follows from its arguments: a new
method is its file and one line. The prior, its mean and ``laplace`` on full states are cells of every suite: no table
and no plot stands without them.

Deviations:

- The paper sweeps and runs its ablation on unnamed variants; here they are the in-distribution one, as the default
  model lies at the centre of the range, where knowing nothing is a perfect guess.
- Its five environments with a policy are not all named; here they are one of each kind.
- Its search is taken as a full grid, without the combinations in which a value has no effect.
- The settings with a policy train the agents of ``benchmark.transfer``.
- The humanoid's and the hand's trajectories take 100 control steps, not 250 and 200: each costs about a millisecond of
  CPU, ten times a half-cheetah's, and the first 100 determine what all do (``benchmark.log``), but for Door's frame in
  one of the logs.
"""

from __future__ import annotations

import fnmatch
import itertools
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from sipe_bayes.core.validation import nearest_name
from sipe_bayes.datasets.acting import Split
from sipe_bayes.datasets.demonstrations import default_steps
from sipe_bayes.datasets.trajectory_sets import TASKS as NINE
from sipe_bayes.envs.registry import TASKS, make_task
from sipe_bayes.envs.task import VARIANTS, Variant
from sipe_bayes.inference.registry import ESTIMATORS, arguments

BASELINES = ("prior", "prior_mean")
PAPER = ("regression", "bayesopt", "maml", "simopt", "adr", "bayessim")
REFERENCE = "laplace"
_BESIDE = (REFERENCE, "npe")  # measured beside the paper's
_WITH_POLICY = ("FetchPush", "Relocate", "Door", "HalfCheetahLinks", "HumanoidLinks")
_TUNED_ON = ("FetchPush", "Relocate")
_COSTLY = ("HumanoidLinks", "HumanoidJoints", "Door", "Relocate")

Value = bool | int | float | str
"""Of an estimator's argument, as JSON keeps it."""


@dataclass(frozen=True)
class Sizes:
    """How much the suites measure.

    Args:
        seeds: of estimators and trajectories.
        gradient_steps: of MAML, at test time.
        budgets: rollouts, of the setting of that name.
        costly_steps: control steps of the humanoid's and the hand's trajectories.
        quick_budget: rollouts of a cell of the suite "quick".
        quick_steps: control steps of its trajectories.
    """

    seeds: Sequence[int] = range(3)
    gradient_steps: Sequence[int] = range(11)
    budgets: Sequence[int] = (100, 300, 1000, 3000)
    costly_steps: int = 100
    quick_budget: int = 200
    quick_steps: int = 50


SIZES = Sizes()
GRIDS: dict[str, tuple[dict[str, Sequence[Value]], ...]] = {  # the paper's appendix
    "regression": ({"batch": (320, 160, 80, 40), "learning_rate": (0.001, 0.01, 0.05, 0.005)},),
    "bayesopt": (
        {"acquisition": ("upper_confidence_bound",), "kappa": (2.5, 5.0, 10.0, 1.0, 0.5)},
        {"acquisition": ("expected_improvement",), "xi": (0.0, 0.5, 1.0)},
    ),
    "maml": ({"hidden": (40, 60, 100), "learning_rate": (0.001, 0.005, 0.0001)},),
    "simopt": (
        {
            "updates": (4, 8, 12),
            "particles": (4, 6, 8),
            "initial_mean": (1.0, 0.5),
            "initial_variance": (0.05, 0.1, 0.2),
        },
    ),
    "adr": (
        {"particles": (4, 6, 8, 10)},
        {"particles": (4, 6, 8, 10), "reward": ("learned",), "learning_rate": (0.001, 0.005)},
    ),
}


@dataclass(frozen=True)
class Cell:
    """One estimate.

    Args:
        task: of ``sipe envs``.
        estimator: its name, or that of a baseline.
        setting: see the module.
        variant: of the environment whose theta is hidden.
        seed: of the estimator and the trajectory.
        values: what is set of the estimator.
        budget: rollouts.
        steps: control steps of the trajectory; None for an episode or its first 250, the humanoid's and the hand's
            first 100.
        training: control steps of the agent's training, of the settings with a policy.
        device: that simulates, as ``Simulator`` has them.
    """

    task: str
    estimator: str
    setting: str = "direct"
    variant: Variant = "in_distribution"
    seed: int = 0
    values: tuple[tuple[str, Value], ...] = ()
    budget: int = 1000
    steps: int | None = None
    training: int = 100_000
    device: str = "cpu"

    @property
    def id(self) -> str:
        """Such as ``HalfCheetahLinks/bayessim/direct/in_distribution/seed0``."""
        return f"{self.task}/{self.estimator}/{self.label}/{self.variant}/seed{self.seed}"

    @property
    def label(self) -> str:
        """The setting with what is set of the estimator."""
        if self.setting == "gradient_steps":
            return f"gradient_steps={dict(self.values)['gradient_steps']}"
        if self.setting == "rollouts":
            return f"rollouts={self.budget}"
        return ",".join([self.setting, *(f"{name}={value}" for name, value in self.values)])

    @property
    def horizon(self) -> int:
        """Control steps of the trajectory."""
        task = make_task(self.task)
        if self.steps is None:
            return SIZES.costly_steps if self.task in _COSTLY else default_steps(task)
        return min(self.steps, task.episode_steps)

    @property
    def with_policy(self) -> bool:
        """Whether an agent is trained meanwhile."""
        return self.setting.startswith("policy")

    @property
    def split(self) -> Split:
        """Of the trajectories: what is tuned never sees those that the results come from."""
        return "validation" if self.setting == "sweep" else "reference"

    @property
    def settings(self) -> dict[str, Value]:
        """Arguments of the estimator."""
        learned: dict[str, Value] = {"reward": "learned"} if self.setting.endswith("learned_reward") else {}
        return {**learned, **dict(self.values)}


@dataclass(frozen=True)
class Suite:
    """Cells under one name, and what they are."""

    about: str
    cells: Callable[[], Iterator[Cell]]


def direct(
    tasks: Iterable[str], estimators: Iterable[str], variants: Iterable[Variant], seeds: Iterable[int] = SIZES.seeds
) -> Iterator[Cell]:
    """Cells of the direct setting.

    Args:
        tasks: which environments.
        estimators: which methods and baselines.
        variants: of the environments.
        seeds: which.
    """
    for task, variant, seed, estimator in itertools.product(tasks, variants, seeds, list(estimators)):
        yield Cell(task, estimator, "direct", variant, seed)


def referenced(cells: Iterable[Cell]) -> Iterator[Cell]:
    """Cells of other settings after those of the direct one that they are held against."""
    own = list(cells)
    for task, variant, seed in dict.fromkeys((cell.task, cell.variant, cell.seed) for cell in own):
        yield from direct((task,), (*BASELINES, REFERENCE), (variant,), (seed,))
    yield from own


def of_setting(tasks: Iterable[str], estimators: Iterable[str], setting: str = "policy") -> Iterator[Cell]:
    """Cells of a setting, in distribution; with "policy" those in which an agent is trained meanwhile."""
    for task, seed, estimator in itertools.product(tasks, SIZES.seeds, list(estimators)):
        yield Cell(task, estimator, setting, seed=seed)


def learned(tasks: Iterable[str], estimators: Iterable[str], setting: str = "learned_reward") -> Iterator[Cell]:
    """Cells of those estimators that can learn a reward.

    Args:
        tasks: which environments.
        estimators: which methods.
        setting: with a policy or without.
    """
    chosen = [name for name in estimators if "reward" in arguments(name)]
    return of_setting(tasks, chosen, setting)


def gradient_steps(tasks: Iterable[str]) -> Iterator[Cell]:
    """Cells of those estimators that take gradient steps at test time."""
    chosen = [name for name in ESTIMATORS if "gradient_steps" in arguments(name)]
    for task, seed, estimator, steps in itertools.product(tasks, SIZES.seeds, chosen, SIZES.gradient_steps):
        yield Cell(task, estimator, "gradient_steps", seed=seed, values=(("gradient_steps", steps),))


def sweep() -> Iterator[Cell]:
    """Cells of the search over hyper-parameters."""
    for task, seed, (estimator, grids) in itertools.product(_TUNED_ON, SIZES.seeds, GRIDS.items()):
        for grid in grids:
            for values in itertools.product(*grid.values()):
                yield Cell(task, estimator, "sweep", seed=seed, values=tuple(zip(grid, values, strict=True)))


def rollouts() -> Iterator[Cell]:
    """Cells of every estimator with several budgets."""
    tasks = ("FetchPush", "HalfCheetahLinks")
    for task, seed, estimator, budget in itertools.product(tasks, SIZES.seeds, ESTIMATORS, SIZES.budgets):
        yield Cell(task, estimator, "rollouts", seed=seed, budget=budget)


def _quick() -> Iterator[Cell]:
    chosen = (*BASELINES, "laplace", "npe", "bayessim", "regression", "simopt", "adr")
    for cell in direct(("FetchPush", "Door", "HalfCheetahLinks"), chosen, ("in_distribution",), (0,)):
        yield replace(cell, budget=SIZES.quick_budget, steps=SIZES.quick_steps)


def _direct_suite() -> Iterator[Cell]:
    return direct(NINE, (*BASELINES, *PAPER, *_BESIDE), VARIANTS)


def _paper() -> Iterator[Cell]:
    yield from _direct_suite()
    yield from learned(NINE, ("simopt", "adr"))
    yield from gradient_steps(NINE)
    yield from _policy_suite()


def _policy_suite() -> Iterator[Cell]:
    yield from of_setting(_WITH_POLICY, ("regression", "bayesopt", "maml", "simopt", "adr"))
    yield from learned(_WITH_POLICY, ("simopt", "adr"), "policy_learned_reward")


def _all() -> Iterator[Cell]:
    yield from direct(TASKS, (*BASELINES, *ESTIMATORS), VARIANTS)
    yield from learned(TASKS, ESTIMATORS)
    yield from gradient_steps(TASKS)
    yield from of_setting(TASKS, ESTIMATORS)
    yield from learned(TASKS, ESTIMATORS, "policy_learned_reward")
    yield from rollouts()
    yield from sweep()


SUITES = {
    "quick": Suite("three environments, six estimators, one seed, 200 rollouts of 50 control steps", _quick),
    "paper": Suite("direct, learned_reward, gradient_steps and policy", _paper),
    "direct": Suite("nine environments, the paper's estimators, laplace and npe, three variants", _direct_suite),
    "learned_reward": Suite(
        "simopt and adr on nine environments", lambda: referenced(learned(NINE, ("simopt", "adr")))
    ),
    "gradient_steps": Suite(
        "MAML with 0 to 10 steps at test time on nine environments", lambda: referenced(gradient_steps(NINE))
    ),
    "policy": Suite(
        "five estimators on five environments, simopt and adr also with learned rewards",
        lambda: referenced(_policy_suite()),
    ),
    "rollouts": Suite("every estimator with 100 to 3,000 rollouts on two environments", lambda: referenced(rollouts())),
    "sweep": Suite(
        "the hyper-parameters of the paper's appendix, on validation trajectories", lambda: referenced(sweep())
    ),
    "all": Suite("every task and estimator there is, in every setting; to select from", _all),
}


def suite(name: str, suites: Mapping[str, Suite] = SUITES) -> list[Cell]:
    """The cells of a suite.

    Raises:
        ValueError: for an unknown one.
    """
    if name not in suites:
        raise ValueError(f"--suite {name}: expected one of {', '.join(suites)}")
    return list(suites[name].cells())


def select(name: str, patterns: Sequence[str] = ()) -> list[Cell]:
    """The cells of a suite whose id matches one of the patterns.

    A pattern is a shell's (``half_cheetah*/adr/*``); capitals and underscores do not count, and it may stop at any
    ``/``.

    Args:
        name: of the suite.
        patterns: none for all cells.

    Raises:
        ValueError: for an unknown suite, and for a pattern that matches none.
    """
    cells = suite(name)
    return matching(cells, patterns, lambda pattern: _no_match(name, cells, pattern))


def matching(cells: list[Cell], patterns: Sequence[str], no_match: Callable[[str], str]) -> list[Cell]:
    """Cells whose id matches one of the patterns.

    Args:
        cells: to choose from.
        patterns: none for all cells.
        no_match: what is said of a pattern that matches none.

    Raises:
        ValueError: for such a pattern.
    """
    for pattern in patterns:
        if not any(matches(cell.id, pattern) for cell in cells):
            raise ValueError(f"--select {pattern}: {no_match(pattern)}")
    return [cell for cell in cells if not patterns or any(matches(cell.id, pattern) for pattern in patterns)]


def matches(cell_id: str, pattern: str) -> bool:
    """Whether a cell's id matches a pattern of ``select``."""
    plain, wanted = _plain(cell_id), _plain(pattern).rstrip("/")
    return fnmatch.fnmatchcase(plain, wanted) or fnmatch.fnmatchcase(plain, wanted + "/*")


def changed(
    cells: Sequence[Cell],
    budget: int | None = None,
    steps: int | None = None,
    training: int | None = None,
    device: str = "cpu",
) -> list[Cell]:
    """Cells with another budget, length, training or device, where one is given.

    Args:
        cells: which cells.
        budget: rollouts.
        steps: control steps of the trajectory.
        training: control steps of the agent's training.
        device: that simulates, as ``Simulator`` has them.
    """
    asked = {"budget": budget, "steps": steps, "training": training, "device": device}
    given: dict[str, Any] = {name: value for name, value in asked.items() if value is not None}
    return [replace(cell, **given) for cell in cells]


def _plain(text: str) -> str:
    return text.lower().replace("_", "")


def _no_match(name: str, cells: list[Cell], pattern: str) -> str:
    elsewhere = next((other for other in SUITES if any(matches(c.id, pattern) for c in suite(other))), None)
    if elsewhere is not None:
        return f"matches no cell of the suite {name}; take --suite {elsewhere}"
    return f"matches no cell of any suite{nearest_name(pattern, [cell.id for cell in cells], 0.0)}"
