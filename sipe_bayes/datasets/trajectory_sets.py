"""Trajectory sets: the benchmark's trajectories, simulated once, stored compactly, and read without a simulation.

A set is one file, ``TASK/VARIANT-SPLIT-TYPE.npz``: five trajectories of one agent in one variant of an environment.
What is stored is what counts: a long contact-rich motion that is replayed on another processor drifts apart. So a file
holds the motion itself: starting states and goals in float64, all later states, the actions and the rewards in float32.
The time is not stored (it is k dt), nor are the observations: they follow from the states. Where an environment reads
more than the state (the humanoid's forces, the hand's palm), sample k+1 has what one control step from the stored state
k under the stored action k gives: no error outlives a step. Measured on the random agent's sets against the
observations at the simulation, root mean square in each channel's sd: 1e-7 at the median and, in the worst channel,
3e-7 (hand), 4e-6 (humanoid, a contact's torque), 9e-6 (Fetch, an object that hardly moves). That is float32's rounding.

float32 numbers are kept as their four bytes apart, the time as the last axis: neighbours share exponents, so that
deflate saves another eighth. Files hold no time stamp and no pickle: the same command on the same versions and kind of
processor gives the same bytes. ``manifest.json`` is the one list of them: size, SHA-256, count, steps, seed, parameter
values, versions, command.

The half-cheetah's default variant is one model whatever is unknown about it, so HalfCheetahLinks' files serve for the
others. HumanoidJoints has springs of 0.001 N m/rad where HumanoidLinks has none: each has its own.

The benchmark is that of A User's Guide to Calibrating Robotics Simulators, Mehta, Handa, Fox and Ramos, 2020,
https://arxiv.org/abs/2011.08985, which released no trajectories; sizes and formats are this library's own.
"""

from __future__ import annotations

import hashlib
import io
import os
import platform
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.files import DATA, LineError, read_arrays, read_json, reading, to_json, write_bytes, write_text
from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.datasets.acting import AGENTS, SPLITS, Agent, Split
from sipe_bayes.envs.task import VARIANTS, Variant
from sipe_bayes.simulation.simulator import Simulator

IN_PACKAGE = Path(__file__).parent / "trajectories"
"""The manifest of the sets that are released, and, in a source tree, their files."""
"""Names the folder in which ``trajectories`` is looked for."""
FORMAT = "sipe_bayes.trajectories/1"
MANIFEST = "manifest.json"
TASKS = (  # the benchmark's
    *("FetchPush", "FetchSlide", "FetchPickAndPlace", "Relocate", "Door"),
    *("HalfCheetahLinks", "HalfCheetahJoints", "HumanoidLinks", "HumanoidJoints"),
)
COUNT = 5
"""Trajectories of a set."""
_SHARED = {
    "HalfCheetahJoints": "HalfCheetahLinks",
    "HalfCheetahAllJoints": "HalfCheetahLinks",  # in the default variant
}
_REMEDY = (
    "`sipe data install ARCHIVE` stores the release's, `sipe data generate --out DIR/trajectories` simulates anew for "
    f"{DATA}=DIR"
)


class TrajectorySetError(LineError):
    """A file of a trajectory set, or the manifest, that cannot be used."""


@dataclass(frozen=True)
class SetName:
    """Which trajectories: of which task, variant, split and type of agent; the task is the one whose file it is."""

    task: str
    variant: Variant
    split: Split
    type: Agent

    def __post_init__(self) -> None:
        if self.variant == "default":
            object.__setattr__(self, "task", _SHARED.get(self.task, self.task))

    @property
    def file(self) -> str:
        """Its path in a folder of sets."""
        return f"{self.task}/{self.variant}-{self.split}-{self.type}.npz"


@dataclass(frozen=True)
class Origin:
    """What a set was made with besides its name: seed, SHA-256 of the agent's file (empty for none), command."""

    seed: int
    agent_sha256: str = ""
    command: str = ""


@dataclass(frozen=True)
class Entry:
    """What the manifest says of a file.

    Args:
        sha256: of the file.
        bytes: its size.
        count: trajectories.
        steps: control steps.
        values: of the variant's parameters.
        seed: of the trajectories.
        agent_sha256: of the agent's file, empty for none.
        command: that made it.
        versions: what the bits depend on.
    """

    sha256: str
    bytes: int
    count: int = 0
    steps: int = 0
    values: tuple[float, ...] = ()
    seed: int = 0
    agent_sha256: str = ""
    command: str = ""
    versions: dict[str, str] | None = None


def data_folder() -> Path:
    """Where data outside the package is kept: what SIPE_BAYES_DATA names, else the user's cache."""
    cache = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(os.environ.get(DATA) or Path(cache) / "sipe_bayes")


def shipped() -> Path:
    """The folder of the released sets: below SIPE_BAYES_DATA, where it is set, else of the source tree or the cache.

    Without any of their files it is the package's own, whose manifest says what is missing.
    """
    kept = data_folder() / "trajectories"
    in_tree = next(IN_PACKAGE.glob("*/*.npz"), None) is not None
    return kept if os.environ.get(DATA) or (not in_tree and (kept / MANIFEST).is_file()) else IN_PACKAGE


def names(
    tasks: Sequence[str] = TASKS,
    variants: Sequence[Variant] = VARIANTS,
    splits: Sequence[Split] = SPLITS,
    types: Sequence[Agent] = AGENTS,
) -> Iterator[SetName]:
    """All sets of these, each file once."""
    every = (SetName(task, v, s, t) for task in tasks for v in variants for s in splits for t in types)
    return iter(dict.fromkeys(every))


def manifest(folder: Path) -> dict[str, Entry]:
    """What a folder's manifest says of each file, nothing without one; raises TrajectorySetError for a damaged one."""
    path = folder / MANIFEST
    if not path.is_file():
        return {}
    what = f"a manifest of {FORMAT}"
    plain = read_json(path, what, _REMEDY, TrajectorySetError)
    with reading(path, what, _REMEDY, TrajectorySetError):
        if plain["format"] != FORMAT:
            raise ValueError(f"its format is {plain['format']!r}")
        return TypeAdapter(dict[str, Entry]).validate_python(plain["sets"])


def entry_of(folder: Path, name: SetName, simulator: Simulator) -> Entry | None:
    """The manifest's entry of a set that was made with a task's parameter values; None where there is no such set."""
    entry = manifest(folder).get(name.file)
    shared = name.task != simulator.task.name  # the values are another task's
    return entry if entry is not None and (shared or fits(entry, simulator, name.variant)) else None


def fits(entry: Entry, simulator: Simulator, variant: Variant) -> bool:
    """Whether a set was made with the values that a variant has today."""
    return list(entry.values) == _values(simulator, variant)


def _values(simulator: Simulator, variant: Variant) -> list[float]:
    return [p.value(t) for p, t in zip(simulator.space, simulator.task.theta(variant).tolist(), strict=True)]


# Writing


def write(
    folder: Path,
    name: SetName,
    simulator: Simulator,
    trajectories: Trajectories,
    goals: FloatArray | None,
    origin: Origin,
) -> Entry:
    """Store trajectories and enter them in the manifest.

    Args:
        folder: of sets.
        name: of the set.
        simulator: of its task.
        trajectories: of equal length, with states and rewards.
        goals: (B, G), where there are any.
        origin: what else there is to say of them.

    Returns:
        The manifest's entry.
    """
    assert trajectories.states is not None
    assert trajectories.rewards is not None
    arrays: dict[str, NDArray[Any]] = {
        "start": trajectories.states[:, 0],
        "states": _planes(trajectories.states[:, 1:, 1:]),  # the time is left out
        "actions": _planes(trajectories.actions),
        "rewards": trajectories.rewards.astype(np.float32),
        "dt": np.asarray(trajectories.dt[0], np.float64),
    }
    if goals is not None:
        arrays["goals"] = goals
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)  # type: ignore[arg-type]
    content = buffer.getvalue()
    write_bytes(folder / name.file, content)
    entry = Entry(
        sha256=hashlib.sha256(content).hexdigest(),
        bytes=len(content),
        count=len(trajectories),
        steps=trajectories.actions.shape[1],
        values=tuple(_values(simulator, name.variant)),
        **asdict(origin),
        versions=versions(),
    )
    sets = {file: asdict(kept) for file, kept in sorted({**manifest(folder), name.file: entry}.items())}
    write_text(folder / MANIFEST, to_json({"format": FORMAT, "sets": sets}, indent=1))
    return entry


def versions() -> dict[str, str]:
    """What the bits of a simulation, and of a file, depend on."""
    return {
        "mujoco": mujoco.__version__,
        "numpy": np.__version__,
        "zlib": zlib.ZLIB_RUNTIME_VERSION,
        "python": platform.python_version(),
        "platform": f"{platform.system()} {platform.machine()} {_processor()}".strip(),
    }


def _processor() -> str:
    """The processor's model, as Linux tells it."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor()
    return next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), "")


def _planes(values: FloatArray) -> NDArray[np.uint8]:
    """(B, T, C) as float32, byte by byte: (4, B, C, T)."""
    single = np.ascontiguousarray(np.moveaxis(values, 1, -1), dtype="<f4")
    return np.ascontiguousarray(np.moveaxis(single.view(np.uint8).reshape(*single.shape, 4), -1, 0))


def _joined(planes: NDArray[np.uint8]) -> FloatArray:
    """(B, T, C) of what ``_planes`` made."""
    single = np.ascontiguousarray(np.moveaxis(planes, 0, -1)).view("<f4")[..., 0]
    return np.moveaxis(single, -1, 1).astype(np.float64)


# Reading


def read(folder: Path, name: SetName, simulator: Simulator, count: int, steps: int) -> Trajectories:
    """The first trajectories of a set, with states and rewards, as of the variant's parameters.

    Args:
        folder: of sets.
        name: of the set.
        simulator: of its task.
        count: trajectories.
        steps: control steps of each.

    Raises:
        TrajectorySetError: for a file that is not as the manifest says; it names the file.
    """
    arrays = _arrays(folder, name.file)
    start, goals = arrays["start"][:count], arrays["goals"][:count] if "goals" in arrays else None
    actions = np.ascontiguousarray(_joined(arrays["actions"])[:count, :steps])
    states = np.concatenate([start[:, None, 1:], _joined(arrays["states"])[:count, :steps]], axis=1)
    dt = float(arrays["dt"])
    time = start[:, :1] + dt * np.arange(states.shape[1])
    states = np.concatenate([time[..., None], states], axis=-1)
    task = simulator.task
    if states.shape[-1] != simulator.state_size or actions.shape[-1] != task.num_actions:
        raise TrajectorySetError(
            f"{folder / name.file}: expected {simulator.state_size} numbers of state and {task.num_actions} of action "
            f"for {task.name}, got {states.shape[-1]} and {actions.shape[-1]}; {_REMEDY}"
        )
    observations = _observations(simulator, task.theta(name.variant), states, actions, goals)
    return Trajectories(
        observations,
        actions,
        np.full(count, dt),
        np.full(count, actions.shape[1]),
        np.ones(states.shape[:2], bool),
        states,
        tuple(f"{name.split}_{i}" for i in range(count)),
        task.channels,
        arrays["rewards"][:count, :steps].astype(np.float64),
    )


def _arrays(folder: Path, file: str) -> dict[str, NDArray[Any]]:
    """What a file holds, checked against the manifest before it is opened."""
    path, entry = folder / file, manifest(folder)[file]
    try:
        content = path.read_bytes()
    except OSError as error:
        raise TrajectorySetError(f"{path}: cannot be read ({error.strerror}); {_REMEDY}") from None
    if len(content) != entry.bytes:
        raise TrajectorySetError(
            f"{path}: expected {entry.bytes} bytes, got {len(content)}: cut short or another file; {_REMEDY}"
        )
    if hashlib.sha256(content).hexdigest() != entry.sha256:
        raise TrajectorySetError(f"{path}: its SHA-256 is not the manifest's: corrupted or altered; {_REMEDY}")
    with reading(path, "an npz file", _REMEDY, TrajectorySetError):
        arrays = read_arrays(io.BytesIO(content))
    missing = {"start", "states", "actions", "rewards", "dt"} - arrays.keys()
    if missing:
        raise TrajectorySetError(f"{path}: holds no {', '.join(sorted(missing))}; {_REMEDY}")
    return arrays


def _observations(
    simulator: Simulator, theta: FloatArray, states: FloatArray, actions: FloatArray, goals: FloatArray | None
) -> FloatArray:
    """Observations (B, T+1, O) of states (B, T+1, S)."""
    task = simulator.environment
    if not task.needs_derived:
        return task.observe(simulator.model, states, None, None if goals is None else goals[:, None])
    batch, steps, _ = actions.shape
    windows = simulator.rollout(
        theta,
        actions.reshape(batch * steps, 1, -1),
        states[:, :-1].reshape(batch * steps, -1),
        allow_outside=True,
        goals=None if goals is None else np.repeat(goals, steps, axis=0),
    )
    seen = windows.observations.reshape(batch, steps, 2, -1)
    after = np.concatenate([seen[:, :1, 0], seen[:, :, 1]], axis=1)
    for channel, column in enumerate(task.state_columns(simulator.model)):
        if column is not None:
            after[..., channel] = states[..., column]
    return after


def verify(folder: Path) -> list[str]:
    """What is wrong with a folder's files, one line each; raises TrajectorySetError where there is no manifest."""
    sets = manifest(folder)
    if not sets:
        raise TrajectorySetError(f"{folder}: no {MANIFEST} there; name a folder that `sipe data generate` filled")
    wrong = []
    for file in sets:
        try:
            _arrays(folder, file)
        except TrajectorySetError as error:
            wrong.append(str(error))
    present = {path.relative_to(folder).as_posix() for path in folder.rglob("*.npz")}
    return wrong + [f"{folder / file}: not in the manifest; delete it" for file in sorted(present - sets.keys())]
