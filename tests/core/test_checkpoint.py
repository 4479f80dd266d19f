"""States on disk: what generic dataclasses hold comes back in its own types and shapes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Generic, TypeVar

import numpy as np
import pytest

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.checkpoint import CheckpointError, load_state, save_state

A, B = TypeVar("A"), TypeVar("B")


@dataclass(frozen=True)
class Weights:
    """Arrays by name."""

    arrays: dict[str, FloatArray]


@dataclass(frozen=True)
class Learned(Generic[A]):
    """What a method has learned."""

    content: A


@dataclass(frozen=True)
class Base(Generic[A]):
    """A state, perhaps before it has learned."""

    learned: Learned[A] | None = None


@dataclass(frozen=True)
class Inherited(Base[B]):
    """Inherits its type variable under another name."""

    round: int = 1


@dataclass(frozen=True)
class Filled(Base[Weights]):
    """Inherits with the variable filled in."""

    more: tuple[int, ...] = ()


@pytest.mark.parametrize(
    ("kind", "made"), [(Base[Weights], Base), (Inherited[Weights], Inherited), (Filled, Filled)], ids=str
)
def test_type_variables_are_filled_in(kind: type, made: type, tmp_path: Path) -> None:
    """Nested, optional and inherited ones; one number stays one number."""
    arrays = {"a.b": np.arange(6.0).reshape(2, 3), "one": np.array(2.0, np.float32)}
    save_state(tmp_path / "state", made(Learned(Weights(arrays))), "mine")
    restored = load_state(tmp_path / "state", kind, "mine")
    assert type(restored) is made
    for name, array in restored.learned.content.arrays.items():
        assert (array.shape, array.dtype) == (arrays[name].shape, arrays[name].dtype)
        np.testing.assert_array_equal(array, arrays[name])
    save_state(tmp_path / "state", made(), "mine")
    assert load_state(tmp_path / "state", kind, "mine") == made()
    with pytest.raises(CheckpointError, match="belongs to another run"):
        load_state(tmp_path / "state", kind, "other")
