"""An estimator's state on disk: one safetensors file, numbers and text in its JSON header, written atomically."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from sipe_bayes.core.files import write_bytes

State = dict[str, Any]
"""Arrays, numbers, text, booleans and lists of text by name; nothing nested."""


class CheckpointError(ValueError):
    """A checkpoint that cannot be read or belongs to another run."""


def save_state(path: Path, state: State, fingerprint: str) -> None:
    """Write ``state`` to ``path``; ``fingerprint`` says which run it belongs to."""
    arrays = {k: np.ascontiguousarray(v) for k, v in state.items() if isinstance(v, np.ndarray)}
    plain = {k: v for k, v in state.items() if not isinstance(v, np.ndarray)}
    arrays.setdefault("_", np.zeros(1))  # safetensors wants at least one
    data = save(arrays, metadata={"plain": json.dumps(plain), "fingerprint": fingerprint})
    write_bytes(path, data)


def load_state(path: Path, fingerprint: str) -> State:
    """Read what ``save_state`` wrote; raises CheckpointError when it is corrupt or belongs to another run."""
    try:
        with safe_open(path, framework="numpy") as file:
            metadata = file.metadata()
            state: State = {k: file.get_tensor(k) for k in file.keys() if k != "_"}  # noqa: SIM118
        state.update(json.loads(metadata["plain"]))
    except (SafetensorError, KeyError, TypeError, json.JSONDecodeError, OSError) as error:
        raise CheckpointError(f"checkpoint {path}: cannot be read ({error}); delete it to start again") from None
    if metadata["fingerprint"] != fingerprint:
        raise CheckpointError(f"checkpoint {path}: belongs to another run; choose another folder or delete it")
    return state
