"""A search's state on disk: a frozen dataclass as one safetensors file, numbers and text in its JSON header.

Fields may be arrays, tensors, numbers, text, booleans, None, enumerations, ``Finding``-like plain dictionaries of JSON,
other frozen dataclasses, and tuples or dictionaries by name of all these. The dataclass that is asked for says how to
read them; nothing in the file does. Of a union of dataclasses it is the one whose fields are there. Results of single
pieces of work are kept in the same form (``Kept``).
"""

from __future__ import annotations

import dataclasses
import enum
import hashlib
import json
import time
import types
import typing
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Generic, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray
from safetensors import safe_open
from safetensors.numpy import save
from torch import Tensor, from_numpy

from sipe_bayes.core.files import LineError, reading, write_bytes
from sipe_bayes.core.findings import Finding


class CheckpointError(LineError):
    """A checkpoint that cannot be read or belongs to another run."""


class SearchState(Protocol):
    """What every method's state is: a frozen dataclass that says whether the search has ended."""

    __dataclass_fields__: ClassVar[dict[str, Any]]

    @property
    def done(self) -> bool:
        """Whether it has."""


S = TypeVar("S")


@dataclass(frozen=True)
class Snapshot(Generic[S]):
    """A state with what was counted and noticed when it was made: what a checkpoint holds."""

    state: S
    rollouts: int
    findings: tuple[Finding, ...]
    diagnostics: str  # JSON


def save_state(path: Path, state: object, fingerprint: str) -> None:
    """Write a state.

    Args:
        path: the file.
        state: a frozen dataclass.
        fingerprint: which run it belongs to.
    """
    arrays: dict[str, Any] = {}
    plain = _flattened("", state, arrays)
    arrays.setdefault("_", np.zeros(1))  # safetensors wants at least one
    text = json.dumps(plain)
    metadata = {"plain": text, "fingerprint": fingerprint, "sha256": checksum(arrays, text)}
    write_bytes(path, save(arrays, metadata=metadata))


class Stored(Generic[S]):
    """A search's file, which holds the last state that the end of the budget had not touched.

    Args:
        path: of the file; None for none.
        fingerprint: which run it belongs to.
        first: the state to begin with.
        seconds: from one writing to the next.
    """

    def __init__(self, path: Path | None, fingerprint: str, first: S, seconds: float) -> None:
        self.path, self.fingerprint, self.last, self.seconds = path, fingerprint, first, seconds
        self._written, self._short = time.monotonic(), False

    def offer(self, state: S, done: bool, short: bool) -> None:
        """A further state; short: whether there would have been more with a larger budget, now or before."""
        self._short = self._short or short
        self.last = self.last if self._short else state
        if done or time.monotonic() - self._written > self.seconds:
            self.write()

    def write(self) -> None:
        """Write what is to be kept."""
        if self.path is not None:
            save_state(self.path, self.last, self.fingerprint)
            self._written = time.monotonic()


class Kept:
    """Results of single pieces of work, a file each: a run that was interrupted makes only those that are not there.

    Args:
        folder: of the files; None to keep nothing.
        fingerprint: of all that the results depend on; those of another are made anew.
        within: what the files' names begin with.
    """

    def __init__(self, folder: Path | None = None, fingerprint: str = "", within: str = "") -> None:
        self.folder, self.fingerprint, self.within = folder, fingerprint, within

    def of(self, name: str, kind: type[S], make: Callable[[Kept], S]) -> S:
        """What is kept, or else made now and kept.

        Args:
            name: of the piece of work.
            kind: of the result: a dataclass, or a tuple or dictionary of what states hold.
            make: called with what keeps the parts of the result until it is whole.
        """
        if self.folder is None:  # laid out in memory as what is read is: sums of it have the same bits
            arrays: dict[str, Any] = {}
            return typing.cast(S, _restored("", _flattened("", make(self), arrays), kind, arrays))
        whole = f"{self.within}{name}"
        path = self.folder / f"{whole}.safetensors"
        if path.exists():
            try:
                return load_state(path, kind, self.fingerprint)
            except CheckpointError:  # of another run, or damaged
                pass
        save_state(path, make(Kept(self.folder, self.fingerprint, f"{whole}.")), self.fingerprint)
        for part in self.folder.glob(f"{whole}.*.safetensors"):
            part.unlink(missing_ok=True)  # another run in this folder may have been faster
        return load_state(path, kind, self.fingerprint)

    def under(self, name: str) -> Kept:
        """For pieces of work that go by the same names as others."""
        return Kept(self.folder, self.fingerprint, f"{self.within}{name}.")


NOTHING_KEPT = Kept()


def fingerprint_of(*content: object) -> str:
    """Of anything that states hold: the same has the same, in another process too."""
    arrays: dict[str, Any] = {}
    return checksum(arrays, json.dumps(_flattened("", content, arrays)))


def load_state(path: Path, kind: type[S], fingerprint: str) -> S:
    """Read what ``save_state`` wrote.

    Args:
        path: the file.
        kind: the dataclass of the state.
        fingerprint: which run it has to belong to.

    Raises:
        CheckpointError: when it is corrupt, of another version, or belongs to another run.
    """
    remedy = "it is damaged or of another version of sipe_bayes: delete it to start again"
    with reading(path, "a checkpoint", remedy, CheckpointError):
        with safe_open(path, framework="numpy") as file:
            metadata = file.metadata()
            arrays = {k: file.get_tensor(k) for k in file.keys()}  # noqa: SIM118
        if metadata["fingerprint"] != fingerprint:
            raise CheckpointError(f"checkpoint {path}: belongs to another run; choose another folder or delete it")
        if metadata["sha256"] != checksum(arrays, metadata["plain"]):
            raise ValueError("does not match its checksum")
        arrays.pop("_", None)
        return typing.cast(S, _restored("", json.loads(metadata["plain"]), kind, arrays))


def checksum(arrays: Mapping[str, NDArray[np.generic]], text: str) -> str:
    """Of what a checkpoint holds: its arrays by name, and the JSON beside them."""
    digest = hashlib.sha256(text.encode())
    for name in sorted(arrays):
        digest.update(f"{name} {arrays[name].dtype} {arrays[name].shape}".encode())
        digest.update(arrays[name].tobytes())
    return digest.hexdigest()


def _flattened(name: str, value: Any, arrays: dict[str, Any]) -> Any:
    """The value as JSON; arrays and tensors go into ``arrays`` under their dotted names, and leave None."""
    if isinstance(value, np.ndarray | Tensor):
        arrays[name] = np.asarray(value, order="C")  # ascontiguousarray would give one number an axis
        return None
    if dataclasses.is_dataclass(value):
        fields = {f.name: getattr(value, f.name) for f in dataclasses.fields(value)}
        return {k: _flattened(f"{name}.{k}", v, arrays) for k, v in fields.items()}
    if isinstance(value, enum.Enum):
        return value.name
    if isinstance(value, tuple | list):
        return [_flattened(f"{name}.{k}", v, arrays) for k, v in enumerate(value)]
    if isinstance(value, dict):
        return {k: _flattened(f"{name}.{k}", v, arrays) for k, v in value.items()}
    return value.item() if isinstance(value, np.generic) else value


def _restored(name: str, plain: Any, kind: Any, arrays: dict[str, Any]) -> Any:
    """The value of type ``kind`` that ``_flattened`` made ``plain`` and ``arrays`` of."""
    if name in arrays:
        return from_numpy(arrays[name]) if kind is Tensor else arrays[name]
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin in (types.UnionType, typing.Union):
        if plain is None and not _stored(name, arrays):
            return None
        return _restored(name, plain, _member([a for a in arguments if a is not type(None)], plain), arrays)
    whole = origin if dataclasses.is_dataclass(origin) else kind
    if dataclasses.is_dataclass(whole) and isinstance(whole, type):
        stands_for = _type_variables(kind)
        hints = {k: _filled_in(v, stands_for) for k, v in typing.get_type_hints(whole).items()}
        return whole(
            **{
                f.name: _restored(f"{name}.{f.name}", plain[f.name], hints[f.name], arrays)
                for f in dataclasses.fields(whole)
            }
        )
    if isinstance(kind, type) and issubclass(kind, enum.Enum):
        return kind[plain]
    if origin in (tuple, list):
        items = [arguments[0] if arguments[1:] in ((), (...,)) else arguments[k] for k in range(len(plain))]
        return origin(_restored(f"{name}.{k}", v, items[k], arrays) for k, v in enumerate(plain))
    if origin is dict:
        return {k: _restored(f"{name}.{k}", v, arguments[1], arrays) for k, v in plain.items()}
    if kind is Tensor or origin is np.ndarray:
        raise ValueError(f"{name.lstrip('.')}: expected an array, got a {type(plain).__name__}")
    if kind in (bool, int, float, str) and not isinstance(plain, (int, float) if kind is float else kind):
        raise ValueError(f"{name.lstrip('.')}: expected {kind.__name__}, got a {type(plain).__name__}")
    return plain


def _type_variables(kind: Any) -> dict[Any, Any]:
    """What a generic dataclass's type variables stand for, with those of the generic ones that it inherits from."""
    whole = typing.get_origin(kind) or kind
    stands_for = dict(zip(getattr(whole, "__parameters__", ()), typing.get_args(kind), strict=False))
    for base in vars(whole).get("__orig_bases__", ()):
        if dataclasses.is_dataclass(typing.get_origin(base)):
            stands_for |= _type_variables(_filled_in(base, stands_for))
    return stands_for


def _filled_in(hint: Any, stands_for: dict[Any, Any]) -> Any:
    """A type in which type variables are replaced by what they stand for, also in ``Learned[T] | None``."""
    if isinstance(hint, TypeVar):
        return stands_for.get(hint, hint)
    if isinstance(hint, type) or not getattr(hint, "__parameters__", ()):
        return hint
    return hint[tuple(stands_for.get(v, v) for v in hint.__parameters__)]


def _member(kinds: list[Any], plain: Any) -> Any:
    """Of a union the dataclass that has the fields which are stored, else the first."""
    fitting = [k for k in kinds if dataclasses.is_dataclass(k) and isinstance(plain, dict)]
    return next((k for k in fitting if {f.name for f in dataclasses.fields(k)} == plain.keys()), kinds[0])


def _stored(name: str, arrays: dict[str, Any]) -> bool:
    return any(key.startswith(f"{name}.") for key in arrays)
