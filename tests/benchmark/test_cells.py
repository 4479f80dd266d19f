"""What the benchmark's cells and suites are."""

import pytest

from sipe_bayes.benchmark import cells
from sipe_bayes.benchmark.cells import NINE, SUITES, Cell, matches, select, suite
from sipe_bayes.inference.registry import ESTIMATORS, estimator_class


def test_ids_name_a_cell_once() -> None:
    every = suite("all")
    assert len({cell.id for cell in every}) == len(every)
    for name in SUITES:
        assert {cell.id for cell in suite(name)} <= {cell.id for cell in every}, name
        assert len({cell.id for cell in suite(name)}) == len(suite(name))
    assert Cell("HalfCheetahLinks", "bayessim").id == "HalfCheetahLinks/bayessim/direct/in_distribution/seed0"


def test_every_estimator_and_the_baselines_are_cells() -> None:
    direct = {cell.estimator for cell in suite("all") if cell.setting == "direct"}
    assert direct == {"prior", "prior_mean", *ESTIMATORS}
    assert {c.estimator for c in suite("all") if c.setting == "gradient_steps"} == {"maml"}
    assert {c.estimator for c in suite("all") if c.setting == "learned_reward"} == {"simopt", "adr"}
    assert {dict(c.values).get("gradient_steps") for c in suite("gradient_steps")} == {None, *range(11)}


@pytest.mark.parametrize("name", ["paper", *(n for n in SUITES if n not in ("quick", "all"))])
def test_every_suite_has_what_its_cells_are_held_against(name: str) -> None:
    """The prior, its mean and laplace, of the direct setting, for each environment, variant and seed."""
    found = {(c.task, c.variant, c.seed, c.estimator) for c in suite(name) if c.setting == "direct"}
    wanted = {(c.task, c.variant, c.seed, e) for c in suite(name) for e in ("prior", "prior_mean", "laplace")}
    assert wanted <= found


def test_suites_are_those_of_the_paper() -> None:
    quick = suite("quick")
    assert len({c.task for c in quick}) == 3
    assert len({c.estimator for c in quick} - {"prior", "prior_mean"}) == 6
    assert {c.seed for c in quick} == {0}
    assert len({(c.task, c.estimator) for c in suite("direct")}) == 9 * 10
    assert len(NINE) == 9
    assert {c.setting for c in suite("paper")} == {
        *("direct", "learned_reward", "gradient_steps", "policy", "policy_learned_reward")
    }
    searched = [c for c in suite("sweep") if c.setting == "sweep"]
    assert {c.split for c in searched} == {"validation"}
    grid = [c for c in searched if (c.task, c.seed) == ("FetchPush", 0)]
    assert [sum(c.estimator == e for c in grid) for e in ("regression", "bayesopt", "maml", "simopt", "adr")] == [
        *(16, 8, 9, 54, 12)
    ]


@pytest.mark.parametrize("estimator", [name for name in ESTIMATORS if name in cells.GRIDS])
def test_sweep_holds_the_defaults(estimator: str) -> None:
    import inspect

    classes = estimator_class(estimator).__mro__[:-1]
    defaults = {p.name: p.default for c in reversed(classes) for p in inspect.signature(c).parameters.values()}
    grids = [dict(c.values) for c in suite("sweep") if c.estimator == estimator]
    assert all(name in defaults for values in grids for name in values)
    assert any(all(defaults[name] == value for name, value in values.items()) for values in grids)


@pytest.mark.parametrize(
    ("pattern", "matched"),
    [
        ("half_cheetah*/adr/*", True),
        ("HalfCheetahLinks/adr", True),
        ("half_cheetah_links/adr/direct/in_distribution/seed0", True),
        ("*/seed0", True),
        ("half_cheetah*/ad", False),
        ("adr", False),
    ],
)
def test_patterns(pattern: str, matched: bool) -> None:
    assert matches(Cell("HalfCheetahLinks", "adr").id, pattern) is matched


def test_the_humanoids_trajectories_are_shorter_unless_asked_for() -> None:
    assert [Cell(task, "adr").horizon for task in ("FetchPush", "HalfCheetahJoints", "HumanoidJoints")] == [
        50,
        250,
        100,
    ]
    assert Cell("HumanoidJoints", "adr", steps=200).horizon == 200


def test_select_keeps_the_order_and_each_cell_once() -> None:
    found = select("quick", ["*/simopt/*", "door/*"])
    assert [c.id for c in found] == [c.id for c in suite("quick") if c.task == "Door" or c.estimator == "simopt"]
