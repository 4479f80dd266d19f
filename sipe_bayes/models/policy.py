"""Policies on disk and at work: a deterministic actor as one safetensors file, run by NumPy.

A policy maps what ``sipe.make(task)`` returns as an observation to an action in the task's own units. Observations of
tasks with goals end in the achieved and the desired goal (Fetch: 25 + 3 + 3), so that one array is all that it sees.
The actor is an MLP: x -> ReLU(W x + b) in the hidden layers, then middle + half range * tanh(W x + b). With statistics
of the observations it sees clip((x - mean) / scale, -clip, clip) in place of x.

The file holds ``weight.0``, ``bias.0``, ... in float32, perhaps ``observation.mean`` and ``observation.scale``, and one
JSON text as its metadata: sizes, action range, the task's name, and the checksum of the arrays. Reading it runs no code
from it.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import safe_open
from safetensors.numpy import save

from sipe_bayes.core.arrays import Float32Array, FloatArray
from sipe_bayes.core.files import LineError, is_file, reading, write_bytes

Controller = Callable[[FloatArray], FloatArray]
"""Actions (B, A) of observations (B, O)."""

FORMAT = "sipe_bayes.policy/1"


class PolicyError(LineError):
    """A policy's file that cannot be used."""


@dataclass(frozen=True, eq=False)
class Policy:
    """A deterministic actor.

    Args:
        task: the name of the task whose observations (B, O) it acts on.
        layers: weight (out, in) and bias (out,) of each layer in float32, the last one's out being A.
        action_low, action_high: bounds of every action.
        mean, scale: (O,) of the observations, or None where they are taken as they come.
        clip: bound of a normalised observation.
        goal_size: numbers at an observation's end that are the desired goal; as many before them are the achieved one;
            0 without goals.
    """

    task: str
    layers: tuple[tuple[Float32Array, Float32Array], ...]
    action_low: float
    action_high: float
    mean: Float32Array | None = None
    scale: Float32Array | None = None
    clip: float = 5.0
    goal_size: int = 0

    @property
    def observation_size(self) -> int:
        """O."""
        return int(self.layers[0][0].shape[1])

    @property
    def action_size(self) -> int:
        """A."""
        return int(self.layers[-1][0].shape[0])

    def __call__(self, observations: FloatArray) -> FloatArray:
        """Actions (B, A) of observations (B, O), or (A,) of (O,); raises ValueError for other sizes."""
        x = np.asarray(observations, np.float32)
        if x.ndim not in (1, 2) or x.shape[-1] != self.observation_size:
            raise ValueError(
                f"observations: expected (B, {self.observation_size}), got {x.shape}; this policy is for {self.task}"
            )
        if self.mean is not None and self.scale is not None:
            x = np.clip((x - self.mean) / self.scale, -self.clip, self.clip)
        for weight, bias in self.layers[:-1]:
            x = np.maximum(x @ weight.T + bias, 0)
        weight, bias = self.layers[-1]
        half, middle = (self.action_high - self.action_low) / 2, (self.action_high + self.action_low) / 2
        return np.asarray(middle + half * np.tanh((x @ weight.T + bias).astype(float)))

    @property
    def checksum(self) -> str:
        """Of the arrays, as the file has it."""
        return _checksum(self._arrays())

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write one safetensors file, atomically; missing folders are made."""
        arrays = self._arrays()
        header = {
            "format": FORMAT,
            "task": self.task,
            "sizes": [self.observation_size, *(len(bias) for _, bias in self.layers)],
            "action_low": self.action_low,
            "action_high": self.action_high,
            "normalised": self.mean is not None,
            "clip": self.clip,
            "goal_size": self.goal_size,
            "sha256": self.checksum,
        }
        write_bytes(Path(path), save(arrays, {"policy": json.dumps(header)}))

    def _arrays(self) -> dict[str, Float32Array]:
        arrays = {}
        for i, (weight, bias) in enumerate(self.layers):
            arrays[f"weight.{i}"], arrays[f"bias.{i}"] = np.ascontiguousarray(weight), np.ascontiguousarray(bias)
        if self.mean is not None and self.scale is not None:
            arrays["observation.mean"], arrays["observation.scale"] = self.mean, self.scale
        return arrays


def load_policy(path: str | os.PathLike[str], task: str | None = None) -> Policy:
    """Read what ``Policy.save`` wrote.

    Args:
        path: the file.
        task: the name of the task that it must be for, or None.

    Raises:
        FileNotFoundError: where there is none.
        PolicyError: for a file that is cut short, altered, of other shapes than it says, or for another task.
    """
    file = Path(path)
    if not is_file(file):
        raise FileNotFoundError(f"{file}: no such policy; train one with `sipe train`")
    header, arrays = _read(file)
    with reading(file, "a policy's header", "save the policy again", PolicyError):
        sizes, normalised = [int(n) for n in header["sizes"]], bool(header["normalised"])
        settings = {key: float(header[key]) for key in ("action_low", "action_high", "clip")}
        name, goal_size, checksum = str(header["task"]), int(header["goal_size"]), str(header["sha256"])
    _check_shapes(file, arrays, sizes, normalised)
    if _checksum(arrays) != checksum:
        raise PolicyError(f"{file}: does not match its checksum; it was altered, get it again")
    if task is not None and name != task:
        raise PolicyError(f"{file}: expected a policy for {task}, got one for {name}")
    layers = tuple((arrays[f"weight.{i}"], arrays[f"bias.{i}"]) for i in range(len(sizes) - 1))
    mean, scale = arrays.get("observation.mean"), arrays.get("observation.scale")
    return Policy(name, layers, mean=mean, scale=scale, goal_size=goal_size, **settings)


def _read(file: Path) -> tuple[dict[str, Any], dict[str, Float32Array]]:
    with reading(file, "a whole safetensors file", "get it again", PolicyError):
        with safe_open(file, framework="numpy") as content:
            metadata = content.metadata() or {}
            arrays = {key: content.get_tensor(key) for key in content.keys()}  # noqa: SIM118 (not a dict)
        header = json.loads(metadata.get("policy", "null"))
    if not isinstance(header, dict) or header.get("format") != FORMAT:
        raise PolicyError(f"{file}: expected a policy of format {FORMAT!r}; save it again with policy.save(path)")
    return header, arrays


def _check_shapes(file: Path, arrays: dict[str, Float32Array], sizes: list[int], normalised: bool) -> None:
    if len(sizes) < 2 or min(sizes) < 1:
        raise PolicyError(f"{file}: expected the sizes of at least one layer, got {sizes}")
    expected: dict[str, tuple[int, ...]] = {}
    for i, (before, after) in enumerate(pairwise(sizes)):
        expected[f"weight.{i}"], expected[f"bias.{i}"] = (after, before), (after,)
    if normalised:
        expected["observation.mean"] = expected["observation.scale"] = (sizes[0],)
    if arrays.keys() != expected.keys():
        raise PolicyError(f"{file}: expected the arrays {sorted(expected)}, got {sorted(arrays)}")
    for name, shape in expected.items():
        if arrays[name].shape != shape or arrays[name].dtype != np.float32:
            raise PolicyError(
                f"{file}: {name}: expected shape {shape} of float32, got {arrays[name].shape} of {arrays[name].dtype}"
            )


def _checksum(arrays: dict[str, Float32Array]) -> str:
    digest = hashlib.sha256()
    for name in sorted(arrays):
        digest.update(name.encode() + arrays[name].tobytes())
    return digest.hexdigest()
