"""The search over structures: what is planted is named, a right model is left as it is.

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
from sipe_bayes.likelihood import Noise, Segments
from sipe_bayes.posterior import Posterior
from sipe_bayes.structure import DiscoverOptions, Extension, Restriction, Structures, discover
from sipe_bayes.structure.fitted import FittedStructure
from sipe_bayes.structure.machine import Machine
from sipe_bayes.structure.scores import Pieces
from sipe_bayes.structure.state import DiscoverState, Offer, Phase
from tests.problems.pendulums import log, pendulum

FRICTION = Parameter("friction", 0.0, 0.3, targets=("joint:hinge.frictionloss",))
DRAG = Parameter("drag", 0.0, 0.3, targets=("joint:hinge.damping_quadratic",))
NO_PIECES, WHITE = Pieces(np.zeros(0), np.zeros(0, np.int64), np.zeros(0)), Noise(np.zeros(0), np.zeros(0))
NAMES = ("dry_friction", "quadratic_damping", "delay", "offset", "spring")


def searched(*recorded: Trajectory, names: tuple[str, ...] = NAMES) -> Structures:
    """Of the plain pendulum, whose mass and damping are unknown."""
    return discover(pendulum(), Trajectories.stack(list(recorded)), restriction=Restriction(only=names))


def test_a_right_model_is_left_as_it_is() -> None:
    structures = searched(log(pendulum(), [0.6, 0.08], 4))
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

    def fitted(method: Laplace, *given: Any) -> Posterior:
        begun.append((method.options.initial[0], method.initial_starts))  # type: ignore[index]
        return fit(method, *given)

    monkeypatch.setattr(Laplace, "fit", fitted)
    fitting, (friction,) = search.fitting, search.structure(["dry_friction:hinge"])
    plain = fitting.fit([], np.array([0.5, 0.5]), 2000)
    initial, begun[:] = np.array([0.5, 0.5, 0.2]), []
    one, close = (fitting.fit([friction], initial, 4000, begin=begin, part=plain) for begin in (None, plain))
    best = fitting.fit([friction], initial, 4000, part=replace(plain, evidence=plain.evidence + 1e3))
    assert best.evidence >= one.evidence > plain.evidence + 20
    assert close.evidence == pytest.approx(one.evidence, abs=1.0)
    there = [*plain.theta, 0.0]  # of the part, without friction
    assert [theta.tolist() for theta, _ in begun] == [initial.tolist()] * 3 + [there]
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
    assert set(structures.best.labels) == {"dry_friction:hinge", "quadratic_damping:hinge"}
    for label, truth in (("dry_friction:hinge", 0.15), ("quadratic_damping:hinge", 0.06)):
        (value,) = structures.posterior_of_piece(label).values(2000).mean(0)
        assert value == pytest.approx(truth, rel=0.25), label


def test_a_piece_is_averaged_over_the_structures_that_have_it(two_effects: Structures) -> None:
    """Each counts with its probability, wherever its parameters stand and however much its bounds cut off."""
    structures, label = two_effects, "dry_friction:hinge"
    alone = structures.search.fitting.fit(structures.search.structure([label]), None, 4000)
    having = [one for one in (*structures.fitted, alone) if label in one.labels]
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


def test_a_larger_budget_begins_anew_where_the_smaller_one_told_the_beginning_short() -> None:
    """A plain fit that had not come to rest in its share; else it goes on."""
    plain = FittedStructure(
        (), np.zeros(1), np.zeros(1), np.eye(1), WHITE, np.zeros(0), 0.0, NO_PIECES, 7, settled=True
    )
    state = DiscoverState(phase=Phase.FIT, fitted=(plain,), queue=(("a",),), budget=100)
    assert state.with_budget(200, 150) == replace(state, budget=200)
    unsettled = replace(state, fitted=(replace(plain, settled=False),))
    assert unsettled.with_budget(200, 150) == DiscoverState(budget=200)
    assert unsettled.with_budget(200, 80).fitted == unsettled.fitted  # it had all that a fit may have
    assert unsettled.with_budget(100, 150).fitted == unsettled.fitted  # an interruption, not a larger budget


def test_what_an_extension_is_worth_is_known_before_a_fit_without_it(two_effects: Structures) -> None:
    """In the order that fits find, which take many times as many rollouts; nothing of a useless one."""
    structures = two_effects
    fitting, every = structures.search.fitting, structures.search.structure([*structures.best.labels, "spring:hinge"])
    one = fitting.fit(every, None, 4000)
    needs, rollouts = fitting.needs(every, one)
    fits = [fitting.fit([piece for piece in every if piece is not left], None, 4000) for left in every]
    worse = {left.label: one.evidence - fit.evidence for left, fit in zip(every, fits, strict=True)}
    print(needs, worse)
    assert rollouts < min(fit.rollouts for fit in fits) / 3
    assert sorted(needs, key=lambda label: needs[label]) == sorted(needs, key=lambda label: worse[label])
    assert needs["spring:hinge"] < 5 < 20 < min(needs[label] for label in structures.best.labels)
