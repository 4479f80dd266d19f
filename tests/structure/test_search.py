"""The search over structures: what is planted is named, a right model is left as it is, wrong columns are found.

One log each at fixed seeds; rates over many are measured by examples/studies/discover.py.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from sipe_bayes.core.budget import BudgetTooSmall
from sipe_bayes.core.parameters import Parameter
from sipe_bayes.core.trajectory import Trajectories, Trajectory
from sipe_bayes.inference.laplace import Laplace
from sipe_bayes.likelihood import Segments
from sipe_bayes.likelihood.windows import Windows
from sipe_bayes.structure import DiscoverOptions, Extension, Restriction, Structures, discover
from sipe_bayes.structure.columns import Column, channels_of, choices, log_jacobian, moving, unexplained
from sipe_bayes.structure.fitted import FittedStructure
from sipe_bayes.structure.machine import Machine
from sipe_bayes.structure.scores import Pieces
from sipe_bayes.structure.state import DiscoverState, Offer, Phase
from tests.problems.pendulums import log, pendulum

FRICTION = Parameter("friction", 0.0, 0.3, targets=("joint:hinge.frictionloss",))
DRAG = Parameter("drag", 0.0, 0.3, targets=("joint:hinge.damping_quadratic",))
NO_PIECES = Pieces(np.zeros(0), np.zeros(0, np.int64), np.zeros(0))
NAMES = ("dry_friction", "quadratic_damping", "delay", "offset", "spring")


def searched(*recorded: Trajectory, names: tuple[str, ...] = NAMES) -> Structures:
    """Of the plain pendulum, whose mass and damping are unknown."""
    return discover(pendulum(), Trajectories.stack(list(recorded)), restriction=Restriction(only=names))


def test_a_right_model_is_left_as_it_is() -> None:
    structures = searched(log(pendulum(), [0.6, 0.08], 4))
    print(structures.table())
    assert structures.best.labels == ()
    assert structures.weights.tolist() == [1.0] + [0.0] * (len(structures.fitted) - 1)
    assert structures.settled


def test_planted_friction_is_named_and_the_mass_is_right_with_it() -> None:
    """Without it the damping takes its part and lies; averaged over the structures it is what it was."""
    recorded = log(pendulum(FRICTION), [0.6, 0.08, 0.1], 5)
    structures = searched(recorded)
    rows = structures.table()
    print(rows)
    assert structures.best.labels == ("dry_friction:hinge",)
    assert rows[0].sentences == ("dry friction at hinge",)
    assert rows[0].evidence > 20
    assert rows[0].gain > 2 * rows[0].error > 0
    truth = pendulum().space.normalise(np.array([0.6, 0.08]))
    plain, after = structures.posterior_of(structures.plain), structures.posterior
    assert abs(plain.mean[1] - truth[1]) > 3 * plain.stddev[1]
    assert (np.abs(after.mean.numpy() - truth) < 4 * after.stddev.numpy()).all()
    (value,) = structures.posterior_of(structures.best).values(1000).mean(0)[2:]
    assert value == pytest.approx(0.1, rel=0.2)


def test_what_is_not_at_its_optimum_is_fitted_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """A structure behind its part from the part's optimum; a plain model that one outdoes by more than predicted."""
    search = searched(log(pendulum(FRICTION), [0.6, 0.08, 0.1], 5)).search
    begun, fit = list[tuple[Any, Any]](), Laplace.fit
    monkeypatch.setattr(
        Laplace, "fit", lambda m, *a: (begun.append((m.options.initial[0], m.initial_starts)), fit(m, *a))[1]
    )
    fitting, (friction,) = search.fitting, search.structure(["dry_friction:hinge"])
    plain = fitting.fit([], np.array([0.5, 0.5]), 2000)
    initial, begun[:] = np.array([0.5, 0.5, 0.2]), []
    one, close = (fitting.fit([friction], initial, 4000, part=plain, near=near) for near in (False, True))
    best = fitting.fit([friction], initial, 4000, part=replace(plain, evidence=plain.evidence + 1e3))
    assert (one.behind, close.behind, best.behind) == (False, False, True)
    assert best.evidence >= one.evidence > plain.evidence + 20
    there = [*plain.theta, 0.0]  # of the part, without friction
    assert [theta.tolist() for theta, _ in begun] == [initial.tolist(), there, initial.tolist(), there]
    for (_, starts), given in zip(begun, (False, True, False, True), strict=True):
        assert (starts is not None and np.array_equal(starts, plain.starts)) == given
    offer, bad = Offer((), friction.label, 5.0, one.theta[2:], one.theta[:2]), replace(plain, evidence=-1e3)
    state = DiscoverState(Phase.FIT, (bad,), ranked=((),), offers=(offer,), queue=((friction.label,),), budget=30_000)
    anew = search.step(state)
    assert (anew.phase, anew.offers, anew.ranked, anew.placed_at) == (Phase.RANK, (), (), None)
    assert [found.evidence for found in anew.fitted] == [pytest.approx(plain.evidence, abs=1.0)]
    assert anew.rollouts > anew.fitted[0].rollouts + 10


def test_the_set_is_the_same_for_other_seeds_threads_and_a_hundredth_less_of_the_samples() -> None:
    recorded, sets = log(pendulum(FRICTION), [0.6, 0.08, 0.1], 5), []
    for seed, threads, missing in ((0, 1, 0.0), (1, 2, 0.0), (2, 1, 0.0), (0, 1, 0.01), (0, 2, 0.01)):
        lost = np.random.default_rng(seed + threads).random(recorded.observations.shape) < missing
        less = replace(recorded, observations=np.where(lost, np.nan, recorded.observations))
        only = Restriction(only=NAMES)
        found = discover(pendulum(num_threads=threads), Trajectories.stack([less]), restriction=only, seed=seed)
        sets.append([one.labels for one in found.supported])
    assert sets == [sets[0]] * 5


@pytest.fixture(scope="module")
def two_effects() -> Structures:
    """Of a pendulum with dry friction and drag."""
    return searched(log(pendulum(FRICTION, DRAG), [0.6, 0.08, 0.15, 0.06], 6))


def test_two_effects_are_found_one_after_the_other(two_effects: Structures) -> None:
    structures = two_effects
    print(structures.table())
    assert set(structures.best.labels) == {"dry_friction:hinge", "quadratic_damping:hinge"}
    for label, truth in (("dry_friction:hinge", 0.15), ("quadratic_damping:hinge", 0.06)):
        (value,) = structures.posterior_of_piece(label).values(2000).mean(0)
        assert value == pytest.approx(truth, rel=0.25), label


def test_a_piece_is_averaged_over_the_structures_that_have_it(two_effects: Structures) -> None:
    """Each counts with its probability, wherever its parameters stand and however much its bounds cut off."""
    structures, label = two_effects, "dry_friction:hinge"
    having = [one for one in structures.fitted if label in one.labels]
    assert len({one.labels.index(label) for one in having}) > 1  # it stands at different places
    index = [structures.simulator(one).space.index("hinge.dry_friction") for one in having]
    pressed = having[0].mean.copy()
    pressed[index[0]] = 0.0  # half of it is cut off
    having[0] = replace(having[0], mean=pressed)
    tied = Structures(structures.search, structures.state)
    tied.__dict__["weights"] = np.full(len(having), 1 / len(having))
    object.__setattr__(tied, "state", replace(structures.state, fitted=tuple(having)))
    posterior = tied.posterior_of_piece(label)
    means = [0.0, *(one.mean[k] for one, k in zip(having[1:], index[1:], strict=True))]
    assert posterior.means.numpy()[:, 0] == pytest.approx(means)
    assert posterior.probabilities.numpy() == pytest.approx(np.full(len(having), 1 / len(having)))


def test_what_the_same_motion_has_is_not_decided() -> None:
    """A constant force by the motor's zero error or by its bias: two names of one number."""
    offset = Parameter("offset", -0.3, 0.3, targets=("actuator:motor.offset",))
    recorded = log(pendulum(offset), [0.6, 0.08, 0.05], 2)
    structures = searched(recorded, names=("offset", "dry_friction"))
    twin = discover(
        pendulum(),
        Trajectories.stack([recorded]),
        restriction=Restriction(only=("offset",), extra=(f"{__file__}:Bias",)),
    )
    print(twin.table())
    assert structures.inclusion()["offset:motor"] > 0.99
    both = twin.inclusion()
    assert both["offset:motor"] == pytest.approx(0.5, abs=0.1)
    assert both["bias:motor"] == pytest.approx(0.5, abs=0.1)
    assert {one.labels for one in twin.supported} == {("offset:motor",), ("bias:motor",)}


@pytest.mark.parametrize(("factor", "command", "words"), [(-1.0, False, "opposite sign"), (1000.0, True, "thousand")])
def test_a_wrong_column_is_found_before_any_physics_is_blamed(factor: float, command: bool, words: str) -> None:
    recorded = log(pendulum(), [0.6, 0.08], 4)
    channels = tuple(pendulum().environment.channels)
    wrong = replace(recorded, actions=recorded.actions * factor, channels=channels)
    if not command:
        wrong = replace(recorded, observations=recorded.observations * factor, channels=channels)
    structures = searched(wrong, names=("dry_friction",))
    (column,) = structures.state.columns
    print(column.sentence, structures.table())
    assert column.factor == pytest.approx(1 / factor)
    assert words in column.sentence
    assert structures.best.labels == ()


class Bias(Extension):
    """The same constant force as an offset's, by another number."""

    name, kind, reference = "bias", "actuator", "-"

    def sentence(self, site: str) -> str:
        """What it is."""
        return f"a bias of {site}"

    def parameters(self, machine: Machine, site: str) -> tuple[Parameter, ...]:
        """As wide as the offset's."""
        size = machine.commands[site]
        return (Parameter(f"{site}.bias", -size, size, targets=(f"actuator:{site}.bias_force",)),)


def test_what_rests_has_neither_sign_nor_unit() -> None:
    """A channel of noise alone is left unexplained by every model, and no reason to try columns."""
    simulator, moves = pendulum(), log(pendulum(), [0.6, 0.08], 4)
    noise = np.random.default_rng(0).standard_normal(moves.observations.shape)
    rests = replace(moves, observations=0.01 * noise)
    rough = replace(moves, observations=moves.observations + 0.7 * moves.observations.std() * noise)
    for trajectory, expected in ((moves, True), (rests, False), (rough, True)):
        windows = Windows(Segments(0.5), simulator, Trajectories.stack([trajectory]))
        assert moving(windows).tolist() == [expected] * len(windows.channels)
        left = unexplained(windows, windows.spread, moving(windows))
        assert left == (dict.fromkeys(windows.fitted, 1.0) if expected else {})


def test_columns_that_are_tried_in_vain_count() -> None:
    """A log of which no unit or sign explains enough: rollouts go on from what the trials took."""
    moves, done = log(pendulum(), [0.6, 0.08], 4), list[int]()
    noise = 0.5 * np.sin(7 * moves.dt * np.arange(len(moves.observations)))[:, None]
    structures = discover(
        pendulum(),
        Trajectories.stack([replace(moves, observations=noise)]),
        restriction=Restriction(only=("delay",)),
        options=DiscoverOptions(column_gain=1e9),
        progress=lambda _, rollouts, __: done.append(rollouts),
    )
    assert not structures.state.columns
    assert done == sorted(done)
    assert structures.rollouts >= done[-1] > 500
    assert structures.state.column_rollouts > 500 > structures.plain.rollouts
    of_fits = sum(one.rollouts for one in structures.fitted)
    assert structures.rollouts == of_fits + structures.state.column_rollouts + structures.state.rank_rollouts


def test_signs_and_units_leave_the_budget_to_physics() -> None:
    """What is not tried for it is named, and the pieces are ranked all the same."""
    moves = log(pendulum(), [0.6, 0.08], 4)
    noise = 0.5 * np.sin(7 * moves.dt * np.arange(len(moves.observations)))[:, None]
    structures = discover(
        pendulum(),
        Trajectories.stack([replace(moves, observations=noise)]),
        restriction=Restriction(only=("delay",)),
        options=DiscoverOptions(column_gain=1e9, column_budget=150),
        budget=1000,
    )
    assert structures.offers()
    assert structures.settled
    assert 0 < structures.state.column_rollouts <= 0.2 * 1000
    tried = 10 - len(structures.state.untried)
    assert 1 <= tried < 10
    machine = structures.search.given.environment
    assert list(structures.state.untried) == choices(channels_of(machine), dict.fromkeys(machine.channels, 1.0))[tried:]


def test_a_budget_is_a_bound_and_where_it_ends_the_search_is_not_settled() -> None:
    recorded = Trajectories.stack([log(pendulum(FRICTION), [0.6, 0.08, 0.1], 5)])
    given = recorded, Restriction(only=("dry_friction",))
    with pytest.raises(BudgetTooSmall, match="raise"):
        discover(pendulum(), given[0], restriction=given[1], budget=1)
    cuts = []
    for budget in (50, 80, 110, 240):
        structures = discover(pendulum(), given[0], restriction=given[1], budget=budget)
        cuts.append(structures.state.cut)
        assert structures.rollouts <= budget
        assert structures.offers()  # half of it is left to what the model may lack
        assert structures.settled == (cuts[-1] is None)
    print(cuts)
    assert cuts[0] is Phase.FIT
    assert cuts[-1] is None


@pytest.mark.parametrize("same", [True, False])
def test_held_out_logs_speak_against_what_only_one_log_has(same: bool) -> None:
    """A machine that rubbed on one day and not on the other: friction is no part of it."""
    other, done = log(pendulum(FRICTION), [0.6, 0.08, 0.1 if same else 0.0], 12), list[int]()
    structures = discover(
        pendulum(),
        Trajectories.stack([log(pendulum(FRICTION), [0.6, 0.08, 0.1], 5)]),
        holdout=Trajectories.stack([other]),
        restriction=Restriction(only=("dry_friction", "delay")),
        progress=lambda _, rollouts, __: done.append(rollouts),
    )
    assert done == sorted(done)
    label = ("dry_friction:hinge",)
    print(structures.table())
    assert structures.best.labels == (label if same else ())
    rubbing = structures.state.of(label)
    assert rubbing is not None
    gains = rubbing.held.density - structures.plain.held.density
    assert gains[rubbing.held.log == 0].sum() > 10
    assert (gains[rubbing.held.log == 1].sum() > 0) == same


def test_a_long_log_is_searched_on_blocks_of_it() -> None:
    recorded = log(pendulum(FRICTION), [0.6, 0.08, 0.1], 5)
    half = len(recorded) * recorded.dt / 2
    structures = discover(
        pendulum(),
        Trajectories.stack([recorded]),
        likelihood=Segments(0.5),
        restriction=Restriction(only=("dry_friction",)),
        options=DiscoverOptions(physics_steps=round(half / pendulum().model.opt.timestep)),
    )
    windows = structures.search.fitting.windows(structures.simulator(structures.plain))
    assert (windows.steps * windows.dt).sum() == pytest.approx(half, rel=0.15)
    assert structures.best.labels == ("dry_friction:hinge",)


def test_a_unit_is_judged_by_the_samples_that_are_fitted_alone() -> None:
    """The fit leaves most of a long log out, and the plain model follows nothing: no unit is to blame for that."""
    gravity = Parameter("spring", 0.0, 30.0, targets=("joint:hinge.stiffness",))
    recorded = log(pendulum(gravity), [0.6, 0.02, 8.0], 8, steps=2000)
    structures = discover(
        pendulum(),
        Trajectories.stack([recorded]),
        restriction=Restriction(only=("dry_friction",)),
        options=DiscoverOptions(physics_steps=500),
    )
    windows = structures.search.given.windows(structures.search.given.simulator([]))
    (name,) = windows.fitted
    assert max(unexplained(windows, structures.plain.sd, moving(windows)).values()) > structures.search.options.gross
    assert structures.columns == ()
    few = log_jacobian(windows, Column(name, False, 1000.0)) / np.log(1000.0)
    assert few == pytest.approx(500, rel=0.2)
    assert log_jacobian(windows, Column("motor", True, 1000.0)) == 0.0


def test_noise_does_not_keep_a_sign_from_being_set_right() -> None:
    """A third of the channel's spread is noise, which no sign explains."""
    recorded = log(pendulum(), [0.6, 0.08], 4, sd=0.0)
    size = 0.35 * recorded.observations.std()
    noise = size * np.random.default_rng(1).standard_normal(recorded.observations.shape)
    turned = replace(recorded, observations=-(recorded.observations + noise))
    assert [column.factor for column in searched(turned, names=("spring",)).columns] == [-1.0]


def test_a_larger_budget_begins_anew_where_the_smaller_one_told_the_beginning_short() -> None:
    """A plain fit that had not come to rest in its share, or columns that were not tried; else it goes on."""
    plain = FittedStructure(
        (), np.zeros(1), np.zeros(1), np.eye(1), np.zeros(0), np.zeros(0), np.zeros(0), 0.0, NO_PIECES, 7, settled=True
    )
    state = DiscoverState(phase=Phase.FIT, fitted=(plain,), queue=(("a",),), budget=100)
    assert state.with_budget(200, 150) == replace(state, budget=200)
    unsettled = replace(state, fitted=(replace(plain, settled=False),))
    assert unsettled.with_budget(200, 150) == DiscoverState(budget=200)
    assert unsettled.with_budget(200, 80).fitted == unsettled.fitted  # it had all that a fit may have
    assert unsettled.with_budget(100, 150).fitted == unsettled.fitted  # an interruption, not a larger budget
    untried = replace(state, untried=(Column("angle", False, -1.0),))
    assert untried.with_budget(200, 150) == DiscoverState(budget=200)
