"""Sim2sim transfer: what an agent earns in the target after training where an estimator believes the target to be.

B. Mehta, A. Handa, D. Fox, F. Ramos 2020, "A User's Guide to Calibrating Robotics Simulators", Section 3.4 and Figure 6
(https://arxiv.org/abs/2011.08985). The target is an environment whose theta is hidden. Each *randomisation* is a
distribution over theta; an agent is trained by DDPG, every episode of it under a draw of its own
(``sipe_bayes.rl.randomization``), and the agent is then evaluated in the target as it is, zero-shot:

- truth: the target itself, the oracle, by whose return the others are measured;
- prior: uniform domain randomisation, the baseline;
- default: the published model, what one has without calibrating;
- an estimator's name: the posterior that the benchmark's cell TASK/ESTIMATOR/direct/VARIANT/seedK came to, as the draws
  that its record keeps, which are particles. The cell is measured first where it is not there.

All of them train with equal settings, for equally many control steps, from the same seed. Of the second half of a
training that policy is kept which earns most in episodes of its own randomisation, ten theta of it, which are the same
with every seed; the target is never looked at for it, but that the oracle's own randomisation is the target. The curve
in the target is made afterwards. Where two cells ask for the same training, as the prior does on both variants, it is
made once, so that their results are not independent.

Variations of a randomisation, the truth's excepted: ``observation_noise`` and ``action_delay``; and of an estimator's
``wider`` (``Posterior.wider``) and, to tell what of a posterior it is that helps, ``point`` ("mean": its mean alone)
and ``particles`` (so many of its draws). The study has both of one estimator whose posteriors are wide.

Deviations:

- The paper trains on the default model's variants, which it does not name; here the target is the default or the
  in-distribution variant, whose theta no prior mean guesses. It has neither the prior nor the default model in its
  figure.
- The agents are small, as many are trained: one hidden layer of 128 units, two of 64 on Pendulum and CartPole, two of
  128 on tasks with goals, and less than an update for a control step.
- Those on tasks with goals learn with the settings of hindsight experience replay (Andrychowicz et al. 2017,
  https://arxiv.org/abs/1707.01495). FetchPush's and FetchPickAndPlace's have 100 scripted demonstrations in the buffer,
  made in simulators drawn from the posterior that they train under, without noise and delay: of the target they show no
  more than that knows; in the benchmark's cells with a policy they are drawn from the prior. FetchSlide's have none, as
  the script's hit fits one friction alone.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar

from sipe_bayes.benchmark.cells import PAPER, Cell, Suite, Value, matching, suite
from sipe_bayes.benchmark.records import Record, RecordError
from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.datasets.trajectory_sets import TASKS as NINE
from sipe_bayes.envs.registry import TASKS, make_task
from sipe_bayes.envs.task import VARIANTS, Task, Variant
from sipe_bayes.inference.registry import ESTIMATORS
from sipe_bayes.posterior import Posterior
from sipe_bayes.rl.evaluation import Evaluation
from sipe_bayes.rl.settings import Settings
from sipe_bayes.simulation.simulator import Simulator

SETTING = "transfer"
TRUTH, PRIOR, DEFAULT = "truth", "prior", "default"
REFERENCES = (TRUTH, PRIOR, DEFAULT)
_VARIANTS: tuple[Variant, ...] = ("default", "in_distribution")
_DEMONSTRATED = ("FetchPush", "FetchPickAndPlace")
_SMALL = ("Pendulum", "CartPole")
_STUDY = ("HalfCheetahLinks", "HalfCheetahJoints", "FetchPush")
_REDUCED = "bayessim"  # also by its mean, and by a few particles
_REDUCING = {"point", "particles"}  # variations
DISTURBING = {"observation_noise", "action_delay"}  # variations that leave the parameters alone


@dataclass(frozen=True)
class Sizes:
    """How much the transfer measures.

    Args:
        episodes: in the target, of the policy that is kept.
        points: of a learning curve, at most one for as many control steps as an episode has.
        point_episodes: of each of them.
        steps: control steps of a training.
        small_steps: of one on Pendulum or CartPole.
        demonstrations: that an agent is shown, where it is shown any.
        demonstration_share: of a batch.
        particles: of the posterior that is reduced to a few.
    """

    episodes: int = 50
    points: int = 20
    point_episodes: int = 10
    steps: int = 150_000
    small_steps: int = 20_000
    demonstrations: int = 100
    demonstration_share: float = 0.3
    particles: int = 10


SIZES = Sizes()
_SMALL_AGENT = Settings(
    hidden=(64, 64), batch=128, learning_rate=1e-3, start_steps=1_000, lanes=4, updates_per_step=0.5
)
_AGENT = Settings(
    hidden=(128,), learning_rate=1e-3, start_steps=5_000, normalise=True, layer_norm=True, lanes=8, updates_per_step=0.5
)
_GOAL_AGENT = Settings(
    hidden=(128, 128),
    discount=0.95,
    tau=0.05,
    learning_rate=1e-3,
    exploration=0.2,
    start_steps=1_000,
    normalise=True,
    lanes=16,
    updates_per_step=0.4,
    clip_targets=True,
    action_penalty=0.1,
    random_share=0.3,
)


@dataclass(frozen=True)
class Point:
    """Of a learning curve: the control step, and what the policy earned there.

    Args:
        step: of the training.
        own_return: in simulators drawn from the randomisation.
        target_return: in the target.
        target_success: share of episodes; None where only the return counts.
    """

    step: int
    own_return: float
    target_return: float
    target_success: float | None = None


@dataclass(frozen=True)
class TransferRecord(Record):
    """Of one agent; as ``Record``, whose ``estimator`` is the randomisation here, with what is added.

    ``setting`` is "transfer" with its variations, and ``values`` holds them; ``mean`` and ``sd`` are those of the
    randomisation, ``seconds`` those of the training. ``converged`` says whether the policy solves simulators drawn from
    the randomisation, ``solved_reference`` whether it solves the target.

    Args:
        evaluation: of the policy, in the target.
        random: the same of a policy that acts at random.
        curve: along the training.
        kept: the step of the evaluated policy.
        redrawn: theta that no model can have, in training.
        diverged: episodes, in training.
    """

    FOLDER: ClassVar[str] = "transfer"
    NONE: ClassVar[str] = "no transfer; make one with `sipe transfer run --suite quick"
    NEVER: ClassVar[str] = "no transfer was started in it; start one with `sipe transfer run --suite quick"

    evaluation: Evaluation | None = None
    random: Evaluation | None = None
    curve: list[Point] = field(default_factory=list)
    kept: int = 0
    redrawn: int = 0
    diverged: int = 0

    @property
    def earned(self) -> Evaluation:
        """The evaluation of a finished cell; raises RecordError where there is none."""
        return self._evaluated(self.evaluation)

    @property
    def earned_at_random(self) -> Evaluation:
        """What a random policy earns in a finished cell's target; raises RecordError where it is not known."""
        return self._evaluated(self.random)

    def _evaluated(self, evaluation: Evaluation | None) -> Evaluation:
        if evaluation is None:
            raise RecordError(f"{self.id}: has no evaluation; run it again with --retry-failed")
        return evaluation


def cells(
    tasks: Iterable[str],
    randomizations: Iterable[str],
    variants: Iterable[Variant] = _VARIANTS,
    seeds: Iterable[int] = range(3),
) -> Iterator[Cell]:
    """The cells of these tasks; on the default variant the default model is the truth and stands there once.

    Args:
        tasks: which environments.
        randomizations: references and estimators.
        variants: of the target.
        seeds: of estimates and trainings.
    """
    for task, variant, seed, name in itertools.product(tasks, variants, seeds, list(randomizations)):
        if not (name == DEFAULT and variant == "default"):
            training = SIZES.small_steps if task in _SMALL else SIZES.steps
            yield Cell(task, name, SETTING, variant, seed, training=training)


def reduced(tasks: Iterable[str]) -> Iterator[Cell]:
    """One estimator's posterior as a point and as a few particles."""
    for cell in cells(tasks, (_REDUCED,), ("in_distribution",)):
        yield from varied([cell], point="mean")
        yield from varied([cell], particles=SIZES.particles)


def settings(task: Task, training: int) -> Settings:
    """How an agent learns a task; the same for every randomisation.

    Args:
        task: which.
        training: control steps.
    """
    chosen = _GOAL_AGENT if task.goal_size else _SMALL_AGENT if task.name in _SMALL else _AGENT
    return replace(
        chosen,
        demonstration_share=SIZES.demonstration_share if task.name in _DEMONSTRATED else 0.0,
        start_steps=min(chosen.start_steps, training // 4),
        capacity=max(training, 2 * chosen.lanes * (task.episode_steps + 1)) + chosen.lanes,
    )


SUITES = {
    "quick": Suite(
        "Pendulum's in-distribution variant, one seed: the references, laplace and regression",
        lambda: cells(("Pendulum",), (*REFERENCES, "laplace", "regression"), ("in_distribution",), (0,)),
    ),
    "study": Suite(
        f"{', '.join(_STUDY)}: the references, the paper's estimators, npe and laplace; {_REDUCED} also as a point and "
        "as particles",
        lambda: itertools.chain(cells(_STUDY, (*REFERENCES, *PAPER, "npe", "laplace")), reduced(_STUDY)),
    ),
    "nine": Suite(
        "the same on the paper's nine environments", lambda: cells(NINE, (*REFERENCES, *PAPER, "npe", "laplace"))
    ),
    "all": Suite("every task and estimator there is; to select from", lambda: cells(TASKS, (*REFERENCES, *ESTIMATORS))),
}


def select(name: str, patterns: Sequence[str] = ()) -> list[Cell]:
    """The cells of a suite whose id matches one of the patterns, as of `sipe benchmark run`.

    Args:
        name: of the suite.
        patterns: none for all cells.

    Raises:
        ValueError: for an unknown suite and for a pattern that matches none.
    """
    cells = suite(name, SUITES)
    such = f"matches no cell of the suite {name}, such as {cells[0].id}; see `sipe transfer cells {name}`"
    return matching(cells, patterns, lambda _: such)


def varied(chosen: Sequence[Cell], **variations: float | str | None) -> list[Cell]:
    """The cells with variations of their randomisation, each once.

    The truth has none, default model and prior only noise and delay.

    Args:
        chosen: which cells.
        **variations: see the module; None leaves one out.
    """
    given = {name: value for name, value in variations.items() if value is not None}
    return list(dict.fromkeys(replace(cell, values=_values(cell, given)) for cell in chosen))


def _values(cell: Cell, given: Mapping[str, Value]) -> tuple[tuple[str, Value], ...]:
    if cell.estimator == TRUTH:
        return ()
    if cell.estimator in REFERENCES:
        given = {name: value for name, value in given.items() if name in DISTURBING}
    before = dict(cell.values)
    if _REDUCING & given.keys():
        before = {name: value for name, value in before.items() if name not in _REDUCING}
    return tuple({**before, **given}.items())


def trained_as(cell: Cell) -> Cell:
    """The cell whose training is the same.

    The prior knows no variant, and to train in the default model is to train in the truth of the default variant.
    """
    if cell.estimator == DEFAULT and not cell.values:  # the truth has no variations
        return replace(cell, estimator=TRUTH, variant="default")
    return replace(cell, variant="default") if cell.estimator in (PRIOR, DEFAULT) else cell


def estimate_of(cell: Cell) -> Cell | None:
    """The benchmark's cell whose posterior a cell randomises by, None of a reference."""
    return None if cell.estimator in REFERENCES else replace(cell, setting="direct", values=(), training=Cell.training)


def cell_of(record: TransferRecord) -> Cell:
    """The cell that a record is of."""
    variant = next(v for v in VARIANTS if v == record.variant)
    what = (record.task, record.estimator, SETTING, variant, record.seed)
    return Cell(*what, tuple(record.values.items()), record.budget, record.steps, record.training)


def agent_of(cell: Cell) -> Settings:
    """How the agent of a cell learns."""
    return settings(make_task(cell.task), cell.training)


def demonstrations_of(cell: Cell, simulator: Simulator, posterior: Posterior) -> Trajectories | None:
    """What the agent of a cell learns from besides.

    Args:
        cell: whose agent.
        simulator: of its task.
        posterior: that the demonstrations' theta are drawn from.

    Returns:
        Demonstrations; None where nothing is shown.

    Raises:
        RuntimeError: where hardly any attempt succeeds.
    """
    if not agent_of(cell).demonstration_share:
        return None
    from sipe_bayes.rl import scripted
    from sipe_bayes.rl.demonstrate import demonstrate
    from sipe_bayes.rl.randomization import Draws

    act, draws = scripted.demonstrator(make_task(cell.task)), Draws(simulator, posterior)
    return demonstrate(simulator, act, SIZES.demonstrations, cell.seed, draws).trajectories
