"""Parameters and trajectories: theta and values go round, files read back exactly, wrong input is named."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sipe_bayes.core.parameters import Parameter, ParameterSpace
from sipe_bayes.core.trajectory import Trajectories, Trajectory

moderate = st.floats(-1e6, 1e6, allow_nan=False)


@st.composite
def parameters(draw: st.DrawFn) -> Parameter:
    scale = draw(st.sampled_from(["linear", "log"]))
    if scale == "log":
        low = draw(st.floats(1e-6, 1e3))
        return Parameter("x", low, low * draw(st.floats(1.01, 1e4)), scale="log", unit="kg")
    low = draw(moderate)
    return Parameter("x", low, low + draw(st.floats(1e-3, 1e6)), unit="kg")


@given(parameters(), st.lists(st.floats(0, 1), min_size=1, max_size=5))
def test_theta_and_values_go_round(parameter: Parameter, thetas: list[float]) -> None:
    theta = np.array(thetas)
    values = parameter.value(theta)
    span = parameter.high - parameter.low
    assert (values >= parameter.low - 1e-9 * span).all()
    assert (values <= parameter.high + 1e-9 * max(span, abs(parameter.high))).all()
    size = max(abs(parameter.low), abs(parameter.high)) / span if parameter.scale == "linear" else 100
    np.testing.assert_allclose(parameter.normalise(values), theta, atol=1e-14 * (1 + size))
    assert parameter.normalise(parameter.low) == pytest.approx(0, abs=1e-15)
    assert parameter.normalise(parameter.high) == pytest.approx(1, abs=1e-15)


@given(st.lists(parameters(), min_size=1, max_size=4), st.integers(0, 2**32 - 1))
def test_spaces_go_round_and_through_json(items: list[Parameter], seed: int) -> None:
    space = ParameterSpace(Parameter(**{**q.__dict__, "name": f"p{j}"}) for j, q in enumerate(items))
    theta = np.random.default_rng(seed).random((3, 2, len(space)))
    values = space.values(theta)
    assert values.shape == theta.shape
    for j, parameter in enumerate(space):
        np.testing.assert_array_equal(values[..., j], parameter.value(theta[..., j]))
    sizes = [max(abs(q.low), abs(q.high)) / (q.high - q.low) for q in space]
    np.testing.assert_allclose(space.normalise(values), theta, atol=1e-13 * (1 + max(sizes)))
    assert ParameterSpace.from_dict(json.loads(json.dumps(space.to_dict()))) == space
    assert hash(ParameterSpace.from_dict(space.to_dict())) == hash(space)


def test_every_field_goes_through_json() -> None:
    full = Parameter(
        "m",
        0.5,
        2,
        1.0,
        "kg",
        "log",
        ("body:a.mass", "body:b.mass"),
        True,
        "run 1",
        1.1,
        0.2,
        "the rod's mass",
    )
    space = ParameterSpace([full, Parameter("n")])
    assert ParameterSpace.from_dict(json.loads(json.dumps(space.to_dict()))) == space


def test_spaces_are_sequences() -> None:
    space = ParameterSpace([Parameter("a", 0, 2, 0.5, "m"), Parameter("b", 1, 100, scale="log", unit="kg")])
    assert (space.names, space.units, len(space)) == (("a", "b"), ("m", "kg"), 2)
    assert space.index("b") == 1
    assert space.subset(["b", "a"]).names == ("b", "a")
    assert space[0].name == "a"
    assert "a" not in space
    assert space[0] in space
    np.testing.assert_allclose(space.default_theta, [0.25, 0.5])
    np.testing.assert_allclose(space.values([0.5, 0.5]), [1.0, 10.0])
    assert space != ParameterSpace([Parameter("a")])


def test_priors_in_theta() -> None:
    assert Parameter("a").theta_prior == (0.5, math.inf)
    mean, sd = Parameter("a", 0, 4, prior_mean=3, prior_sd=1).theta_prior
    assert (mean, sd) == (0.75, 0.25)
    mean, sd = Parameter("a", 1, math.e**2, scale="log", prior_mean=math.e, prior_sd=0.1 * math.e).theta_prior
    assert (mean, sd) == pytest.approx((0.5, 0.05))


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"name": ""}, "parameter name: expected a non-empty string"),
        ({"low": math.nan}, "parameter 'x': bounds must be finite"),
        ({"high": math.inf}, "bounds must be finite"),
        ({"low": 2}, r"bounds are reversed or empty, got \[2, 1\]; give \[low, high\] with low < high"),
        ({"low": 1}, "bounds are reversed or empty"),
        ({"scale": "cubic"}, "scale must be 'linear' or 'log', got 'cubic'"),
        (
            {"scale": "log"},
            "a log scale needs bounds above zero, got low = 0; raise it or use scale = 'linear'",
        ),
        ({"default": 2, "unit": "kg"}, r"default 2 kg lies outside the bounds \[0, 1\]; widen the bounds"),
        ({"prior_mean": 0.5}, "a normal prior needs both mean and sd"),
        ({"prior_sd": 0.5}, "a normal prior needs both mean and sd"),
        ({"prior_mean": 0.5, "prior_sd": 0.0}, "prior sd must be positive, got 0"),
        ({"prior_mean": 0.5, "prior_sd": math.nan}, "prior sd must be positive, got nan"),
        (
            {"low": 0.1, "scale": "log", "prior_mean": -1, "prior_sd": 1},
            "prior mean must be positive on a log scale, got -1",
        ),
    ],
)
def test_wrong_parameters_are_named(arguments: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        Parameter(**{"name": "x", **arguments})


def test_wrong_spaces_are_named() -> None:
    with pytest.raises(ValueError, match="expected at least one, got none"):
        ParameterSpace([])
    with pytest.raises(ValueError, match=r"the names must differ, but \['a'\] appear more than once"):
        ParameterSpace([Parameter("a"), Parameter("a")])
    space = ParameterSpace([Parameter("a")])
    with pytest.raises(KeyError, match=r"no parameter 'b'; this space has \['a'\]"):
        space.index("b")
    with pytest.raises(ValueError, match=r"expected 1 parameters on the last axis, got shape \(2, 3\)"):
        space.values(np.zeros((2, 3)))
    with pytest.raises(ValueError, match="expected 1 parameters"):
        space.normalise(0.5)


# trajectories


def trajectory(steps: int = 4, seed: int = 0, **more: Any) -> Trajectory:
    rng = np.random.default_rng(seed)
    observations = rng.normal(size=(steps + 1, 2))
    observations[1, 0] = np.nan
    return Trajectory(observations, rng.normal(size=(steps, 1)), more.pop("dt", 0.01), **more)


def assert_same(one: Trajectory, other: Trajectory) -> None:
    np.testing.assert_array_equal(one.observations, other.observations)
    np.testing.assert_array_equal(one.actions, other.actions)
    assert (one.dt, one.name, one.channels) == (other.dt, other.name, other.channels)
    assert (one.states is None) == (other.states is None)
    if one.states is not None:
        np.testing.assert_array_equal(one.states, other.states)


@given(st.lists(st.integers(1, 9), min_size=1, max_size=5), st.booleans())
def test_stacking_and_indexing_go_round(lengths: list[int], with_states: bool) -> None:
    items = [
        trajectory(
            n,
            seed,
            dt=0.01 * (seed + 1),
            name=f"log {seed}",
            channels=("q", "v"),
            states=np.full((n + 1, 3), float(seed)) if with_states else None,
        )
        for seed, n in enumerate(lengths)
    ]
    batch = Trajectories.stack(items)
    assert len(batch) == len(items)
    assert batch.observations.shape == (len(items), max(lengths) + 1, 2)
    for one, other in zip(batch, items, strict=True):
        assert_same(one, other)
    assert_same(batch[-1], items[-1])
    np.testing.assert_array_equal(batch.valid.sum(1), np.array(lengths) + 1)
    assert np.isnan(batch.observations[~batch.valid]).all()
    assert not batch.actions[np.arange(max(lengths)) >= np.array(lengths)[:, None]].any()
    assert Trajectories.stack(batch) is batch
    assert_same(Trajectories.stack(items[0])[0], items[0])


@given(st.integers(0, 4), st.integers(0, 4), st.integers(1, 2))
def test_slices_keep_what_is_valid(start: int, stop: int, step: int) -> None:
    batch = Trajectories.stack([trajectory(n, n, name=str(n)) for n in (5, 3, 7, 2)])
    batch.valid[2, 4:] = False  # a simulation that diverged
    chosen = list(range(4))[start:stop:step]
    if not chosen:
        with pytest.raises(ValueError, match="expected to choose at least one of 4, got none"):
            batch[start:stop:step]
        return
    for part in (batch[start:stop:step], batch[chosen], batch[np.array(chosen)]):
        assert part.names == tuple(batch.names[i] for i in chosen)
        assert part.observations.shape[1] == part.length.max() + 1
        for k, i in enumerate(chosen):
            assert_same(part[k], batch[i])
            np.testing.assert_array_equal(part.valid[k], batch.valid[i, : part.valid.shape[1]])
    mask = np.isin(np.arange(4), chosen)
    np.testing.assert_array_equal(batch[mask].length, batch.length[mask])


@pytest.mark.parametrize("with_states", [True, False])
def test_files_read_back_exactly(tmp_path: Path, with_states: bool) -> None:
    states = {5: np.ones((6, 4)), 3: np.zeros((4, 4))} if with_states else {}
    batch = Trajectories.stack(
        [trajectory(n, n, name=f"größe {n}", channels=("q", "v"), states=states.get(n)) for n in (5, 3)]
    )
    batch.valid[0, 2:] = False
    for name in ("log.npz", "log"):  # the name is kept as given
        path = tmp_path / name
        batch.save(path)
        batch.save(path)
        other = Trajectories.load(path)
        for one, two in zip(batch, other, strict=True):
            assert_same(one, two)
        np.testing.assert_array_equal(other.valid, batch.valid)
        assert (other.names, other.channels) == (batch.names, batch.channels)
    assert sorted(f.name for f in tmp_path.iterdir()) == ["log", "log.npz"]


def test_a_failed_save_leaves_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, batch = tmp_path / "log.npz", Trajectories.stack(trajectory())
    batch.save(path)
    before = path.read_bytes()

    def fail(*_: Any, **__: Any) -> None:
        raise OSError("no space left")

    monkeypatch.setattr(np, "savez_compressed", fail)
    with pytest.raises(OSError, match="no space left"):
        batch.save(path)
    assert path.read_bytes() == before
    assert [f.name for f in tmp_path.iterdir()] == ["log.npz"]


@pytest.mark.parametrize("content", [b"", b"time,angle\n0,1\n", b"PK\x03\x04 not a zip"])
def test_other_files_are_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "other"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"other: cannot be read as trajectories .*; write them again"):
        Trajectories.load(path)


def test_other_arrays_are_refused(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", x=np.zeros(3))
    with pytest.raises(ValueError, match=r"a.npz: .*expected the arrays \['actions'.*got \['x'\]"):
        Trajectories.load(tmp_path / "a.npz")
    np.save(tmp_path / "b.npy", np.zeros(3))
    with pytest.raises(ValueError, match=r"b.npy: cannot be read as trajectories"):
        Trajectories.load(tmp_path / "b.npy")
    np.savez(tmp_path / "c.npz", observations=np.array([{}], dtype=object), allow_pickle=True)
    with pytest.raises(ValueError, match=r"c.npz: cannot be read as trajectories"):
        Trajectories.load(tmp_path / "c.npz")
    with pytest.raises(FileNotFoundError):
        Trajectories.load(tmp_path / "none.npz")


def test_a_trajectory_is_cut_with_both_ends() -> None:
    whole = trajectory(5, states=np.arange(12.0).reshape(6, 2), name="log", channels=("q", "v"))
    part = whole.slice(1, 4)
    assert len(part) == 3
    np.testing.assert_array_equal(part.observations, whole.observations[1:5])
    np.testing.assert_array_equal(part.actions, whole.actions[1:4])
    np.testing.assert_array_equal(part.states, whole.states[1:5])  # type: ignore[index]
    assert (part.name, part.channels, part.dt) == ("log", ("q", "v"), 0.01)
    np.testing.assert_allclose(part.time, [0, 0.01, 0.02, 0.03])
    assert_same(whole.slice(0, 5), whole)


OBSERVED, ACTED = np.zeros((4, 2)), np.zeros((3, 1))


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (
            (np.zeros((3, 2)), ACTED, 0.01),
            r"expected observations \(T\+1, O\) and actions \(T, A\), got \(3, 2\)",
        ),
        ((OBSERVED, np.zeros(3), 0.01), r"expected observations \(T\+1, O\) and actions \(T, A\)"),
        ((np.zeros((1, 2)), np.zeros((0, 1)), 0.01), "expected at least one control step, got none"),
        ((OBSERVED, ACTED, 0.0), "dt must be positive, got 0"),
        ((OBSERVED, ACTED, np.nan), "dt must be positive, got nan"),
        ((OBSERVED, ACTED, np.inf), "dt must be positive, got inf"),
        ((OBSERVED, np.full((3, 1), np.nan), 0.01), "actions must be finite, got 3 that are not"),
        ((OBSERVED, ACTED, 0.01, np.zeros((3, 5))), r"expected states \(4, S\), got \(3, 5\)"),
        ((OBSERVED, ACTED, 0.01, np.zeros(4)), r"expected states \(4, S\), got \(4,\)"),
        ((OBSERVED, ACTED, 0.01, None, "log", ("q",)), "trajectory 'log': 1 channel names for 2 channels"),
    ],
)
def test_wrong_trajectories_are_named(arguments: tuple[Any, ...], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        Trajectory(*arguments)


@pytest.mark.parametrize(("start", "stop"), [(2, 2), (3, 1), (-1, 2), (0, 6)])
def test_wrong_cuts_are_named(start: int, stop: int) -> None:
    with pytest.raises(ValueError, match=f"expected 0 <= start < stop <= 5, got {start} and {stop}"):
        trajectory(5).slice(start, stop)


@pytest.mark.parametrize(
    ("items", "words"),
    [
        ([], "expected at least one, got none"),
        (
            [trajectory(), Trajectory(OBSERVED[:, :1], ACTED, 0.01)],
            r"differ in \(observation, action\) sizes",
        ),
        ([trajectory(channels=("a", "b")), trajectory(channels=("b", "a"))], "differ in their channels"),
        (
            [trajectory(states=np.zeros((5, 2))), trajectory(states=np.zeros((5, 3)))],
            r"differ in the size of their states: \[2, 3\]",
        ),
    ],
)
def test_wrong_batches_are_named(items: list[Trajectory], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        Trajectories.stack(items)
